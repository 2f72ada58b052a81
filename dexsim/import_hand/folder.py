"""A hand's folder, written whole or not at all; what a person changed in it stays."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dexsim import outputs
from dexsim.console import folders
from dexsim.errors import UserError
from dexsim.import_hand import corrections

HAND = "hand.yaml"
SHOWN = ("check.png", "check.mp4")  # what `check` wrote: it stays until the next check


def claim(folder: Path) -> dict[str, Any] | None:
    """Return what the importer noted in the folder before; None: it is new or empty. Raises UserError for a folder that
    holds anything else."""
    note = corrections.written(folder)
    if note is None and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(
            f"out={folder} exists and is not a folder that import-hand wrote: choose another out=, or move it away"
        )
    return note


@contextmanager
def staged(folder: Path, note: dict[str, Any] | None, carried: list[str]) -> Iterator[Path]:
    """Yield a folder beside `folder`, which it replaces when the block ends. Files of the old one that the importer did
    not write, or that a person changed since, are carried over and named in `carried` (hand.yaml, whose corrections are
    kept field by field, excepted). Where the block raises, `folder` stays as it was."""
    folders.make(folder.parent, "out=")
    stage = Path(tempfile.mkdtemp(prefix=f".{folder.name}.writing-", dir=folder.parent))
    os.chmod(stage, 0o755)
    try:
        yield stage
        if note is not None:
            _carry(folder, stage, note["files"], carried)
        if folder.exists():
            aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.old-", dir=folder.parent))
            os.rename(folder, aside / "was")
            try:
                os.rename(stage, folder)
            except OSError:
                os.rename(aside / "was", folder)
                raise
            finally:
                if folder.exists():
                    shutil.rmtree(aside, ignore_errors=True)
        else:
            os.rename(stage, folder)
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror or error}; choose another out=") from None
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _carry(old: Path, new: Path, sums: dict[str, str], carried: list[str]) -> None:
    for path in sorted(p for p in old.rglob("*") if p.is_file() and not p.is_symlink()):
        name = path.relative_to(old).as_posix()
        if name in (HAND, corrections.NOTE):
            continue
        drawn = name == outputs.WRITTEN or (name in SHOWN and outputs.ours(old, name))
        if not drawn and name in sums and sha(path) == sums[name]:
            continue
        (new / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, new / name)
        if not drawn:
            carried.append(name)


def write_note(folder: Path, hand: dict[str, Any], said: list[str]) -> None:
    """Notes what the importer wrote: content of hand.yaml, sums of the files, and the places that a person said."""
    sums = {p.relative_to(folder).as_posix(): sha(p) for p in sorted(folder.rglob("*")) if p.is_file()}
    data = {"hand": hand, "files": sums, "said": said}
    (folder / corrections.NOTE).write_text(json.dumps(data, indent=1), encoding="utf-8")


def sha(path: Path) -> str:
    """Return SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
