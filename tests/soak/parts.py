"""What is repeated, each in its own process: `python -m tests.soak.parts NAME AMOUNT FOLDER`; prints what it did."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import time
import warnings
from pathlib import Path

import numpy as np

from tests.soak.watch import look

ROOT = Path(__file__).parents[2]
NEXT = 7
"""Numbers of worlds and seeds of the environments repeat after as many."""
TOLD = 5000
"""Readings of the loop between two notes of how far it is."""


def tell(folder: Path, done: float, between: bool = True) -> None:
    """Tell how much of its work a part has done, and where it is `between` two pieces of it (all that they had is given
    back), the memory that the process then keeps [MiB], in a file `done`, for who watches it."""
    saved = look(os.getpid()) if between else None
    part = folder / "done.tmp"
    part.write_text(f"{done:.6g} {saved[0]:.6g}" if saved else f"{done:.6g}")
    part.replace(folder / "done")


class Lagging:
    """A hand that follows its targets, with counts of touch that change, and an error code now and then."""

    name = "a hand that lags"

    def __init__(self, clock, folder: Path | None = None):
        from dexsim.deploy.driver import HandState

        self.clock, self._state, self.folder, self.begun = clock, HandState, folder, clock.now()
        self.q = self.target = np.full(12, 0.05)
        self.sequence, self.rng = 0, np.random.default_rng(0)

    def open(self):
        self.last = self.clock.now()
        return {}

    def read(self):
        now = self.clock.now()
        self.q = self.q + (self.target - self.q) * (1 - np.exp(-(now - self.last) / 0.03))
        self.last, self.sequence = now, self.sequence + 1
        if self.folder is not None and self.sequence % TOLD == 1:
            tell(self.folder, (now - self.begun) / 3600, between=False)
        touch = np.zeros((5, 120, 3), np.float32)
        touch[:, self.sequence % 120, 2] = 3.0
        error = np.zeros(12, int)
        error[3] = int(self.sequence % 1000 == 0)
        current = self.rng.normal(0, 20, 12)
        return self._state(now, self.sequence, self.q.astype(np.float32), current, tactile=touch, error=error)

    def send(self, command):
        self.target = command.position.copy()

    def relax(self):
        pass

    close = relax


def deploy(hours: float, folder: Path) -> str:
    """Return the loop with the included grasp policy for so many hours of its own time."""
    import torch

    from dexsim import export
    from dexsim.calibration.file import Calibration
    from dexsim.deploy import bundle
    from dexsim.deploy.driver import VirtualClock
    from dexsim.deploy.loop import Loop, LoopSettings
    from dexsim.deploy.vision import FixedPlace

    torch.set_num_threads(1)
    made = export.export(str(ROOT / "checkpoints" / "grasp.pt"), folder / "bundle", steps=2)
    clock = VirtualClock(100.0)
    settings = LoopSettings(seconds=3600 * hours, tor_max=300.0)
    loop = Loop(
        bundle.load(made), Lagging(clock, folder), FixedPlace([0.055, 0.0, 0.04]), Calibration.default(), settings,
        clock,
    )  # fmt: skip
    report = loop.run()
    if report.ended != "done" or report.not_relaxed:
        raise SystemExit(f"the loop ended: {report.ended} {report.not_relaxed}")
    did = f"{report.timing.turns} turns, {report.acts} actions, {report.counts['error_codes']} error codes"
    return f"{hours:g} h of the loop: {did}"


def envs(count: float, folder: Path) -> str:
    """Return the environments made, stepped and closed, of both tasks, of one to seven worlds."""
    import torch

    from dexsim.cli import start
    from dexsim.paths import CONFIGS
    from dexsim.sim.quiet import quiet_warp
    from dexsim.tasks import make_env

    quiet_warp("cpu")
    torch.set_num_threads(1)
    cfgs = {}
    for k in range(int(count)):
        worlds, task = 1 + k % NEXT, ("grasp", "grasp", "rotate")[k % 3]
        if (task, worlds) not in cfgs:
            own = [f"task={task}", "preset=none", f"worlds={worlds}", "device=cpu", f"sim.threads={1 + worlds % 2}"]
            cfgs[task, worlds] = start.for_train(own, CONFIGS).cfg
        env = make_env(cfgs[task, worlds], worlds, "cpu", k % NEXT, "mujoco")
        for _ in range(2):
            env.step(torch.zeros(worlds, 12))
        env.close()
        del env
        tell(folder, k + 1)
    return f"{int(count)} environments made, stepped and closed"


def diagnoses(count: float, folder: Path) -> str:
    """Diagnoses of four short recordings each, effects hidden in turn, with their reports written; every twentieth
    searches among all effects, the others among three."""
    from dexsim.gap import demo
    from dexsim.gap.diagnosis import diagnose
    from dexsim.gap.inquiry import Settings
    from dexsim.gap.report.files import save
    from dexsim.sim.quiet import quiet_warp

    warnings.simplefilter("ignore")
    quiet_warp("cpu")
    hidden = ("command_delay", "controller_term", "coulomb_friction")
    made = {effect: demo.make(folder / effect, effect, seconds=3.0)[:3] for effect in hidden}
    named = 0
    for k in range(int(count)):
        effect = hidden[k % len(hidden)]
        paths, model, servo = made[effect]
        out = folder / effect / "out"
        requested = Settings(
            paths,
            out,
            None,
            str(model),
            str(servo),
            replay="none",
            next_recording=False,
            allowed=set(hidden) if k % 20 else None,
        )
        d = diagnose(requested, say=lambda _: None)
        save(d, out)
        tell(folder, k + 1)
        named += any(f["effect"] == effect for f in d.data["findings"])
    return f"{int(count)} diagnoses, the hidden effect among the findings of {named}"


def plays(count: float, folder: Path) -> str:
    """Return `dexsim play` with the included grasp policy, its plots and a recording each time; prints memory."""
    from dexsim.cli.main import main

    heaps = []
    for k in range(int(count)):
        requested = ["episodes=2", "device=cpu", "video=false", f"seed={k % NEXT}", f"out={folder / 'play'}"]
        with contextlib.redirect_stdout(io.StringIO()):
            status = main(["play", f"checkpoint={ROOT / 'checkpoints' / 'grasp.pt'}", *requested,
                           f"record={folder / 'recordings' / f'{k}.mcap'}"])  # fmt: skip
        if status:
            raise SystemExit(f"play {k}: status {status}")
        tell(folder, k + 1)
        heap, rss, files, threads = look(os.getpid())
        heaps.append(heap)
        print(f"play {k + 1}: heap {heap:.1f} MiB, resident {rss:.1f}, {files} files, {threads} threads", flush=True)
    return f"{int(count)} plays, heap {heaps[0]:.0f} MiB after the first, {heaps[-1]:.0f} after the last"


if __name__ == "__main__":
    name, amount, where = sys.argv[1], float(sys.argv[2]), Path(sys.argv[3])
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    where.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    done = {"deploy": deploy, "envs": envs, "diagnoses": diagnoses, "plays": plays}[name](amount, where)
    print(f"{done}, in {time.monotonic() - began:.0f} s", flush=True)
