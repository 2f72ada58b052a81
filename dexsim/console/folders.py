"""Folders for results."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from dexsim.errors import UserError


def make(folder: Path, setting: str, empty: bool = False) -> Path:
    """Create a folder and make sure that it can be written. Raises UserError naming the setting to change.

    Args:
        setting: the settings that choose the folder, for the message.
        empty: refuse one that already holds something.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # has no name where the system can do that: a process that is killed here leaves nothing behind
        with tempfile.TemporaryFile(dir=folder, prefix=".writable.", suffix=".tmp") as probe:
            probe.write(b"x")
        if empty and any(not (p.name.startswith(".writable.") and p.suffix == ".tmp") for p in folder.iterdir()):
            last = folder / "last.pt"  # a run that ended before it was saved has none
            go_on = f", or continue it with resume={last}" if last.is_file() else ""
            raise UserError(f"{folder} already holds a run: choose another {setting}{go_on}")
    except (OSError, ValueError) as error:  # the latter of a text that no path can be
        why = getattr(error, "strerror", None) or error
        raise UserError(f"cannot write into {folder}: {why}; choose another place with {setting}") from None
    return folder


def caches() -> None:
    """See that libraries can write what they keep for later (Warp its kernels, matplotlib its fonts): where the user's
    own place cannot be written, or there is none, in a folder that goes with this process."""
    home = os.path.join(os.path.expanduser("~"), ".cache")
    places = {name: os.environ.get(name) for name in ("XDG_CACHE_HOME", "WARP_CACHE_PATH", "MPLCONFIGDIR")}
    places["XDG_CACHE_HOME"] = places["XDG_CACHE_HOME"] or home
    own = ""
    for name, place in places.items():
        try:
            if place:
                make(Path(place), name)
        except UserError:
            own = own or tempfile.mkdtemp(prefix="dexsim_cache_")
            os.environ[name] = own
            os.environ.setdefault("MPLCONFIGDIR", own)
    if own:
        atexit.register(shutil.rmtree, own, ignore_errors=True)
