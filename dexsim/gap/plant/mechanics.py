"""What the MuJoCo model says of each joint along a measured motion: inertia, gravity, the pull of the other joints."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import mujoco.batch
import numpy as np

from dexsim.gap.plant.columns import SERIES, SERIES_INDEX
from dexsim.gap.plant.lines import on_lines
from dexsim.hand.couplings import Couplings

if TYPE_CHECKING:
    from dexsim.gap.read import Run

# Hz at which the model is evaluated (along a refined motion); the series are interpolated between
RATE, FINE = 100.0, 250.0
CHUNK = 64  # samples of a motion that are evaluated in one call


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
    leaf_mass: float = 0.0  # of the last link after it, kg
    own_mass: float = 0.0  # of the joint's own link, kg
    carried: float = 0.0  # of all links that the joint moves, kg
    centre: np.ndarray | None = None  # [3] m: that link's centre of mass in the link's frame
    places: np.ndarray | None = None  # [2, 3] in the link's frame: out from the hinge, and along the way it turns there


def leaf_of(model: mujoco.MjModel, body: int) -> int:
    """Return the last link after `body`: the deepest body of its subtree that has mass."""
    best, depth = body, 0
    for b in range(body, model.nbody):
        up = chain(model, b)
        if body in up and up.index(body) > depth and model.body_mass[b] > 0:
            best, depth = b, up.index(body)
    return best


def chain(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and those that carry it, the nearest first, without the world's."""
    out = [int(body)]
    while parent := int(model.body_parentid[out[-1]]):
        out.append(parent)
    return out


def along(
    model: mujoco.MjModel, run: Run, joints: tuple[str, ...], added: bool = True
) -> tuple[np.ndarray, np.ndarray, list[JointConstants]]:
    """Return series of each joint along a run. added: also what a mass that is added, or a tilt, would do; else those
    columns are 0.

    Returns times [G0] s, values [J, G0, E] with the mechanical columns of `SERIES` filled, and the constants.
    """
    run.smooth()
    t0, t1 = run.t[0], run.t[-1]
    n = max(int(np.ceil((t1 - t0) * (FINE if run.fine else RATE))) + 1, 2)
    times = np.linspace(t0, t1, n)
    known, motion = (run.fine[0], run.fine[1:]) if run.fine else (run.t, (run.qs, run.vs, run.as_))
    q, v, a = (on_lines(times, known, x) for x in motion)
    return times, *of_motion(model, joints, run.gravity, q, v, a, added)


def of_motion(
    model: mujoco.MjModel,
    joints: Sequence[str],
    gravity: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    added: bool = True,
) -> tuple[np.ndarray, list[JointConstants]]:
    """Return the values and constants of `along` of positions, speeds and accelerations [n, J] in world gravity [3];
    the model's other joints rest where the model has them."""
    ids = [model.joint(name).id for name in joints]
    qadr = np.array([model.jnt_qposadr[i] for i in ids])
    dadr = np.array([model.jnt_dofadr[i] for i in ids])
    n, J = len(q), len(joints)
    bodies = np.array([model.jnt_bodyid[i] for i in ids])
    leaves = np.array([leaf_of(model, b) for b in bodies])
    places = _places(model, mujoco.MjData(model), ids, leaves)
    ties = Couplings(model, joints)
    # a hand's every frame along a recording is memory that takes longer to come by than to be worked out
    of = {name: slice(None) for name in ("M", "qfrc_bias", "qfrc_spring")} | {"xaxis": ids, "xanchor": ids}
    of |= {"subtree_com": bodies} | ({"xipos": np.r_[leaves, bodies], "xmat": leaves} if added else {})
    if ties.tied:  # what follows moves along: inertia and forces as the drives feel them
        every = np.tile(model.qpos0, (n, 1))
        every[:, qadr] = q
        every, moves = ties.dragged(every)
        across = moves.transpose(0, 2, 1)  # [n, J, nv]
        speed = (moves @ v[:, :, None])[:, :, 0]
        seen = _evaluated(model, np.arange(model.nq), np.arange(model.nv), every, speed, of)
        full = across @ _full(model, seen["M"]) @ moves
        total, diag = (full @ a[:, :, None])[:, :, 0], full[:, np.arange(J), np.arange(J)]
        drag = model.dof_damping * speed + model.dof_frictionloss * np.sign(speed)
        drag[:, dadr] = 0.0  # a driven joint's own is no load
        bias, passive = ((across @ x[:, :, None])[:, :, 0] for x in (seen["qfrc_bias"] + drag, seen["qfrc_spring"]))
    else:
        seen = _evaluated(model, qadr, dadr, q, v, of)
        full = _full(model, seen["M"])
        acc = np.zeros((n, model.nv, 1))
        acc[:, dadr, 0] = a
        total, diag = (full @ acc)[:, dadr, 0], full[:, dadr, dadr]
        bias, passive = seen["qfrc_bias"][:, dadr], seen["qfrc_spring"][:, dadr]
    axis, anchor, com = seen["xaxis"], seen["xanchor"], seen["subtree_com"]
    rest = total - diag * a + bias - passive
    mass = model.body_subtreemass[bodies]
    slide = np.array([int(model.jnt_type[i]) == int(mujoco.mjtJoint.mjJNT_SLIDE) for i in ids])
    out = np.zeros((J, len(SERIES), n)).transpose(0, 2, 1)  # columns lie together, as in `JointPlant.series`

    def put(j: int, name: str, x: np.ndarray | float) -> None:
        out[j, :, SERIES_INDEX[name]] = x

    for j in range(J):
        put(j, "q", q[:, j])
        put(j, "v", v[:, j])
        put(j, "inertia", diag[:, j])
        put(j, "rest", rest[:, j])
        put(j, "supply", 1.0)
        put(j, "enabled", 1.0)
        loads = [("gravity", mass[j], com[:, j])]
        if added:
            point, own = seen["xipos"][:, j], seen["xipos"][:, J + j]
            loads += [("load", 1.0, point), *([("own", 1.0, own)] if leaves[j] != bodies[j] else [])]
        for prefix, m, where in loads:
            c, s, square = _turned(axis[:, j], where - anchor[:, j], m, gravity, slide[j])
            put(j, f"{prefix}_cos", c)
            put(j, f"{prefix}_sin", s)
            if prefix != "gravity":
                put(j, f"{prefix}_inertia", square)
        if not added:
            continue
        lever, turn = cross(axis[:, j], point - anchor[:, j]), seen["xmat"][:, j].reshape(n, 3, 3)
        for name, way in zip(("out", "across"), places[j], strict=True):
            arm = turn @ way
            if not slide[j]:
                c, s, _ = _turned(axis[:, j], arm, 1.0, gravity, False)
                put(j, f"com_{name}_cos", c)
                put(j, f"com_{name}_sin", s)
                put(j, f"com_{name}_inertia", 2.0 * (lever * cross(axis[:, j], arm)).sum(-1))
        for k, letter in enumerate("xyz"):
            tilted = np.cross(np.eye(3)[k], gravity)
            c, s, _ = _turned(axis[:, j], com[:, j] - anchor[:, j], mass[j], tilted, slide[j])
            put(j, f"tilt_{letter}_cos", c)
            put(j, f"tilt_{letter}_sin", s)
    constants = [
        _constants(model, ids[j], bodies[j], leaves[j], bool(slide[j]), places[j], diag[:, j]) for j in range(J)
    ]
    return out, constants


