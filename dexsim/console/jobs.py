"""Many jobs, each commands of dexsim in turn, on an engine that exists: processes of this machine, Slurm or Dask."""

from __future__ import annotations

import importlib
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dexsim import files, system
from dexsim.console.stop import Stop
from dexsim.console.tables import duration
from dexsim.errors import UserError
from dexsim.typed import whole

LOST = -1
"""Status of a job whose machine was lost more often than its engine begins it again."""
RETRIES = 2
REACH_S = 20
"""s that a Dask scheduler has to answer."""
HELP = """  on=local          where jobs run: local (processes here), slurm, dask (of this machine), dask=tcp://HOST:8786
  at_once=          jobs at a time (default: one for each GPU, or one); with slurm, as many as its queue lets
  slurm.NAME=       of submitit: slurm.partition=gpu slurm.gpus_per_node=1 slurm.time=120 (minutes)
"""


@dataclass(frozen=True)
class Job:
    """Commands of dexsim, run in turn until one fails.

    commands: each the arguments behind `program`. folder: what they write into; what is said of the job, and what it
    says, stands beside it in jobs/NAME.json and jobs/NAME.txt. program: how dexsim is called. resumes: the first
    command is `[...] train ... out=PLACE`, and a job that was lost goes on from PLACE/last.pt. Commands that had
    ended are not repeated.
    """

    commands: tuple[tuple[str, ...], ...]
    folder: Path
    program: tuple[str, ...] = (sys.executable, "-m", "dexsim")
    resumes: bool = False

    @property
    def note(self) -> Path:
        """Where the job's commands, status and seconds are noted."""
        return self.folder.parent / "jobs" / f"{self.folder.name}.json"


@dataclass
class Engine:
    """Where jobs run: see HELP. devices: CUDA devices that local jobs take in turn, one each."""

    on: str = "local"
    at_once: int | None = None
    devices: Sequence[str] = ()
    slurm: Mapping[str, str] = field(default_factory=dict)


def taken(argv: Sequence[str], devices: Sequence[str] = ()) -> tuple[Engine, list[str]]:
    """Take on=, at_once= and slurm.NAME= out of a command's arguments. Raises UserError."""
    engine, rest = Engine(devices=devices), []
    slurm: dict[str, str] = {}
    for argument in argv:
        key, _, text = argument.partition("=")
        if key == "on":
            name = text.partition("=")[0]
            if name not in ("local", "slurm", "dask") or ("=" in text and name != "dask"):
                raise UserError(f"on={text}: must be local, slurm, dask or dask=tcp://HOST:PORT")
            engine.on = text
        elif key == "at_once":
            engine.at_once = whole("at_once", text, 1, 10_000)
        elif key.startswith("slurm.") and text:
            slurm[key.removeprefix("slurm.")] = text
        else:
            rest.append(argument)
    if slurm and engine.on != "slurm":
        raise UserError(f"slurm.{next(iter(slurm))}=: only with on=slurm")
    engine.slurm = slurm
    return engine, rest


def run(jobs: Sequence[Job], engine: Engine) -> list[int]:
    """Run all jobs, saying what ends and how long the rest will take; returns their exit statuses, LOST of one that was
    lost for good. Ctrl-C, SIGTERM and SIGHUP end those that run. Raises UserError for an engine that is not here."""
    status, began = [LOST] * len(jobs), time.perf_counter()
    with Stop(), _ENGINES[engine.on.partition("=")[0]](engine, jobs) as begin:
        waiting = {begin(job): k for k, job in enumerate(jobs)}
        ended = 0
        while waiting:
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                k, ended = waiting.pop(future), ended + 1
                error = future.exception()
                if isinstance(error, UserError):
                    raise error
                status[k] = LOST if error is not None else future.result()
                remaining = (time.perf_counter() - began) / ended * (len(jobs) - ended)
                said = f"lost ({_line(error)})" if error is not None else f"status {status[k]}" if status[k] else "done"
                more = f", about {duration(remaining)} left" if ended < len(jobs) else ""
                print(f"  {jobs[k].folder.name}: {said}; {ended} of {len(jobs)}{more}", flush=True)
    return status


