"""`dexsim audit FILE ...`: what is in recordings, what is wrong with them, and what a diagnosis could tell from them,
before a search of minutes.

Beside the reader's audit of each recording: the signals that `diagnose` would find wrong, judged over all of them; of
each joint the rate at which it was really read, its quantum, how it moves and follows; how well repeats of the same
commands agree, by motion; and the command to run next.
"""

from __future__ import annotations

import copy
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from dexsim.console.tables import table as columns_of
from dexsim.errors import UserError
from dexsim.gap.read import Run, agreement, channels, conditions, inputs
from dexsim.gap.read.noise import noise
from dexsim.hand import load_hand
from dexsim.recording.arguments import read_arguments
from dexsim.recording.audit import KINDS, summary, table
from dexsim.recording.audit_time import command_lead
from dexsim.recording.mechanism import Mechanism, mechanism
from dexsim.recording.reader import read
from dexsim.recording.schema import STATES, Finding, Recording

HELP = """usage: dexsim audit FILE ... [model=FILE] [servo=FILE] [out=FOLDER] [units.QUANTITY=UNIT ...]
                    [remap.OURS=THEIRS ...] [meta.KEY=VALUE ...]

Say what is in recordings (MCAP, a ROS 2 bag's folder, CSV or NPZ with named columns, episodes of a LeRobot, Zarr or
HDF5 data set), what is wrong with them, and what a diagnosis could tell from them. FILE may be a pattern. model=,
servo=: of the mechanism, for its joints, their ranges, and which figures of its drives a fit could tell. out=: a folder
for a model.xml and a servo.yaml to begin with, where these are not given.

examples:
  dexsim audit a.mcap remap./joint_states=/xhand/state
  dexsim audit 'logs/*.csv' units.position=deg model=rig.xml

kinds of findings:
"""
MORE = {
    "stale": "a position that is read more seldom than it is logged, or sent again",
    "repeats_disagree": "recordings of the same commands that differ by far more than their noise",
}
"""Kinds that only the diagnosis' own reading shows."""
APART, OF_SPAN = 5.0, 0.01
"""x the noise of a sample, and of the motion's span: repeats that differ by more disagree."""
REVERSALS, STEPS, STILL = 4, 3, 6.0
"""Fewer reversals, or steps of a target, tell little; a joint that moves by less than so many times its noise rests."""


@dataclass(frozen=True)
class Repeats:
    """Recordings of the same commands. names: theirs; apart: by joint, rms by which two of them differ, over the square
    root of two [rad]; noise: of a sample; worst: by joint, when they differ most [s since their start] and by how
    much."""

    names: tuple[str, ...]
    apart: dict[str, float]
    noise: dict[str, float]
    worst: dict[str, tuple[float, float]]
    span: dict[str, float]

    def disagree(self, joint: str) -> bool:
        """Return whether they differ by far more than noise."""
        return self.apart[joint] > max(APART * self.noise[joint], OF_SPAN * self.span[joint])


def repeats(runs: Sequence[Run]) -> list[Repeats]:
    """Return recordings of the same commands, motion by motion: the floor of each."""
    number = conditions(list(runs))
    groups = [[run for run, k in zip(runs, number, strict=True) if k == g] for g in dict.fromkeys(number)]
    return [_apart(g) for g in groups if len(g) > 1]


def _apart(group: Sequence[Run]) -> Repeats:
    t = np.arange(0.2, min(r.duration for r in group) - 0.05, 0.01)
    apart, level, worst, span = {}, {}, {}, {}
    for j, joint in enumerate(group[0].joints):
        lines = [np.interp(r.t[0] + t, *r.readings(j)) for r in group]
        squares = np.mean([(a - b) ** 2 for i, a in enumerate(lines) for b in lines[i + 1 :]], 0) / 2
        apart[joint] = float(np.sqrt(squares.mean())) if len(t) else 0.0
        level[joint] = float(np.median([noise(*r.readings(j))[0] for r in group]))
        k = int(np.argmax(squares)) if len(t) else 0
        worst[joint] = (float(t[k]), float(np.sqrt(2 * squares[k]))) if len(t) else (0.0, 0.0)
        span[joint] = float(np.ptp(lines[0])) if len(t) else 0.0
    return Repeats(tuple(r.name for r in group), apart, level, worst, span)