def _constants(
    model: mujoco.MjModel, joint: int, body: int, leaf: int, slide: bool, places: np.ndarray, inertia: np.ndarray
) -> JointConstants:
    """Return what does not change along a motion. joint, body, leaf: numbers in the model; inertia [n]: along the
    motion."""
    dof = model.jnt_dofadr[joint]
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-1e9, 1e9)
    return JointConstants(
        damping=float(model.dof_damping[dof]),
        friction=float(model.dof_frictionloss[dof]),
        low=float(low),
        high=float(high),
        slide=slide,
        armature=float(model.dof_armature[dof]),
        inertia=float(np.median(inertia)),
        leaf_mass=float(model.body_mass[leaf]),
        own_mass=float(model.body_mass[body]),
        carried=float(model.body_subtreemass[body]),
        centre=model.body_ipos[leaf].copy(),
        places=places,
    )


def _evaluated(
    model: mujoco.MjModel, qadr: np.ndarray, dadr: np.ndarray, q: np.ndarray, v: np.ndarray, of: dict[str, Any]
) -> dict[str, np.ndarray]:
    """Return what MuJoCo makes of positions and speeds [n, J] of some joints, the others at rest: its fields [n, ...]
    by name, rows `of` each, contacts, constraints and gravity (which comes in by columns of its own) left out."""
    model, n = copy.copy(model), len(q)
    bit = mujoco.mjtDisableBit
    for flag in (bit.mjDSBL_CONTACT, bit.mjDSBL_CONSTRAINT, bit.mjDSBL_SENSOR):
        model.opt.disableflags |= int(flag)
    model.opt.gravity[:] = 0.0
    batch = mujoco.batch.Batch(model, min(n, CHUNK), 1)
    qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
    fields = {name: batch.bind(name) for name in of}
    out = {name: np.empty((n, *x[0, of[name]].shape)) for name, x in fields.items()}
    for first in range(0, n, len(qpos)):
        part = slice(first, min(first + len(qpos), n))
        count = part.stop - first
        qpos[:count, qadr], qvel[:count, dadr] = q[part], v[part]
        batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        for name, x in fields.items():
            out[name][part] = x[:count, of[name]]
    return out


def _full(model: mujoco.MjModel, sparse: np.ndarray) -> np.ndarray:
    """Return inertia matrices [n, nv, nv] of MuJoCo's sparse ones, their lower triangles by rows."""
    rows = np.repeat(np.arange(model.nv), model.M_rownnz)
    columns = np.concatenate(
        [model.M_colind[at : at + k] for at, k in zip(model.M_rowadr, model.M_rownnz, strict=True)]
    )
    full = np.zeros((len(sparse), model.nv, model.nv))
    full[:, rows, columns] = sparse
    full[:, columns, rows] = sparse
    return full


def _places(model: mujoco.MjModel, data: mujoco.MjData, ids: Sequence[int], leaves: np.ndarray) -> np.ndarray:
    """Return [J, 2, 3] unit vectors in each last link's frame, by which a mass on it may be off that link's centre as a
    joint feels it: out from the hinge and across, both square to the hinge, at the model's own pose (along the hinge a
    joint feels nothing)."""
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


def _turned(
    axis: np.ndarray, arm: np.ndarray, mass: np.ndarray | float, gravity: np.ndarray, slide: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gravity's bias torque of a mass at `arm` from a hinge as the joint turns by d: cos * cos(d) + sin *
    sin(d).

    The torque is -m g . (axis x r), and r turns about the axis, which leaves the part along it. Also m |axis x r|^2.
    """
    if slide:
        c = -mass * (axis @ gravity)
        return c, np.zeros_like(c), np.full_like(c, mass)
    across = cross(axis, arm)
    return -mass * (across @ gravity), -mass * (cross(axis, across) @ gravity), mass * (across**2).sum(-1)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [n, 3] cross products, as `np.cross` has them, in a third of its time for the few thousand of a
    recording."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[..., k] = a[..., i] * b[..., j] - a[..., j] * b[..., i]
    return out
