"""Safe command trajectories that show what a mechanism's drives do. Used by `dexsim excite` and the
diagnosis."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from dexsim import typed
from dexsim.errors import UserError
from dexsim.recording import safety
from dexsim.recording.mechanism import Mechanism, Run, drive, recorded
from dexsim.recording.realistic import CURRENT_PER_TORQUE
from dexsim.recording.schema import COMMANDS, Series
from dexsim.recording.waveforms import KINDS, PEAK, minimum_jerk
from dexsim.recording.writer import Writer, write

SHRINK, TRIES = 0.8, 14
SMALLEST = 0.05  # of the free range: a motion that must be smaller than this to be safe is left out
RESERVE = 0.9  # of the limits, for a motion alone: within the sequence it starts from a little elsewhere
REST = 0.3  # s at home between two motions
SETTLES = 1.0  # s, in which a drive that cannot carry its links lets them sink
PASSED = 1e-3  # rad (m) beyond a limit: where a weak drive lets a joint rest on one, it passes by a tenth of that
CHECK_STEP, FRAME = 0.004, 0.008  # s: physics step and spacing of contact checks of the simulation


@dataclass
class Limits:
    """What a motion may reach. speed: fraction of the no-load speed; torque: fraction of the stall torque; margin:
    share of a joint's range kept free at both ends; clearance [m] between bodies that are not neighbours; current: A
    that no motor may draw (None: only `torque` limits it)."""

    speed: float = 0.6
    torque: float = 0.8
    margin: float = 0.05
    clearance: float = 0.002
    current: float | None = None

    def torques(self, m: Mechanism) -> np.ndarray:
        """Return fraction of the stall torque that each joint may reach [J], by `torque` and `current`."""
        share = np.full(len(m.joints), self.torque)
        if self.current is not None:
            stall = m.column("torque_limit")
            most = self.current / (current_per_torque(m) * np.where(np.isfinite(stall), stall, np.nan))
            share = np.fmin(share, most)  # a drive without a limit has no share of it
        return share


def current_per_torque(m: Mechanism) -> np.ndarray:
    """Return a per N.m [J] of the servo table, `realistic.CURRENT_PER_TORQUE` where it does not say."""
    known = np.asarray(m.table.current(m.joints), float)
    return np.where(np.isfinite(known), known, CURRENT_PER_TORQUE)


@dataclass
class Segment:
    """One motion of a plan: kind, joints that move, start and end [s], the factor by which it was made smaller to be
    safe, and the number of the segment that it repeats (None: it is new)."""

    kind: str
    joints: tuple[str, ...]
    command: np.ndarray
    scale: float
    start: float = 0.0
    end: float = 0.0
    repeats: int | None = None


@dataclass
class Plan:
    """Commands t [T] s, value [T, J] rad (or m), home [J], segments in order; run: the simulation that found it
    safe."""

    mechanism: Mechanism
    t: np.ndarray
    value: np.ndarray
    home: np.ndarray
    segments: list[Segment]
    peaks: safety.Peaks
    run: Run
    left_out: list[str] = field(default_factory=list)
    exempt: list[tuple[str, str]] = field(default_factory=list)


def plan(
    m: Mechanism, joints: Sequence[str] | None = None, kinds: Sequence[str] | None = None, seed: int = 0,
    rate: float = 100.0, limits: Limits = Limits(), repeats: int = 1, say: Callable[[str], None] = lambda text: None,
) -> Plan:  # fmt: skip
    """Return a safe sequence of motions of `joints` (default all) of these `kinds` (default all), in an order shuffled
    by `seed`.

    Each motion begins and ends at rest at home and is simulated with the mechanism's servo; it is made smaller until it
    keeps the limits and nothing touches, or left out. repeats: how many of the motions of each group of joints come a
    second time, at another place in the order (they measure the noise floor). Raises UserError for joints without
    limits.
    """
    moving = tuple(joints) if joints is not None else m.joints
    chosen = tuple(kinds) if kinds is not None else tuple(KINDS)
    _check(m, moving, chosen, limits)
    rng, dt = np.random.default_rng(seed), 1.0 / rate
    low, high, home = _range(m, limits)
    for last in (False, True):
        check = safety.ContactCheck(m, home, limits.clearance)
        rest = np.tile(home, (round(SETTLES / dt), 1))
        run = _simulate(m, np.arange(len(rest)) * dt, rest, home)
        faults = _faults(m, safety.peaks(m, run, check), limits)
        if faults and last:
            raise UserError(
                f"{m.robot} is not held at rest, where each motion begins: {faults}; correct torque_limit and kp of its"
                " servo.yaml, or its links' masses"
            )
        if not faults:
            break
        home = np.clip(2 * home - run.position[-1], low, high)  # as much higher as a soft drive lets them sink
    free = {j: _free(check, home, m.joints.index(j), low, high) for j in moving}
    jobs: list[tuple[str, tuple[str, ...]]] = []
    for group in groups(m, moving):
        jobs += [(kind, group) for kind in chosen if kind != "random"]
    jobs += [("random", moving)] * (2 if "random" in chosen and len(moving) > 1 else int("random" in chosen))
    made: list[Segment] = []
    left_out: list[str] = []
    for number, (kind, group) in enumerate(jobs):
        say(f"{kind} of {', '.join(group)} ({number + 1}/{len(jobs)})")
        segment, why = _motion(m, kind, group, free, home, limits, check, dt, int(rng.integers(1 << 31)))
        if segment is None and len(group) > 1 and kind != "random":  # together they cannot move; one by one perhaps
            for joint in group:
                segment, why = _motion(m, kind, (joint,), free, home, limits, check, dt, int(rng.integers(1 << 31)))
                made.append(segment) if segment is not None else left_out.append(f"{kind} of {joint}: {why}")
        elif segment is None:
            left_out.append(f"{kind} of {', '.join(group)}: {why}")
        else:
            made.append(segment)
    if not made:
        raise UserError(
            f"no motion of {', '.join(moving)} is safe: {'; '.join(left_out)};"
            " relax speed=, torque=, margin= or clearance="
        )
    order = [int(i) for i in rng.permutation(len(made))]
    order += _repeated(made, repeats, rng)
    order = [order[int(i)] for i in rng.permutation(len(order))]
    segments: list[Segment] = []
    first: dict[int, int] = {}
    rest = np.tile(home, (round(REST / dt), 1))
    parts, at = [rest], len(rest)
    for index in order:
        source = made[index]
        parts += [source.command, rest]
        segments.append(
            Segment(
                source.kind, source.joints, source.command, source.scale, at * dt, (at + len(source.command)) * dt,
                first.get(index),
            )
        )
        first.setdefault(index, len(segments) - 1)
        at += len(source.command) + len(rest)
    value = np.concatenate(parts)
    t = np.arange(len(value)) * dt
    say("simulating the whole sequence")
    run = _simulate(m, t, value, home)
    peaks = safety.peaks(m, run, check)
    faults = _faults(m, peaks, limits)
    if faults:  # each motion alone was safe
        raise UserError(f"the sequence as a whole is not safe: {faults}; choose fewer joints= or a smaller speed=")
    return Plan(m, t, value, home, segments, peaks, run, left_out, sorted(check.exempt))


def groups(m: Mechanism, joints: Sequence[str]) -> list[tuple[str, ...]]:
    """Return joints that move at the same time: the k-th of every branch of the tree (a finger), so that no joint
    carries another."""
    model = m.spec.compile()
    branches: dict[int, list[str]] = {}
    body_of = {j: int(model.joint(j).bodyid[0]) for j in m.joints}
    driven = set(body_of.values())
    for j in joints:
        top, body = body_of[j], body_of[j]
        while body > 0:
            if body in driven:
                top = body
            body = int(model.body_parentid[body])
        branches.setdefault(top, []).append(j)
    longest = max(len(b) for b in branches.values())
    return [tuple(b[k] for b in branches.values() if k < len(b)) for k in range(longest)]


FILES = ("excite.mcap", "excite.csv", "excite_simulated.mcap", "excite.yaml")
"""What `write_plan` writes."""


def write_plan(p: Plan, folder: Path) -> list[Path]:
    """Write into a folder that is there the commands, twice, what the simulation made of them, and what moves when,
    what was left out, the peaks. Returns the paths."""
    paths = [folder / name for name in FILES]
    write_commands(p, paths[0])
    with open(paths[1], "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["time", *p.mechanism.joints])
        rows.writerows([f"{t:.4f}", *(f"{v:.6f}" for v in row)] for t, row in zip(p.t, p.value, strict=True))
    simulated = recorded(p.run, p.mechanism, Series(p.t, p.value, COMMANDS), p.mechanism.joints, rate=100.0)
    write(paths[2], simulated)
    paths[3].write_text(yaml.safe_dump(summary(p), sort_keys=False), "utf-8")
    return paths


def write_commands(p: Plan, path: str | Path) -> None:
    """Write the commands alone, as a recording without states."""
    m = p.mechanism
    notes = yaml.safe_dump(
        [[s.kind, list(s.joints), round(s.start, 3), round(s.end, 3)] for s in p.segments],
        default_flow_style=True,
        width=10**6,
    )
    meta = {
        "source": "sim", "robot": m.robot, "effort_is": "none", "effort_sign": "+1",
        "gravity": " ".join(f"{g:g}" for g in m.spec.option.gravity),
        "notes": "commands to send, not a measurement; kind, joints, start, end: " + notes.strip(),
    }  # fmt: skip
    with Writer(path, m.joints, meta, start_ns=1_000_000_000) as w:
        for t, row in zip(p.t, p.value, strict=True):
            w.add_command(float(t), row)


def next_recording(
    path: str | Path, m: Mechanism, joints: Sequence[str] | None = None, kinds: Sequence[str] | None = None,
    seed: int = 0, limits: Limits = Limits(),
) -> Plan:  # fmt: skip
    """Return the recording that a diagnosis asks for: a safe plan of these joints and kinds of motion, written as
    `path`."""
    made = plan(m, joints, kinds, seed, limits=limits)
    write_commands(made, path)
    return made


def summary(p: Plan) -> dict:
    """Return the plan as plain data."""
    joints = p.mechanism.joints
    return {
        "robot": p.mechanism.robot,
        "seconds": round(float(p.t[-1]), 2),
        "rate_hz": round(float(1 / (p.t[1] - p.t[0])), 3),
        "home": {j: round(float(q), 4) for j, q in zip(joints, p.home, strict=True)},
        "peaks": {
            j: {"speed_fraction": round(float(v), 3), "torque_fraction": round(float(x), 3)}
            for j, v, x in zip(joints, p.peaks.speed, p.peaks.torque, strict=True)
        },
        "segments": [
            {
                "kind": s.kind, "joints": list(s.joints), "start": round(s.start, 3), "end": round(s.end, 3),
                "scale": round(s.scale, 3),
            }
            | ({} if s.repeats is None else {"repeats": s.repeats})
            for s in p.segments
        ],
        "left_out": p.left_out,
        "bodies_not_checked_against_each_other": [list(pair) for pair in p.exempt],
    }


# -- how it is made -----------------------------------------------------------


def _check(m: Mechanism, joints: Sequence[str], kinds: Sequence[str], limits: Limits) -> None:
    for joint in joints:
        if joint not in m.joints:
            raise UserError(f"joints={joint}: not a driven joint; those are {', '.join(m.joints)}")
        if not np.isfinite(m.limits[m.joints.index(joint)]).all():
            raise UserError(
                f"joint '{joint}' has no position limits in the model: give it a range there before it is excited"
            )
    for kind in kinds:
        if kind not in KINDS:
            raise UserError(f"kinds={kind}: must be among {', '.join(KINDS)}")
    for name, low, high in (
        ("speed", 0.01, 1.0), ("torque", 0.01, 1.0), ("margin", 0.0, 0.4), ("clearance", 0.0, 0.05),
        ("current", 1e-3, 1e3),
    ):  # fmt: skip
        if (value := getattr(limits, name)) is not None:
            typed.number(name, value, low, high)


def _range(m: Mechanism, limits: Limits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return lowest and highest command and home [J]: the model's rest position, brought inside the margins."""
    model = m.spec.compile()
    rest = np.array([model.qpos0[model.jnt_qposadr[model.joint(j).id]] for j in m.joints])
    wide = m.limits[:, 1] - m.limits[:, 0]
    low, high = m.limits[:, 0] + limits.margin * wide, m.limits[:, 1] - limits.margin * wide
    endless = ~np.isfinite(wide)
    low, high = np.where(endless, rest, low), np.where(endless, rest, high)
    return low, high, np.clip(rest, low, high)


