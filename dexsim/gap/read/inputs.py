"""From recording files to runs: joints matched, clocks aligned, faults of the signals told apart from physics, what is
not in free air found."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import replace
from glob import glob
from itertools import chain
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from dexsim import yaml_text
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.gap.finding import WRONG_SIGNAL, Finding
from dexsim.gap.read import Run, channels, joined, pieces
from dexsim.gap.rules import SIGNAL
from dexsim.recording import readers, spikes
from dexsim.recording.mechanism import Mechanism, merged
from dexsim.recording.schema import COMMANDS_FIX, DUTY, STATES, Recording, Series

# kinds of the reader's findings that make a channel's numbers wrong, whatever the physics
SIGN = ("lost_sign", "sign_mismatch")  # faults of an effort that a sensor makes just as well as who recorded it
WRONG = ("joint_order", "wrap", "lost_sign", "unit", "sign_mismatch", "stuck", "held", "clock_skew")
SHORTEST = 0.5  # s: what a recording must last to be read


class Unusable(Exception):
    """A recording that cannot carry an answer, with the reason: a verdict, not a crash."""


def to_run(recording: Recording, m: Mechanism, notes: list[str]) -> Run:
    """Return the recording as plain arrays. Raises Unusable where it cannot be used; what is left out goes to notes."""
    name = recording.path.name
    joints = _known_joints(recording, m, notes)
    column = [recording.joints.index(j) for j in joints]
    _without_spikes(recording, notes)
    notes += [f"{name}: {f.topic}: {f.text}" for f in recording.findings if f.kind == "time_not_monotonic"]
    t, q, read, good = _positions(recording, joints, column, notes)
    ct, c, kept = _commands(recording, joints, column, good, notes)
    if not kept:
        raise Unusable(f"{name}: no joint has both commands and positions")
    joints, column = tuple(joints[j] for j in kept), [column[j] for j in kept]
    q, c, read = q[:, kept], c[:, kept], read[:, kept]
    start = _begin(name, t, ct, notes)
    t, q, read = t[start:], q[start:], read[start:]
    table = m.table
    if recording.meta.get("servo"):
        table = ServoTable.from_dict(
            merged(table.to_dict(), yaml_text.parse(recording.meta["servo"], f"servo of {name}")),
            source=f"servo of {name}",
        )
    run = Run(name, joints, ct, c, t, q, table, recording.gravity, counted=m.joints)
    run.breaks = tuple(recording.breaks)
    run.read = None if read.all() else read
    run.v = _at(recording.states.velocity, t, column)
    run.torque = _torque(recording, table, joints, t, column, notes)
    run.temperature = _at(recording.temperature, t, column)
    if not any(f.kind == "wrap" and f.topic == DUTY for f in recording.findings):
        run.duty = _at(recording.duty, t, column)
    run.enabled = _at(recording.enabled, t, column, hold=True)
    if run.enabled is not None:
        run.enabled = np.where(np.isfinite(run.enabled), run.enabled, 1.0)  # a joint that it does not tell of is driven
    if recording.supply_voltage is not None and len(recording.supply_voltage):
        s = recording.supply_voltage
        finite = np.isfinite(s.value)
        if finite.any():
            run.supply = np.interp(t, s.t[finite], s.value[finite])
    return run


def _known_joints(recording: Recording, m: Mechanism, notes: list[str]) -> tuple[str, ...]:
    """Return the recording's joints that the model has, in its order. Raises Unusable where there are none, or no
    states or commands."""
    name = recording.path.name
    joints = tuple(j for j in m.joints if j in recording.joints)
    followers = () if m.hand is None else m.hand.couplings.passive  # measured, but nothing commands them
    foreign = [j for j in recording.joints if j not in m.joints and j not in followers]
    if foreign:
        notes.append(f"{name}: joints that the model has not are left out: {', '.join(foreign)}")
    if not joints:
        raise Unusable(
            f"{name}: none of its joints ({', '.join(recording.joints) or 'none named'}) is in the model, whose "
            "joints are"
            f" {', '.join(m.joints)}; name them with remap.OURS=THEIRS or give its own model="
        )
    if not len(recording.states.position):
        raise Unusable(f"{name}: commands without states: no {STATES} to compare with")
    if not len(recording.commands):
        raise Unusable(f"{name}: states without commands: what the servo was asked is unknown; {COMMANDS_FIX}")
    return joints


def _positions(
    recording: Recording, joints: tuple[str, ...], column: list[int], notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """(times [S], positions [S, J] without gaps, which of them were read [S, J], which of the joints have enough of
    them). Raises Unusable where they are too few."""
    name, p = recording.path.name, recording.states.position
    t, q = np.asarray(p.t, float), p.value[:, column]
    keep = np.r_[True, np.diff(t) > 1e-6] & np.isfinite(q).any(1)
    t, q = t[keep], q[keep].copy()
    read = np.isfinite(q)
    if len(t) < 20 or t[-1] - t[0] < SHORTEST:
        span = t[-1] - t[0] if len(t) else 0.0
        raise Unusable(f"{name}: {len(t)} samples over {span:.2f} s; at least 20 samples and {SHORTEST:g} s are needed")
    good = []
    for j in range(q.shape[1]):
        finite = read[:, j]
        told = p.carried[keep, column[j]] if p.carried is not None else np.ones(len(t), bool)
        missing = int((told & ~finite).sum())
        if finite.sum() < 20 or missing > 0.5 * told.sum() or np.ptp(t[finite]) < SHORTEST:
            notes.append(
                f"{name}: {joints[j]} has {100 * missing / max(told.sum(), 1):.0f} % of its {int(told.sum())} positions"
                " missing; left out"
            )
            continue
        if missing:
            notes.append(f"{name}: {joints[j]}: {missing} positions are missing; nothing is measured there")
        if not finite.all():
            from scipy.interpolate import PchipInterpolator

            q[:, j] = PchipInterpolator(t[finite], q[finite, j], extrapolate=False)(t)
            q[:, j] = np.where(np.isfinite(q[:, j]), q[:, j], np.interp(t, t[finite], q[finite, j]))
        good.append(j)
    return t, q, read, good


def _commands(
    recording: Recording, joints: tuple[str, ...], column: list[int], good: list[int], notes: list[str]
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """(times [C] in order, targets [C, J], each held until the next, which of the `good` joints have any)."""
    name = recording.path.name
    commands = recording.targets()
    t, c = np.asarray(commands.t, float), commands.value[:, column].copy()
    kept = []
    for j in good:
        finite = np.isfinite(c[:, j])
        if not finite.any():
            notes.append(f"{name}: {joints[j]} has states but no commands; left out")
            continue
        index = np.maximum.accumulate(np.where(finite, np.arange(len(c)), -1))
        first = int(np.argmax(finite))
        c[:, j] = np.where(index >= 0, c[np.maximum(index, 0), j], c[first, j])
        kept.append(j)
    order = np.argsort(t, kind="stable")
    return t[order], c[order], kept


def _begin(name: str, t: np.ndarray, commands: np.ndarray, notes: list[str]) -> int:
    """Return the first state from which on it is known what was asked; a command from before the first state still
    holds. t [S], commands [C]: times. Raises Unusable where the two do not overlap."""
    if commands[0] > t[-1]:
        raise Unusable(
            f"{name}: the commands begin {commands[0] - t[-1]:.1f} s after the last state: the clocks do not belong "
            "together"
        )
    if commands[0] <= t[0] + 0.05:
        return 0
    start = int(np.searchsorted(t, commands[0]))
    if t[-1] - t[min(start, len(t) - 1)] < SHORTEST:
        raise Unusable(f"{name}: states and commands overlap for less than {SHORTEST:g} s")
    notes.append(f"{name}: the first {commands[0] - t[0]:.2f} s have no command and are left out")
    return start


def _torque(
    recording: Recording, table: ServoTable, joints: tuple[str, ...], t: np.ndarray, column: list[int], notes: list[str]
) -> np.ndarray | None:
    """Return [S, J] the effort in the unit of the drive's torque; None where none was recorded or it is not what it
    says."""
    effort = recording.signed_effort()
    if effort is None or recording.effort_is == "none" or _bad(recording, STATES, "effort"):
        return None
    values = _at(effort, t, column)
    if values is not None and recording.effort_is == "current_A":
        per = table.current(joints)
        values = values / per[None]
        if np.isnan(per).all():
            notes.append(
                f"{recording.path.name}: current_per_torque is unknown, so the current is not compared (dexsim "
                "calibrate measures it)"
            )
    told = values is not None and np.isfinite(values).any() and np.nanmax(np.abs(values)) > 0
    return values if told else None


def _without_spikes(recording: Recording, notes: list[str]) -> None:
    """Spikes of position, command and effort that the audit has found are missing values from here on."""
    done: set[tuple[str, str]] = set()
    s = recording.states
    for f in recording.findings:
        quantity = f.text.split(" ")[0]
        if f.kind != "spike" or (quantity, f.joint) in done or f.joint not in recording.joints:
            continue
        done.add((quantity, f.joint))
        series, j = (
            {"position": s.position, "command": recording.commands, "effort": s.effort}[quantity],
            recording.joints.index(f.joint),
        )
        assert series is not None  # a finding is about what was recorded
        on = spikes.of_effort(recording, j) if quantity == "effort" else spikes.spiked(series.value[:, j], quantity)
        series.value = series.value.copy()
        series.value[on, j] = np.nan
        notes.append(f"{recording.path.name}: {f.text}; left out")


def _bad(recording: Recording, topic: str, word: str) -> bool:
    return any(
        f.kind in ("wrap", "lost_sign") and f.topic == topic and word in f.text.lower() for f in recording.findings
    )


def _at(series: Series | None, t: np.ndarray, columns: Sequence[int], hold: bool = False) -> np.ndarray | None:
    """Return columns of a series at times t, interpolated (held where hold)."""
    if series is None or not len(series):
        return None
    out = np.empty((len(t), len(columns)))
    for k, c in enumerate(columns):
        x = series.value[:, c]
        finite = np.isfinite(x)
        if not finite.any():
            out[:, k] = np.nan
        elif hold:
            i = np.clip(np.searchsorted(series.t[finite], t, side="right") - 1, 0, finite.sum() - 1)
            out[:, k] = x[finite][i]
        else:
            out[:, k] = np.interp(t, series.t[finite], x[finite])
    return None if np.isnan(out).all() else out


def free_air(
    runs: list[Run],
    held: list[int],
    touched: dict[str, list[tuple[float, float]]],
    notes: list[str],
    why: str = "something is touched, or links touch each other",
    rest: str = "in free air",
    room: tuple[float, float] = (0.1, 0.3),
    least: float = 2.0,
) -> tuple[list[Run], list[int]]:
    """Return the runs without the stretches in which something is touched (by recording: start, end in s; `why`, and
    what is left, `rest`, in words) and `room` s before and after, and which are held out. Pieces shorter than `least` s
    are left out.

    A joint is judged by its own dynamics, which a contact's unknown force would distort; a run that is touched in
    between becomes several of the same name, on its own clock.
    """
    out: list[Run] = []
    kept: list[int] = []
    for i, run in enumerate(runs):
        spans = touched.get(run.name, [])
        if not spans:
            kept += [len(out)] if i in held else []
            out.append(run)
            continue
        edges = [float(run.t[0])]
        for a, b in spans:
            edges += [a - room[0], b + room[1]]
        edges.append(float(run.t[-1]))
        pieces = [run.between(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= least]
        pieces = [p for p in pieces if len(p.t) >= 20 and (np.ptp(p.q, axis=0) > 2e-3).any()]
        share = sum(p.duration for p in pieces) / max(run.duration, 1e-9)
        notes.append(f"{run.name}: {why}; joints are judged by the {100 * share:.0f} % of its time {rest}" if pieces
                     else f"{run.name}: {why}, nearly all the time; its joints are not judged")  # fmt: skip
        kept += range(len(out), len(out) + len(pieces)) if i in held else []
        out += pieces
    return out, kept


def common_joints(runs: list[Run], notes: list[str]) -> list[Run]:
    """Return the runs with the joints that all of them have, in one order."""
    shared = [j for j in runs[0].joints if all(j in r.joints for r in runs)]
    if not shared:
        raise Unusable(
            "the recordings have no joint in common: " + "; ".join(f"{r.name}: {', '.join(r.joints)}" for r in runs)
        )
    for r in runs:
        extra = [j for j in r.joints if j not in shared]
        if extra:
            notes.append(f"{r.name}: {', '.join(extra)} not in every recording; left out")
        r.only([r.joints.index(j) for j in shared])
    # counts only where every run has it; enabled and supply act in the run that has them
    for name in ("torque", "temperature", "duty"):
        have = [getattr(r, name) is not None for r in runs]
        if any(have) and not all(have):
            for r in runs:
                setattr(r, name, None)
            notes.append(f"{name} is not in every recording and is left out")
    return runs


def channel_findings(
    recordings: list[Recording],
    joints: Sequence[str],
    sensors: dict[str, str],
    openly: Set[tuple[str, str]] = frozenset(),
) -> list[Finding]:
    """Return findings of signals that are not what they say. sensors: ids of the effects that
    make the same of an effort's sign, each with the experiment that shows it; openly: of `channels.driven_openly`."""
    out: dict[tuple, Finding] = {}
    for r in recordings:
        for f in r.findings:
            if f.kind not in WRONG or f.severity != "error" or channels.far_target(f, r.path.name, openly):
                continue
            # dry friction may hold it: `channels.inspect` tells beside the others
            if f.kind == "stuck" and f.text.startswith("position"):
                continue
            key = (f.kind, f.topic, f.joint)
            sensor = f.kind in SIGN and f.joint in joints
            joint, topics = f.joint if f.joint in joints else "", [f.topic] if f.topic else []
            one = out.get(key) or channels.finding(f.kind, f.text, joint, topics, [])
            if sensor:
                experiment = next(iter(sensors.values()), None)
                one = replace(one, indistinguishable=[WRONG_SIGNAL, *sensors], separating_experiment=experiment)
            if np.isfinite(f.time):
                end = f.end if np.isfinite(f.end) else f.time
                when = {"recording": r.path.name, "start": float(f.time), "end": float(max(end, f.time))}
                one = replace(one, when=[*one.when, when])
            out[key] = one
    return list(out.values())


