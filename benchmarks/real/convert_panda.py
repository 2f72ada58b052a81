"""A Franka Emika Panda on an exciting trajectory (Gaz, Cognetti, Oliva, Robuffo Giordano, De Luca, RA-L 2019): seven
joint torque sensors at 1 kHz.

From github.com/marcocognetti/FrankaEmikaPandaDynModel, matlab/data/Exciting_Traj/Trajectory_1, as one npz (t, q, tau,
t_target, q_target) beside panda.xml (links with the inertial parameters that its authors identified) and panda.yaml (a
loose belief of the drives).
"""

from __future__ import annotations

import shutil
from pathlib import Path

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from benchmarks.real.common import Converted, save
from dexsim import intervals
from dexsim.errors import UserError

JOINTS = tuple(f"joint{k}" for k in range(1, 8))
FILE = "exciting_trajectory_1.npz"
DRAWS, BLOCK, WIDTH = 400, 0.5, 0.16  # bootstraps, s of a block, s of the smoothing polynomial


def convert(data: Path, out: Path) -> Converted:
    """Convert the trajectory; the reference is its command, the sensors' torque its effort."""
    missing = [n for n in (FILE, "panda.xml", "panda.yaml") if not (data / n).is_file()]
    if missing:
        raise UserError(f"{data}: no {', '.join(missing)}")
    out.mkdir(parents=True, exist_ok=True)
    raw = np.load(data / FILE)
    for name in ("panda.xml", "panda.yaml"):
        shutil.copyfile(data / name, out / name)
    path = save(
        out / "panda.mcap",
        JOINTS,
        raw["t_target"],
        raw["q_target"],
        raw["t"],
        raw["q"],
        effort=raw["tau"],
        robot="panda",
        gravity="0 0 -9.81",
    )
    return Converted([path], out / "panda.xml", out / "panda.yaml")


def plain(data: Path, share: float = 1.0) -> dict[str, dict[str, float]]:
    """Return what a plain least squares makes of the first `share` of the trajectory, by joint: Coulomb, viscous
    friction and offset on the torque less the rigid body (central derivatives by a local polynomial), with 90 % of a
    block bootstrap; N.m, N.m.s/rad, and what is left (rms, N.m). Shares no code with the tool but how blocks are
    drawn."""
    raw = np.load(data / FILE)
    model = mujoco.MjModel.from_xml_path(str(data / "panda.xml"))
    state = mujoco.MjData(model)
    step = float(np.median(np.diff(raw["t"])))
    t = np.arange(raw["t"][0], raw["t"][-1], step)
    width = int(round(WIDTH / step)) | 1
    even = lambda x: np.stack([np.interp(t, raw["t"], x[:, j]) for j in range(x.shape[1])], 1)  # noqa: E731
    q, v, a = (savgol_filter(even(raw["q"]), width, 3, deriv=d, delta=step, axis=0) for d in range(3))
    torque = savgol_filter(even(raw["tau"]), width, 3, axis=0)
    body = np.empty_like(q)
    for i in range(len(t)):
        state.qpos[:], state.qvel[:], state.qacc[:] = q[i], v[i], a[i]
        mujoco.mj_inverse(model, state)
        body[i] = state.qfrc_inverse
    on = slice(width, int(share * len(t)) - width)
    block = ((t[on] - t[on][0]) / BLOCK).astype(int)
    pick = intervals.singles(block.max() + 1, 0, DRAWS)
    out = {}
    for j, joint in enumerate(JOINTS):
        X = np.stack([savgol_filter(np.sign(v[:, j]), width, 3)[on], v[on, j], np.ones(on.stop - on.start)], 1)
        u = (torque - body)[on, j]
        grams = np.stack([X[block == b].T @ X[block == b] for b in range(block.max() + 1)])
        sides = np.stack([X[block == b].T @ u[block == b] for b in range(block.max() + 1)])
        draws = np.stack([np.linalg.solve(grams[p].sum(0), sides[p].sum(0)) for p in pick])
        x = np.linalg.lstsq(X, u, rcond=None)[0]
        low, high = np.quantile(draws, [0.05, 0.95], axis=0)
        out[joint] = {
            "coulomb": x[0],
            "low": low[0],
            "high": high[0],
            "viscous": x[1],
            "offset": x[2],
            "left": float(np.std(u - X @ x)),
            "rigid_left": float(np.std(u)),
        }
    return out
