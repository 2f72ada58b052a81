"""Which classes agent settings may name: rsl-rl imports and calls whatever its settings name, so a checkpoint that
names code of its own would run it. Names come from the lists here, unless the user types them on the command line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Annotated, Any

import msgspec

from dexsim.errors import UserError
from dexsim.typed import convert

MODELS = ("MLPModel", "RNNModel", "CNNModel")
PARTS = ("actor", "critic", "student", "teacher")
DISTRIBUTIONS = ("GaussianDistribution", "HeteroscedasticGaussianDistribution", "BetaDistribution")
ALLOWED: dict[str, tuple[str, ...]] = {
    "class_name": ("OnPolicyRunner", "DistillationRunner"),
    **{f"{part}.class_name": MODELS for part in PARTS},
    **{f"{part}.distribution_cfg.class_name": DISTRIBUTIONS for part in PARTS},
    "algorithm.class_name": ("PPO", "Distillation"),
    "algorithm.symmetry_cfg.data_augmentation_func": ("dexsim.learning.symmetry:augmented",),
    "logger": ("tensorboard",),  # the others send what they log to another machine
}
"""Settings below `agent` that name code, and the names that need no typing; a setting that is not here has none."""
LEAVES = ("class_name", "data_augmentation_func", "logger", "_target_")
"""Last parts of the settings that rsl-rl, or Hydra, turns into code, wherever they stand."""

MOST_LAYERS, MOST_WEIGHTS = 32, 1 << 27
"""Of a network."""
Units = Annotated[int, msgspec.Meta(ge=1, le=16_384)]
"""Of a layer."""

Typed = frozenset[tuple[str, Any]]
"""Settings (whole dotted name, value) that the user typed on the command line."""


def check(agent: dict[str, Any], typed: Iterable[tuple[str, Any]] = (), where: str = "agent settings") -> None:
    """Raise UserError where a setting of `agent` names code that is neither on the lists above nor in `typed`.

    where: whose settings these are (a checkpoint's path), for the message.
    """
    trusted = set(typed)
    for key, value in leaves(agent):
        last = key.rpartition(".")[2]
        if last not in LEAVES or value is None:
            continue
        allowed = ALLOWED.get(key, ())
        if value in allowed or (f"agent.{key}", value) in trusted:
            continue
        text = str(value)[:120]
        known = f"dexsim takes {', '.join(allowed)} from a file" if allowed else "dexsim takes none from a file"
        raise UserError(f"{where}: agent.{key}={text} names code to run, and {known}; only if you trust it, type"
                        f" agent.{key}={text} on the command line")


class Network(msgspec.Struct):
    """What of a part's settings makes its size."""

    hidden_dims: Annotated[list[Units], msgspec.Meta(min_length=1, max_length=MOST_LAYERS)] | None = None
    rnn_hidden_dim: Units | None = None
    rnn_num_layers: Annotated[int, msgspec.Meta(ge=1, le=MOST_LAYERS)] | None = None


def check_sizes(agent: dict[str, Any], where: str = "settings") -> None:
    """Raise UserError where a part would be no network, or one that no memory holds. where: whose settings."""
    parts = {part: agent[part] for part in PARTS if isinstance(agent.get(part), dict)}
    for part, network in convert({"agent": parts}, dict[str, dict[str, Network]], where)["agent"].items():
        sizes = network.hidden_dims or []
        if (weights := sum(a * b for a, b in pairwise(sizes))) > MOST_WEIGHTS:
            text = f"{weights:,.0f} weights; at most {MOST_WEIGHTS:,} are learned"
            raise UserError(f"{where}: agent.{part}.hidden_dims={sizes}: {text}")


def leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of every single value below a nest of dicts and lists; a logger's own mapping is
    looked into too."""
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for name, value in items:
        key = f"{prefix}{name}"
        if isinstance(value, (dict, list, tuple)):
            yield from leaves(value, f"{key}.")
        else:
            yield key, value