def files(given: Any, key: str) -> list[Path]:
    """Return a list of recording paths from a setting; UserError where it is empty or a file is missing."""
    items = given if isinstance(given, (list, tuple)) else [given]
    out = []
    for item in items:
        path = Path(str(item)).expanduser()
        if any(ch in str(item) for ch in "*?[") and not path.exists():
            base, hash_, part = path.name.partition("#")
            found = [Path(p) for p in sorted(glob(str(path.parent / base), recursive=True)) if not p.endswith(".yaml")]
            if not found:
                raise UserError(f"{key}={item}: no file matches")
            out += [q for p in found for q in readers.expanded(p.with_name(p.name + hash_ + part))]
        elif not readers.address(path)[0].exists():
            raise UserError(f"{key}: recording '{path}' does not exist")
        else:
            out += readers.expanded(path)
    if not out:
        raise UserError(f"{key}: say which, e.g. {key}='[a.mcap,b.mcap]'")
    return list(dict.fromkeys(out))


def parted(recordings: Any, held_out: Any) -> tuple[list[Path], list[Path] | None]:
    """Return (recordings that are fitted, those held out of the fit, None where nothing is said). held_out: as
    recordings, or `episodes[40:]` of them; what is held out is taken out of the fit. Raises UserError where nothing is
    left."""
    every = files(recordings, "recordings")
    if not held_out:
        return every, None
    items = held_out if isinstance(held_out, (list, tuple)) else [held_out]
    held: list[Path] = []
    for item in items:
        found = re.fullmatch(r"episodes\[(.*)\]", str(item).strip())
        if found:
            held += [every[k] for k in readers.numbers(found[1].strip(), len(every), f"held_out={item}")]
        else:
            held += files([item], "held_out")
    away = {p.absolute() for p in held}
    fitted = [p for p in every if p.absolute() not in away]
    if not fitted:
        raise UserError("held_out: it names all of the recordings; nothing is left to fit")
    return fitted, list(dict.fromkeys(held))


