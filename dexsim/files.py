"""Files that come in: only plain ones, and none larger than its kind can be."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from dexsim.errors import UserError

MAX_YAML = 4 << 20
"""Bytes of a YAML file that people write (servo, metadata, calibration, touch)."""


def check(path: Path, most: int, what: str) -> int:
    """The file's size in bytes. Raises UserError where it is missing, not a plain file (a device or a pipe never ends),
    or larger than `most`."""
    try:
        about = os.stat(path)
    except FileNotFoundError:
        raise UserError(f"{what} {path} does not exist") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{what} {path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not stat.S_ISREG(about.st_mode):
        kind = "a folder" if stat.S_ISDIR(about.st_mode) else "a device, a pipe or a socket"
        raise UserError(f"{what} {path} is {kind}, not a file")
    if about.st_size > most:
        raise UserError(f"{what} {path} has {about.st_size} bytes; at most {most} ({most / 2**20:g} MiB) are read")
    return about.st_size


def text(path: Path, most: int, what: str) -> str:
    """A UTF-8 text file. Raises UserError as `check` does, and where it is not text."""
    check(path, most, what)
    try:
        with open(path, "rb") as file:
            raw = file.read(most + 1)
        return raw[:most].decode("utf-8")
    except OSError as error:
        raise UserError(f"{what} {path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{what} {path} is not UTF-8 text (byte {error.start})") from None
