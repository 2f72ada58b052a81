"""Several runs from one command: dexsim train --multirun seed=1,2,3 servo=xhand,ideal.

Hydra's sweeper expands the lists; each of its jobs is `dexsim train` in a process of its own, here or on a cluster
(:mod:`dexsim.console.jobs`).
"""

from __future__ import annotations

import csv
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

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
    argv = [a for a in argv if not a.startswith("sweep=")]
    task = next((a.partition("=")[2] for a in reversed(argv) if a.startswith("task=")), "grasp").replace(",", "_")
    folder = (
        Path(given[-1] if given else Path("runs") / task / time.strftime("sweep_%Y-%m-%d_%H-%M-%S"))
        .expanduser()
        .resolve()
    )
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder} already holds a sweep: choose another sweep=")
    places = [
        f"hydra.sweep.dir={folder}",
        "hydra.sweep.subdir=${hydra.job.num}",
        "hydra.output_subdir=null",
        "hydra.job.chdir=false",
        "hydra/job_logging=disabled",
        "hydra/hydra_logging=none",
    ]
    wanted: list[jobs.Job] = []

    def add(_cfg: Any) -> None:
        from hydra.core.hydra_config import HydraConfig

        hydra = HydraConfig.get()
        settings, place = list(hydra.overrides.task), Path(hydra.runtime.output_dir)
        print(f"job {place.name}: {' '.join(settings)}", flush=True)
        wanted.append(jobs.Job((("train", *settings, f"out={place}"),), place, tuple(program), resumes=True))

    _hydra(argv, places, config_dir, add)
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


def _hydra(argv: list[str], places: list[str], config_dir: Path, job: Callable[[Any], None]) -> None:
    """Run Hydra's own entry with our settings file; its one-line refusals become UserError."""
    from hydra._internal.utils import _run_hydra, get_args_parser
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    parser = get_args_parser()
    args = parser.parse_args(["--multirun", *argv, *places])
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors as exceptions, to be said our way
    try:
        _run_hydra(
            args=args,
            args_parser=parser,
            task_function=job,
            config_path=str(config_dir.resolve()),
            config_name="config",
        )
    except (HydraException, OmegaConfBaseException) as error:
        lines = [x.strip() for x in str(error).splitlines() if x.strip()]
        raise UserError(f"sweep: {' '.join(lines[:3])}") from None


def _collect(folder: Path) -> tuple[list[tuple], bool]:
    """Return a row for each job: name, settings, status, iterations, last step reward, seconds; and whether one
    failed."""
    rows, failed = [], False
    notes = sorted(folder.glob("jobs/*.json"), key=lambda p: int(p.stem))
    jobs_run = [json.loads(note.read_text("utf-8")) for note in notes]
    typed = [[x for x in note["commands"][0][1:] if not x.startswith("out=")] for note in jobs_run]
    common = set.intersection(*map(set, typed)) if len(jobs_run) > 1 else set()
    for note, job, own in zip(notes, jobs_run, typed):
        progress: list[dict[str, str]] = []
        if (run := folder / note.stem / "progress.csv").exists():
            with open(run, newline="", encoding="utf-8") as file:
                progress = list(csv.DictReader(file))
        last = progress[-1] if progress else {}
        tail = [float(r["step_reward"]) for r in progress[-10:]]
        rows.append(
            (
                note.stem,
                " ".join(x for x in own if x not in common),
                job["status"],
                int(last.get("iteration", 0)),
                sum(tail) / len(tail) if tail else float("nan"),
                job["seconds"],
            )
        )
        failed |= job["status"] != 0
    return rows, failed