def findings(recordings: Sequence[Recording], m: Mechanism) -> tuple[list[Run], dict[str, list[Finding]]]:
    """Return (the recordings as a diagnosis takes them, what it would say of their signals by recording). A recording
    that cannot be used is left out, with the reason."""
    runs: list[Run] = []
    out: dict[str, list[Finding]] = {r.path.name: [] for r in recordings}
    for r in recordings:
        try:
            runs.append(inputs.to_run(r, m, []))
        except inputs.Unusable as error:
            out[r.path.name].append(Finding("damage", "", float("nan"), 1, f"{error}", "error"))
    known = channels.spoiled(list(recordings), channels.driven_openly(runs))
    found, _, _ = channels.inspect([copy.copy(r) for r in runs], m.spec.compile(), known)  # which takes samples out
    for f in found:
        kind, _, text = f.regime.partition(": ")
        kind = {"sign": "sign_mismatch"}.get(kind, kind)
        severity = "warning" if kind == "stale" or f.confidence < 0.5 else "error"
        for name in dict.fromkeys(w["recording"] for w in f.when):
            when = [w for w in f.when if w["recording"] == name]
            joint = (f.joints or [""])[0]
            topic = (f.topics or [""])[0]
            out[name].append(Finding(kind, topic, when[0]["start"], len(when), text, severity, joint, when[-1]["end"]))
    for joint in dict.fromkeys(j for r in runs for j in r.joints):
        taken = {r.guessed[joint]: r.path.name for r in reversed(recordings) if joint in r.guessed}
        for r in recordings if len(taken) > 1 else ():
            if (mine := r.guessed.get(joint, "")) in taken:
                rest = ", ".join(f"for {unit} in {name}" for unit, name in taken.items() if unit != mine)
                text = f"{joint}: by its values taken for {mine} here, {rest}: one machine? State units.position="
                out[r.path.name].append(Finding("unit", "", float("nan"), len(recordings), text, "warning", joint))
        for name, kind, text in agreement.contradictions(runs, joint):
            if not any(f.kind == kind and f.joint == joint for f in out[name]):
                out[name].append(Finding(kind, STATES, 0.0, 1, text, "warning", joint))
    for group in repeats(runs):
        for joint in group.apart:
            if group.disagree(joint):
                at, by = group.worst[joint]
                text = (
                    f"{joint}: {len(group.names)} recordings of the same commands ({', '.join(group.names)}) differ by "
                    f"{1e3 * group.apart[joint]:.3g} mrad, {group.apart[joint] / group.noise[joint]:.0f} x a sample's "
                    f"noise; most at {at:.2f} s, by {1e3 * by:.3g}"
                )
                found_of = Finding("repeats_disagree", STATES, at, len(group.names), text, "warning", joint)
                out[group.names[0]].append(found_of)
    return runs, out


def carries(recordings: Sequence[Recording], runs: Sequence[Run]) -> str:
    """Return what a diagnosis could tell from recordings: a row a joint; where repeats agree, motion by motion."""
    rows = []
    for joint in dict.fromkeys(j for r in runs for j in r.joints):
        mine = [(r, r.joints.index(joint)) for r in runs if joint in r.joints]
        levels = [noise(*r.readings(j)) for r, j in mine]
        sigma, quantum = (float(np.median([x[k] for x in levels])) for k in (0, 1))
        slow = channels.common_rhythm(list(runs), joint)
        logged = float(np.median([np.median(np.diff(r.readings(j)[0])) for r, j in mine]))
        span, speed, turns, jumps = 0.0, 0.0, 0, 0
        for r, j in mine:
            r.smooth()
            v = r.vs[:, j]
            span = max(span, float(np.ptp(r.qs[:, j])))
            speed = max(speed, float(np.quantile(np.abs(v), 0.99)))
            fast = np.sign(v[np.abs(v) > 0.1 * max(float(np.abs(v).max()), 1e-9)])
            turns += int((np.diff(fast) != 0).sum())
            c = np.abs(np.diff(r.cmd[:, j]))
            jumps += int((c > max(0.1 * float(np.ptp(r.cmd[:, j])), 0.02)).sum())
        lags = [lead for x in recordings if joint in x.joints and (lead := command_lead(_only(x, joint))) is not None]
        late = f"{-1e3 * float(np.median(lags)):.0f}" if lags else "-"
        blind = []
        if span < STILL * sigma:
            blind = ["it hardly moves: nothing"]
        else:
            if turns < REVERSALS:
                blind.append("friction, play (few reversals)")
            if jumps < STEPS and speed * 0.005 < 2 * sigma:
                blind.append("delay, lag (no step, and slow)")
            if speed < 0.3:
                blind.append("limits, viscous friction (slow)")
        every = f"{1e3 * slow:.3g} (logged {1e3 * logged:.3g})" if slow > 1.5 * logged else f"{1e3 * logged:.3g}"
        rows.append((joint, every, f"{1e3 * quantum:.3g}" if quantum else "-", f"{1e3 * sigma:.3g}", f"{span:.3g}",
                     f"{speed:.3g}", str(turns), str(jumps), late, "; ".join(blind) or "-"))  # fmt: skip
    head = ("joint", "read every ms", "quantum mrad", "noise mrad", "span rad", "speed rad/s", "reversals", "steps",
            "lag ms", "not to be told")  # fmt: skip
    out = columns_of("what they carry", head, rows)
    groups = repeats(runs)
    if groups:
        apart = [(", ".join(g.names), j, f"{1e3 * g.apart[j]:.3g}", f"{1e3 * g.noise[j]:.3g}", f"{g.worst[j][0]:.2f}",
                 f"{1e3 * g.worst[j][1]:.3g}") for g in groups for j in g.apart]  # fmt: skip
        out += "\n\n" + columns_of(
            "repeats of the same commands, motion by motion",
            ("recordings", "joint", "apart mrad", "noise mrad", "most at s", "by mrad"), apart)  # fmt: skip
    elif len(runs) > 1:
        out += "\n\nno two recordings have the same commands: what repeats differ by is not known"
    return out


