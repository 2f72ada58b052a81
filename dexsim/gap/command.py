"""The command line of `diagnose.py`: settings, progress, the verdict in ten lines."""

from __future__ import annotations

import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dexsim import yaml_text
from dexsim.console import jobs, program
from dexsim.errors import UserError
from dexsim.typed import number, whole

if TYPE_CHECKING:
    from dexsim.gap.compute import TimeLimit
    from dexsim.gap.inquiry import Diagnosis, Settings

HELP = """usage: python diagnose.py recordings='[a.mcap,b.mcap]' out=DIR [key=value ...]
       python diagnose.py demo=true [out=DIR]
       python diagnose.py columns=true

Find what the simulator leaves out of a recorded mechanism: where it goes wrong, which physics is missing, its size, and
the proof on recordings not used for the fit. Joints by their motion, current and duty; touch by /tactile and what is
known of the object (/object_pose, or a body of the model) and of its force (/external_force). A joint is judged while
nothing is touched.

writes to out=:
  report.html           one page: open it in a browser
  diagnosis.json        the same for programs
  servo.yaml            the fitted drives with intervals: python train.py servo_file=FILE randomizes inside them
  tactile.yaml          where something of touch was found: python train.py tactile_file=FILE draws inside
  model.xml             where masses or inertias were fitted: python train.py model_file=FILE
  next_recording.mcap   commands to send, where another recording would settle a question

examples:
  python diagnose.py recordings='[a.mcap,b.mcap,c.mcap]' out=out/hand
  python diagnose.py recordings='[a.mcap,b.mcap]' held_out='[c.mcap]' model=rig.xml servo=rig.yaml out=out/rig
  python diagnose.py fleet='logs/*/' model=rig.xml servo=rig.yaml out=out/fleet
  python diagnose.py demo=true

settings (key=default):
  recordings=                 MCAP files, bag folders, CSV and NPZ files with named columns, data sets (LeRobot, Zarr,
                              HDF5; DATASET#0:40 are some of its episodes): [a.mcap,b.csv,...], or a pattern
                              'runs/*.mcap'
  held_out=                   recordings held out of the fit, or 'episodes[40:]' of them; they are taken out of
                              recordings=. Without them a condition, or the last quarter of the time, is held out
  model=                      MuJoCo or URDF file, or the folder of a hand; hand= by default
  hand=xhand                  a hand that comes with dexsim, or a folder; beside model=, the hand whose fingertips and
                              touch pads that model carries
  hand_mirror=false           its mirror image: a left hand of a right one
  servo=                      servo.yaml believed of its drives; the xHand's by default
  out=out/diagnosis           folder for the results
  effects=                    consider only these effects: [backlash,lag,tactile_hysteresis,...]; all by default
  joints=                     judge only these joints: [elbow,wrist]; the others' recorded motion is only prescribed
  limit=                      seconds to take at most: the best answer by then, saying so. Ctrl-C does the same at once
  next=true                   also write the commands of the next recording, where one would help
  seed=0                      of the bootstraps
  replay=mujoco               engine in which the answer is replayed: mujoco (C MuJoCo), warp (MuJoCo-Warp, on the
                              device), none
  device=cpu                  cpu | cuda | cuda:1: where hypotheses are simulated. On a CPU, OMP_NUM_THREADS limits
                              the cores that are used
  demo=false                  make recordings with a hidden effect, diagnose them, then open the answer: true
                              (command_delay),
                              or backlash, compliance, coulomb_friction, deadband, load_friction, stribeck_friction
  columns=false               list the columns of servo.yaml with unit, neutral value and meaning
  fleet=                      folders of machines of one type, 'logs/*/': each is diagnosed from its own recordings
                              (and by its own model.xml, servo.yaml, where it has them); out=DIR gets a page that
                              compares them
  before=                     fleet=: the folder of an earlier diagnosis of the fleet; says which machine drifted since
  on= at_once= slurm.NAME=    fleet=: where its jobs run (docs/howto/gpus.md)
  meta.KEY=                   metadata that the recordings lack, e.g. meta.gravity="0 0 -9.81"
  units.QUANTITY=             the unit of what is recorded: units.position=deg, ticks:4096, percent, normalized,
                              registers (0 to 1000); units.position.JOINT= of one joint
  remap.OURS=                 their name of a topic, a joint or a column, e.g. remap./joint_states=/xhand/state,
                              remap.position.elbow=enc1
"""
KEYS = tuple(re.findall(r"^  (\w+)=\S*  ", HELP, re.M))  # as they are listed there


