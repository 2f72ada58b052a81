"""Joints that a file ties together: which of them follow, how far they go, and what of it is not simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim.errors import UserError
from dexsim.import_hand import drives

GRID = 401  # places of a drive's range that are tried
SLACK = 0.02  # of a follower's range: beyond its limits by less is rounding


def read(
    spec: mujoco.MjSpec, path: Path, coupled: str, moved: set[str], bent: Mapping[str, float]
) -> tuple[list[str], set[str]]:
    """Return what ties joints together, a line each, and the joints that follow others. Taken out where coupled is
    "independent". moved: joints that an actuator of the file moves; bent: routed tendons that no fixed coefficients
    replace, and how far they are from it.

    Raises UserError for joints that follow in a ring, and for all that is not simulated: loops, routed tendons, joints
    with a motor that follow.
    """
    found, things, passive = [], [], set()
    closed: list[str] = []
    targets = {a.target for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_TENDON}
    reached = moved.union(*(drives.fixed_arms(t) for t in spec.tendons if t.name in targets))
    for tendon in spec.tendons:
        things.append(tendon)
        arms = drives.fixed_arms(tendon)
        if not arms:
            off = f", off a line by {100 * bent[tendon.name]:.0f} % of its travel" if tendon.name in bent else ""
            closed.append(f"tendon '{tendon.name}' is routed over sites or geoms{off}")
        elif len(arms) > 1:  # one over a single joint is a spring or a limit of that joint
            found.append(f"tendon '{tendon.name}' ({', '.join(sorted(arms))})")
            still = [j for j in arms if j not in moved]
            follows = any(e.type == mujoco.mjtEq.mjEQ_TENDON and e.name1 == tendon.name and e.name2 for e in
                          spec.equalities)  # fmt: skip
            if not reached & set(arms) and not follows:
                closed.append(f"no actuator moves any of the joints of tendon '{tendon.name}' ({', '.join(arms)})")
            passive |= set(still)
    for equality in spec.equalities:
        things.append(equality)
        both = ", ".join(n for n in (equality.name1, equality.name2) if n)
        if equality.type == mujoco.mjtEq.mjEQ_JOINT:
            if equality.name1 in moved and equality.name2 and equality.name2 not in moved:
                _turn(equality)
            found.append(f"mimic or joint equality ({both})")
            if equality.name1 in moved:
                closed.append(f"joint '{equality.name1}' has an actuator, and follows '{equality.name2}'")
            elif equality.name1 in passive and _twice(spec, equality.name1):
                closed.append(f"joint '{equality.name1}' follows two joints")
            passive.add(equality.name1)
        elif equality.type == mujoco.mjtEq.mjEQ_TENDON:
            if not equality.name2:
                continue  # a length of its own: the tendon's joints are among those above
            found.append(f"tendon equality ({both})")
            led = set(drives.fixed_arms(spec.tendon(equality.name1)))
            if np.any(np.array(equality.data)[2:5]):
                closed.append(f"tendon '{equality.name1}' follows '{equality.name2}' by a polynomial")
            passive |= led - moved
            if not led - moved:
                closed.append(f"every joint of tendon '{equality.name1}' has an actuator, and follows"
                              f" '{equality.name2}'")  # fmt: skip
        else:
            kind = {mujoco.mjtEq.mjEQ_CONNECT: "a closed loop (connect", mujoco.mjtEq.mjEQ_WELD: "a weld ("}
            closed.append(f"{kind.get(equality.type, 'an equality (')} {both})")
    if coupled == "independent":
        for thing in things:
            spec.delete(thing)
        return found + closed, set()
    tied = {e.name1: e.name2 for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT}
    for start in tied:
        at, seen = start, [start]
        while (at := tied.get(at, "")) and at not in seen:
            seen.append(at)
        if at == start:
            raise UserError(
                f"model {path}: joints {', '.join(seen)} follow each other in a ring: take one equality out"
            )
    if closed:
        balls = [j.name for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_BALL]
        instead = "or coupled=independent drives each joint by a motor of its own (another hand than the real one)"
        if balls:
            instead = f"and hinges in that of its {len(balls)} ball joints ({', '.join(balls[:3])} ...)"
        raise UserError(
            f"model {path}: what ties its joints is not simulated: {'; '.join(closed[:6])}"
            f"{f'; {len(closed) - 6} more' if len(closed) > 6 else ''}: put joint equalities or tendons of fixed"
            f" coefficients in its place, {instead}"
        )
    return found, passive


def _turn(equality: Any) -> None:
    """Let the second joint of an equality follow the first, where their law is a line."""
    offset, slope, *rest = (float(x) for x in equality.data[:5])
    if slope and not any(rest):
        equality.name1, equality.name2 = equality.name2, equality.name1
        equality.data[:2] = -offset / slope, 1 / slope


def _twice(spec: mujoco.MjSpec, joint: str) -> bool:
    return sum(e.type == mujoco.mjtEq.mjEQ_JOINT and e.name1 == joint for e in spec.equalities) > 1


def laws_of(m: mujoco.MjModel) -> list[tuple[int, int, np.ndarray]]:
    """Return follower, leader and coefficients [5] of the equalities of two joints."""
    return [(int(m.eq_obj1id[e]), int(m.eq_obj2id[e]), m.eq_data[e, :5]) for e in range(m.neq)
            if m.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT and m.eq_obj2id[e] >= 0]  # fmt: skip


def follow(m: mujoco.MjModel, law: tuple[int, int, np.ndarray], q: np.ndarray) -> np.ndarray:
    """Return the follower's positions where its leader is at q."""
    one, other, factors = law
    zero = [float(m.qpos0[m.jnt_qposadr[j]]) for j in (one, other)]
    return zero[0] + np.polynomial.polynomial.polyval(q - zero[1], factors)