def self_touch(runs: list[Run], model: mujoco.MjModel) -> dict[str, list[tuple[float, float]]]:
    """By recording, the stretches [s] in which links of the model press on one another along the measured motion.

    A pair that touches nearly always overlaps by design and says nothing.
    """
    rate, depth = 25.0, 3e-4  # Hz; m: less is left to the geometry's accuracy
    data = mujoco.MjData(model)
    seen: list[tuple[str, float, set[tuple[int, int]]]] = []
    for run in runs:
        address = [int(model.joint(j).qposadr[0]) for j in run.joints]
        for t in np.arange(run.t[0], run.t[-1], 1 / rate):
            data.qpos[address] = [np.interp(t, run.t, run.q[:, j]) for j in range(len(run.joints))]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            contacts = data.contact
            deep = np.flatnonzero(contacts.dist[: data.ncon] < -depth) if data.ncon else ()
            bodies = (sorted(int(model.geom_bodyid[g]) for g in contacts.geom[c]) for c in deep)
            pairs = {(a, b) for a, b in bodies}
            seen.append((run.name, float(t), pairs))
    counts = Counter(p for _, _, pairs in seen for p in pairs)
    always = {p for p, n in counts.items() if n > 0.9 * len(seen)}
    out: dict[str, list[tuple[float, float]]] = {}
    for name, t, pairs in seen:
        if pairs - always:
            out.setdefault(name, []).append((t - 1 / rate, t + 1 / rate))
    return {name: joined(spans, 0.3 - 1 / rate) for name, spans in out.items()}


