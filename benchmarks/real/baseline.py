"""A least squares by hand, to compare with: of each joint PD gains, torque limit, Coulomb and viscous friction, delay,
lag, added inertia and offset by SciPy's bounded `least_squares` over whole recordings run free, from several starts.

It shares nothing with the diagnosis but the reader and MuJoCo's model: each joint alone, the others along their
recorded motion, gravity to first order about it, steps of a millisecond.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import least_squares

from dexsim.actuator.columns import INDEX
from dexsim.actuator.table import ServoTable
from dexsim.recording.mechanism import Mechanism, of_recording
from dexsim.recording.schema import Recording
from dexsim.recording.smooth import local_polynomial

STEP = 1e-3  # s
STARTS, EVALUATIONS = 3, 25
NAMES = ("kp", "kd", "limit", "coulomb", "viscous", "delay", "lag", "inertia", "offset")
SLIDE = 1e-3  # rad (m) by which gravity's slope is taken


@dataclass
class Piece:
    """A recording, or a part of one, of one joint. t [S] s, q [S]: measured; grid [n] s; cmd: (times, targets);
    inertia, bias, slope [n]: about the joint along the recorded motion of all, and the bias' slope with its position;
    at [n]: measured position; q0, v0: where it begins; row: servo columns believed; supply: share of the nominal;
    enabled [n]."""

    t: np.ndarray
    q: np.ndarray
    grid: np.ndarray
    cmd: tuple[np.ndarray, np.ndarray]
    inertia: np.ndarray
    bias: np.ndarray
    slope: np.ndarray
    at: np.ndarray
    q0: float
    v0: float
    row: np.ndarray
    supply: float
    enabled: np.ndarray


def piece(m: Mechanism, r: Recording, joint: str, start: float = 0.0, end: float = np.inf) -> Piece:
    """Return one joint of a recording between two times [s]."""
    m = of_recording(m, r)
    model = m.spec.compile()
    data = mujoco.MjData(model)
    state = r.states.position
    on = np.isfinite(state.value).all(1) & np.r_[True, np.diff(state.t) > 1e-6]
    t, (q, v, a) = np.asarray(state.t[on], float), local_polynomial(np.asarray(state.t[on], float), state.value[on])
    address = [int(model.joint(j).qposadr[0]) for j in r.joints]
    dofs = [int(model.joint(j).dofadr[0]) for j in r.joints]
    k = r.joints.index(joint)
    dof, others = dofs[k], np.array([i for i in range(len(dofs)) if i != k], int)
    full, out = np.zeros((model.nv, model.nv)), np.zeros((len(t), 3))
    for i in range(len(t)):
        for moved, column in ((0.0, 1), (SLIDE, 2)):
            data.qpos[address], data.qvel[dofs] = q[i], v[i]
            data.qpos[address[k]] += moved
            mujoco.mj_forward(model, data)
            out[i, column] = data.qfrc_bias[dof] - data.qfrc_passive[dof]
            if not moved:
                mujoco.mj_fullM(model, data, full)
                out[i, 0] = full[dof, dof]
                pull = full[dof, np.array(dofs)[others]] @ a[i, others] if len(others) else 0.0
        out[i, 1:] += pull
    inside = (t >= start - 1e-9) & (t <= end + 1e-9)
    t0 = float(t[inside][0])
    grid = np.arange(0.0, t[inside][-1] - t0 + STEP, STEP)
    at = lambda x: np.interp(grid + t0, t, x)  # noqa: E731
    c = r.commands
    ok = np.isfinite(c.value[:, k])
    sent = np.asarray(c.t[ok], float) - t0, c.value[ok, k]
    on_at = np.ones(len(grid))
    if r.enabled is not None:
        e = np.clip(np.searchsorted(r.enabled.t, grid + t0, side="right") - 1, 0, None)
        on_at = np.nan_to_num(r.enabled.value[e, k], nan=1.0)
    supply = 1.0
    if r.supply_voltage is not None and m.table.supply_voltage:
        supply = float(np.nanmean(r.supply_voltage.value)) / m.table.supply_voltage
    first = int(np.argmax(inside))
    return Piece(
        t[inside] - t0,
        np.interp(t[inside], state.t[on], state.value[on, k]),
        grid,
        sent,
        at(out[:, 0]),
        at(out[:, 1]),
        at((out[:, 2] - out[:, 1]) / SLIDE),
        at(q[:, k]),
        float(q[first, k]),
        float(v[first, k]),
        m.table.nominal([joint])[0],
        supply,
        on_at,
    )


def simulate(x: np.ndarray, pieces: Sequence[Piece], voltage: bool, friction: float) -> list[np.ndarray]:
    """Return positions [H, S] of each piece run free, for figures x [H, 9] as `NAMES` (factors on what is believed;
    what is added). friction: the model's own in the joint [N.m]."""
    H, P = len(x), len(pieces)
    n = max(len(p.grid) for p in pieces)
    pad = lambda y: np.pad(y, (0, n - len(y)), mode="edge")  # noqa: E731
    M, bias, slope, at, on = (np.stack([pad(getattr(p, k)) for p in pieces]) for k in ("inertia", "bias", "slope", "at",
                                                                                       "enabled"))  # fmt: skip
    col = lambda name: np.array([p.row[INDEX[name]] for p in pieces])  # noqa: E731
    kp, kd, limit, no_load = (col(c)[None] for c in ("kp", "kd", "torque_limit", "no_load_speed"))
    g = lambda k: x[:, [NAMES.index(k)]]  # noqa: E731
    kp, limit = kp * g("kp"), np.minimum(limit, 1e9) * g("limit")
    kd = kd * g("kd") if kd.any() else np.broadcast_to(g("kd"), kp.shape)
    coulomb, viscous = g("coulomb") + friction, g("viscous")
    target = np.empty((H, P, n))
    for i, p in enumerate(pieces):
        for h in range(H):
            target[h, i] = np.interp(pad(p.grid) - x[h, NAMES.index("delay")], *p.cmd)
    lag = np.maximum(g("lag"), 1e-9)
    keep = np.exp(-STEP / lag)
    supply = np.array([p.supply for p in pieces])[None]
    q, v = (np.broadcast_to([getattr(p, k) for p in pieces], (H, P)).astype(float).copy() for k in ("q0", "v0"))
    tau, out = np.zeros((H, P)), np.empty((n, H, P))
    for i in range(n):
        out[i] = q
        wanted = kp * (target[:, :, i] - q) - kd * v
        if voltage:
            new = limit * (supply * np.clip(wanted, -1.0, 1.0) - v / no_load)
        else:
            room = np.where(np.isfinite(no_load) & (no_load < 1e8), np.clip(1 - np.sign(wanted) * v / no_load, 0, 1), 1)
            new = np.clip(wanted, -limit * room, limit * room)
        tau = new + keep * (tau - new)
        inertia = np.maximum(M[:, i] + g("inertia"), 1e-9)
        pull = tau * on[:, i] - bias[:, i] - slope[:, i] * (q - at[:, i]) + g("offset")
        # what damps is stiff: implicitly
        damp = viscous + np.where(np.abs(wanted) < (1.0 if voltage else limit), (limit if voltage else 1.0) * kd, 0.0)
        damp = damp * (keep < 0.5) + viscous * (keep >= 0.5)
        free = v + STEP * (pull - viscous * v) / (inertia + STEP * damp)
        stop = STEP * coulomb / (inertia + STEP * damp)
        v = np.clip(np.sign(free) * np.maximum(np.abs(free) - stop, 0.0), -1e3, 1e3)
        q = np.clip(q + STEP * v, -1e3, 1e3)
    return [
        np.stack([np.interp(p.t, STEP * np.arange(n), out[:, h, i]) for h in range(H)]) for i, p in enumerate(pieces)
    ]


