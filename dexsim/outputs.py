"""Files that a command writes into the folder the user named: nothing that is not ours is overwritten, and what is
there is whole.

Each folder keeps `.dexsim.json`: what was written there, with its SHA-256. A file is ours as long as it is as we wrote
it. Results are written beside (a folder `.writing-...` in the same place) and renamed once all of them are there: a
full disk or a kill leaves what was.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dexsim.console.folders import make
from dexsim.errors import UserError

WRITTEN = ".dexsim.json"


def claim(folder: Path, setting: str, names: Iterable[str], inputs: Iterable[Path] = ()) -> Path:
    """The folder, made and writable, before the work begins. Raises UserError where it cannot be written, or where one
    of `names` (of a file, or of a folder of files) is there and not ours, or is one of `inputs`."""
    make(folder, setting)
    read = {p.expanduser().resolve() for p in inputs}
    for name in names:
        path = folder / name
        if path.resolve() in read:
            raise UserError(f"{path} is read and would be written: choose another {setting}")
        for there in (
            sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() and not path.is_symlink() else [path]
        ):
            _refuse(folder, there, setting)
    return folder


@contextmanager
def staged(folder: Path, setting: str = "out=") -> Iterator[Path]:
    """A folder beside the results: what is in it when the block ends is moved into `folder`, file by file, and noted as
    ours. Where the block raises, `folder` stays as it was. Raises UserError where a file would go over one that is not
    ours, or the disk is full."""
    make(folder, setting)
    stage = Path(tempfile.mkdtemp(prefix=".writing-", dir=folder))
    try:
        yield stage
        files = sorted(p for p in stage.rglob("*") if p.is_file())
        for path in files:
            _refuse(folder, folder / path.relative_to(stage), setting)
        sums = {str(p.relative_to(stage)): _sum(p) for p in files}
        for path in files:
            to = folder / path.relative_to(stage)
            to.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, to)
        note(folder, sums)
    except OSError as error:
        raise UserError(
            f"cannot write into {folder}: {error.strerror or error}; choose another place with {setting}"
        ) from None
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def note(folder: Path, sums: dict[str, str]) -> None:
    """Adds files (relative path -> SHA-256) to those that are ours."""
    data = json.dumps({"files": _known(folder) | sums}, indent=1)
    part = folder / f"{WRITTEN}.part"
    part.write_text(data, encoding="utf-8")
    os.replace(part, folder / WRITTEN)


def note_paths(folder: Path, paths: Iterable[Path]) -> None:
    """Adds files in `folder`, and all files of folders in it, to those that are ours."""
    every = [q for p in paths for q in (p.rglob("*") if p.is_dir() else [p]) if q.is_file()]
    note(folder, {str(p.relative_to(folder)): _sum(p) for p in every})


def replace_text(path: Path, text: str) -> None:
    """Writes a text file beside and renames it."""
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _refuse(folder: Path, path: Path, setting: str) -> None:
    if not (path.exists() or path.is_symlink()):
        return
    inside = path.parent.resolve().is_relative_to(folder.resolve()) and not path.is_symlink()
    known = _known(folder).get(str(path.relative_to(folder)))
    if not inside or known is None or not path.is_file() or _sum(path) != known:
        what = (
            "was changed since it was written"
            if known is not None and inside
            else "is not a result written here before"
        )
        raise UserError(f"{path} {what}, and would be overwritten: choose another {setting}, or move it away")


def _known(folder: Path) -> dict[str, str]:
    try:
        files = json.loads((folder / WRITTEN).read_text(encoding="utf-8"))["files"]
        return {str(k): str(v) for k, v in files.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}


def _sum(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
