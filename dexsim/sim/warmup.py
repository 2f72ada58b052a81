"""Compile many kernels at once: a first start takes as long as the longest of them, not as their sum.

Warp compiles a kernel when it is first launched, one after another. Here a program's launches are first only listed,
then all their modules are compiled on as many threads as there are cores, while the caller does something else; then
the program may run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import warp as wp
from warp._src import context

from dexsim.system import cores

_begun: dict[tuple[Any, int], Future] = {}


def begin(program: Callable[[], None], device: str) -> int:
    """Begin to compile what `program` launches on `device`; returns how many modules. The program runs without its
    kernels: what it reads must not decide what it launches. On a CPU nothing is done: LLVM compiles one module at a
    time."""
    where = wp.get_device(device)
    if not where.is_cuda:
        return 0
    with wp.ScopedDevice(where):
        modules = listed(program)
    pool = ThreadPoolExecutor(max_workers=min(len(modules), cores()) or 1)
    for module, block_dim in modules:
        _begun[module, block_dim] = pool.submit(module.load, where, block_dim=block_dim)
    pool.shutdown(wait=False)
    return len(modules)


def finish(program: Callable[[], None] | None = None) -> None:
    """Wait for what `program` launches, where its compilation has begun; None: for all that has."""
    for key in list(_begun) if program is None or not _begun else listed(program):
        if key in _begun:
            _begun.pop(key).result()


def listed(program: Callable[[], None]) -> list[tuple[Any, int]]:
    """Return (module, threads a block) of each kernel that `program` launches, in order, none twice."""
    found: dict[tuple[Any, int], None] = {}
    with _instead_of_launching(lambda kernel, block_dim: found.setdefault((_own_module(kernel), block_dim))):
        program()
    return list(found)


def _own_module(kernel: wp.Kernel) -> Any:
    """Return the module that a kernel is compiled in. Of MuJoCo-Warp's modules a model launches a part: each of their
    kernels gets one of its own, to the same machine code."""
    shared = kernel.module
    if shared.name.startswith("mujoco_warp.") and len(shared.kernels) > 1:
        kernel.module = context.Module(f"{shared.name}.{kernel.key}")
        kernel.module.options |= shared.options
        kernel.module.register_kernel(kernel)
    return kernel.module


@contextmanager
def _instead_of_launching(keep: Callable[[wp.Kernel, int], object]) -> Iterator[None]:
    def launch(
        kernel: wp.Kernel, dim: int | Sequence[int], *args: Any, block_dim: int | None = None, **kwargs: Any
    ) -> None:
        # an empty launch compiles nothing; which types a generic kernel has, only a launch finds out
        if math.prod(dim if isinstance(dim, (tuple, list)) else (dim,)) and not kernel.is_generic:
            keep(kernel, int(block_dim or 256))

    def once(condition: wp.array, while_body: Callable[..., None], **kwargs: Any) -> None:
        while_body(**kwargs)

    def suggested(kernel: wp.Kernel, device: Any = None) -> tuple[int, int]:
        return 256, 132  # the real one compiles the kernel to know; it decides about sizes only

    chosen = [
        (owner, name, getattr(owner, name))
        for owner, name in (
            (wp, "launch"), (context, "launch"), (wp, "capture_while"), (wp, "get_suggested_block_size"),
        )
    ]
    wp.launch = context.launch = launch
    # what is called of them
    wp.capture_while, wp.get_suggested_block_size = once, suggested  # type: ignore[assignment]
    try:
        yield
    finally:
        for owner, name, what in chosen:
            setattr(owner, name, what)
