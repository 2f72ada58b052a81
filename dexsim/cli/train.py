"""One training run from resolved settings to the command that plays its policy."""

from __future__ import annotations

import contextlib
import math
import shlex
import time
from pathlib import Path
from typing import Any

from dexsim.cli import build, folder, machine
from dexsim.cli.console import TrainingLines
from dexsim.cli.replay import replay
from dexsim.cli.report import describe_env
from dexsim.cli.start import Start
from dexsim.cli.watch import Watch
from dexsim.console import program
from dexsim.console.stop import Stop
from dexsim.console.tables import count, duration, table
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.ranks import Ranks
from dexsim.learning.runner import Runner
from dexsim.tasks.registry import typing

SAVE_EVERY_S = 60.0  # last.pt and policy.pt, besides what save_interval keeps
TAGS = {
    "reward": "Train/mean_reward", "length": "Train/mean_episode_length", "step_reward": "Train/step_reward",
    "rate": "Perf/steps_per_second", "collect_s": "Perf/collection_time", "learn_s": "Perf/learning_time",
}  # fmt: skip


def run(start: Start, make_env: build.MakeEnv | None = None, where: Path | None = None) -> int:
    """Train; returns the exit status: 0, 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP. Raises UserError.

    where: the run's folder, already claimed (:func:`dexsim.cli.folder.for_run`); None: claim one.

    Under torchrun this runs in every process (rank): all learn, rank 0 alone prints and writes.
    """
    ranks = Ranks()
    _check_resume(start)
    if start.source and ranks.leader:
        folder.tidy([Path(start.source).expanduser().parent])
    with (
        ranks.only_leader_prints(),
        Stop(several=ranks.size > 1) as stop,
        contextlib.ExitStack() as open_,
        ranks.joined(start.cfg["device"]),
    ):
        return _run(start, make_env, ranks, stop, where, open_)


def _run(
    start: Start, make_env: build.MakeEnv | None, ranks: Ranks, stop: Stop, where: Path | None,
    open_: contextlib.ExitStack,
) -> int:  # fmt: skip
    cfg = start.cfg
    where = Path(ranks.tell(str(where or folder.for_run(cfg)) if ranks.leader else None))
    if ranks.leader:
        folder.write_config(where, cfg)
    ranks.on_loss("")
    facts = {"run": where} if ranks.size == 1 else {"ranks": f"{ranks.size}, {cfg['worlds']} worlds each", "run": where}
    with ranks.one_compiles(), folder.kept_if_begun(where):
        env = build.build_env(cfg | {"seed": ranks.seed(cfg["seed"])}, make_env, facts, start.given)
    open_.callback(build.close, env)
    env.dump_folder = where if ranks.leader else where / f"rank_{ranks.rank}"  # for worlds that were not finite
    print("\n" + describe_env(env.describe()) + "\n", flush=True)
    if expect := cfg["task"].get("expect"):
        ranges = (f"{name} {low:g} to {high:g}" for name, (low, _, high) in _ranges(expect).items())
        print(f"expect   {', '.join(ranges)}: {expect['of']}\n")
    stop.requested()  # Ctrl-C while compiling: nothing to save
    runner = Runner(env, cfg, machine.versions(), ranks, start.typed)
    if start.data is not None:
        runner.restore(start.data, str(start.source))
        went = f"; {runner.resumed}" if runner.resumed else ""
        print(f"continuing {start.source} after {runner.iteration} iterations, {count(runner.steps)} steps{went}")
    said = typing(str(cfg["task"]["class"])) if "class" in cfg["task"] else ""
    resume = f"{_command(ranks)} resume={shlex.quote(str(where / 'last.pt'))}{said}"
    ranks.on_loss(f"continue: {resume}")
    watch = Watch(cfg, where) if ranks.leader and cfg.get("view") else None
    if watch is not None:
        open_.callback(watch.end)
    log = Log(runner, where, start, watch) if ranks.leader else None
    stop.gently = True
    try:
        finished = runner.learn(cfg["iterations"], log.iteration if log else lambda row: None, stop.requested)
    except checkpoint.SaveError:
        raise
    except UserError as error:
        saved = f"; saved until then: {where / 'last.pt'}" if (where / "last.pt").exists() else ""
        raise UserError(f"{error}{saved}") from error.__cause__
    if log:
        log.finish()
    stop.gently = False
    ranks.leave()
    if not finished:
        print(f"\nstopped after {runner.iteration} iterations; saved {where / 'last.pt'}\ncontinue: {resume}")
        return stop.status
    status = _final_episodes(runner, cfg, where) if ranks.leader else 0
    print(f"\nplay it:  {program.name('play')} checkpoint={shlex.quote(str(where / 'policy.pt'))}{said}")
    return status


def _command(ranks: Ranks) -> str:
    return program.name("train") if ranks.size == 1 else program.torchrun("train", ranks.here, ranks.machines)


