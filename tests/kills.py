"""`python -m tests.kills [count=200] [kinds=train,record,write,diagnose,save,export] [seed=0] [out=FOLDER]`: kill -9 at
random moments; is what was saved before still there, whole, and does the next start remove what was left unfinished?

train: trainings that save after each iteration, each going on where the last that was killed had saved; record: the
deployed loop in real time with `record=`; write: a recording written over and over in one place; diagnose: a diagnosis
over an earlier one; save: its results written again and again; export: a bundle.
Ends with status 1 where anything was lost but the time since the last save.
"""

from __future__ import annotations

import csv
import json
import mmap
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
LONGEST = {"train": 2.5, "record": 3.0, "write": 0.3, "diagnose": 2.5, "save": 0.5, "export": 4.0}
"""s after which a process is killed at the latest, counted from when it is ready; of a work that ends, 1.3 times what
it takes on this machine (`longest`) where that is longer."""
CHUNK = 0.5
"""s of a recording that may be lost: what came since its last chunk was finished. (What waits for the recorder's thread
is lost as well: how much depends on what else the machine does.)"""
MOST = 1_000_000
"""Times that a child tells at most."""


class Shared:
    """Two numbers, and a list of times, that a child writes and its parent reads after it is gone."""

    def __init__(self) -> None:
        self._map = mmap.mmap(-1, 8 * (3 + MOST))
        self._numbers = np.frombuffer(self._map)

    def tell(self, ready: float, done: float = 0.0) -> None:
        self._numbers[1] = done
        self._numbers[0] = ready

    def read(self) -> tuple[float, float]:
        return float(self._numbers[0]), float(self._numbers[1])

    def add(self, t: float) -> None:
        n = int(self._numbers[2])
        self._numbers[3 + n] = t
        self._numbers[2] = n + 1

    def times(self) -> np.ndarray:
        return self._numbers[3: 3 + int(self._numbers[2])].copy()


def killed(work: Callable[[Shared], None], after: float, wait: bool) -> Shared:
    """Run in a child, kill it `after` s (from when it says that it is ready, if `wait`); what it told. Raises
    RuntimeError where the child ended by itself with an error."""
    shared = Shared()
    shared.tell(0.0)
    pid = os.fork()
    if pid == 0:
        status = 0
        try:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            work(shared)
        except BaseException:
            traceback.print_exc()
            status = 1
        os._exit(status)
    end = time.monotonic() + 120
    while wait and not shared.read()[0] and time.monotonic() < end and os.waitpid(pid, os.WNOHANG) == (0, 0):
        time.sleep(0.002)
    time.sleep(after)
    try:
        os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
    except (ProcessLookupError, ChildProcessError):
        raise RuntimeError("the child ended before it was killed") from None
    if os.WIFEXITED(status) and os.WEXITSTATUS(status):
        raise RuntimeError("the child failed (see above)")
    return shared


def takes(work: Callable[[Shared], None]) -> float:
    """Return s that a work takes in a child, until it first tells that it is ready."""
    began = time.monotonic()
    killed(work, 0.0, True)
    return time.monotonic() - began


class Train:
    """A chain of trainings."""

    def __init__(self, folder: Path):
        self.folder, self.k, self.source, self.iteration = folder, 0, None, 0

    def trial(self, after: float, rng: np.random.Generator) -> str:
        from dexsim.cli import folder as folders
        from dexsim.learning import checkpoint

        self.k += 1
        out = self.folder / f"run{self.k}"
        begun = self.iteration
        noted = int(killed(lambda shared: self._train(out, shared), after, rng.random() < 0.7).read()[1])
        last = out / "last.pt"
        if not last.exists():
            assert not noted, f"saved after iteration {noted}, and nothing is there"
            return "before the first save"
        for path in sorted(out.glob("*.pt")):
            data = checkpoint.load(path)
        data = checkpoint.load(last)
        assert data["iteration"] >= max(noted, begun), f"{last}: iteration {data['iteration']}, {noted} was saved"
        assert data["steps"] == data["iteration"] * 24 * 4, "steps do not fit the iterations"
        rows = [int(r["iteration"]) for r in csv.DictReader(open(out / "progress.csv"))]
        assert rows[: data["iteration"]] == list(range(1, data["iteration"] + 1)), (
            f"{out}/progress.csv lacks rows: {rows}"
        )
        self.source, self.iteration = last, data["iteration"]
        folders.tidy([out])
        assert not list(out.glob(".*.tmp")), "unfinished files are left"
        return "kept"

    def _train(self, out: Path, shared: Shared) -> None:
        from dexsim.cli import start, train
        from dexsim.paths import CONFIGS

        save = train.Log._save

        def saved(log, *names):
            save(log, *names)
            shared.tell(1.0, log._runner.iteration)

        train.Log._save = saved
        learn = train.Runner.learn
        train.Runner.learn = lambda self, *a: (shared.tell(1.0), learn(self, *a))[1]
        own = ["save_interval=1", "iterations=1000000", "final_episodes=0", f"out={out}"]
        fresh = ["task=grasp", "preset=none", "device=cpu", "worlds=4", "sim.threads=1", "agent.actor.hidden_dims=[16]",
                 "agent.critic.hidden_dims=[16]"]  # fmt: skip
        train.run(start.for_train([*([f"resume={self.source}"] if self.source else fresh), *own], CONFIGS))


