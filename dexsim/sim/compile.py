"""Kernels of a program compiled side by side, before it runs: the first start waits for the longest, not for their sum."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

import warp as wp
from warp._src.context import Module

_MOST = 8  # compilers at once: each takes up to a gigabyte
SWITCH = "DEXSIM_COMPILE_TOGETHER"
"""Environment variable: 1 compiles together on CUDA too, where it is not tried enough to be the default; 0 never."""


def compile_together(program: Callable[[], None], device: str) -> None:
    """Load what `program` (Warp launches on `device`) needs, compiling on all cores of this process what no cache holds.

    The program is gone through without launching: its arrays stay as they are, loops that a device value ends run once. It is
    a convenience: what it misses, or cannot go through, is compiled when it is launched.
    """
    workers = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, _MOST)
    if workers < 2 or os.environ.get(SWITCH, "1" if device == "cpu" else "0") != "1":
        return
    with _noted() as needed, suppress(Exception):  # the real run tells what is wrong, if something is
        program()
    on = wp.get_device(device)
    left = [(module, size) for module, size in needed if (on.context, size) not in module.execs]
    if len(left) > 1:
        with ThreadPoolExecutor(workers) as pool, suppress(Exception):
            list(pool.map(lambda pair: pair[0].load(on, pair[1]), left))


@contextmanager
def _noted() -> Iterator[dict[tuple[Module, int | None], None]]:
    """Inside, launches only note (module, block size), in order; copies and device-side loops do nothing or run once."""
    needed: dict[tuple[Module, int | None], None] = {}

    def note(self: Module, device: object, block_dim: int | None = None, *args: object, **kwargs: object) -> None:
        needed[self, block_dim] = None  # and None for an executable: wp.launch returns

    def once(condition: object, while_body: Callable, *args: object, **kwargs: object) -> None:
        while_body(**kwargs)

    def either(condition: object, on_true: Callable | None = None, on_false: Callable | None = None, **kwargs: object) -> None:
        for body in (on_true, on_false):
            if body is not None:
                body(**kwargs)

    own = {name: getattr(wp, name) for name in ("copy", "capture_while", "capture_if", "get_suggested_block_size")}
    load = Module.load

    def block_size(*args: object, **kwargs: object) -> tuple[int, int]:
        Module.load = load  # it asks the compiled kernel
        try:
            return own["get_suggested_block_size"](*args, **kwargs)
        finally:
            Module.load = note

    Module.load, wp.copy, wp.capture_while, wp.capture_if, wp.get_suggested_block_size = note, lambda *a, **k: None, once, either, block_size
    try:
        yield needed
    finally:
        Module.load = load
        for name, value in own.items():
            setattr(wp, name, value)