def _check_resume(start: Start) -> None:
    if start.data is None:
        return
    if start.data["kind"] != "train":
        raise UserError(f"{start.source}: holds only a policy, nothing to resume; use the last.pt of its run folder")
    done = int(start.data["iteration"])
    if start.cfg["iterations"] <= done:
        raise UserError(
            f"resume={start.source}: all {done} iterations are done; ask for more, e.g. iterations={2 * done}"
        )


def _final_episodes(runner: Runner, cfg: dict[str, Any], where: Path) -> int:
    """Play with the learned policy and film it; the training stands whatever happens here."""
    episodes = cfg["final_episodes"]
    if not episodes:
        return 0
    print(f"\nplaying {episodes} episodes for metrics and a video (final_episodes=0: none)", flush=True)
    out = folder.make(where / "play", "out=")
    about = {"checkpoint": str(where / "policy.pt"), "iteration": runner.iteration, "versions": machine.versions()}
    try:
        metrics = replay(
            runner.env, runner.policy(), out, episodes, seed=cfg["seed"] + 1_000_003, video=True, about=about
        )
        if rows := beside(cfg, metrics):
            title = f"This policy beside {cfg['task']['expect']['of']}"
            print("\n" + table(title, ("metric", "this one", "lowest", "mean", "highest"), rows))
    except KeyboardInterrupt:
        print("\nfinal episodes broken off; the training is saved")
        return 130
    return 0


def _ranges(expect: dict[str, Any]) -> dict[str, list[float]]:
    return {name: given for name, given in expect.items() if name != "of"}


def beside(cfg: dict[str, Any], metrics: dict[str, Any]) -> list[tuple]:
    """Return (metric, this policy's, and of other trainings the lowest, mean and highest), as far as the task's
    settings know (`expect`)."""
    ranges = _ranges(cfg["task"].get("expect") or {})
    return [(name, metrics[name], *given) for name, given in ranges.items() if metrics.get(name) is not None]


class Log:
    """Where an iteration's numbers go: the writer (TensorBoard), progress.csv, the console; and when to save."""

    def __init__(self, runner: Runner, where: Path, start: Start, watch: Watch | None = None) -> None:
        self._runner, self._where, self._every, self._watch = runner, where, start.cfg["save_interval"], watch
        times = f"{runner.ranks.size} x " if runner.ranks.size > 1 else ""
        self._title = f"{start.cfg['choices']['task']}, {times}{start.cfg['worlds']} worlds, {where}"
        self._writer = runner.open_writer(where)
        earlier = Path(start.source).parent / "progress.csv" if start.source else None
        self._file = folder.ProgressFile(where / "progress.csv", earlier, runner.iteration)
        self._lines = TrainingLines(start.cfg["iterations"], runner.env.describe().get("headline", ()))
        self._lines.start(runner.iteration)
        self._began = time.perf_counter()
        self._first_step = runner.steps
        self._saved_at, self._saved_time = -1, -math.inf

    def iteration(self, row: dict[str, float]) -> None:
        """Take one iteration's numbers."""
        row["rate"] = self._runner.steps_per_iteration / (row["collect_s"] + row["learn_s"])
        self._file.add(row)
        for name, value in row.items():
            if name not in ("iteration", "steps", "episodes"):
                self._writer.add_scalar(TAGS.get(name, name), value, int(row["iteration"]))
        self._lines.show(row)
        if self._runner.iteration % self._every == 0:
            self._save(f"model_{self._runner.iteration}.pt")
        elif time.perf_counter() - self._saved_time > SAVE_EVERY_S:  # so that a killed run loses a minute at most
            self._save()

    def _save(self, *names: str) -> None:
        payload = self._runner.payload()
        data = checkpoint.encode(payload)
        for name in (*names, "last.pt"):
            checkpoint.write(self._where / name, data)
        checkpoint.save(self._where / "policy.pt", checkpoint.policy_only(payload))
        self._saved_at, self._saved_time = self._runner.iteration, time.perf_counter()
        if self._watch is not None:
            self._watch.begin()

    def finish(self) -> None:
        """Save what is not saved yet, close the writer, draw the curves, sum up."""
        if self._saved_at != self._runner.iteration:
            self._save()
        for name in ("flush", "close", "stop"):
            getattr(self._writer, name, lambda: None)()
        seconds, steps = time.perf_counter() - self._began, self._runner.steps - self._first_step
        print(
            f"\nlearned from {count(steps)} steps in {duration(seconds)} ({count(steps / max(seconds, 1e-9))} steps/s)"
        )
        if (self._where / "progress.csv").exists():
            from dexsim.view.plots import curves, read_progress

            drawn = curves(read_progress(self._where / "progress.csv"), self._where / "curves.png", self._title)
            print(f"curves   {drawn}")
        print(f"run      {self._where}")
