"""Ends of a joint's motion that the model does not have: a joint that its drive presses against something hard."""

from __future__ import annotations

import mujoco
import numpy as np

from dexsim.gap.read.runs import Run

NEAR = 0.012  # of the joint's whole motion: as near to its outermost position
PRESSED = 5.0  # x the usual error at rest: what no friction would hold
AGAINST = 5.0  # x gravity, at least, of the torque asked for: what no load would hold
LAST = 0.1  # s: the shortest meeting
TIMES = 2  # separate times that it must meet the end


def used(model: mujoco.MjModel, runs: list[Run]) -> list[str]:
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
                "is used: put it into the model"
            )
    return said


def unforeseen(model: mujoco.MjModel, runs: list[Run]) -> dict[str, list[tuple[float, float]]]:
    """By recording: the stretches (start, end in s) in which joints of `runs`, which are kept out of the fit, press
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
                    on = (side * run.q[:, j] > side * found[0] - found[2]).astype(int)
                    edges = np.flatnonzero(np.diff(np.r_[0, on, 0]))
                    out.setdefault(run.name, []).extend(
                        (float(run.t[a]), float(run.t[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)
                    )
    return {name: spans for name, spans in out.items() if spans}


def _end(
    model: mujoco.MjModel, data: mujoco.MjData, runs: list[Run], j: int, side: int
) -> tuple[float, str, float] | None:
    """(position of the end, names of the recordings, what counts as near it) on one side of a joint; None where it
    meets none."""
    outer = max(float((side * r.q[:, j]).max()) for r in runs)
    near = NEAR * (max(float(r.q[:, j].max()) for r in runs) - min(float(r.q[:, j].min()) for r in runs))
    errors = [side * (r.command_at(r.t)[:, j] - r.q[:, j]) for r in runs]
    at = [side * r.q[:, j] > outer - near for r in runs]
    still = [_still(r, j, near) for r in runs]
    usual = np.concatenate([np.abs(e[s & ~a]) for e, s, a in zip(errors, still, at, strict=True)])
    if len(usual) < 50:  # it hardly ever stands
        usual = np.concatenate([np.abs(e[~a]) for e, a in zip(errors, at, strict=True)])
    if not near > 0 or len(usual) < 50:
        return None
    need = max(PRESSED * float(np.quantile(usual, 0.95)), 3 * near)
    ends, names = [], []
    for run, error, on in zip(runs, errors, at, strict=True):
        on = on & (error > need)
        edges = np.flatnonzero(np.diff(np.r_[0, on.astype(int), 0]))
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            q, target = run.q[a:b, j], run.q[a:b, j] + side * error[a:b]
            if (
                run.t[b - 1] - run.t[a] < LAST
                or np.ptp(target) < 3 * np.ptp(q)
                or np.ptp(q) > near
                or not _hard(model, data, run, j, a + int(np.argmax(error[a:b])))
            ):
                continue
            ends.append(float(np.median(q)))
            names.append(run.name)
    if len(ends) < TIMES:
        return None
    return side * max(side * e for e in ends), ", ".join(dict.fromkeys(names)), near


def _still(run: Run, j: int, near: float) -> np.ndarray:
    """[S] whether the joint stands, as far as 0.1 s around each sample show."""
    n = max(int(round(0.05 / max(float(np.median(np.diff(run.t))), 1e-6))), 1)
    q = np.pad(run.q[:, j], n, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(q, 2 * n + 1)
    return np.ptp(windows, axis=1) < 0.25 * near


def _hard(model: mujoco.MjModel, data: mujoco.MjData, run: Run, j: int, i: int) -> bool:
    """Whether the believed drive asks at sample i for far more than gravity weighs there."""
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
    return asked > AGAINST * abs(float(data.qfrc_bias[model.jnt_dofadr[model.joint(run.joints[j]).id]]))
