"""What the MuJoCo model says of each joint along a measured motion: inertia, gravity, the pull of the other joints."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from dexsim.errors import UserError
from dexsim.gap.plant.columns import SERIES, SERIES_INDEX

# Hz at which the model is evaluated (along a sharpened motion); the series are interpolated between
RATE, FINE = 100.0, 250.0


@dataclass
class JointConstants:
    """What of a joint does not change: the model's own friction and range, its kind, its base inertia."""

    damping: float
    friction: float
    low: float
    high: float
    slide: bool
    armature: float
    inertia: float  # median about the joint, kg.m2
    gravity: float  # largest gravity torque along the motion, N.m
    leaf: str = ""  # the last link after it
    leaf_mass: float = 0.0  # of that link, kg
    own_mass: float = 0.0  # of the joint's own link, kg
    centre: np.ndarray | None = None  # [3] m: that link's centre of mass in the link's frame
    places: np.ndarray | None = None  # [2, 3] in the link's frame: out from the hinge, and along the way it turns there


def load_model(path: str) -> mujoco.MjModel:
    """The compiled model of an MJCF or URDF file; UserError with MuJoCo's reason where it does not compile."""
    from pathlib import Path

    if not Path(path).is_file():
        raise UserError(f"model '{path}' does not exist; model=PATH must name an MJCF or URDF file.")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise UserError(f"model '{path}' does not compile: {reason}. Fix the file; `simulate` shows it.") from None


def movable(model: mujoco.MjModel) -> list[str]:
    """Names of the model's hinge and slide joints."""
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    names = [(model.joint(i).name, int(model.jnt_type[i])) for i in range(model.njnt)]
    return [name for name, kind in names if name and kind in kinds]


def leaf_of(model: mujoco.MjModel, body: int) -> int:
    """The last link after `body`: the deepest body of its subtree that has mass."""
    best, depth = body, 0
    for b in range(body, model.nbody):
        d, p = 0, b
        while p not in (0, body):
            p, d = int(model.body_parentid[p]), d + 1
        if p == body and d > depth and model.body_mass[b] > 0:
            best, depth = b, d
    return best