class Record:
    """The loop and its recorder, in real time."""

    def __init__(self, folder: Path):
        from dexsim import export

        self.folder, self.bundle, self.k = folder, folder / "bundle", 0

        def made(shared: Shared) -> None:
            export.export(str(ROOT / "checkpoints" / "grasp.pt"), self.bundle, steps=2)
            shared.tell(1.0)
            time.sleep(60)

        killed(made, 0.0, True)

    def trial(self, after: float, rng: np.random.Generator) -> str:
        from dexsim.errors import UserError
        from dexsim.recording import read

        self.k += 1
        path = self.folder / f"{self.k}.mcap"
        noted = killed(lambda shared: self._loop(path, shared), after, True).times()
        try:
            t = read(path, audit=False).states.position.t
        except UserError as error:
            assert (not len(noted) or noted[-1] < CHUNK) and "\n" not in str(error), f"{noted[-1]:.2f} s: {error}"
            return "before the first chunk"
        both = min(len(t), len(noted))  # it may be killed between a sample and the word of it
        assert np.allclose(t[:both], noted[:both], rtol=0, atol=1e-6) and len(t) <= both + 1, "samples are gone"
        lost = noted[both:]
        assert not len(lost) or lost[-1] - lost[0] < CHUNK, f"of {noted[-1]:.2f} s all from {lost[0]:.2f} s on is gone"
        path.unlink()
        return "kept"

    def _loop(self, path: Path, shared: Shared) -> None:
        from dexsim.calibration.file import Calibration
        from dexsim.deploy import bundle, loop
        from dexsim.deploy.driver import Clock
        from dexsim.deploy.recorder import Recorder
        from dexsim.deploy.vision import FixedPlace
        from dexsim.recording import schema
        from dexsim.recording.writer import Writer
        from tests.soak.parts import Lagging

        clock, made = Clock(), bundle.load(self.bundle)
        message, first = Writer._message, []

        def noted(self, topic, t, data):
            message(self, topic, t, data)
            first.append(t)
            if topic == schema.STATES:
                shared.add(t - first[0])  # readers count from the first sample
            shared.tell(1.0)

        Writer._message = noted
        recorder = Recorder(path, made.manifest["joints"], {"effort_is": "current_A"}, None, clock.now())
        # this machine is shared: a loop that is late is another test's
        settings = loop.LoopSettings(seconds=1000.0, tor_max=300.0, late=10.0, stale=10.0, hang=10.0, overruns=1000000)
        loop.Loop(
            made, Lagging(clock), FixedPlace([0.055, 0.0, 0.04]), Calibration.default(), settings, clock, recorder
        ).run()


class Write:
    """A recording written over and over."""

    def __init__(self, folder: Path):
        from tests.fuzz import corpus

        self.path, self.made = folder / "x.mcap", corpus.recording(6.0)

    def trial(self, after: float, rng: np.random.Generator) -> str:
        from dexsim import files
        from dexsim.recording import read, write

        def work(shared: Shared) -> None:
            write(self.path, self.made)
            shared.tell(1.0)
            while True:
                write(self.path, self.made)

        killed(work, after, True)
        there = read(self.path, audit=False)
        assert len(there.states.position) == len(self.made.states.position) and len(there.tactile.t) == len(
            self.made.tactile.t
        ), "samples are gone"
        files.sweep(self.path.parent)
        assert [p.name for p in self.path.parent.iterdir()] == ["x.mcap"], "unfinished files are left"
        return "kept"


