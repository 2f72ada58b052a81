"""Files that come in: only plain ones, and none larger than its kind can be. Files that go out: written beside their
place and renamed, so that a kill leaves what was; what it leaves unfinished goes at the next start."""

from __future__ import annotations

import contextlib
import csv
import json
import math
import os
import re
import shutil
import socket
import stat
import time
import zipfile
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexsim import guard, system, typed
from dexsim.errors import UserError

if TYPE_CHECKING:
    import numpy as np

LEFT_S = 86400.0
"""Age [s] from which an unfinished file is nobody's."""
HOST = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:60]
_UNFINISHED = re.compile(r"\..+?\.((?P<host>[A-Za-z0-9-]+)\.)?(?P<pid>[0-9]{1,9})\.tmp")
MAX_FILE, MAX_TEXT = 256 << 20, 4 << 20
"""Bytes of a file, and of a text that people write (YAML, JSON, CSV), where nothing else is said."""


def check(path: Path, what: str, most: int = MAX_FILE) -> int:
    """Return the bytes that a file takes on its disk, without the holes of a sparse one. Raises UserError where it is
    missing, not a plain file (a device or a pipe never ends), or larger than `most`."""
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
    return stored(about)


def stored(about: os.stat_result) -> int:
    """Return the bytes that a file takes on its disk, without the holes of a sparse one."""
    return min(about.st_size, 512 * getattr(about, "st_blocks", 0) or about.st_size)


def text(path: Path, what: str, most: int = MAX_TEXT, other: str | None = None) -> str:
    """Return a text file of UTF-8, of UTF-16 with its mark, or of the encoding `other` where it is neither. Raises
    UserError as `check` does, and where it is not text."""
    check(path, what, most)
    try:
        with open(path, "rb") as file:
            raw = file.read(most + 1)
        with contextlib.suppress(*[UnicodeDecodeError] * (other is not None)):
            return raw[:most].decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8")
        return raw[:most].decode(other or "utf-8")
    except OSError as error:
        raise UserError(f"{what} {path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{what} {path} is not UTF-8 text (byte {error.start})") from None


def table(
    path: Path, what: str, needs: Sequence[str], also: Sequence[str] = (), words: Collection[str] = (),
    whole: bool = False,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Return columns [n] of a CSV file by name: those that it `needs`, and of `also` those that are there (whole: all
    or none, and no others); finite numbers, texts of `words`. Lines that begin with # are left out. Raises UserError,
    with the column or the line."""
    import numpy as np

    lines = [(k, s) for k, s in enumerate(text(path, what).splitlines(), 1) if s.strip() and not s.startswith("#")]
    head, *rows = csv.reader(s for _, s in lines) if lines else [[]]
    has = [name.strip() for name in head]
    if whole and has not in ([*needs], [*needs, *also]):
        fits = f"must be {','.join(needs)} or {','.join((*needs, *also))}"
        raise UserError(f"{what} {path}: columns {', '.join(has) or 'none'}; {fits}")
    if missing := [name for name in needs if name not in has]:
        raise UserError(f"{what} {path}: no column {', '.join(missing)}; needed: {', '.join(needs)};"
                        f" it has: {', '.join(has) or 'none'}")  # fmt: skip
    out = {}
    for k, name in enumerate(has):
        if name in (*needs, *also):
            out[name] = cells = np.array([row[k] if k < len(row) else "" for row in rows], object)
            if name in words:
                continue
            for (line, _), cell in zip(lines[1:], cells, strict=True):
                if not math.isfinite(typed.real(cell)):
                    raise UserError(f"{what} {path}: line {line}: {name} is {cell!r}, must be a finite number")
            out[name] = cells.astype(float)
    return out


def mapping(path: Path, what: str, most: int = MAX_TEXT) -> dict[str, Any]:
    """Return a JSON file that maps keys to values. Raises UserError as `text` does, and where it is another."""
    try:
        out = json.loads(text(path, what, most))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{what} {path}: not JSON ({error})") from None
    if not isinstance(out, dict):
        raise UserError(f"{what} {path}: is a {type(out).__name__}, must map keys to values")
    return out


def place(text: Any) -> Path:
    """Return a path as it was typed or stored, `~` being its user's folder where there is such a user. Raises UserError
    for a text that no path can be."""
    if "\0" in str(text):
        raise UserError(f"'{text}': a path holds no zero character")
    try:
        os.fsencode(str(text))
    except UnicodeEncodeError as error:
        raise UserError(f"'{text}': no path holds its character {error.start}") from None
    path = Path(str(text))
    try:
        return path.expanduser()
    except RuntimeError:
        return path


def arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a NumPy archive by name; nothing pickled is read. Raises ValueError, in one line, where it
    is no plain file, or none that can be read within limits."""
    size = check(path, "file", 1 << 30)
    return _arrays(path) if guard.ours(path) else guard.call(_arrays, path, what="it", size=size)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    import numpy as np

    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    if odd := next((n for n, count in Counter(names).items() if count > 1 or not n.endswith(".npy")), ""):
        raise UserError(f"its entry '{odd}' is there twice, or is no array (.npy)")
    with np.load(path, allow_pickle=False) as stored:
        try:
            return {str(k): stored[k] for k in stored.files}
        except ValueError as error:
            hint = "; save plain arrays of numbers, no objects" if "pickle" in str(error) else ""
            raise UserError(f"{error}{hint}") from None


def unfinished(path: Path) -> Path:
    """Return where what will be `path` is written first: beside it, named after this process."""
    return path.with_name(f".{path.name}.{HOST}.{os.getpid()}.tmp")


@contextlib.contextmanager
def beside(path: Path) -> Iterator[Path]:
    """Write the file (or the folder) that is given; it becomes `path` when the block ends, and is removed where the
    block raises. What killed processes left beside `path` is removed first."""
    sweep(path.parent)
    part = unfinished(path)
    try:
        yield part
        os.replace(part, path)
    finally:
        _remove(part)


def write(path: Path, content: str, what: str) -> None:
    """Write a text file, replacing the old one only once the new one is whole. Raises UserError, which names `what`."""
    try:
        with beside(path) as part:
            part.write_text(content, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{what} {path} cannot be written: {error.strerror}") from None


def picture(figure: Any, path: Path, dpi: float | str = "figure") -> None:
    """Save a matplotlib figure in the format of the path's ending; it is empty afterwards.

    What was drawn refers to itself in circles and holds the pixels (some 5 MB a figure): Python would keep them until
    it happens to look for such, which it does the more seldom the more else there is.
    """
    with beside(path) as part:
        figure.savefig(part, dpi=dpi, format=path.suffix[1:])
    figure.clear()


def sweep(folder: Path) -> list[int]:
    """Remove the unfinished files and folders (``.NAME.HOST.PID.tmp``) of killed processes; returns their sizes in
    bytes. One of another machine, or of a process that lives, is left until it is a day old."""
    removed = []
    for path in folder.glob(".*.tmp"):
        if _UNFINISHED.fullmatch(path.name) is None:
            continue
        with contextlib.suppress(OSError):
            about = path.lstat()
            if abandoned(path.name) or time.time() - about.st_mtime > LEFT_S:
                inside = [p.lstat().st_size for p in path.rglob("*")] if stat.S_ISDIR(about.st_mode) else []
                _remove(path)
                removed.append(sum(inside) or about.st_size)
    return removed


def abandoned(name: str) -> bool:
    """Return whether a file of this name is what a process of this machine wrote that is no more."""
    found = _UNFINISHED.fullmatch(name)
    return found is not None and found["host"] == HOST and not system.lives(int(found["pid"]))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()
