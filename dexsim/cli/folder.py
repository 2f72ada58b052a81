"""A run's folder: resolved config, progress.csv, checkpoints, curves."""

from __future__ import annotations

import csv
import math
import time
from pathlib import Path
from typing import Any

import yaml

from dexsim.console.folders import make


def for_run(cfg: dict[str, Any]) -> Path:
    """The new run's folder: ``out``, else ``runs/<task>/<run>`` with date and time for a nameless run."""
    if cfg["out"] is not None:
        return make(Path(str(cfg["out"])).expanduser(), "out=", empty=True)
    parent = Path("runs") / cfg["choices"]["task"]
    if cfg["run"] is not None:
        return make(parent / str(cfg["run"]), "run=", empty=True)
    name = stamp = time.strftime("%Y-%m-%d_%H-%M-%S")
    k = 2
    while (parent / name).exists():
        name, k = f"{stamp}_{k}", k + 1
    return make(parent / name, "out=", empty=True)


def write_config(folder: Path, cfg: dict[str, Any]) -> None:
    """Save the resolved config as ``config.yaml``."""
    (folder / "config.yaml").write_text(yaml.safe_dump(cfg, sort_keys=False))


class ProgressFile:
    """``progress.csv``: one row an iteration; a column may appear later, earlier rows then have it empty.

    Rows stay on disk only: a run of a million iterations must not hold them in memory.
    """

    def __init__(self, path: Path, earlier: Path | None = None, until: int = 0) -> None:
        self._path: Path = path
        self._names: list[str] = []
        if earlier is not None and earlier.is_file():  # a resumed run's past
            with open(earlier, newline="") as file:
                rows = [
                    {k: v for k, v in row.items() if v}
                    for row in csv.DictReader(file)
                    if int(row["iteration"]) <= until
                ]
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
            with open(self._path, "a", newline="") as file:
                csv.DictWriter(file, self._names, restval="").writerow(text)

    def _read(self) -> list[dict[str, str]]:
        if not self._path.is_file():
            return []
        with open(self._path, newline="") as file:
            return list(csv.DictReader(file))

    def _write(self, rows: list[dict[str, str]]) -> None:
        with open(self._path, "w", newline="") as file:
            writer = csv.DictWriter(file, self._names, restval="")
            writer.writeheader()
            writer.writerows(rows)
