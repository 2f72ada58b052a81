"""A least squares by hand, to compare with: of each joint PD gains, torque limit, Coulomb and viscous friction, delay,
lag, added inertia and offset by SciPy's bounded `least_squares` over whole recordings run free, from several starts.

It shares nothing with the diagnosis but the reader and MuJoCo's model: each joint alone, the others along their
recorded motion, gravity to first order about it, steps of a millisecond.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import warp as wp
from scipy.optimize import least_squares

from dexsim.actuator.columns import INDEX
from dexsim.actuator.table import ServoTable
from dexsim.recording.mechanism import Mechanism, of_recording
from dexsim.recording.schema import Recording
from dexsim.recording.smooth import local_polynomial

STEP = 1e-3  # s
STARTS, EVALUATIONS = 3, 25
WIDE = 0.05  # rad or m: misses far beyond it count by their size alone
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


@wp.kernel
def _run(
    x: wp.array2d(dtype=wp.float64),
    series: wp.array3d(dtype=wp.float64),
    target: wp.array3d(dtype=wp.float64),
    row: wp.array2d(dtype=wp.float64),
    steps: wp.array(dtype=int),
    voltage: int,
    friction: wp.float64,
    out: wp.array3d(dtype=wp.float64),
):
    """Run guess h of x [H, 9] along piece p: series [P, n, 5] inertia, bias, slope, measured position, enabled; target
    [H, P, n]; row [P, 7] kp, kd, limit, no-load speed, supply, position and speed at the start; out [H, P, n]."""
    h, p = wp.tid()
    zero, one, step = wp.float64(0.0), wp.float64(1.0), wp.float64(STEP)
    kp, limit, no_load = row[p, 0] * x[h, 0], row[p, 2] * x[h, 2], row[p, 3]
    kd = row[p, 1] * x[h, 1]
    if row[p, 1] == zero:
        kd = x[h, 1]
    coulomb, viscous = x[h, 3] + friction, x[h, 4]
    keep = wp.exp(-step / wp.max(x[h, 6], wp.float64(1e-9)))
    q, v, tau = row[p, 5] + zero, row[p, 6] + zero, wp.float64(0.0)
    for i in range(steps[p]):
        out[h, p, i] = q
        wanted = kp * (target[h, p, i] - q) - kd * v
        new, most, gives = wp.float64(0.0), limit + zero, wp.float64(1.0)
        if voltage == 1:
            new = limit * (row[p, 4] * wp.clamp(wanted, -one, one) - v / no_load)
            most, gives = one, limit
        else:
            room = wp.float64(1.0)
            if no_load < wp.float64(1e8):
                room = wp.clamp(one - wp.sign(wanted) * v / no_load, zero, one)
            new = wp.clamp(wanted, -limit * room, limit * room)
        tau = new + keep * (tau - new)
        inertia = wp.max(series[p, i, 0] + x[h, 7], wp.float64(1e-9))
        pull = tau * series[p, i, 4] - series[p, i, 1] - series[p, i, 2] * (q - series[p, i, 3]) + x[h, 8]
        damp = viscous + zero  # what damps is stiff: implicitly
        if keep < wp.float64(0.5) and wp.abs(wanted) < most:
            damp += gives * kd
        free = v + step * (pull - viscous * v) / (inertia + step * damp)
        stop = step * coulomb / (inertia + step * damp)
        v = wp.clamp(wp.sign(free) * wp.max(wp.abs(free) - stop, zero), wp.float64(-1e3), wp.float64(1e3))
        q = wp.clamp(q + step * v, wp.float64(-1e3), wp.float64(1e3))


def simulate(x: np.ndarray, pieces: Sequence[Piece], voltage: bool, friction: float) -> list[np.ndarray]:
    """Return positions [H, S] of each piece run free, for figures x [H, 9] as `NAMES` (factors on what is believed;
    what is added). friction: the model's own in the joint [N.m]."""
    n, late = max(len(p.grid) for p in pieces), x[:, NAMES.index("delay")]
    pad = lambda y: np.pad(y, (0, n - len(y)), mode="edge")  # noqa: E731
    names = ("inertia", "bias", "slope", "at", "enabled")
    series = np.stack([np.stack([pad(getattr(p, k)) for k in names], 1) for p in pieces])
    target = np.stack([np.stack([pad(np.interp(p.grid - d, *p.cmd)) for p in pieces]) for d in late])
    believed = ("kp", "kd", "torque_limit", "no_load_speed")
    row = np.array([[*(min(p.row[INDEX[c]], 1e9) for c in believed), p.supply, p.q0, p.v0] for p in pieces])
    out = wp.empty(target.shape, dtype=wp.float64, device="cpu")
    given = [wp.array(a, dtype=wp.float64, device="cpu") for a in (x, series, target, row)]
    steps = wp.array([len(p.grid) for p in pieces], dtype=int, device="cpu")
    wp.launch(_run, target.shape[:2], [*given, steps, int(voltage), friction], [out], device="cpu")
    q = out.numpy()
    return [np.stack([np.interp(p.t, p.grid, y[i, : len(p.grid)]) for y in q]) for i, p in enumerate(pieces)]


def fit(
    m: Mechanism,
    joint: str,
    train: Sequence[tuple[Recording, float, float]],
    test: Sequence,
    seed: int = 0,
    limit: float = np.inf,
) -> dict:
    """Return figures of one joint fitted to parts (recording, start s, end s) and the error of others, rms [rad or m],
    beside what is believed (without friction that nobody knows). limit: seconds after which no further start is tried,
    and one under way ends."""
    begun = time.monotonic()
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

    tried: list[tuple[float, np.ndarray]] = []

    def residuals(x: np.ndarray) -> np.ndarray:
        error = missed(x, pieces)[0]
        tried.append((float(np.mean(np.sqrt(1 + (error / WIDE) ** 2))), x))
        if time.monotonic() - begun > limit:
            raise TimeoutError
        return error

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
    with contextlib.suppress(TimeoutError):
        for x0 in [believed, *guesses[np.argsort(loss)[: STARTS - 1]]]:
            least_squares(
                residuals, np.clip(x0, low + 1e-9 * scale, high - 1e-9 * scale), jacobian,
                bounds=(low, high), x_scale=scale, loss="soft_l1", f_scale=WIDE, max_nfev=EVALUATIONS,
            )  # fmt: skip
    best = min(tried, key=lambda row: row[0])[1]
    rms = lambda x: float(np.sqrt(np.mean(missed(x, judging) ** 2)))  # noqa: E731
    return {
        "believed": rms(believed),
        "error": rms(best),
        "fitted": float(np.sqrt(np.mean(missed(best, pieces) ** 2))),
        "figures": dict(zip(NAMES, map(float, best), strict=True)),
        "ended_early": time.monotonic() - begun > limit,
    }
