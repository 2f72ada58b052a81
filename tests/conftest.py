"""What holds for every test."""

from __future__ import annotations

import os
import signal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
"""Before NumPy is loaded, here and in programs that tests start. Its threads wait for each other by spinning: where
other work shares the cores, products of small matrices take ten times as long with two threads as with one."""


def pytest_configure(config) -> None:
    """Programs that tests start can be interrupted and hung up, also where the tests themselves run in the background
    of a shell without job control, or under nohup, which has SIGINT or SIGHUP ignored for them."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGHUP, signal.SIGTERM):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
