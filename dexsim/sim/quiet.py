"""A quiet start of Warp."""

from __future__ import annotations

import os
import sys


def quiet_warp(device: str) -> None:
    """Start Warp without its banner and, where only the CPU is wanted, without its warning that there is no GPU driver
    (printed by its native library, hence the file descriptor)."""
    import warp

    warp.config.log_level = warp.LOG_WARNING
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        if device == "cpu":
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 2)
            os.close(nowhere)
        warp.init()
    finally:
        os.dup2(saved, 2)
        os.close(saved)
