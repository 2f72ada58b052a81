"""The concealed rigs' physics: written apart from the simulator they test, sharing no code with it, and not MuJoCo.

A rig is a set of chains of hinges. Every joint has two inertias, the motor's and the link's, joined by a stiff damped
spring with optional play; the links' coupled dynamics come from Jacobians (mass matrix, gravity and Coriolis terms,
refreshed every millisecond and extrapolated between). Friction is the LuGre bristle model (Canudas de Wit et al. 1995)
on the motor side; the firmware runs its own loop at 1 kHz on its own encoder; all is integrated at 10 kHz,
semi-implicit Euler. All rows of a batch run at once: parameters are [B, J]. SI units: rad, rad/s, N.m, s, kg, degC.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DT = 1e-4  # s, integration
LOOP = 10  # integration steps in one firmware period (1 kHz)
TICK = DT * LOOP
AMBIENT = 25.0  # degC; torque constant and friction are those of here
REST = 0.02  # rad/s: slower than this a joint dwells
MESSAGE = 10  # ms between two commands

# Every parameter of a joint and its value where the effect is absent.
DEFAULTS: dict[str, float] = {
    # of its link [kg], added at its centre [kg], distance of the centre over nominal
    "mass": 0.15, "extra": 0.0, "com": 1.0,
    # reflected rotor inertia [kg.m2], N.m/rad (no stiffer than the step allows), rad
    "rotor": 4e-4, "spring": 600.0, "play": 0.0,
    # 1: the loop gives a duty, 0: a torque
    "voltage": 0.0, "kp": 2.0, "kd": 0.04, "torque_limit": 1.0, "no_load_speed": 15.0,
    "delay": 0.0, "lag": 0.0, "speed_lag": 0.0, "deadband": 0.0,  # s, s, s (of the loop's speed), rad (half width)
    "offset": 0.0, "scale": 1.0, "eccentric": 0.0, "eccentric_at": 0.0,  # of both encoders
    "motor_side": 0.0,  # 1: the loop reads the motor, 0: the link
    "coulomb": 0.015, "asymmetry": 0.0, "viscous": 0.003, "peak": 0.0, "peak_speed": 0.1, "load": 0.0, "load_back": 0.0,
    "ripple": 0.0, "per_turn": 12.0, "phase": 0.0,  # N.m, per turn of the joint, rad
    "heat": 60.0, "cooling": 25.0, "warm": AMBIENT,  # degC per (N.m)^2 held, s, degC at the start
    "thermal_torque": 0.0, "thermal_friction": 0.0,  # 1/degC
    "sag": 0.0,  # share of the supply lost per N.m of the other joints
    "couple": 0.0, "couple_from": 0.0,  # joint = motor + couple * joint number couple_from
    # outside the catalogue
    "dwell": 0.0, "dwell_time": 1.0,  # stiction that grows with time at rest [N.m], its time constant [s]
    "cable": 0.0, "cable_rest": 0.0,  # spring to the world [N.m/rad] that pulls beyond an angle [rad] only
    "mount": 0.0, "mount_inertia": 1e-3,  # compliance of what the motor is screwed to [rad/N.m], its inertia [kg.m2]
    "tooth": 0.0, "tooth_at": 0.3, "tooth_width": 0.04,  # a damaged tooth: resistance [N.m] about one angle
    "bristle": 1.0,  # 1: LuGre; 0: ideal dry friction, to see what the law itself changes
    # second laws: other physics under the same name (`laws.py`); at these values there is none of it
    "peak_power": 2.0,  # the Stribeck peak falls as exp(-(|v| / peak_speed) ** peak_power)
    "shear": 0.0, "shear_speed": 1.5,  # grease that thins: N.m.s/rad at rest, rad/s at which half of it is left
    "load_power": 1.0, "load_unit": 1.0,  # load friction: fraction * unit [N.m] * (|load| / unit) ** power
    "impact": 1.0,  # share of the transmission's damping that is there: little of it and the teeth rebound
    "hardening": 0.0,  # N.m: load by which the transmission's spring has become twice as stiff as at none (secant)
    "jitter": 0.0, "jitter_from": 0.0,  # share by which a message's delay varies; where its row of chance begins
    "lag_order": 1.0, "speed_order": 1.0,  # equal first-order stages that share the time constant
    "knee": 0.0,  # 0: the limit is sharp; else the exponent of a soft one, see `soft_limit`
    "corner": 0.0,  # 1: full torque up to half of the no-load speed, then down to none; 0: a line from rest on
    "sag_duty": 0.0,  # share of the supply lost per N.m of the others' torque times their duty (what the bus feels)
    "sawtooth": 0.0,  # 1: the ripple rises evenly and drops
    "core": 0.0, "core_time": 3.0,  # the winding over the logged housing: degC per (N.m)^2 held, s
    "exponential": 0.0,  # 1: friction follows exp(thermal_friction * warming), 0: the line
    "arm": 0.0,  # 1: what couples two joints pulls on a lever: by the sine of the other one's angle
    "bulk": 0.0,  # radius of the added mass (a ball) over the distance of the link's centre
    "second_harmonic": 0.0,  # of the eccentric encoders, over the first
    "subtract": 0.0,  # 1: beyond the deadband the error counts from its edge, 0: whole
}  # fmt: skip


@dataclass(frozen=True)
class Rig:
    """Chains of links. names [J]; place [J, 2]: chain and depth of each joint. By chain C and depth D, in the parent
    link's frame: frame [C, D, 3, 3] rotation at angle 0, offset [C, D, 3] m, axis [C, D, 3] (in the link's own); com
    [C, D, 3] m, spread [C, D, 3, 3] inertia about the centre over mass [m2]. gravity [3] m/s2."""

    names: tuple[str, ...]
    place: np.ndarray
    frame: np.ndarray
    offset: np.ndarray
    axis: np.ndarray
    com: np.ndarray
    spread: np.ndarray
    gravity: np.ndarray

    @property
    def slots(self) -> np.ndarray:
        """[J] place of each joint among the C * D slots."""
        return self.place[:, 0] * self.com.shape[1] + self.place[:, 1]


def pendulum(
    length: float = 0.1, radius: float = 0.0, names: tuple[str, ...] = ("joint",), lengths: tuple[float, ...] = ()
) -> Rig:
    """Return a bench of single pendulums about y that hang along -z: bobs of a radius [m] at their lengths [m]."""
    lengths = lengths or (length,) * len(names)
    n = len(names)
    one = lambda v: np.tile(np.asarray(v, float), (n, 1, 1))  # noqa: E731
    com = one([0.0, 0.0, 0.0])
    com[:, 0, 2] = -np.array(lengths)
    spread = np.tile(0.4 * radius**2 * np.eye(3), (n, 1, 1, 1))
    place = np.stack([np.arange(n), np.zeros(n, int)], 1)
    return Rig(
        names,
        place,
        np.tile(np.eye(3), (n, 1, 1, 1)),
        one([0, 0, 0]),
        one([0, 1, 0]),
        com,
        spread,
        np.array([0, 0, -9.81]),
    )


def rows(count: int, joints: int = 1, **values) -> dict[str, np.ndarray]:
    """Return the parameters [count, joints]: the defaults, with the given scalars, [count] or [count, joints] arrays in
    place."""
    unknown = set(values) - set(DEFAULTS)
    if unknown:
        raise KeyError(f"the plant has no parameter {sorted(unknown)}")
    out = {}
    for k, v in DEFAULTS.items():
        x = np.asarray(values.get(k, v), float)
        out[k] = np.broadcast_to(x[:, None] if x.ndim == 1 else x, (count, joints)).copy()
    return out


def _rotation(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return [B, C, 3, 3] about axis [C, 3] by angle [B, C] (Rodrigues)."""
    K = np.zeros((*axis.shape[:-1], 3, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -axis[..., 2], axis[..., 1], -axis[..., 0]
    K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = axis[..., 2], -axis[..., 1], axis[..., 0]
    s, c = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.eye(3) + s * K + (1 - c) * (K @ K)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(-1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def soft_limit(x: np.ndarray, limit: np.ndarray | float, knee: np.ndarray | float) -> np.ndarray:
    """Return x within a limit that is approached, not hit: x / (1 + |x / limit|^knee)^(1 / knee)."""
    limit = np.maximum(limit, 1e-9)
    return x / (1 + np.abs(x / limit) ** knee) ** (1 / np.asarray(knee))


def encoded(
    q: np.ndarray, scale: np.ndarray, offset: np.ndarray, eccentric: np.ndarray, at: np.ndarray, second: np.ndarray
) -> np.ndarray:
    """Return what an eccentric encoder makes of an angle [rad]; second: amplitude of its second harmonic over the
    first."""
    seen = scale * q + offset + eccentric * np.sin(q + at)
    return seen + eccentric * second * np.sin(2 * (q + at)) if np.any(second) else seen


def angle_read_as(
    seen: np.ndarray, scale: np.ndarray, offset: np.ndarray, eccentric: np.ndarray, at: np.ndarray, second: np.ndarray
) -> np.ndarray:
    """Return the angle [rad] of which such an encoder makes `seen`: the inverse of `encoded`, by Newton's method."""
    q = (seen - offset) / scale
    for _ in range(20):
        slope = scale + eccentric * (np.cos(q + at) + 2 * second * np.cos(2 * (q + at)))
        q = q - (encoded(q, scale, offset, eccentric, at, second) - seen) / slope
    return q


def arrivals(delay: float, jitter: float, start: int, count: int) -> np.ndarray:
    """[count] times [s] at which messages sent every MESSAGE ms arrive: late by the delay, more or less by a share of
    it that varies evenly from message to message, and never before an earlier one (a queue)."""
    chance = np.random.default_rng(11).uniform(-1, 1, 4096)[(start + np.arange(count)) % 4096]
    return np.maximum.accumulate(np.arange(count) * MESSAGE * TICK + delay * (1 + jitter * chance))


def dynamics(
    rig: Rig,
    mass: np.ndarray,
    extra: np.ndarray,
    reach: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    gravity: np.ndarray,
    radius: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return mass matrix [B, C, D, D] and the torque [B, C, D] that gravity and the motion itself ask of each hinge.

    mass, extra, reach, q, v: [B, C, D]; gravity [B, 3]; radius [B, C, D]: of the added mass, m; None: a point.
    """
    B, C, D = q.shape
    R = np.broadcast_to(np.eye(3), (B, C, 3, 3))
    p = np.zeros((B, C, 3))
    w, a, acc = np.zeros((B, C, 3)), np.zeros((B, C, 3)), np.zeros((B, C, 3))
    z, at = [], []
    M, h = np.zeros((B, C, D, D)), np.zeros((B, C, D))
    for d in range(D):
        step = np.einsum("bcij,cj->bci", R, rig.offset[:, d])
        if d:
            acc = acc + _cross(a, step) + _cross(w, _cross(w, step))
        p = p + step
        R = R @ rig.frame[:, d] @ _rotation(rig.axis[:, d], q[:, :, d])
        axis = np.einsum("bcij,cj->bci", R, rig.axis[:, d])
        spin = axis * v[:, :, d, None]
        if d:
            a = a + _cross(w, spin)
        w = w + spin
        z.append(axis)
        at.append(p)
        arm = np.einsum("bcij,cj->bci", R, rig.com[:, d]) * reach[:, :, d, None]
        here = p + arm
        m = (mass + extra)[:, :, d]
        I = (R @ rig.spread[:, d] @ np.swapaxes(R, -1, -2)) * mass[:, :, d, None, None]  # noqa: E741
        if radius is not None:
            I = I + (0.4 * extra[:, :, d] * radius[:, :, d] ** 2)[..., None, None] * np.eye(3)  # noqa: E741
        pulled = _cross(w, _cross(w, arm))
        moment = _cross(w, np.einsum("bcij,bcj->bci", I, w))
        if d:  # the first hinge's own turning is all that moves the first link
            pulled = acc + _cross(a, arm) + pulled
            moment = np.einsum("bcij,bcj->bci", I, a) + moment
        force = m[..., None] * (pulled - gravity[:, None])
        J = [_cross(z[i], here - at[i]) for i in range(d + 1)]
        Iz = [np.einsum("bcij,bcj->bci", I, z[i]) for i in range(d + 1)]
        for i in range(d + 1):
            h[:, :, i] += _dot(J[i], force) + _dot(z[i], moment)
            for j in range(i + 1):
                M[:, :, i, j] += m * _dot(J[i], J[j]) + _dot(z[i], Iz[j])
                M[:, :, j, i] = M[:, :, i, j]
    return M, h


def simulate(
    rig: Rig,
    p: dict[str, np.ndarray],
    command: np.ndarray,
    q0: np.ndarray | float = 0.0,
    driven: bool = True,
    gravity: np.ndarray | None = None,
    external: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Runs all rows. command [B, J, M]: the target in every millisecond; q0: first angles, broadcast to [B, J] rad;
    gravity [B, 3]: None for the rig's; external [B, J, M]: torque on the links from outside.

    Returns, each [B, J, M] at the start of every millisecond: position (link), torque (motor), speed (motor), load
    (through the transmission), slip (friction over its level), asked (before any limit), free (1 where the teeth do not
    touch), temperature; where a law needs them, supply (share of the nominal) and winding (its temperature).
    """
    B, J, steps = command.shape
    C, D = rig.com.shape[:2]
    S, slots = C * D, rig.slots
    there = np.zeros(S, bool)
    there[slots] = True

    def spread(x: np.ndarray, empty: float) -> np.ndarray:
        out = np.full((B, S), empty)
        out[:, slots] = x
        return out

    P = {k: spread(v, DEFAULTS[k]) for k, v in p.items()}
    grid = lambda x: x.reshape(B, C, D)  # noqa: E731
    mass, extra, reach = (grid(np.where(there, P[k], 0.0)) for k in ("mass", "extra", "com"))
    g = np.broadcast_to(rig.gravity if gravity is None else gravity, (B, 3))
    q = spread(np.broadcast_to(np.asarray(q0, float), (B, J)), 0.0)
    source = np.zeros((B, S), int)
    source[:, slots] = slots[p["couple_from"].astype(int)]
    has = {k: bool((P[k] != DEFAULTS[k]).any()) for k in DEFAULTS}
    lever = P["arm"] > 0.5
    first = np.take_along_axis(q, source, 1)
    motor = q - P["couple"] * (np.where(lever, np.sin(first), first) if has["arm"] else first)
    v, vm, z, rest, tau = (np.zeros((B, S)) for _ in range(5))
    locked = np.diag((~there).astype(float) * 1.0)
    base, base_v = np.zeros((B, S)), np.zeros((B, S))
    gaps = np.zeros((C, D))
    gaps[rig.place[:, 0], rig.place[:, 1]] = np.linalg.norm(rig.com, axis=-1)[rig.place[:, 0], rig.place[:, 1]]
    radius = grid(P["bulk"]) * gaps * reach if has["bulk"] else None

    def terms() -> tuple[np.ndarray, np.ndarray]:
        M, h = dynamics(rig, mass, extra, reach, grid(q + base), grid(v + base_v), g, radius)
        for c in range(C):
            M[:, c] += locked[c * D : (c + 1) * D, c * D : (c + 1) * D]
        return np.linalg.inv(M) if D > 1 else 1 / M, h.reshape(B, S)

    inverse, bias = terms()
    link = 1 / np.stack([inverse[:, s // D, s % D, s % D] for s in range(S)], 1)
    reduced = link * P["rotor"] / (link + P["rotor"])
    spring = np.minimum(P["spring"], reduced / (16 * DT * DT))  # the mode stays slow beside the step
    loss = 0.6 * np.sqrt(spring * reduced) * P["impact"]
    half = 0.5 * P["play"]
    flank = -half
    strongest = P["coulomb"] + P["peak"] + P["dwell"] + 1e-6
    sigma0 = np.clip(strongest / 4e-4, 5.0, 0.05 * P["rotor"] / (DT * DT))
    sigma1 = 0.5 * np.sqrt(sigma0 * P["rotor"])
    late = np.maximum(P["delay"] / TICK, 0.0)
    whole = np.floor(late).astype(int)
    part = late - whole  # of a millisecond, by mixing two targets
    settle = lambda T: np.where(T > 0, 1 - np.exp(-TICK / np.maximum(T, 1e-6)), 1.0)  # noqa: E731
    rate, speed_rate = (
        settle(P["lag"] / P["lag_order"]),
        np.where(P["speed_lag"] > 0, settle(P["speed_lag"] / P["speed_order"]), 0.8),
    )
    full = np.zeros((B, S, steps))
    full[:, slots] = command
    push_in = None
    if external is not None:
        push_in = np.zeros((B, S, steps))
        push_in[:, slots] = external
    stage, speed_stage, winding = np.zeros((B, S)), np.zeros((B, S)), np.zeros((B, S))  # winding: over the housing
    uneven = np.argwhere((P["jitter"] > 0) & there) if has["jitter"] else np.zeros((0, 2), int)
    sent = np.zeros((len(uneven), steps), int)  # the millisecond whose target acts
    for row, (b, s) in enumerate(uneven):
        at = arrivals(P["delay"][b, s], P["jitter"][b, s], int(P["jitter_from"][b, s]), steps // MESSAGE + 1)
        sent[row] = MESSAGE * np.maximum(np.searchsorted(at, np.arange(steps) * TICK + 1e-9, "right") - 1, 0)
    sent = np.minimum(sent, steps - 1)
    filtered, carried, last = np.zeros((B, S)), np.zeros((B, S)), None
    warm, previous = P["warm"].copy(), bias
    b_index, s_index = np.arange(B)[:, None], np.arange(S)[None]
    keys = ("position", "torque", "speed", "load", "slip", "asked", "free", "temperature")
    keys += ("supply",) * has["sag_duty"] + ("winding",) * has["core"]
    out = {k: np.empty((B, J, steps), np.float32 if k not in ("position", "torque") else float) for k in keys}
    ideal = P["bristle"] < 0.5
    some_ideal = bool(ideal.any())
    friction = push = np.zeros((B, S))
    free = np.zeros((B, S))
    level = strongest
    unit = 2 * np.pi / 2**18  # the loop's own encoder
    decay = np.exp(-DT / 5e-3)  # the load that presses the gear's flanks, as its friction feels it
    for k in range(steps):
        # firmware: reads its encoder, filters the speed, and asks for a torque that holds one millisecond
        true = np.where(P["motor_side"] > 0.5, motor, q)
        if has["eccentric"]:
            seen = encoded(true, P["scale"], P["offset"], P["eccentric"], P["eccentric_at"], P["second_harmonic"])
        else:
            seen = P["scale"] * true + P["offset"]
        seen = np.floor(seen / unit) * unit
        if last is not None:
            fresh = (seen - last) / TICK
            if has["speed_order"]:
                speed_stage = speed_stage + speed_rate * (fresh - speed_stage)
                fresh = np.where(P["speed_order"] > 1.5, speed_stage, fresh)
            filtered = filtered + speed_rate * (fresh - filtered)
        last = seen
        i = np.maximum(k - whole, 0)
        target = full[b_index, s_index, i] * (1 - part) + full[b_index, s_index, np.maximum(i - 1, 0)] * part
        if len(uneven):
            target[uneven[:, 0], uneven[:, 1]] = full[uneven[:, 0], uneven[:, 1], sent[:, k]]
        error = target - seen
        counts = error - np.sign(error) * P["deadband"] * P["subtract"] if has["subtract"] else error
        raw = np.where(np.abs(error) < P["deadband"], 0.0, P["kp"] * counts) - P["kd"] * filtered
        supply = 1.0
        if has["sag"] or has["sag_duty"]:
            use = np.abs(tau)
            drop = P["sag"] * (use.sum(1, keepdims=True) - use)
            if has["sag_duty"]:
                bus = use * np.minimum(use / P["torque_limit"] + np.abs(vm) / P["no_load_speed"], 1.0)
                drop = drop + P["sag_duty"] * (bus.sum(1, keepdims=True) - bus)
            supply = np.maximum(1 - drop, 0.05)
        room = np.maximum(supply - np.abs(filtered) / P["no_load_speed"], 0.0)
        if has["corner"]:
            room = np.where(P["corner"] > 0.5, np.minimum(2 * room, 1.0), room)
        most = P["torque_limit"] * room
        duty, given = np.minimum(np.maximum(raw, -1), 1), np.minimum(np.maximum(raw, -most), most)
        if has["knee"]:
            is_soft, knee = P["knee"] > 0, np.maximum(P["knee"], 1.0)
            duty = np.where(is_soft, soft_limit(raw, 1.0, knee), duty)
            given = np.where(is_soft, soft_limit(raw, most, knee), given)
        commanded = np.where(P["voltage"] > 0.5, P["torque_limit"] * (duty * supply - vm / P["no_load_speed"]), given)
        if has["lag_order"]:
            stage = stage + rate * (commanded - stage)
            commanded = np.where(P["lag_order"] > 1.5, stage, commanded)
        tau = tau + rate * (commanded - tau) if driven else np.zeros((B, S))
        drive = tau
        rub = 1.0
        if has["thermal_torque"]:
            drive = tau * np.maximum(1 + P["thermal_torque"] * (warm + winding - AMBIENT), 0.05)
        if has["thermal_friction"]:
            rub = np.maximum(1 + P["thermal_friction"] * (warm - AMBIENT), 0.05)
            if has["exponential"]:
                rub = np.where(P["exponential"] > 0.5, np.exp(P["thermal_friction"] * (warm - AMBIENT)), rub)
        for name, value in (("position", q), ("torque", tau), ("speed", vm), ("load", push),
                            ("slip", friction / level), ("asked", raw), ("free", free),
                            ("temperature", warm)):  # fmt: skip
            out[name][:, :, k] = value[:, slots]
        if has["sag_duty"]:
            out["supply"][:, :, k] = np.broadcast_to(supply, (B, S))[:, slots]
        if has["core"]:
            out["winding"][:, :, k] = (warm + winding)[:, slots]
            winding = winding + TICK * (P["core"] * tau * tau - winding) / P["core_time"]
        warm = warm + TICK * (P["heat"] * tau * tau - (warm - AMBIENT)) / P["cooling"]
        grown = 0.0
        if has["dwell"]:
            rest = np.where(np.abs(v) < REST, rest + TICK, np.maximum(rest - 0.02 * rest - TICK, 0.0))
            grown = P["dwell"] * (1 - np.exp(-rest / P["dwell_time"]))
        inverse, now = terms()
        slope, previous = now - previous, now
        flat = inverse[..., 0, 0].reshape(B, S) if D == 1 else None
        for n in range(LOOP):
            bias = now + slope * ((n + 0.5) / LOOP)
            twist, rate_of = motor - q, vm - v
            if has["couple"]:
                drag, drag_v = np.take_along_axis(q, source, 1), np.take_along_axis(v, source, 1)
                if has["arm"]:
                    pulls = np.where(lever, np.cos(drag), 1.0)
                    drag, drag_v = np.where(lever, np.sin(drag), drag), pulls * drag_v
                twist, rate_of = twist + P["couple"] * drag, rate_of + P["couple"] * drag_v
            deep = twist - np.minimum(np.maximum(twist, flank), half)
            elastic = spring * deep
            if has["hardening"]:
                stiffer = (elastic / np.where(P["hardening"] > 0, P["hardening"], np.inf)) ** 2
                elastic = elastic * (1 + stiffer)
            push = np.where(deep != 0, elastic + loss * rate_of, 0.0)
            push = np.where(deep * push < 0, 0.0, push)  # a tooth cannot pull
            carried = carried * decay + (1 - decay) * push
            speed = np.abs(vm)
            level = P["coulomb"] + grown
            if has["asymmetry"]:
                level = level * (1 + 0.5 * P["asymmetry"] * np.sign(vm))
            if has["peak"]:
                fall = (speed / P["peak_speed"]) ** (P["peak_power"] if has["peak_power"] else 2)
                level = level + P["peak"] * np.exp(-fall)
            if has["load"] or has["load_back"]:
                press = np.abs(carried)
                if has["load_power"]:
                    press = P["load_unit"] * (press / P["load_unit"]) ** P["load_power"]
                level = level + np.where(carried * vm >= 0, P["load"], P["load_back"]) * press
            if has["tooth"]:
                level = level + P["tooth"] * np.exp(-(((motor - P["tooth_at"]) / P["tooth_width"]) ** 2))
            level = level * rub + 1e-7
            # the bristle's own equation, taken implicitly: stable however fast it settles
            z_next = (z + vm * DT) / (1 + sigma0 * speed * DT / level)
            friction = sigma0 * z_next + sigma1 * np.exp(-((speed / 0.05) ** 2)) * (z_next - z) / DT
            z = z_next
            if some_ideal:
                held = P["rotor"] * vm / DT + drive - push
                friction = np.where(ideal, np.minimum(np.maximum(held, -level), level), friction)
            net = drive - push - friction
            if has["ripple"]:
                angle = P["per_turn"] * motor + P["phase"]
                wave = np.sin(angle)
                if has["sawtooth"]:
                    wave = np.where(P["sawtooth"] > 0.5, np.mod(angle + np.pi, 2 * np.pi) / np.pi - 1, wave)
                net = net + P["ripple"] * wave
            thick = P["viscous"] + P["shear"] / (1 + speed / P["shear_speed"]) if has["shear"] else P["viscous"]
            vm = (vm + DT * net / P["rotor"]) / (1 + DT * thick * rub / P["rotor"])
            pull = push - bias
            if has["couple"]:  # what drags is held back
                reaction = P["couple"] * push * (pulls if has["arm"] else 1.0)
                for s in slots:
                    pull[np.arange(B), source[:, s]] -= reaction[:, s]
            if has["cable"]:
                pull = pull - P["cable"] * np.maximum(q - P["cable_rest"], 0.0)
            if push_in is not None:
                pull = pull + push_in[:, :, k]
            if D == 1:
                acc = pull * flat
            else:
                acc = (inverse @ pull.reshape(B, C, D, 1)).reshape(B, S)
            if has["mount"]:
                soft = np.maximum(P["mount"], 1e-9)
                base_acc = np.where(
                    P["mount"] > 0,
                    (-push - base / soft - 0.2 * np.sqrt(P["mount_inertia"] / soft) * base_v) / P["mount_inertia"],
                    0.0,
                )
                base_v = base_v + DT * base_acc
                base = base + DT * base_v
                acc = acc - base_acc
            v = v + DT * acc
            motor = motor + DT * vm
            q = q + DT * v
        free = (deep == 0).astype(float)
    return out


def log(
    signals: list[np.ndarray], rng: np.random.Generator, rate: float, jitter: float, loss: float = 0.01
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Times [S] s and values [J, S] of millisecond-sampled signals [J, M] as a host reads them: jittered, some samples
    lost."""
    period = 1.0 / rate
    n = int(signals[0].shape[-1] * TICK / period) - 2
    t = (np.arange(n) + 0.5) * period + np.clip(rng.normal(0, jitter, n), -0.4 * period, 0.4 * period)
    t = t[rng.uniform(size=n) > loss]
    grid = np.arange(signals[0].shape[-1]) * TICK
    return t, [np.stack([np.interp(t, grid, x) for x in s]) for s in signals]