def attempt(job: Job, env: Mapping[str, str] | None = None) -> int:
    """Run a job's commands here; returns the status of the one that failed, or 0. What an earlier attempt has left,
    whose machine or worker was lost, is put aside first; its process is ended where it still lives."""
    commands, number, note, done = job.commands, 1, job.note, 0
    note.parent.mkdir(parents=True, exist_ok=True)
    if note.is_file():
        before = json.loads(note.read_text("utf-8"))
        number = int(before["attempt"]) + 1
        if before["host"] == files.HOST and before["pid"] and system.lives(before["pid"]):
            system.stop(before["pid"])
            limit = time.monotonic() + 30
            while system.lives(before["pid"]) and time.monotonic() < limit:
                time.sleep(0.1)
        done = int(before["done"])
        if not done:
            aside = note.with_name(f"{job.folder.name}_lost_{number - 1}")
            if job.folder.exists():
                shutil.move(job.folder, aside)
            if job.resumes:
                place = Path(next(a for a in reversed(commands[0]) if a.startswith("out=")).removeprefix("out="))
                last = aside / place.relative_to(job.folder) / "last.pt"
                if last.is_file():
                    train = commands[0][: commands[0].index("train") + 1]
                    commands = ((*train, f"resume={last}", f"out={place}"), *commands[1:])
    job.folder.mkdir(parents=True, exist_ok=True)
    began, status = time.perf_counter(), 0

    def write(pid: int | None) -> None:
        about = {"commands": commands, "attempt": number, "host": files.HOST, "pid": pid, "status": status,
                 "done": done, "seconds": round(time.perf_counter() - began, 1)}  # fmt: skip
        with files.beside(note) as part:
            part.write_text(json.dumps(about), "utf-8")

    write(None)
    for command in commands[done:]:
        with open(note.with_suffix(".txt"), "ab") as log:
            # a session of its own: a terminal's Ctrl-C reaches whoever waits for the job, who passes it on once
            process = subprocess.Popen([*job.program, *command], env={**os.environ, **(env or {})}, stdout=log,
                                       stderr=subprocess.STDOUT, start_new_session=True)  # fmt: skip
            write(process.pid)
            try:
                status = process.wait()
            except BaseException:
                system.stop(process.pid)
                process.wait()
                raise
        if status:
            break
        done += 1
        write(None)
    write(None)
    return status


@contextmanager
def _local(engine: Engine, jobs: Sequence[Job]) -> Iterator[Callable[[Job], Any]]:
    free: queue.Queue[str] = queue.Queue()
    for device in engine.devices:
        free.put(device)
    stopped = threading.Event()

    def one(job: Job) -> int:
        if stopped.is_set():
            return 130
        device = free.get() if engine.devices else None
        try:
            return attempt(job, None if device is None else {"CUDA_VISIBLE_DEVICES": device})
        finally:
            if device is not None:
                free.put(device)

    pool = ThreadPoolExecutor(engine.at_once or max(len(engine.devices), 1))
    try:
        yield lambda job: pool.submit(one, job)
    except BaseException:
        stopped.set()
        for job in jobs:
            if job.note.is_file() and (pid := json.loads(job.note.read_text("utf-8"))["pid"]):
                system.stop(pid)
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _slurm(engine: Engine, jobs: Sequence[Job]) -> Iterator[Callable[[Job], Any]]:
    try:
        import submitit
    except ImportError:
        raise UserError("on=slurm needs a package: pip install 'dexsim[cluster]'") from None
    if shutil.which("sbatch") is None:
        raise UserError("on=slurm: this machine has no sbatch; run it where jobs are submitted")
    executor = submitit.SlurmExecutor(folder=jobs[0].folder.parent / "slurm", max_num_timeout=RETRIES)
    given = {"array_parallelism": engine.at_once or 256, "job_name": "dexsim"}
    try:
        executor.update_parameters(**given, **{k: int(v) if v.isdecimal() else v for k, v in engine.slurm.items()})
    except ValueError as error:
        raise UserError(f"slurm.NAME=: {' '.join(str(error).split())[:300]}") from None
    pool, begun = ThreadPoolExecutor(max(len(jobs), 1)), []
    try:
        with executor.batch():
            begun = [executor.submit(attempt, job) for job in jobs]
        by_folder = {str(job.folder): one for job, one in zip(jobs, begun)}
        yield lambda job: pool.submit(by_folder[str(job.folder)].result)
    except submitit.core.utils.FailedJobError as error:
        raise UserError(f"on=slurm: sbatch refuses: {_line(error)}") from None
    except BaseException:
        for one in begun:
            one.cancel(check=False)
        raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _dask(engine: Engine, jobs: Sequence[Job]) -> Iterator[Callable[[Job], Any]]:
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise UserError("on=dask needs a package: pip install 'dexsim[cluster]'") from None
    address = engine.on.partition("=")[2]
    at_once = engine.at_once or max(len(engine.devices), 1)
    try:
        here = None if address else distributed.LocalCluster(at_once, threads_per_worker=1, dashboard_address=None)
        client = distributed.Client(here or address, timeout=REACH_S)
    except (OSError, ValueError) as error:
        raise UserError(f"on={engine.on}: no Dask scheduler answers there ({_line(error)})") from None
    pool = ThreadPoolExecutor(max(len(jobs), 1))
    try:
        yield lambda job: pool.submit(client.submit(attempt, job, pure=False, retries=RETRIES).result)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        client.close()
        if here is not None:
            here.close()


def _line(error: BaseException) -> str:
    return next((line.strip()[:200] for line in str(error).splitlines() if line.strip()), type(error).__name__)


_ENGINES: dict[str, Callable[[Engine, Sequence[Job]], Any]] = {"local": _local, "slurm": _slurm, "dask": _dask}