def merged_spans(*several: dict[str, list[tuple[float, float]]]) -> dict[str, list[tuple[float, float]]]:
    """Stretches of several sources by recording, sorted, those that overlap joined."""
    return {name: joined(sorted(x for s in several for x in s.get(name, [])), 1e-9) for name in {*chain(*several)}}


# -- end stops --------------------------------------------------------------------------------------------------------
# Ends of a joint's motion that the model does not have: a joint that its drive presses against something hard.

def used_end_stops(model: mujoco.MjModel, runs: list[Run]) -> list[str]:
    """Narrows the model's ranges to the ends that joints meet; in words, one line each.

    An end is where a joint stands still at its outermost position, again and again, while its target goes on and the
    torque asked for is far above what friction or gravity could hold. The joint's drive says nothing there.
    """
    said = []
    data = mujoco.MjData(model)
    for j, name in enumerate(runs[0].joints):
        joint = model.joint(name).id
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.inf, np.inf)
        for side, limit in ((-1, low), (1, high)):
            found = _end(model, data, runs, j, side)
            if found is None or side * (limit - found[0]) < 0:
                continue
            end, where, _ = found
            if not np.isfinite(low) and not np.isfinite(high):
                low, high = -1e6, 1e6
            low, high = (end, high) if side < 0 else (low, end)
            model.jnt_range[joint], model.jnt_limited[joint] = (low, high), 1
            beyond = (
                f"the model's range goes on to {limit:.3g}" if np.isfinite(limit) else "the model has no limit there"
            )
            said.append(
                f"{where}: {name} meets an end of its motion at {end:.4g} while its target goes on; {beyond}. The end "
                "is used"
            )
    return said