def parse(argv: list[str]) -> dict:
    """Return key=value settings; UserError for a key that does not exist or a value of the wrong type."""
    from dexsim.actuator.columns import did_you_mean

    out: dict = {"meta": {}, "remap": {}}
    for argument in argv:
        key, equals, text = argument.partition("=")
        if not equals:
            hint = f"write {argument.lstrip('-')}=..." if argument.startswith("-") else "write it as key=value"
            raise UserError(f"'{argument}' is not a setting: {hint} (--help lists them)")
        group, dot, name = key.partition(".")
        if group == "units":
            group, name = "meta", key
        if dot and group in ("meta", "remap") and name:
            out[group][name] = text
            continue
        if key not in KEYS:
            raise UserError(
                f"setting '{key}' does not exist.{did_you_mean(key, KEYS)} Valid: {', '.join(KEYS)}, meta.KEY, "
                "units.QUANTITY, remap.OURS"
            )
        if key in ("recordings", "held_out", "effects", "joints"):
            text = text.strip()
            items = re.split(r",(?![^\[]*\])", text[1:-1]) if text.startswith("[") and text.endswith("]") else [text]
            out[key] = [i.strip().strip("'\"") for i in items if i.strip()]
        elif key == "demo":
            out[key] = _hidden(text)
        elif key in ("columns", "next", "hand_mirror"):
            value = yaml_text.parse(text, f"{key}=")
            if not isinstance(value, bool):
                raise UserError(f"{key}={text}: must be true or false")
            out[key] = value
        elif key == "limit":
            out[key] = number(key, text, 1.0, 1e7, "s")
        elif key == "seed":
            out[key] = whole(key, text)
        else:
            out[key] = text
    return out


def _hidden(text: str) -> str | None:
    """Return the effect that a demo hides; None for no demo."""
    from dexsim.gap.demo import HIDDEN
    from dexsim.gap.effects.signals import CommandDelay

    value = {"true": CommandDelay.id, "false": None}.get(text.lower(), text)
    if value is not None and value not in HIDDEN:
        raise UserError(f"demo={text}: must be true, false or one of {', '.join(sorted(HIDDEN))}")
    return value


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status. Raises UserError."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(program.words(HELP), end="")
        return 0 if argv else 2
    if any(a.startswith("fleet=") for a in argv):
        from dexsim.gap import fleet

        return fleet.run(argv, parse(jobs.taken(argv)[1]))
    given = parse(argv)
    if "before" in given:
        raise UserError("before=: only with fleet=")
    if given.get("columns"):
        from dexsim.actuator.columns import describe

        print(describe())
        return 0
    from dexsim import outputs
    from dexsim.gap.compute import TimeLimit
    from dexsim.gap.diagnosis import diagnose, save
    from dexsim.gap.report.files import RESULTS

    start = time.perf_counter()
    device = started(given.get("device", "cpu"))
    demo = None
    out = Path(given.get("out", "out/demo" if given.get("demo") else "out/diagnosis")).expanduser()
    if given.get("demo"):
        from dexsim.gap import demo as maker

        outputs.claim(out, "out=", (*RESULTS, "recordings"))
        print("Making recordings of a pendulum whose drive hides something ...", flush=True)
        with outputs.staged(out) as stage:
            paths, model, servo, demo = maker.make(
                stage / "recordings", given["demo"], seed=given.get("seed", 0), joint="knuckle"
            )
        made = [str(out / p.relative_to(stage)) for p in (*paths, model, servo)]
        given |= {"recordings": made[:-2], "model": made[-2], "servo": made[-1]}
    if "recordings" not in given:
        raise UserError("say what to diagnose: recordings='[a.mcap,b.mcap]' (or demo=true; --help lists the settings)")
    settings = settings_of(given, out, device)
    claim(settings)
    settings.time_limit = TimeLimit(settings.limit)
    with _interruptible(settings.time_limit):
        result = diagnose(settings, say=lambda text: print(text, flush=True), progress=Progress(settings.time_limit))
    written = save(result, out)
    print(verdict(result))
    if demo is not None:
        print(f"\nWhat was hidden: {', '.join(f'{k} {v:g}' for k, v in demo.items())}")
    print("\n" + "\n".join(str(p) for p in written) + f"\n{time.perf_counter() - start:.0f} s")
    return 0


def claim(s: Settings) -> None:
    """Make the folder of the results. Raises UserError where they would go over a file that is read, or is not ours."""
    from dexsim import outputs
    from dexsim.gap.report.files import RESULTS

    read = [*s.recordings, *(s.held_out or []), *(Path(p) for p in (s.model, s.servo) if p)]
    outputs.claim(s.out, "out=", RESULTS, read)


@contextmanager
def _interruptible(limit: TimeLimit) -> Iterator[None]:
    """Let Ctrl-C end the search with the best answer so far; a second one ends the program."""

    def ask(number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, before)
        print("\n  ending with the best answer so far; Ctrl-C again gives up", flush=True)
        limit.stop()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, ask)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def settings_of(given: dict, out: Path, device: str) -> Settings:
    """Return what `parse` took apart, as :func:`dexsim.gap.diagnosis.diagnose` takes it. Raises UserError."""
    from dexsim.actuator.columns import did_you_mean
    from dexsim.gap.effects.catalogue import EFFECTS, TOUCH_EFFECTS
    from dexsim.gap.inquiry import Settings
    from dexsim.gap.judge.full_model import REPLAY
    from dexsim.gap.read import inputs

    if given.get("replay", "mujoco") not in REPLAY:
        raise UserError(f"replay={given['replay']}: must be one of {', '.join(REPLAY)}")
    known = tuple(dict.fromkeys((*EFFECTS, *TOUCH_EFFECTS)))
    for e in given.get("effects") or ():
        if e not in known:
            raise UserError(
                f"effects: '{e}' is not in the catalogue.{did_you_mean(e, known)} It has: {', '.join(known)}"
            )
    fitted, held_out = inputs.parted(given["recordings"], given.get("held_out"))
    same = ("model", "servo", "seed", "replay", "meta", "remap", "limit", "hand", "hand_mirror")
    return Settings(
        fitted,
        out,
        held_out,
        device=device,
        next_recording=given.get("next", True),
        allowed=set(given.get("effects") or ()) or None,
        joints=set(given.get("joints") or ()) or None,
        **{k: given[k] for k in same if k in given},
    )