def delays(runs: Sequence[Run]) -> str:
    """Return the order and the delays of the stages of each drive, a row a joint; nothing where only targets and
    positions are recorded."""
    rows, order = [], []
    for joint in dict.fromkeys(j for r in runs for j in r.joints):
        chain = agreement.stages(runs, joint)
        if not chain:
            continue
        steps = [f"{s.before} -> {s.after} " + ("?" if s.delay is None else f"{1e3 * s.delay:.0f}") for s in chain]
        rows.append((joint, ", ".join(steps)))
        order += [f"{joint}: {s.after} is logged {-1e3 * s.delay:.0f} ms before the {s.before} that it follows"
                  for s in chain if s.delay is not None and s.delay < -0.004]  # fmt: skip
    if not rows:
        return ""
    return "\n".join([columns_of("stages of the drives, ms (?: it does not tell)", ("joint", "delays"), rows), *order])


def beliefs(runs: Sequence[Run], known: Mechanism) -> str:
    """Return how well a fit could tell each figure of the believed drives from recordings, a row a joint, and what to
    record for those that it could not."""
    from dexsim.gap.plant.case import build
    from dexsim.gap.plant.information import advice, informed
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    joints = [j for j in known.joints if all(j in r.joints for r in runs)]
    if not joints:
        return "figures that could be told: not known, for the recordings have no joint in common"
    mine = inputs.common_joints([copy.copy(r) for r in runs], [])
    floors = {j: max((g.apart[j] for g in repeats(runs) if j in g.apart), default=0.0) for j in joints}
    rows: list[tuple[str, ...]] = []
    more: dict[tuple[str, str], list[str]] = {}
    for case in build(known.spec.compile(), mine):
        figures = informed(case, floors[case.joint])
        good = [x for x in figures if x.possible]
        well = ", ".join(f"{x.figure.words} {x.within()}" for x in good)
        poor = [x for x in figures if not x.possible]
        rest = [x.figure.words + (f" (only with {x.beside.words})" if x.beside else "") for x in poor]
        rows.append((case.joint, f"{len(good)} of {len(figures)}", well or "-", ", ".join(rest) or "-"))
        for x in advice(figures):
            more.setdefault(x, []).append(case.joint)
    text = columns_of(
        "figures of the believed drives that a fit could tell", ("joint", "told", "to about", "not told"), rows
    )
    if more:
        text += "\n\nfor the others record, with `dexsim excite kinds=...` or by hand:"
    for (words, how), of in more.items():
        text += f"\n  {words} of {', '.join(of) if len(of) < len(joints) else 'all joints'}: {how}"
    return text


NAMES = re.compile(r"(meta\.joint_names=[^.\s]+)$")
"""The order of joints that a finding states."""
LEAP, FEW = 3.0, 8
"""Smallest steps of a signal by which a new value leaps, and new values that tell how often they come."""


