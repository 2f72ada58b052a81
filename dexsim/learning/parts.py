"""Checks of the parts of a checkpoint: types, sizes and finite weights, told in one line where one is not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import msgspec
import torch
from torch import Tensor

from dexsim import typed
from dexsim.errors import UserError
from dexsim.learning.names import leaves
from dexsim.typed import Count

Size = Annotated[int, msgspec.Meta(ge=1, le=10**6)]
Group = dict[str, Any]


class Layout(msgspec.Struct):
    """See :func:`dexsim.learning.checkpoint.layout_of`."""

    joints: list[str]
    action: list[list[str | float]]
    observations: dict[str, list[tuple[str, Size]]]


class Git(msgspec.Struct):
    """See :func:`dexsim.learning.checkpoint.git_state`."""

    commit: str
    dirty: bool | None  # None: not known, of a commit that was written in afterwards
    note: str = ""


class Optimizer(msgspec.Struct):
    """A torch optimizer's state dict."""

    state: dict[int, Group]
    param_groups: list[Group]


class Random(msgspec.Struct):
    """See :func:`dexsim.learning.checkpoint.rng_state`."""

    torch: Tensor
    cuda: list[Tensor]
    numpy: tuple[str, Tensor, int, int, float]
    python: tuple[int, Tensor, float | None]


class Settings(msgspec.Struct):
    """The parts of a resolved config that every command relies on; what is inside them is checked where it is used."""

    agent: Group
    task: Group
    choices: dict[str, str | None]
    sim: Group = {}
    servo: Group = {}
    tactile: Group = {}
    randomize: Group = {}
    reality: Group | None = None
    seed: Count = 0


class Policy(msgspec.Struct):
    """The parts of a ``policy`` file."""

    kind: Literal["policy", "train"]
    config: Settings
    versions: dict[str, str]
    git: Git
    layout: Layout
    iteration: Count
    steps: Count
    actor: dict[str, torch.Tensor]


class Train(Policy):
    """The parts of a ``train`` file."""

    critic: dict[str, torch.Tensor]
    optimizer: Optimizer
    env: dict[str, Any]
    rng: Random
    worlds: dict[str, torch.Tensor] | None = None
    learner: dict[str, torch.Tensor] | None = None


def check(data: dict[str, Any], path: object) -> None:
    """Raise UserError naming the part of a checkpoint that is not what it must be, and what it is.

    data: with ``config`` as a dict. Weights must be finite, and no tensor larger than the bytes that it was stored in.
    """
    again = "use another checkpoint of its run folder"
    typed.convert(data, Train if data["kind"] == "train" else Policy, f"{path}: damaged checkpoint", again)
    for name, tensor in tensors(data):
        plain = tensor.layout == torch.strided and not tensor.is_quantized and not tensor.is_meta
        if not plain or tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            what = "all of whose numbers are stored (none that is sparse, quantized or expanded)"
            raise UserError(f"{path}: damaged checkpoint, {name} must be a plain tensor, {what}; {again}")
    for group in ("actor", "critic", "learner"):
        for name, tensor in (data.get(group) or {}).items():
            if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
                bad = int((~tensor.isfinite()).sum())
                raise UserError(
                    f"{path}: {group}.{name} holds {bad} of {tensor.numel()} weights that are not finite: learning had"
                    " diverged; use an earlier checkpoint of its run folder"
                )


def tensors(node: Any) -> Iterator[tuple[str, torch.Tensor]]:
    """Yield (dotted name, tensor) of all below a nest of dicts and lists."""
    return ((name, value) for name, value in leaves(node) if isinstance(value, torch.Tensor))
