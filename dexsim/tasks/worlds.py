"""The worlds of an environment as a checkpoint keeps them: with them a resumed run is the unbroken one.

Kept is the memory that one control step leaves to the next, by name, and the random state. What a step computes anew
from it (poses, contacts, forces on pads) is not. Each class names its own: `memory()` of engine, servo, touch, objects
and task.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from dexsim.tasks.keeping import Kept

Memory = Mapping[str, "torch.Tensor | tuple[torch.Tensor, int, int]"]
"""Live tensors by name; whole numbers with lowest and highest: they index memory, and a file may hold anything."""
SAME = ("worlds", "task", "sim", "servo", "tactile", "randomize", "model_file", "reality")
"""Settings that must be as they were: other ones hold for new episodes."""


def live(env: Kept) -> dict[str, tuple[torch.Tensor, int, int]]:
    """Return (tensor, lowest, highest) of all memory by name; the bounds matter for whole numbers only."""
    out: dict[str, tuple[torch.Tensor, int, int]] = {}
    things = () if env.scene.object is None else (env.objects,)
    for part in (env.engine, env.servo, env.touch, *things, env):
        name = "env" if part is env else type(part).__name__.lower()
        for key, value in part.memory().items():
            tensor, low, high = value if isinstance(value, tuple) else (value, 0, 0)
            if not isinstance(value, tuple) and not tensor.is_floating_point() and tensor.dtype != torch.bool:
                raise TypeError(f"{name}.{key}: memory of whole numbers needs its lowest and highest")
            out[f"{name}.{key}"] = tensor, low, high
    return out


def keep(env: Kept) -> dict[str, torch.Tensor]:
    """Return a copy of the worlds, on their device, and of the environment's random state."""
    return {name: tensor.clone() for name, (tensor, _, _) in live(env).items()} | {"rng": env.rng.get_state()}


def put_back(env: Kept, state: Mapping[str, torch.Tensor]) -> None:
    """Make the worlds what they were. Raises ValueError, and changes nothing, where the state is not of this
    environment or holds a whole number that cannot be."""
    own = live(env)
    if set(state) != {*own, "rng"}:
        odd = sorted(set(state) ^ {*own, "rng"})
        raise ValueError(f"{odd[0]} is {'missing' if odd[0] not in state else 'not of this environment'}")
    for name, (tensor, low, high) in own.items():
        new = state[name]
        if new.shape != tensor.shape or new.dtype != tensor.dtype:
            raise ValueError(f"{name} is {_kind(new)}, here it is {_kind(tensor)}")
        if not tensor.is_floating_point() and tensor.dtype != torch.bool and new.numel():
            least, most = int(new.min()), int(new.max())
            if least < low or most > high:
                raise ValueError(f"{name} holds {least if least < low else most}, must lie in [{low}, {high}]")
    rng = state["rng"].cpu()
    if rng.shape != env.rng.get_state().shape or rng.dtype != torch.uint8:
        raise ValueError("rng is not that of this device")
    for name, (tensor, _, _) in own.items():
        tensor.copy_(state[name])
    env.engine.refresh()
    env.rng.set_state(rng)


def of_another_version(env: Kept, state: Mapping[str, torch.Tensor]) -> bool:
    """Tell whether a state is of a task that had other memory, as an earlier dexsim wrote it: it has names that this
    one has not, and lacks some."""
    own = {*live(env), "rng"}
    return bool(set(state) - own) and bool(own - set(state))


def size(env: Kept) -> int:
    """Return bytes of all worlds."""
    return sum(tensor.numel() * tensor.element_size() for tensor, _, _ in live(env).values())


def changed(then: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return the first setting of `SAME` that differs between two resolved configs; empty where none does."""
    other = [k for k in SAME if _plain(then.get(k)) != _plain(now.get(k))]
    kinds = [str(c.get("device") or "").partition(":")[0] for c in (then, now)]
    return other[0] if other else "device" if kinds[0] != kinds[1] else ""


def _plain(node: Any) -> Any:
    """Return tuples as lists: a config that went through a file has lists."""
    if isinstance(node, Mapping):
        return {k: _plain(v) for k, v in node.items()}
    return [_plain(v) for v in node] if isinstance(node, (list, tuple)) else node


def _kind(tensor: torch.Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