def renewed(t: np.ndarray, x: np.ndarray) -> float:
    """Return s from one new value of a signal x [n] at t [n] to the next while it changes; 0 where each sample is a new
    one, or too few are. A joint that creeps over a coarse encoder's steps has new values seldom, but no leaps."""
    ok = np.isfinite(x)
    t, x = t[ok], x[ok]
    change = np.flatnonzero(np.diff(x) != 0) + 1
    if len(change) < FEW:
        return 0.0
    if (period := channels.rhythm(t, x)) > 0:  # as a diagnosis takes it
        return period
    size = np.abs(x[change] - x[change - 1])
    leaps = size > LEAP * size.min()
    both = leaps[1:] & leaps[:-1]  # from one leap to the next: between them it moves, and stands in the log
    since = np.diff(change)[both]
    if both.sum() < FEW - 1 or both.sum() < 0.5 * len(both) or np.median(since) < 2 or np.mean(since < 2) > 0.25:
        return 0.0
    return float(np.median(np.diff(t[change])[both]))


def rates(recordings: Sequence[Recording]) -> list[str]:
    """Return the signals that are renewed more seldom than they are logged, a line each."""
    out = []
    for name in ("position", "velocity", "effort", "duty", "command"):
        slow: dict[str, tuple[float, float]] = {}
        for r in recordings:
            for part in r.parts():
                s = part.commands if name == "command" else part.duty if name == "duty" else getattr(part.states, name)
                if s is None or len(s) < 20:
                    continue
                for k, joint in enumerate(part.joints):
                    period, logged = renewed(s.t, s.value[:, k]), float(np.median(np.diff(s.t)))
                    if period > 1.5 * logged > 0:
                        slow.setdefault(joint, (period, logged))
        if slow:
            period, logged = (float(np.median([x[k] for x in slow.values()])) for k in (0, 1))
            out.append(f"{name} of {', '.join(slow)}: a new value every {1e3 * period:.3g} ms, logged every "
                       f"{1e3 * logged:.3g}")  # fmt: skip
    return out


def _only(r: Recording, joint: str) -> Recording:
    return next(p for p in r.parts() if joint in p.joints)._of([_place(r, joint)])


def _place(r: Recording, joint: str) -> int:
    return next(p.joints.index(joint) for p in r.parts() if joint in p.joints)


def of_names(joints: Sequence[str]) -> Mechanism:
    """Return a mechanism of joints of which nothing is known."""
    bodies = "".join(
        f'<body><joint name="{j}" axis="0 1 0"/><geom size=".01" mass=".1" contype="0" conaffinity="0"/></body>'
        for j in map(_quoted, joints)
    )
    from dexsim.actuator.table import ServoTable

    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    return Mechanism(spec, tuple(joints), ServoTable.from_dict({"joints": {"*": {"kp": 1.0}}}), "unknown")


def _quoted(text: str) -> str:
    for a, b in (("&", "&amp;"), ('"', "&quot;"), ("<", "&lt;")):
        text = text.replace(a, b)
    return text


START = """# Guesses to begin with: put in what the drives' maker says (dexsim diagnose columns=true lists the columns)
joints:
  "*": {kp: [0.2, 20], kd: [0.002, 1], torque_limit: [0.2, 5], no_load_speed: [2, 30]}
"""
"""A servo.yaml of a drive of which nothing is known."""


def begin(out: Path, joints: Sequence[str], own: dict[str, str]) -> None:
    """Write model.xml and servo.yaml to begin with into a new folder, those that `own` does not name, and name them
    there. Raises UserError where the folder is not free."""
    names = {"model": "model.xml", "servo": "servo.yaml"}
    new = {k: out / name for k, name in names.items() if not own.get(k)}
    for path in new.values():
        if path.exists():
            raise UserError(f"out={out}: {path} exists; name another folder")
    out.mkdir(parents=True, exist_ok=True)
    for key, path in new.items():
        if key == "servo":
            path.write_text(START, encoding="utf-8")
        else:
            note = "<!-- A pendulum a joint, to begin with: put in your axes, lengths, masses and inertias -->\n"
            bodies = "".join(
                f'    <body pos="0 {0.2 * k:g} 0"><joint name="{_quoted(j)}" axis="0 1 0" armature="1e-4"/>\n      '
                '<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.1" mass="0.05" contype="0" conaffinity="0"/>'
                "</body>\n" for k, j in enumerate(joints)
            )  # fmt: skip
            text = f'<mujoco>\n  {note}  <compiler angle="radian"/>\n  <worldbody>\n{bodies}  </worldbody>\n</mujoco>\n'
            path.write_text(text, encoding="utf-8")
        own[key] = str(path)