def with_ranges(spec: mujoco.MjSpec, used: mujoco.MjModel) -> tuple[mujoco.MjSpec, list[str]]:
    """Return (a copy of a mechanism with the joints' ranges of `used`, a model of it, what changed in words): a joint
    that has moved beyond its range, or meets an end before it, does so in training too."""
    own, spec, said = spec.compile(), spec.copy(), []
    for i in range(own.njnt):
        name, limited, ends = own.joint(i).name, bool(used.jnt_limited[i]), used.jnt_range[i]
        if limited == bool(own.jnt_limited[i]) and (not limited or np.array_equal(ends, own.jnt_range[i])):
            continue
        joint = spec.joint(name)
        turns = spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
        joint.limited = limited
        if limited:
            joint.range = np.degrees(ends) if turns else ends
        ends_said = f"is {ends[0]:.4g} to {ends[1]:.4g}" if limited else "is taken away"
        said.append(f"model.xml: the range of {name} {ends_said}")
    return spec, said


def unforeseen_end_stops(model: mujoco.MjModel, runs: list[Run]) -> dict[str, list[tuple[float, float]]]:
    """By recording: the stretches (start, end in s) in which joints of `runs`, which are held out of the fit, press
    against ends that the model does not have. What nothing in the fit has shown is not used to simulate them, and not
    held against a drive either."""
    out: dict[str, list[tuple[float, float]]] = {}
    data = mujoco.MjData(model)
    for j, name in enumerate(runs[0].joints if runs else ()):
        joint = model.joint(name).id
        for side, limit in zip(
            (-1, 1), model.jnt_range[joint] if model.jnt_limited[joint] else (-np.inf, np.inf), strict=True
        ):
            found = _end(model, data, runs, j, side)
            if found is not None and side * (limit - found[0]) > found[2]:
                for run in runs:
                    on = side * run.q[:, j] > side * found[0] - found[2]
                    out.setdefault(run.name, []).extend((float(run.t[a]), float(run.t[b - 1])) for a, b in pieces(on))
    return {name: spans for name, spans in out.items() if spans}