def _free(
    check: safety.ContactCheck, home: np.ndarray, j: int, low: np.ndarray, high: np.ndarray, count: int = 60
) -> tuple[float, float]:
    """Return the interval around home in which joint j touches nothing, the others at home."""
    ends = []
    for end in (low[j], high[j]):
        reached = home[j]
        for x in np.linspace(home[j], end, count)[1:]:
            q = home.copy()
            q[j] = x
            if check.near(q):
                break
            reached = x
        ends.append(float(reached))
    return ends[0], ends[1]


def _motion(
    m: Mechanism, kind: str, group: tuple[str, ...], free: dict[str, tuple[float, float]], home: np.ndarray,
    limits: Limits, check: safety.ContactCheck, dt: float, seed: int,
) -> tuple[Segment | None, str]:  # fmt: skip
    """Return the largest safe version of a motion, or None and why there is none."""
    scale, why = 1.0, ""
    for _ in range(TRIES):
        command = _command(m, kind, group, free, home, limits, dt, seed, scale)
        if command is None:
            return None, "it has no room to move"
        t = np.arange(len(command)) * dt
        run = _simulate(m, t, command, home)
        peaks = safety.peaks(m, run, check)
        why = _faults(m, peaks, limits, RESERVE)
        if not why:
            return Segment(kind, group, command, scale), ""
        over = max(peaks.speed.max() / limits.speed, (peaks.torque / limits.torques(m)).max()) / RESERVE
        scale *= float(np.clip(1.0 / over, 0.5, SHRINK))
        if scale < SMALLEST:
            break
    return None, why


