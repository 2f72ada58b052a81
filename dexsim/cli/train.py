"""One training run from resolved settings to the ``play.py`` command. Called by train.py in the root folder."""

from __future__ import annotations

import shlex
import signal
import time
from pathlib import Path
from types import FrameType
from typing import Any

from dexsim.cli import build, folder, machine
from dexsim.cli.console import TrainingLines
from dexsim.cli.replay import replay
from dexsim.cli.report import count, duration
from dexsim.cli.start import Start
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.runner import Runner

TAGS = {"reward": "Train/mean_reward", "length": "Train/mean_episode_length", "step_reward": "Train/step_reward",
        "rate": "Perf/steps_per_second", "collect_s": "Perf/collection_time", "learn_s": "Perf/learning_time"}


def run(start: Start, make_env: build.MakeEnv | None = None) -> int:
    """Train; returns the exit status: 0, 130 after Ctrl-C, 143 after SIGTERM. Raises UserError."""
    cfg = start.cfg
    machine.refuse_many_ranks()
    _check_resume(start)
    where = folder.for_run(cfg)
    folder.write_config(where, cfg)
    with Stop() as stop:
        env = build.build_env(cfg, make_env, {"run": where})
        env.dump_folder = where  # for worlds that were not finite
        build.print_tables(env)
        stop.asked()  # Ctrl-C while compiling: nothing to save
        runner = Runner(env, cfg, machine.versions())
        if start.data is not None:
            runner.restore(start.data, str(start.source))
            print(f"continuing {start.source} after {runner.iteration} iterations, {count(runner.steps)} steps")
        log = Log(runner, where, start)
        stop.gently = True
        try:
            finished = runner.learn(cfg["iterations"], log.iteration, stop.asked)
        except checkpoint.SaveError:
            raise
        except UserError as error:
            saved = f"; saved until then: {where / 'last.pt'}" if (where / "last.pt").exists() else ""
            raise UserError(f"{error}{saved}") from error.__cause__
        log.finish()
        stop.gently = False
        if not finished:
            print(f"\nstopped after {runner.iteration} iterations; saved {where / 'last.pt'}\n"
                  f"continue: python train.py resume={shlex.quote(str(where / 'last.pt'))}")
            return stop.status
        status = _final_episodes(runner, cfg, where)
    print(f"\nplay it:  python play.py checkpoint={shlex.quote(str(where / 'policy.pt'))}")
    return status


def _check_resume(start: Start) -> None:
    if start.data is None:
        return
    if start.data["kind"] != "train":
        raise UserError(f"{start.source}: holds only a policy, nothing to resume; use the last.pt of its run folder")
    done = int(start.data["iteration"])
    if start.cfg["iterations"] <= done:
        raise UserError(f"resume={start.source}: all {done} iterations are done; ask for more, e.g. iterations={2 * done}")


def _final_episodes(runner: Runner, cfg: dict[str, Any], where: Path) -> int:
    """Play with the learned policy and film it; the training stands whatever happens here."""
    episodes = cfg["final_episodes"]
    if not episodes:
        return 0
    print(f"\nplaying {episodes} episodes")
    out = folder.make(where / "play", "out=")
    about = {"checkpoint": str(where / "policy.pt"), "iteration": runner.iteration, "versions": machine.versions()}
    try:
        replay(runner.env, runner.policy(), out, episodes, seed=cfg["seed"] + 1_000_003, video=True, about=about)
    except KeyboardInterrupt:
        print("\nfinal episodes broken off; the training is saved")
        return 130
    return 0


class Log:
    """Where an iteration's numbers go: the writer (TensorBoard), progress.csv, the console; and when to save."""

    def __init__(self, runner: Runner, where: Path, start: Start) -> None:
        self._runner, self._where, self._every = runner, where, start.cfg["save_interval"]
        self._title = f"{start.cfg['choices']['task']}, {start.cfg['worlds']} worlds, {where}"
        self._writer = runner.open_writer(where)
        earlier = Path(start.source).parent / "progress.csv" if start.source else None
        self._file = folder.ProgressFile(where / "progress.csv", earlier, runner.iteration)
        self._lines = TrainingLines(start.cfg["iterations"], runner.env.describe().get("headline", ()))
        self._lines.start(runner.iteration)
        self._began = time.perf_counter()
        self._first_step = runner.steps
        self._saved_at = -1

    def iteration(self, row: dict[str, float]) -> None:
        """Take one iteration's numbers."""
        steps = self._runner.cfg["num_steps_per_env"] * self._runner.env.num_envs
        row["rate"] = steps / (row["collect_s"] + row["learn_s"])
        self._file.add(row)
        for name, value in row.items():
            if name not in ("iteration", "steps", "episodes"):
                self._writer.add_scalar(TAGS.get(name, name), value, int(row["iteration"]))
        self._lines.show(row)
        if self._runner.iteration % self._every == 0:
            self._save(f"model_{self._runner.iteration}.pt")

    def _save(self, *names: str) -> None:
        payload = self._runner.payload()
        data = checkpoint.encode(payload)
        for name in (*names, "last.pt"):
            checkpoint.write(self._where / name, data)
        checkpoint.save(self._where / "policy.pt", checkpoint.policy_only(payload))
        self._saved_at = self._runner.iteration

    def finish(self) -> None:
        """Save what is not saved yet, close the writer, draw the curves, sum up."""
        if self._saved_at != self._runner.iteration:
            self._save()
        for name in ("flush", "close", "stop"):
            getattr(self._writer, name, lambda: None)()
        seconds, steps = time.perf_counter() - self._began, self._runner.steps - self._first_step
        print(f"\nlearned from {count(steps)} steps in {duration(seconds)} ({count(steps / max(seconds, 1e-9))} steps/s)")
        if (self._where / "progress.csv").exists():
            from dexsim.view.plots import curves, read_progress

            print(f"curves   {curves(read_progress(self._where / 'progress.csv'), self._where / 'curves.png', self._title)}")
        print(f"run      {self._where}")


class Stop:
    """Ctrl-C and SIGTERM: at once by default; while ``gently`` is set, the first only asks the loop to end."""

    def __init__(self) -> None:
        self.gently, self.status = False, 130
        self._asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stop:
        try:
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._handle)
        except ValueError:  # not in the main thread: whoever runs us handles signals
            pass
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        self.status = 128 + number
        if not self.gently or self._asked:
            raise KeyboardInterrupt
        self._asked = True
        print("\nstopping and saving (Ctrl-C again: stop at once, without saving)", flush=True)

    def asked(self) -> bool:
        """Whether someone asked to stop."""
        return self._asked
