"""Several runs from one command: dexsim train --multirun seed=1,2,3 servo=xhand,ideal.

Hydra's grammar expands the lists; each run is `dexsim train` in a process of its own, here or on a cluster
(:mod:`dexsim.console.jobs`).
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from dexsim.console import jobs
from dexsim.console.tables import table
from dexsim.errors import UserError

FLAGS = ("--multirun", "-m")
PROGRAM = (sys.executable, "-m", "dexsim")


def wanted(argv: list[str]) -> bool:
    """Return whether the command asks for a sweep."""
    return any(a in FLAGS for a in argv)


def run(argv: list[str], config_dir: Path, program: Sequence[str] = PROGRAM) -> int:
    """Run all jobs; returns 0 when all ended with 0, else 1. Raises UserError for what Hydra refuses.

    Each job's run folder is `<sweep>/<number>`; the sweep folder is runs/<task>/sweep_<date and time>, or
    `sweep=FOLDER`.
    """
    engine, argv = jobs.taken([a for a in argv if a not in FLAGS], [] if "device=cpu" in argv else _cuda())
    if launcher := next((a for a in argv if a.startswith(("hydra/launcher", "hydra.launcher"))), None):
        raise UserError(f"{launcher}: jobs run by on=local at_once=8, on=slurm or on=dask (docs/howto/gpus.md)")
    for name in ("out", "run"):
        if any(a.startswith(f"{name}=") for a in argv):
            raise UserError(
                f"{name}=: a sweep names its run folders itself, <sweep>/<number>; choose the place with sweep=FOLDER"
            )
    given = [a.partition("=")[2] for a in argv if a.startswith("sweep=")]
    runs = _expanded([a for a in argv if not a.startswith("sweep=")])
    task = "_".join(_tasks(runs, config_dir))
    folder = (
        Path(given[-1] if given else Path("runs") / task / time.strftime("sweep_%Y-%m-%d_%H-%M-%S"))
        .expanduser()
        .resolve()
    )
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder} already holds a sweep: choose another sweep=")
    wanted: list[jobs.Job] = []
    for number, settings in enumerate(runs):
        place = folder / str(number)
        place.mkdir(parents=True)
        print(f"job {number}: {' '.join(settings)}", flush=True)
        wanted.append(jobs.Job((("train", *settings, f"out={place}"),), place, tuple(program), resumes=True))
    jobs.run(wanted, engine)
    rows, failed = _collect(folder)
    print("\n" + table(f"sweep {folder}", ("run", "settings", "status", "iterations", "step reward", "seconds"), rows))
    return 1 if failed or not rows else 0


def _cuda() -> list[str]:
    """Names of the CUDA devices that jobs may use."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return [d for d in visible.split(",") if d]
    from dexsim.cli import machine

    return [str(k) for k in range(machine.cuda_devices())]


def _expanded(argv: list[str]) -> list[list[str]]:
    """Return the settings of each run: every combination of the lists. Raises UserError."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        given = OverridesParser.create().parse_overrides(argv)
        lists = {
            key: [f"{key}={v}" for v in x.sweep_string_iterator()] if x.is_sweep_override() else [x.input_line or key]
            for x in given
            for key in (x.get_key_element(),)
        }
    except HydraException as error:
        lines = [x.strip() for x in str(error).splitlines() if x.strip()]
        raise UserError(f"sweep: {' '.join(lines[:3])}") from None
    return [list(each) for each in itertools.product(*lists.values())]


def _tasks(runs: list[list[str]], config_dir: Path) -> list[str]:
    """Return the names of the runs' tasks. Raises UserError for a setting of any, before the first run starts."""
    from dexsim.cli import start

    names: dict[str, None] = {}
    seen: set[str] = set()
    for settings in runs:
        if not names or not seen.issuperset(settings):  # each value once, not each combination
            if (ready := start.for_train(settings, config_dir)) is None:
                raise UserError("a sweep shows no settings: leave --cfg and --help out, or --multirun")
            names[ready.cfg["task"]["name"]] = None
            seen.update(settings)
    return [*names]


def _collect(folder: Path) -> tuple[list[tuple], bool]:
    """Return a row for each job: name, settings, status, iterations, last step reward, seconds; and whether one
    failed."""
    from dexsim.view.plots import read_progress

    rows, failed = [], False
    notes = sorted(folder.glob("jobs/*.json"), key=lambda p: int(p.stem))
    jobs_run = [json.loads(note.read_text("utf-8")) for note in notes]
    typed = [[x for x in note["commands"][0][1:] if not x.startswith("out=")] for note in jobs_run]
    common = set.intersection(*map(set, typed)) if len(jobs_run) > 1 else set()
    for note, job, own in zip(notes, jobs_run, typed):
        run = folder / note.stem / "progress.csv"
        progress = read_progress(run) if run.exists() else {}
        tail = progress.get("step_reward", [])[-10:]
        rows.append(
            (
                note.stem, " ".join(x for x in own if x not in common), job["status"],
                int(progress["iteration"][-1]) if tail else 0, sum(tail) / len(tail) if tail else float("nan"),
                job["seconds"],
            )
        )
        failed |= job["status"] != 0
    return rows, failed