def along(model: mujoco.MjModel, run, joints: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, list[JointConstants]]:
    """Series of each joint along a run.

    Returns times [G0] s, values [J, G0, E] with the mechanical columns of `SERIES` filled, and the constants.
    """
    run.smooth()
    t0, t1 = run.t[0], run.t[-1]
    n = max(int(np.ceil((t1 - t0) * (FINE if run.fine else RATE))) + 1, 2)
    times = np.linspace(t0, t1, n)
    ids = [model.joint(name).id for name in joints]
    qadr = np.array([model.jnt_qposadr[i] for i in ids])
    dadr = np.array([model.jnt_dofadr[i] for i in ids])
    known, motion = (run.fine[0], run.fine[1:]) if run.fine else (run.t, (run.qs, run.vs, run.as_))
    q, v, a = (np.stack([np.interp(times, known, x[:, j]) for j in range(x.shape[1])], 1) for x in motion)
    data = mujoco.MjData(model)
    flags = model.opt.disableflags
    model.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    )
    J, nv = len(joints), model.nv
    bodies = np.array([model.jnt_bodyid[i] for i in ids])
    leaves = np.array([leaf_of(model, b) for b in bodies])
    axis = np.empty((n, J, 3))
    anchor = np.empty((n, J, 3))
    com = np.empty((n, J, 3))
    point = np.empty((n, J, 3))
    total = np.empty((n, J))
    diag = np.empty((n, J))
    bias = np.empty((n, J))
    passive = np.empty((n, J))
    own = np.empty((n, J, 3))
    turn = np.empty((n, J, 3, 3))
    places = _places(model, data, ids, leaves)
    full = np.zeros((nv, nv))
    acc = np.zeros(nv)
    gravity = np.array(model.opt.gravity)
    model.opt.gravity[:] = 0.0  # gravity comes in by its own columns
    try:
        for i in range(n):
            data.qpos[qadr] = q[i]
            data.qvel[dadr] = v[i]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fullM(model, data, full)
            acc[dadr] = a[i]
            total[i] = (full @ acc)[dadr]
            diag[i] = full[dadr, dadr]
            bias[i] = data.qfrc_bias[dadr]
            passive[i] = data.qfrc_spring[dadr]
            axis[i], anchor[i] = data.xaxis[ids], data.xanchor[ids]
            com[i], point[i] = data.subtree_com[bodies], data.xipos[leaves]
            own[i] = data.xipos[bodies]
            turn[i] = data.xmat[leaves].reshape(J, 3, 3)
    finally:
        model.opt.gravity[:] = gravity
        model.opt.disableflags = flags
    rest = total - diag * a + bias - passive
    mass = model.body_subtreemass[bodies]
    slide = np.array([int(model.jnt_type[i]) == int(mujoco.mjtJoint.mjJNT_SLIDE) for i in ids])
    out = np.zeros((J, n, len(SERIES)))

    def put(j, name, x):
        out[j, :, SERIES_INDEX[name]] = x

    for j in range(J):
        put(j, "q", q[:, j])
        put(j, "v", v[:, j])
        put(j, "inertia", diag[:, j])
        put(j, "rest", rest[:, j])
        loads = (("load", 1.0, point[:, j]), *([("own", 1.0, own[:, j])] if leaves[j] != bodies[j] else []))
        for prefix, m, where in (("gravity", mass[j], com[:, j]), *loads):
            c, s, square = _turned(axis[:, j], where - anchor[:, j], m, run.gravity, slide[j])
            put(j, f"{prefix}_cos", c)
            put(j, f"{prefix}_sin", s)
            if prefix != "gravity":
                put(j, f"{prefix}_inertia", square)
        lever = np.cross(axis[:, j], point[:, j] - anchor[:, j])
        for name, way in zip(("out", "across"), places[j], strict=True):
            arm = turn[:, j] @ way
            if not slide[j]:
                c, s, _ = _turned(axis[:, j], arm, 1.0, run.gravity, False)
                put(j, f"com_{name}_cos", c)
                put(j, f"com_{name}_sin", s)
                put(j, f"com_{name}_inertia", 2.0 * (lever * np.cross(axis[:, j], arm)).sum(-1))
        for k, letter in enumerate("xyz"):
            tilted = np.cross(np.eye(3)[k], run.gravity)
            c, s, _ = _turned(axis[:, j], com[:, j] - anchor[:, j], mass[j], tilted, slide[j])
            put(j, f"tilt_{letter}_cos", c)
            put(j, f"tilt_{letter}_sin", s)
        put(j, "supply", 1.0)
        put(j, "enabled", 1.0)
    constants = []
    for j, i in enumerate(ids):
        limited = bool(model.jnt_limited[i])
        low, high = model.jnt_range[i] if limited else (-1e9, 1e9)
        constants.append(
            JointConstants(
                damping=float(model.dof_damping[dadr[j]]),
                friction=float(model.dof_frictionloss[dadr[j]]),
                low=float(low),
                high=float(high),
                slide=bool(slide[j]),
                armature=float(model.dof_armature[dadr[j]]),
                inertia=float(np.median(diag[:, j])),
                gravity=float(np.abs(out[j, :, SERIES_INDEX["gravity_cos"]]).max()),
                leaf=model.body(int(leaves[j])).name,
                leaf_mass=float(model.body_mass[leaves[j]]),
                own_mass=float(model.body_mass[bodies[j]]),
                centre=model.body_ipos[leaves[j]].copy(),
                places=places[j],
            )
        )
    return times, out, constants


def _places(model: mujoco.MjModel, data: mujoco.MjData, ids, leaves) -> np.ndarray:
    """[J, 2, 3] unit vectors in each last link's frame, by which a mass on it may be off that link's centre as a joint
    feels it: out from the hinge and across, both square to the hinge, at the model's own pose (along the hinge a joint
    feels nothing)."""
    mujoco.mj_resetData(model, data)
    mujoco.mj_kinematics(model, data)
    out = np.empty((len(ids), 2, 3))
    for j, (i, leaf) in enumerate(zip(ids, leaves, strict=True)):
        axis, arm = data.xaxis[i], data.xipos[leaf] - data.xanchor[i]
        arm = arm - (arm @ axis) * axis
        if np.linalg.norm(arm) < 1e-6:
            arm = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        arm = arm / np.linalg.norm(arm)
        out[j] = np.stack([arm, np.cross(axis, arm)]) @ data.xmat[leaf].reshape(3, 3)
    return out


def _turned(axis, arm, mass, gravity, slide):
    """Gravity's bias torque of a mass at `arm` from a hinge as the joint turns by d: cos * cos(d) + sin * sin(d).

    The torque is -m g . (axis x r), and r turns about the axis, which leaves the part along it. Also m |axis x r|^2.
    """
    if slide:
        c = -mass * (axis @ gravity)
        return c, np.zeros_like(c), np.full_like(c, mass)
    across = np.cross(axis, arm)
    return -mass * (across @ gravity), -mass * (np.cross(axis, across) @ gravity), mass * (across**2).sum(-1)
