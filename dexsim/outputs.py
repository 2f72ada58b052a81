"""Files that a command writes into the folder the user named: nothing that is not ours is overwritten, and what is
there is whole.

Each folder keeps `.dexsim.json`: what was written there, with its SHA-256. A file is ours as long as it is as we wrote
it. Results are written beside (a folder `.results.HOST.PID.tmp` in the same place), noted, and renamed once all of them
are there: a full disk or a kill leaves what was. A kill between two of the renames leaves some of each; the next start
there makes the rest, from the note. What a kill before that left is removed then.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dexsim import files
from dexsim.console.folders import make
from dexsim.errors import UserError

WRITTEN = ".dexsim.json"


def claim(folder: Path, setting: str, names: Iterable[str], inputs: Iterable[Path] = ()) -> Path:
    """Return the folder, made and writable, before the work begins. Raises UserError where it cannot be written, or
    where one of `names` (of a file, or of a folder of files) is there and not ours, or is one of `inputs`."""
    make(folder, setting)
    recover(folder)
    read = {files.place(p).resolve() for p in inputs}
    for name in names:
        path = folder / name
        if path.resolve() in read:
            raise UserError(f"{path} is read and would be written: choose another {setting}")
        for there in (
            sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() and not path.is_symlink() else [path]
        ):
            _refuse(folder, there, setting)
    return folder


def new(path: Path, setting: str) -> Path:
    """Return the path, where nothing is yet. Raises UserError: recordings are never overwritten."""
    if path.exists() or path.is_symlink():
        raise UserError(f"{setting}{path}: is there already, and would be overwritten: give another, or move it away")
    return path


def recording(text: str | Path, setting: str = "record=") -> Path:
    """Return the path of a new MCAP file, its folder made. Raises UserError."""
    path = mcap(text)
    make(path.parent, setting)
    return new(path, setting)


def mcap(text: str | Path) -> Path:
    """Return a path with the ending of a recording."""
    path = files.place(text)
    return path if path.suffix == ".mcap" else path.with_name(path.name + ".mcap")


def ours(folder: Path, name: str) -> bool:
    """Return whether a file is there as we wrote it."""
    return _is(folder, folder / name, _known(folder).get(name, ""))


@contextmanager
def staged(folder: Path, setting: str = "out=", instead: Iterable[str] = ()) -> Iterator[Path]:
    """Yield a folder beside the results: what is in it when the block ends is moved into `folder`, file by file, and
    noted as ours. Of the names `instead`, what an earlier run wrote and this one did not is removed: it would be taken
    for a result of this one. Where the block raises, `folder` stays as it was. Raises UserError where a file would go
    over one that is not ours, or the disk is full."""
    make(folder, setting)
    recover(folder)
    stage = _stage(folder)
    try:
        stage.mkdir()
        yield stage
        made = sorted(p for p in stage.rglob("*") if p.is_file())
        for path in made:
            _refuse(folder, folder / path.relative_to(stage), setting)
        sums = {p.relative_to(stage).as_posix(): _sum(p) for p in made}
        _write_note(folder, _known(folder), {"stage": stage.name, "files": sums})
        _move(folder, stage, sums)
        gone = [name for name in instead if name not in sums and ours(folder, name)]
        for name in gone:
            (folder / name).unlink()
        _write_note(folder, {name: sum for name, sum in (_known(folder) | sums).items() if name not in gone})
    except OSError as error:
        raise UserError(
            f"cannot write into {folder}: {error.strerror or error}; choose another place with {setting}"
        ) from None
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def recover(folder: Path) -> None:
    """Finish the renames that a killed process had noted, and remove what others left unfinished."""
    pending = _read_note(folder).get("pending")
    sums = pending.get("files") if isinstance(pending, dict) else None
    stage = folder / str(pending.get("stage")) if isinstance(pending, dict) else folder
    if isinstance(sums, dict) and files.abandoned(stage.name) and stage.parent == folder and not stage.is_symlink():
        unmoved = {str(k): str(v) for k, v in sums.items() if _is(folder, stage / str(k), str(v))}
        with contextlib.suppress(OSError, UserError):
            for path in unmoved:
                _refuse(folder, folder / path, "out=")
            _move(folder, stage, unmoved)
            _write_note(folder, _known(folder))
    files.sweep(folder)


def _move(folder: Path, stage: Path, paths: Iterable[str]) -> None:
    for path in paths:
        to = folder / path
        to.parent.mkdir(parents=True, exist_ok=True)
        os.replace(stage / path, to)


def _is(folder: Path, path: Path, digest: str) -> bool:
    """Return whether this is a file of that SHA-256 within the folder."""
    return path.is_file() and path.resolve().is_relative_to(folder.resolve()) and _sum(path) == digest


def _stage(folder: Path) -> Path:
    """Return a folder beside the results that is not there yet."""
    for k in itertools.count():
        stage = files.unfinished(folder / (f"results{k}" if k else "results"))
        if not stage.exists():
            return stage
    raise AssertionError("unreachable")


def _write_note(folder: Path, known: dict[str, str], pending: dict[str, Any] | None = None) -> None:
    data = {"files": known} | ({"pending": pending} if pending else {})
    with files.beside(folder / WRITTEN) as part:
        part.write_text(json.dumps(data, indent=1), encoding="utf-8")


def _refuse(folder: Path, path: Path, setting: str) -> None:
    if not (path.exists() or path.is_symlink()):
        return
    inside = path.parent.resolve().is_relative_to(folder.resolve()) and not path.is_symlink()
    known = _known(folder).get(path.relative_to(folder).as_posix())
    if not inside or known is None or not path.is_file() or _sum(path) != known:
        what = (
            "was changed since it was written"
            if known is not None and inside
            else "is not a result written here before"
        )
        raise UserError(f"{path} {what}, and would be overwritten: choose another {setting}, or move it away")


def _known(folder: Path) -> dict[str, str]:
    """Return what is ours: what was noted, and what a process was about to move and has moved."""
    found = _read_note(folder)
    known, pending = found.get("files"), found.get("pending")
    out = {str(k): str(v) for k, v in known.items()} if isinstance(known, dict) else {}
    moving = pending.get("files") if isinstance(pending, dict) else None
    for path, digest in moving.items() if isinstance(moving, dict) else ():
        if _is(folder, folder / str(path), str(digest)):
            out[str(path)] = str(digest)
    return out


def _read_note(folder: Path) -> dict[str, Any]:
    try:
        data = json.loads((folder / WRITTEN).read_text(encoding="utf-8"))
        return data if isinstance(data, dict) else {}
    except (OSError, ValueError, RecursionError):
        return {}


def _sum(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