def started(device: str) -> str:
    """Start Warp without its banner; the device that is there. Raises UserError."""
    from dexsim.sim.quiet import quiet_warp

    if device != "cpu" and not device.startswith("cuda"):
        raise UserError(f"device={device}: must be cpu or cuda")
    quiet_warp(device)
    return available(device)


def available(device: str) -> str:
    """Return the device with its number, or the CPU with a line that says so where there is no such GPU."""
    if device == "cpu":
        return device
    import warp as wp

    count = wp.get_cuda_device_count()
    number = device.partition(":")[2] or "0"
    if not number.isdecimal():
        raise UserError(f"device={device}: must be cpu, cuda or cuda:0, cuda:1, ...")
    if int(number) < count:
        return f"cuda:{number}"  # torch wants the number
    have = (
        f"it has {count}, counted from 0"
        if count
        else "no NVIDIA driver or none visible, see nvidia-smi and CUDA_VISIBLE_DEVICES"
    )
    print(f"device={device}: this machine has no such GPU ({have}); the CPU is used", flush=True)
    return "cpu"


class Progress:
    """Which joint is searched or what is replayed, and how far that is. limit: of the whole.

    A search says what it is at, in counts, and no time left: how long it takes is not known before it is known what is
    hidden. A replay's steps are counted: it says a time."""

    EVERY = 3.0  # s between lines while none is done, where they are not written over each other

    def __init__(self, limit: TimeLimit | None = None) -> None:
        self.start, self.limit = time.perf_counter(), limit
        self.live = sys.stdout.isatty()
        self.said, self.searched = 0.0, -1

    def __call__(
        self, done: float, total: int, name: str, stage: str = "", left: float | None = None, doing: str = "search"
    ) -> None:
        """done of total are searched (doing: a verb); stage: of the one under way; left: s, where that is known."""
        now = time.perf_counter()
        if not done and not stage:  # what was before says nothing of how long it takes
            self.start = now
        if int(done) == self.searched < total and not self.live and now - self.said < self.EVERY:
            return
        self.said, self.searched, spent = now, int(done), now - self.start
        if done >= total:
            text = f"  {doing}ed {name}" if name else f"  {doing}ed {total} in {spent:.0f} s"
        elif left is not None:
            text = f"  {doing}ing {name}, {100 * done / total:.0f} % done, "
            text += f"about {left:.{int(left < 10)}f} s left to {doing}"
        else:
            text = f"  {doing}ing {name} ({done + 1}/{total})" + (f": {stage}, {spent:.0f} s so far" if stage else "")
            if self.limit is not None and self.limit.seconds is not None:
                text += f", at most {max(self.limit.until(1.0), 0.0):.0f} s left of all"
        if self.live:  # over the line before, and no longer than one
            wide = shutil.get_terminal_size().columns - 1
            text = f"\r{text[:wide]:<{wide}}"
        print(text, end="" if self.live and done < total else "\n", flush=True)


def verdict(d: Diagnosis) -> str:
    """Return the verdict in at most ten lines."""
    from dexsim.console.tables import number
    from dexsim.gap.finding import gathered
    from dexsim.gap.judge.conclude import place
    from dexsim.gap.search import baseline

    data = d.data
    lines = ["", f"{data['verdict'].replace('_', ' ').upper()}: {d.sentence}"]
    if plain := baseline.text(data["baseline"], "mm" if data["held_out"]["error"].endswith("_m") else "mrad"):
        lines.append(f"  {plain}")
    for f in gathered(d.findings)[: 4 - bool(plain)]:
        where = place(f, d.mechanism)
        sizes = ", ".join(
            f"{k} {number(p['value'], 4)} ({number(p['low'])} to {number(p['high'])}) {p['unit']}"
            for k, p in f.parameters.items()
            if isinstance(p["value"], float)
        )
        hint = " (a hint)" if f.hint else ""
        lines.append(f"  {f.effect} @ {where}, confidence {f.confidence:.2f}{hint}: {sizes or f.regime}")
        if f.indistinguishable:
            lines.append(
                f"    cannot be told from {', '.join(x for x in f.indistinguishable if x != f.effect)}: "
                f"{f.separating_experiment}"
            )
    if data["next_recording"]:
        lines.append(f"  record next: {data['next_recording']['why']}")
    if d.notes:
        lines.append(
            f"  note: {d.notes[0]}" + (f" (and {len(d.notes) - 1} more in report.html)" if len(d.notes) > 1 else "")
        )
    return "\n".join(lines[:11])