def next_command(paths: Sequence[str], own: dict[str, str], rest: Sequence[str]) -> str:
    """Return the `dexsim diagnose` to run next, as it is typed."""
    recordings = paths[0] if len(paths) == 1 else f"[{','.join(paths)}]"
    of = [f"{k}={own[k]}" for k in ("model", "servo") if own.get(k)]
    words = [f"recordings={recordings}", *of, *rest, "out=out/diagnosis"]
    return "dexsim diagnose " + " ".join(shlex.quote(w) for w in words)


def main(argv: Sequence[str]) -> int:
    """Print what is in recordings and what is wrong with them; status 1 where a channel cannot be used as it is."""
    if not argv or argv[0] in ("-h", "--help"):
        print(HELP + "\n".join(f"  {kind:<20}{text}" for kind, text in (KINDS | MORE).items()))
        return 0 if argv else 2
    own = {k: v for k, _, v in (a.partition("=") for a in argv) if k in ("model", "servo", "out")}
    rest = [a for a in argv if a.partition("=")[0] not in own]
    given, remap, meta = read_arguments(rest)
    known = mechanism(own["model"], own.get("servo") or {}) if own.get("model") else None
    recordings, worst = [], 0
    for path in inputs.files(given, "audit"):
        of = (None, None) if known is None else (known.joints, known.ranges)
        recording = read(path, remap, meta, joints=of[0], limits=of[1])
        recording.path = Path(path.name)
        recordings.append((path, recording))
    joints = tuple(dict.fromkeys(j for _, r in recordings for j in r.joints))
    runs: list[Run] = []
    said: dict[str, list[Finding]] = {}
    cures: dict[str, None] = {}  # settings that findings ask for
    if joints and any(len(r.commands) and len(r.states.position) for _, r in recordings):
        runs, said = findings([r for _, r in recordings], known or of_names(joints))
    for path, recording in recordings:
        found = [*recording.findings, *_new(said.get(path.name, []), recording.findings)]
        recording.path = path
        print(summary(recording) + "\n")
        print(table(_gathered(found)) + "\n")
        worst = max(worst, int(any(f.severity == "error" for f in found)))
        cures |= {x[1]: None for f in found if f.kind == "joint_order" and (x := NAMES.search(f.text))}
    if runs:
        print(carries([r for _, r in recordings], runs) + "\n")
        believed = beliefs(runs, known) if known is not None and own.get("servo") else ""
        for text in ("\n".join(rates([r for _, r in recordings])), delays(runs), believed):
            if text:
                print(text + "\n")
        options = [a for a in rest if a not in given] + list(cures)
        xhand = own.get("model") is None and set(joints) <= set(load_hand().joints)
        if own.get("out") and not xhand:
            begin(Path(own["out"]).expanduser(), joints, own)
            print(f"{own['out']}: model.xml, servo.yaml to begin with, of guesses: put in what you know\n")
        missing = [] if xhand else [k for k in ("model", "servo") if not own.get(k)]
        asked = own | {k: {"model": "MODEL.xml", "servo": "SERVO.yaml"}[k] for k in missing}
        print("commands stamped late alike in all files look like a drive that leads: only a fit, `diagnose`, tells")
        print(f"next: {next_command(given, asked, options)}")
        if missing:
            print(f"  ({' and '.join(missing)} of the machine; out=FOLDER writes what is missing, to begin with)")
    return worst


def _new(more: Sequence[Finding], known: Sequence[Finding]) -> list[Finding]:
    """Return findings of which the reader's audit does not say the like already."""
    there = {(f.kind, f.joint) for f in known if f.severity == "error"}
    there |= {(f.kind, "") for f in known if not f.joint and (f.topic or f.kind != "unit")}  # no guess of a unit
    return [f for f in more if (f.kind, f.joint) not in there and (f.kind, "") not in there]


def _gathered(found: Sequence[Finding]) -> list[Finding]:
    """Return findings with the defaults that hold in one line."""
    plain = [f for f in found if f.kind == "missing_metadata" and f.severity == "info"]
    rest = [f for f in found if f not in plain]
    if len(plain) < 2:
        return list(found)
    keys = ", ".join(f.text.split(" ")[0] for f in plain)
    text = f"not stated, usual values are assumed: {keys} (state them with meta.KEY=...)"
    return [*rest, Finding("missing_metadata", "", float("nan"), len(plain), text, "info")]
