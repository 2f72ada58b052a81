"""Memory that is free, given back to the system."""

from __future__ import annotations

import ctypes
from functools import cache


@cache
def _libc() -> ctypes.CDLL | None:
    """Return GNU's C library, which alone keeps freed memory so; None elsewhere."""
    try:
        found = ctypes.CDLL(None)
        found.malloc_trim.argtypes, found.malloc_trim.restype = [ctypes.c_size_t], ctypes.c_int
        return found
    except (OSError, AttributeError):
        return None


def give_back() -> None:
    """Give the C library's free pages, of all its arenas, back to the system.

    It keeps what is freed between two pieces that are still in use: of environments made and closed one after the other
    some 40 MB, at places that change with their sizes, so that memory seems to grow although as much as before is in
    use. Takes some milliseconds."""
    libc = _libc()
    if libc is not None:
        libc.malloc_trim(0)