def give_limits(m: mujoco.MjModel) -> None:
    """Give a joint without limits (a `continuous` one) those that the joints tied to it leave it, in place."""
    laws = laws_of(m)
    for _ in laws:
        for law in laws:
            one, other, (offset, slope, *rest) = law
            bounded = [bool(m.jnt_limited[j]) for j in (one, other)]
            if bounded == [False, True]:
                ends = follow(m, law, np.linspace(m.jnt_range[other, 0], m.jnt_range[other, 1], GRID))
                j = one
            elif bounded == [True, False] and slope and not any(rest):
                zero = [m.qpos0[m.jnt_qposadr[j]] for j in (one, other)]
                ends, j = zero[1] + (m.jnt_range[one] - zero[0] - offset) / slope, other
            else:
                continue
            if np.ptp(ends) > 0:
                m.jnt_range[j], m.jnt_limited[j] = (ends.min(), ends.max()), 1


def reach(m: mujoco.MjModel, leaders: Sequence[int], where: str) -> dict[int, tuple[float, float, str]]:
    """Return, by id of a driven joint, how far it goes before a joint that follows it meets a limit, and which one;
    only of those that do not reach both of their own.

    Raises UserError where a follower is beyond its limits wherever the driven joint stands, or is held there.
    """
    laws, out = laws_of(m), {}
    for e in range(m.neq):
        j = int(m.eq_obj1id[e])
        if m.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT and m.eq_obj2id[e] < 0 and m.jnt_limited[j]:
            stands, (low, high) = float(m.qpos0[m.jnt_qposadr[j]] + m.eq_data[e, 0]), m.jnt_range[j]
            if not low - SLACK * (high - low) <= stands <= high + SLACK * (high - low):
                raise UserError(
                    f"{where}: joint '{m.joint(j).name}' is held at {stands:g}, beyond its limits {low:g} to {high:g}"
                )
    for leader in leaders:
        q = np.linspace(m.jnt_range[leader, 0], m.jnt_range[leader, 1], GRID)
        places, most = {leader: q}, (0.0, leader)
        free = np.ones(GRID, bool)
        for _ in laws:
            for law in laws:
                if law[1] not in places or law[0] in places or not m.jnt_limited[law[0]]:
                    continue
                at = places[law[0]] = follow(m, law, places[law[1]])
                low, high = m.jnt_range[law[0]]
                beyond = np.maximum(low - at, at - high)
                free &= beyond <= SLACK * (high - low)
                most = max(most, (float(beyond.max() / (high - low)), law[0]))
        if free.all():
            continue
        name, follower = m.joint(leader).name, m.joint(most[1]).name
        if not free.any():
            raise UserError(
                f"{where}: joint '{follower}' follows '{name}' beyond its limits, wherever that stands: correct"
                " the offset and multiplier, or the limits"
            )
        edges = np.flatnonzero(np.diff(np.concatenate([[0], free, [0]])))
        begin, end = max(edges.reshape(-1, 2), key=lambda e: e[1] - e[0])
        out[leader] = float(q[begin]), float(q[end - 1]), follower
    return out