def fit(
    m: Mechanism, joint: str, train: Sequence[tuple[Recording, float, float]], test: Sequence, seed: int = 0
) -> dict:
    """Return figures of one joint fitted to parts (recording, start s, end s) and the error of others, rms [rad or m],
    beside what is believed (without friction that nobody knows)."""
    pieces, judging = ([piece(m, *([r, joint, a, b])) for r, a, b in parts] for parts in (train, test))
    table: ServoTable = m.table
    voltage, model = table.drive == "voltage", m.spec.compile()
    friction = float(model.dof_frictionloss[model.joint(joint).dofadr[0]])
    inertia = float(np.median(np.concatenate([p.inertia for p in pieces])))
    load = np.concatenate([p.bias for p in pieces])
    accelerations = np.concatenate([np.gradient(np.gradient(p.at, STEP), STEP) for p in pieces])
    torque = float(np.percentile(np.abs(load + inertia * accelerations), 95)) + 1e-9
    speed = float(np.percentile(np.abs(np.concatenate([np.gradient(p.at, STEP) for p in pieces])), 95)) + 1e-9
    row = pieces[0].row
    damped = row[INDEX["kd"]] > 0
    stiff = float(row[INDEX["kp"]] * (row[INDEX["torque_limit"]] if voltage else 1.0))
    per = row[INDEX["torque_limit"]] if voltage else 1.0
    high_kd = 20.0 if damped else 4.0 * float(np.sqrt(max(stiff * inertia, 1e-12))) / per
    low = np.array([0.05, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, -0.5 * inertia, -0.5 * torque])
    high = np.array([20.0, high_kd + 1e-9, 5.0, torque, 2 * torque / speed, 0.1, 0.05, 5 * inertia, 0.5 * torque])
    believed = np.array([1.0, 1.0 if damped else 0.0, 1.0, row[INDEX["coulomb_friction"]],
                         row[INDEX["viscous_friction"]], row[INDEX["delay"]], row[INDEX["lag"]], 0.0, 0.0])  # fmt: skip
    believed = np.clip(believed, low, high)
    each = 0.3 * torque
    scale = np.array([1.0, high_kd / 10 + 1e-9, 1.0, each, each / speed, 0.01, 0.01, inertia, 0.1 * torque])

    def missed(x: np.ndarray, given: Sequence[Piece]) -> np.ndarray:
        """Return residuals [H, m]."""
        return np.concatenate(
            [p.q - q for p, q in zip(given, simulate(np.atleast_2d(x), given, voltage, friction), strict=True)], 1
        )

    def jacobian(x: np.ndarray) -> np.ndarray:
        step = 1e-3 * scale * np.where(x + 1e-3 * scale > high, -1, 1)
        every = missed(np.vstack([x, x + np.diag(step)]), pieces)
        return ((every[1:] - every[0]) / step[:, None]).T

    rng = np.random.default_rng(seed)
    guesses = low + (high - low) * rng.uniform(size=(40, len(low))) ** 3
    guesses[:, [0, 2]] = np.exp(rng.uniform(np.log([0.2, 0.3]), np.log([5.0, 2.0]), (40, 2)))
    guesses[:, 1] = np.exp(rng.uniform(np.log(0.2), np.log(6.0), 40)) if damped else guesses[:, 1]
    guesses[:, 7:] = 0.0
    loss = np.concatenate([np.mean(missed(guesses[k : k + 10], pieces) ** 2, 1) for k in range(0, 40, 10)])
    best = None
    for x0 in [believed, *guesses[np.argsort(loss)[: STARTS - 1]]]:
        found = least_squares(
            lambda x: missed(x, pieces)[0], np.clip(x0, low + 1e-9 * scale, high - 1e-9 * scale), jacobian,
            bounds=(low, high), x_scale=scale, loss="soft_l1", f_scale=0.05, max_nfev=EVALUATIONS,
        )  # fmt: skip
        best = found if best is None or found.cost < best.cost else best
    assert best is not None  # of several starts
    rms = lambda x: float(np.sqrt(np.mean(missed(x, judging) ** 2)))  # noqa: E731
    return {
        "believed": rms(believed),
        "error": rms(best.x),
        "fitted": float(np.sqrt(np.mean(missed(best.x, pieces) ** 2))),
        "figures": dict(zip(NAMES, map(float, best.x), strict=True)),
    }