def _command(
    m: Mechanism, kind: str, group: tuple[str, ...], free: dict[str, tuple[float, float]], home: np.ndarray,
    limits: Limits, dt: float, seed: int, scale: float,
) -> np.ndarray | None:  # fmt: skip
    """Return targets [T, J]: from home to each joint's centre, the motion, and back."""
    kp, stall, allowed = m.column("kp"), m.column("torque_limit"), limits.torques(m)
    rng = np.random.default_rng(seed)
    speed = limits.speed * m.speeds * (1.0 if kind == "steps" else max(scale, 0.2))
    centre, paths = home.copy(), {}
    for joint in group:
        j = m.joints.index(joint)
        low, high = free[joint]
        half = 0.5 * (high - low)
        if half < 1e-3:
            return None
        # a smaller motion also stays nearer to home, where there is room
        centre[j] = home[j] + (0.5 * (low + high) - home[j]) * scale
        a = half * scale
        if kind == "steps" and m.table.drive == "torque" and np.isfinite(stall[j]):
            a = min(a, RESERVE * allowed[j] * stall[j] / kp[j] * scale)
        paths[j] = KINDS[kind](a, speed[j], dt, rng)
    longest = max(len(p) for p in paths.values())
    body = np.tile(centre, (longest, 1))
    for j, path in paths.items():
        body[: len(path), j] += path
    seconds = max(0.4, float((PEAK * np.abs(centre - home) / (0.4 * speed)).max()))
    to = minimum_jerk(home, centre, seconds, dt)
    return np.concatenate([to, body, minimum_jerk(centre, home, seconds, dt)])


