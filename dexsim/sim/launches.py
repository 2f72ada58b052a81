"""What kernels take, and launches repeated with the same arguments, which are packed once. Packing takes several times
as long as a kernel of a few worlds on a CPU, and a simulation launches the same few kernels in every physics step."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import warp as wp


def taken(kind: Any, *owners: object) -> Any:
    """Return a kernel's struct of the arrays that owners have under its names, the first that has one; others are
    empty."""
    struct = kind()
    for name in kind.vars:
        for owner in owners:
            if hasattr(owner, name):
                setattr(struct, name, getattr(owner, name))
                break
    return struct


class Launches:
    """The launches of one owner, by name. What a name stands for must not change: the same kernel, shape, numbers and
    arrays (whose contents may). On a GPU, where a graph repeats a step, each is an ordinary launch. captured: whether a
    graph may record them."""

    def __init__(self, device: Any, captured: bool = True):
        self._device, self._captured = wp.get_device(device), captured
        self._packed: dict[str, tuple[Callable[[], Any], Any]] = {}

    def __call__(self, name: str, kernel: Any, dim: int | tuple[int, ...], inputs: Sequence[Any]) -> None:
        """Launches `kernel` over `dim` threads."""
        if not self._device.is_cpu:
            wp.launch(kernel, dim=dim, inputs=inputs, device=self._device)
            return
        if name not in self._packed:  # kept with its inputs: it points to their memory
            command = wp.launch(kernel, dim=dim, inputs=inputs, device=self._device, record_cmd=True)
            if command is None:  # it was only listed (`dexsim.sim.warmup`)
                return
            self._packed[name] = command.launch if self._captured else _call(command), (command, inputs)
        self._packed[name][0]()


def _call(command: wp.Launch) -> Callable[[], Any]:
    """Return the call of a recorded launch on a CPU, which no graph sees; the launch itself builds its arguments in
    each."""
    bounds, *given = command.params
    names = [f"given{k}" for k in range(len(given))]
    arguments = type("Arguments", (ctypes.Structure,), {"_fields_": [*zip(names, map(type, given), strict=True)]})
    return partial(command.hooks.forward, ctypes.byref(bounds), ctypes.byref(arguments(*given)))
