"""Results that C MuJoCo's batch does not return by itself, as Warp kernels on its arrays: poses alone, contact forces,
flags."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

import mujoco
import numpy as np
import warp as wp

FREE, BALL, SLIDE = (
    int(j) for j in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_SLIDE)
)
ROW = 10
"""Numbers a slot of a contact sensor with found, force, normal, tangent."""


@wp.struct
class Tree:
    """The kinematic tree of a model. Fields that may differ by world have a first axis of 1 or N."""

    parent: wp.array(dtype=int)  # [B]
    first_joint: wp.array(dtype=int)  # [B]
    joints: wp.array(dtype=int)  # [B]
    kind: wp.array(dtype=int)  # [J]
    address: wp.array(dtype=int)  # [J] in qpos
    body_pos: wp.array2d(dtype=wp.vec3d)
    body_quat: wp.array2d(dtype=wp.vec4d)  # w x y z
    joint_pos: wp.array2d(dtype=wp.vec3d)
    joint_axis: wp.array2d(dtype=wp.vec3d)
    qpos0: wp.array2d(dtype=wp.float64)


def tree(model: mujoco.MjModel, expanded: dict[str, np.ndarray]) -> Tree:
    """Return the tree of `model`; `expanded` holds the fields that differ by world, [N, ...]."""
    t = Tree()
    for name, field in (
        ("parent", "body_parentid"), ("first_joint", "body_jntadr"), ("joints", "body_jntnum"), ("kind", "jnt_type"),
        ("address", "jnt_qposadr"),
    ):  # fmt: skip
        setattr(t, name, wp.array(getattr(model, field), dtype=int, device="cpu"))
    for name, field, kind in (
        ("body_pos", "body_pos", wp.vec3d), ("body_quat", "body_quat", wp.vec4d), ("joint_pos", "jnt_pos", wp.vec3d),
        ("joint_axis", "jnt_axis", wp.vec3d), ("qpos0", "qpos0", wp.float64),
    ):  # fmt: skip
        if field in expanded:
            setattr(t, name, wp.array(expanded[field], dtype=kind, device="cpu", copy=False))
        else:
            setattr(t, name, wp.array(getattr(model, field)[None], dtype=kind, device="cpu"))
    return t


@wp.func
def times(a: wp.vec4d, b: wp.vec4d):
    """Return the product of two quaternions (w x y z)."""
    return wp.vec4d(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def turned(v: wp.vec3d, q: wp.vec4d):
    """Return v rotated by the unit quaternion q."""
    u = wp.vec3d(q[1], q[2], q[3])
    t = wp.float64(2.0) * wp.cross(u, v)
    return v + q[0] * t + wp.cross(u, t)


@wp.func
def unit(q: wp.vec4d):
    """Return q over its length; like MuJoCo, no rotation where it has none."""
    n = wp.length(q)
    out = wp.vec4d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    if n > wp.float64(1.0e-15):
        out = q / n
    return out


@wp.kernel(enable_backward=False)
def poses(
    t: Tree,
    qpos: wp.array2d(dtype=wp.float64),
    # scratch
    pos: wp.array2d(dtype=wp.vec3d),
    quat: wp.array2d(dtype=wp.vec4d),
    # out
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
):
    """Compute the body frames by the recursion of mj_kinematics."""
    w = wp.tid()
    half = wp.float64(0.5)
    pos[w, 0] = wp.vec3d()
    quat[w, 0] = wp.vec4d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    for b in range(xpos.shape[1]):
        p = wp.vec3d()
        q = wp.vec4d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
        j = t.first_joint[b]
        n = t.joints[b]
        if b > 0:
            free = n == 1 and t.kind[wp.max(j, 0)] == FREE
            if free:
                a = t.address[j]
                p = wp.vec3d(qpos[w, a], qpos[w, a + 1], qpos[w, a + 2])
                q = unit(wp.vec4d(qpos[w, a + 3], qpos[w, a + 4], qpos[w, a + 5], qpos[w, a + 6]))
            else:
                up = t.parent[b]
                p = turned(t.body_pos[w % t.body_pos.shape[0], b], quat[w, up]) + pos[w, up]
                q = times(quat[w, up], t.body_quat[w % t.body_quat.shape[0], b])
                for k in range(n):
                    i = j + k
                    a = t.address[i]
                    axis = t.joint_axis[w % t.joint_axis.shape[0], i]
                    anchor = t.joint_pos[w % t.joint_pos.shape[0], i]
                    if t.kind[i] == SLIDE:
                        p += turned(axis, q) * (qpos[w, a] - t.qpos0[w % t.qpos0.shape[0], a])
                    else:
                        at = turned(anchor, q) + p
                        if t.kind[i] == BALL:
                            q = times(q, unit(wp.vec4d(qpos[w, a], qpos[w, a + 1], qpos[w, a + 2], qpos[w, a + 3])))
                        else:
                            angle = half * (qpos[w, a] - t.qpos0[w % t.qpos0.shape[0], a])
                            s = wp.sin(angle)
                            q = times(q, wp.vec4d(wp.cos(angle), s * axis[0], s * axis[1], s * axis[2]))
                        p = at - turned(anchor, q)
                q = unit(q)
        pos[w, b] = p
        quat[w, b] = q
        xpos[w, b] = wp.vec3(p)
        x = turned(wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0)), q)
        y = turned(wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0)), q)
        z = turned(wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0)), q)
        xmat[w, b] = wp.mat33(
            float(x[0]), float(y[0]), float(z[0]), float(x[1]), float(y[1]), float(z[1]), float(x[2]), float(y[2]),
            float(z[2]),
        )  # fmt: skip


@wp.kernel(enable_backward=False)
def read_contacts(
    sensors: wp.array2d(dtype=wp.float64),
    first: wp.array(dtype=int),  # [P] column of each pair's sensor
    slots: int,
    lost: int,
    flags: wp.array(dtype=int),
    nan_bit: int,
    # out
    normal_sum: wp.array2d(dtype=float),
    force_sum: wp.array2d(dtype=wp.vec3),
    overflow: wp.array(dtype=int),
    most: wp.array(dtype=int),
):
    """Sums of each pair's contact forces. A slot holds what the first member exerts on the second, in the frame
    (normal, tangent, their cross product); the sum is of what acts on the first: minus. A world whose state is not
    finite has none: what the sensors say of it is nonsense."""
    w, p = wp.tid()
    if (flags[w] & nan_bit) != 0:
        normal_sum[w, p] = float(0.0)
        force_sum[w, p] = wp.vec3()
        return
    a = first[p]
    found = int(sensors[w, a])
    total = wp.vec3d()
    pressed = wp.float64(0.0)
    for k in range(wp.min(found, slots)):
        c = a + k * ROW
        n = wp.vec3d(sensors[w, c + 4], sensors[w, c + 5], sensors[w, c + 6])
        t = wp.vec3d(sensors[w, c + 7], sensors[w, c + 8], sensors[w, c + 9])
        total += sensors[w, c + 1] * n + sensors[w, c + 2] * t + sensors[w, c + 3] * wp.cross(n, t)
        pressed += sensors[w, c + 1]
    normal_sum[w, p] = float(pressed)
    force_sum[w, p] = -wp.vec3(total)
    if found > slots:
        wp.atomic_or(overflow, w, lost)
    wp.atomic_max(most, 0, found)


@wp.kernel(enable_backward=False)
def check_worlds(
    qpos: wp.array2d(dtype=wp.float64),
    qvel: wp.array2d(dtype=wp.float64),
    nan_bit: int,
    # out
    flags: wp.array(dtype=int),
):
    """Set nan_bit where a state is not finite or a speed is beyond what anything here does: the solver has diverged."""
    w = wp.tid()
    bad = int(0)
    for i in range(qpos.shape[1]):
        if not wp.isfinite(qpos[w, i]):
            bad = nan_bit
    for i in range(qvel.shape[1]):
        if not (wp.abs(qvel[w, i]) < wp.float64(1.0e4)):  # NaN compares false
            bad = nan_bit
    flags[w] = bad


def friction_rows(model: mujoco.MjModel) -> np.ndarray:
    """Return [nv, 2] of the constraint that MuJoCo makes of a dof's dry friction: its impedance d, and B [1/s] of its
    reference acceleration -B v (MuJoCo's documentation, "Computation", "Parameters" of the constraint solver, at no
    distance)."""
    out = np.zeros((model.nv, 2))
    for i, (ref, imp) in enumerate(zip(model.dof_solref, model.dof_solimp, strict=True)):
        low, high = np.clip(imp[:2], mujoco.mjMINIMP, mujoco.mjMAXIMP)
        flat = low == high or imp[2] <= mujoco.mjMINVAL
        time = ref[0]
        if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
            time = max(time, 2.0 * model.opt.timestep)
        b = 2.0 / max(mujoco.mjMINVAL, high * time) if ref[0] > 0 else -ref[1] / max(mujoco.mjMINVAL, high)
        out[i] = 0.5 * (low + high) if flat else low, b
    return out


@wp.kernel(enable_backward=False)
def outside_torque(
    rows: wp.array2d(dtype=wp.float64),
    level: wp.array2d(dtype=wp.float64),
    invweight: wp.array2d(dtype=wp.float64),
    v: wp.array2d(dtype=wp.float64),
    smooth: wp.array2d(dtype=wp.float64),
    damper: wp.array2d(dtype=wp.float64),
    constraint: wp.array2d(dtype=wp.float64),
    acceleration: wp.array2d(dtype=wp.float64),
    applied: wp.array2d(dtype=wp.float64),
    # out
    outside: wp.array2d(dtype=wp.float64),
):
    """Compute what `Engine.keep_outside` says. The batch does not hand out the constraints' own forces, so that of
    dry friction is computed as MuJoCo does: -(a - a_ref) / R within the level, R = (1 - d) / d * invweight, a_ref =
    -B v."""
    w, i = wp.tid()
    most = level[w % level.shape[0], i]
    friction = wp.float64(0.0)
    if most > wp.float64(0.0):
        r = (wp.float64(1.0) - rows[i, 0]) / rows[i, 0] * invweight[w, i]
        missed = acceleration[w, i] + rows[i, 1] * v[w, i]
        friction = wp.clamp(-missed / wp.max(r, wp.float64(1.0e-15)), -most, most)
    outside[w, i] = smooth[w, i] - applied[w, i] - damper[w, i] + constraint[w, i] - friction