def _simulate(m: Mechanism, t: np.ndarray, command: np.ndarray, home: np.ndarray) -> Run:
    return drive(m, Series(t, command), m.joints, float(t[-1]) + 0.3, home, CHECK_STEP, frame_s=FRAME)


def _faults(m: Mechanism, peaks: safety.Peaks, limits: Limits, reserve: float = 1.0) -> str:
    """Return what a motion violates of this share of the limits, in words; "" where nothing."""
    out = []
    speeds = np.full(len(m.joints), limits.speed)
    for name, value, allowed in (("speed", peaks.speed, speeds), ("torque", peaks.torque, limits.torques(m))):
        j = int(np.argmax(value / allowed))
        if value[j] > reserve * allowed[j] + 1e-6:
            out.append(f"{name} of {m.joints[j]} reaches {value[j]:.2f} of its limit, {allowed[j]:.3g} is allowed")
    if peaks.excess > PASSED:
        out.append(f"a joint passes its limit by {peaks.excess:.3g}")
    out += [f"{a} touches {b} at {t:.2f} s" for (a, b), t in list(peaks.contacts.items())[:2]]
    return "; ".join(out)


def _repeated(made: list[Segment], repeats: int, rng: np.random.Generator) -> list[int]:
    """Return indices of the motions that come again: `repeats` of each group of joints."""
    by_group: dict[tuple[str, ...], list[int]] = {}
    for i, s in enumerate(made):
        by_group.setdefault(s.joints, []).append(i)
    return [int(i) for members in by_group.values() for i in rng.permutation(members)[:repeats]]