def _end(
    model: mujoco.MjModel, data: mujoco.MjData, runs: list[Run], j: int, side: int
) -> tuple[float, str, float] | None:
    """Return (position of the end, names of the recordings, what counts as near it) on one side of a joint; None where
    it meets none."""
    outer = max(float((side * r.q[:, j]).max()) for r in runs)
    near = SIGNAL.near * (max(float(r.q[:, j].max()) for r in runs) - min(float(r.q[:, j].min()) for r in runs))
    errors = [side * (r.command_at(r.t)[:, j] - r.q[:, j]) for r in runs]
    at = [side * r.q[:, j] > outer - near for r in runs]
    still = [_still(r, j, near) for r in runs]
    usual = np.concatenate([np.abs(e[s & ~a]) for e, s, a in zip(errors, still, at, strict=True)])
    if len(usual) < 50:  # it hardly ever stands
        usual = np.concatenate([np.abs(e[~a]) for e, a in zip(errors, at, strict=True)])
    if not near > 0 or len(usual) < 50:
        return None
    need = max(SIGNAL.pressed * float(np.quantile(usual, 0.95)), 3 * near)
    ends, names = [], []
    for run, error, on in zip(runs, errors, at, strict=True):
        for a, b in pieces(on & (error > need)):
            q, target = run.q[a:b, j], run.q[a:b, j] + side * error[a:b]
            if (
                run.t[b - 1] - run.t[a] < SIGNAL.meeting
                or np.ptp(target) < 3 * np.ptp(q)
                or np.ptp(q) > near
                or not _hard(model, data, run, j, a + int(np.argmax(error[a:b])))
            ):
                continue
            ends.append(float(np.median(q)))
            names.append(run.name)
    if len(ends) < SIGNAL.times:
        return None
    return side * max(side * e for e in ends), ", ".join(dict.fromkeys(names)), near


def _still(run: Run, j: int, near: float) -> np.ndarray:
    """Return [S] whether the joint stands, as far as 0.1 s around each sample show."""
    n = max(int(round(0.05 / max(float(np.median(np.diff(run.t))), 1e-6))), 1)
    most, least = (f(run.q[:, j], 2 * n + 1, mode="nearest") for f in (maximum_filter1d, minimum_filter1d))
    return most - least < 0.25 * near


def _hard(model: mujoco.MjModel, data: mujoco.MjData, run: Run, j: int, i: int) -> bool:
    """Return whether the believed drive asks at sample i for far more than gravity weighs there."""
    row = run.servo.nominal(run.joints)[j]
    from dexsim.actuator.columns import INDEX

    kp, limit = row[INDEX["kp"]], row[INDEX["torque_limit"]]
    asked = kp * abs(run.command_at(run.t[i : i + 1])[0, j] - run.q[i, j])
    asked = limit * min(asked, 1.0) if run.servo.drive == "voltage" else min(asked, limit)
    mujoco.mj_resetData(model, data)
    model.opt.gravity[:] = run.gravity
    for k, name in enumerate(run.joints):
        data.qpos[model.jnt_qposadr[model.joint(name).id]] = run.q[i, k]
    mujoco.mj_forward(model, data)
    return asked > SIGNAL.hard * abs(float(data.qfrc_bias[model.jnt_dofadr[model.joint(run.joints[j]).id]]))
