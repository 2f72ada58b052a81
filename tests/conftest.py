"""What holds for every test."""

from __future__ import annotations

import signal


def pytest_configure(config) -> None:
    """Programs that tests start can be interrupted, also where the tests themselves run in the background of a shell without job control,
    which has SIGINT ignored for them."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
