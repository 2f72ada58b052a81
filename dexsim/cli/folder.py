"""A run's folder: resolved config, progress.csv, checkpoints, curves."""

from __future__ import annotations

import contextlib
import csv
import itertools
import math
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import yaml

from dexsim import files
from dexsim.console.folders import make
from dexsim.errors import UserError
from dexsim.learning import checkpoint

CONFIG = "config.yaml"


def for_run(cfg: dict[str, Any]) -> Path:
    """Return the new run's folder: ``out``, else ``runs/<task>/<run>`` with date and time for a nameless run.

    No two starts get one folder, however close they are. What killed runs left unfinished beside it is removed.
    """
    if cfg["out"] is not None:
        return _claim(make(Path(str(cfg["out"])).expanduser(), "out=", empty=True), "out=")
    parent = Path("runs") / cfg["choices"]["task"]
    if cfg["run"] is not None:
        folder = _claim(make(parent / str(cfg["run"]), "run=", empty=True), "run=")
    else:
        make(parent, "out=")
        folder = _new(parent, time.strftime("%Y-%m-%d_%H-%M-%S"))
    tidy([p for p in parent.iterdir() if p.is_dir()])
    return folder


def _new(parent: Path, stamp: str) -> Path:
    """Return a folder that was not there before: making it is what claims it."""
    for k in itertools.count(1):
        folder = parent / (stamp if k == 1 else f"{stamp}_{k}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"cannot write into {parent}: {error.strerror}; choose another place with out=") from None
        return _claim(folder, "out=")
    raise AssertionError("unreachable")


def _claim(folder: Path, setting: str) -> Path:
    """Take an empty folder: of those who find it empty at once, one makes its config.yaml."""
    try:
        (folder / CONFIG).touch(exist_ok=False)
    except FileExistsError:
        raise UserError(f"{folder} was taken by another run that started just now: choose another {setting}") from None
    except OSError as error:
        raise UserError(f"cannot write into {folder}: {error.strerror}; choose another place with {setting}") from None
    return folder


@contextlib.contextmanager
def kept_if_begun(folder: Path) -> Iterator[None]:
    """Leave nothing of a run that is refused before it has begun: the same out= may be typed again."""
    try:
        yield
    except UserError:
        (folder / CONFIG).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            folder.rmdir()
        raise


def tidy(folders: Iterable[Path]) -> None:
    """Remove what killed processes left unfinished in these folders, and say so."""
    removed = [size for folder in folders for size in files.sweep(folder)]
    if removed:
        print(f"tidied   {len(removed)} unfinished file(s) of killed runs, {sum(removed) / 2**20:.1f} MiB")


def write_config(folder: Path, cfg: dict[str, Any]) -> None:
    """Save the resolved config as ``config.yaml``."""
    checkpoint.write(folder / CONFIG, yaml.safe_dump(cfg, sort_keys=False).encode())


class ProgressFile:
    """``progress.csv``: one row an iteration; a column may appear later, earlier rows then have it empty.

    Rows stay on disk only: a run of a million iterations must not hold them in memory.
    """

    def __init__(self, path: Path, earlier: Path | None = None, until: int = 0) -> None:
        self._path: Path = path
        self._names: list[str] = []
        if earlier is not None and earlier.is_file():  # a resumed run's past
            whole = earlier.read_text("utf-8").splitlines(keepends=True)
            whole = [line for line in whole if line.endswith("\n")]  # power may have failed within the last one
            earlier_rows = (row for row in csv.DictReader(whole) if int(row["iteration"]) <= until)
            rows = [{k: v for k, v in row.items() if v} for row in earlier_rows]
            self._names = list(dict.fromkeys(k for row in rows for k in row))
            self._write(rows)

    def add(self, row: dict[str, float]) -> None:
        """Append a row."""
        text = {k: repr(v) for k, v in row.items() if not (isinstance(v, float) and math.isnan(v))}
        new = [k for k in text if k not in self._names]
        if new:  # rare: the header grows, so the file is written again
            self._names += new
            self._write([*self._read(), text])
        else:
            with open(self._path, "a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, self._names, restval="").writerow(text)

    def _read(self) -> list[dict[str, str]]:
        if not self._path.is_file():
            return []
        with open(self._path, newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    def _write(self, rows: list[dict[str, str]]) -> None:
        with files.beside(self._path) as part, open(part, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._names, restval="")
            writer.writeheader()
            writer.writerows(rows)