class Diagnose:
    """Diagnoses, and their results written again and again."""

    def __init__(self, folder: Path, again: bool):
        from dexsim.gap import demo

        self.folder, self.again, self.out = folder, again, folder / "out"
        killed(
            lambda shared: (demo.make(folder, "command_delay", seconds=3.0), shared.tell(1.0), time.sleep(60)),
            0.0,
            True,
        )
        self.before: dict[str, bytes] = {}
        self.longest = 0.0 if again else 1.3 * takes(self._diagnose)

    def trial(self, after: float, rng: np.random.Generator) -> str:
        from dexsim import outputs
        from dexsim.gap.report.files import RESULTS

        killed(self._diagnose, after, self.again)
        if self.out.exists():
            outputs.claim(self.out, "out=", RESULTS)  # as the next start does
        there = {p.name for p in self.out.glob("*")} if self.out.exists() else set()
        assert not [n for n in there if n.endswith(".tmp")], f"unfinished files are left: {there}"
        files = there - {outputs.WRITTEN}
        if not files:
            assert not self.before, "the earlier results are gone"
            return "before the first save"
        assert files >= {"diagnosis.json", "details.json", "report.html", "servo.yaml"}, f"only some are there: {files}"
        for name in files:
            text = (self.out / name).read_text()
            whole = (
                json.loads(text) is not None
                if name.endswith(".json")
                else text.rstrip().endswith("</html>")
                if name.endswith("html")
                else text
            )
            assert whole, f"{name} is cut off"
        self.before = {n: (self.out / n).read_bytes() for n in files}
        return "kept"

    def _diagnose(self, shared: Shared) -> None:
        from dexsim.gap.diagnosis import diagnose
        from dexsim.gap.inquiry import Settings
        from dexsim.gap.report.files import save

        paths = sorted(self.folder.glob("motion_*.mcap"))
        model, servo = (str(self.folder / f"rig{end}") for end in (".xml", ".yaml"))
        quick = {"replay": "none", "next_recording": False, "allowed": {"command_delay"}}
        requested = Settings(paths, self.out, None, model, servo, **quick)
        d = diagnose(requested, say=lambda _: None)
        save(d, self.out)
        shared.tell(1.0)
        for k in range(10**6):
            d.notes = [f"the {k}th time"]
            save(d, self.out)


class Export:
    """Bundles: there or not."""

    def __init__(self, folder: Path):
        self.folder, self.k = folder, 0
        self.longest = 1.3 * takes(lambda shared: (self._export(folder / "whole"), shared.tell(1.0), time.sleep(60)))

    def _export(self, out: Path) -> None:
        from dexsim import export

        export.export(str(ROOT / "checkpoints" / "grasp.pt"), out, steps=2)

    def trial(self, after: float, rng: np.random.Generator) -> str:
        from dexsim import outputs
        from dexsim.deploy import bundle

        self.k += 1
        out = self.folder / f"bundle{self.k % 3}"  # into what the last but two left

        def made(shared: Shared) -> None:
            shared.tell(1.0)
            self._export(out)
            time.sleep(60)

        killed(made, after, True)
        outputs.recover(out)
        there = sorted(p.name for p in out.iterdir()) if out.exists() else []
        if not there:
            return "before it was whole"
        bundle.load(out)
        assert set(there) - {outputs.WRITTEN} == {"config.yaml", "golden.npz", "manifest.yaml", "policy.onnx"}, there
        shutil.rmtree(out)
        return "kept"


KINDS: dict[str, tuple[Callable[[Path], object], int]] = {
    "train": (Train, 6), "record": (Record, 4), "write": (Write, 2), "diagnose": (lambda f: Diagnose(f, False), 2),
    "save": (lambda f: Diagnose(f, True), 3), "export": (Export, 3),
}  # fmt: skip
"""What is killed, and how often among twenty."""


def run(count: int, kinds: list[str], seed: int, folder: Path) -> tuple[Counter[str], list[str]]:
    """Return (outcomes, what was lost)."""
    import torch

    import dexsim.cli.train
    import dexsim.export
    import dexsim.gap.diagnosis  # noqa: F401  (before the forks, so that each is quick)
    from dexsim.deploy import loop  # noqa: F401

    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    rng, made, outcomes, lost = np.random.default_rng(seed), {}, Counter(), []
    order = [k for k in kinds for _ in range(KINDS[k][1])]
    for n in range(count):
        kind = order[n % len(order)]
        if kind not in made:
            (folder / kind).mkdir(parents=True)
            made[kind] = KINDS[kind][0](folder / kind)
        after = float(rng.uniform(0, max(LONGEST[kind], getattr(made[kind], "longest", 0.0))))
        try:
            outcomes[f"{kind}: {made[kind].trial(after, rng)}"] += 1
        except Exception as error:
            lost.append(f"{kind}, killed after {after:.3f} s: {type(error).__name__}: {error}")
            print(lost[-1], flush=True)
    return outcomes, lost


def main(argv: list[str]) -> int:
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    if set(given) - {"count", "kinds", "seed", "out"} or any("=" not in a for a in argv):
        print(__doc__)
        return 2
    with tempfile.TemporaryDirectory() as scratch:
        kinds = given.get("kinds", ",".join(KINDS)).split(",")
        outcomes, lost = run(
            int(given.get("count", 200)), kinds, int(given.get("seed", 0)), Path(given.get("out", scratch))
        )
    for what, number in sorted(outcomes.items()):
        print(f"{number:5d}  {what}")
    print(json.dumps({"kills": sum(outcomes.values()) + len(lost), "lost": len(lost)}))
    return int(bool(lost))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
