"""The static press from which the force scale F_max comes: how hard a fingertip presses at full motor torque."""

from __future__ import annotations

import mujoco
import numpy as np

from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.hand import Finger, Hand
from dexsim.tactile.layout import hand_layout

RADIUS = 0.012  # m, of the ball that is pressed


def fingertip_press(
    hand: Hand, servo: dict, finger: str | None = None, stiffness: float = 7000.0, flexion: float = 0.2,
    drive: float = 1.0,
) -> float:  # fmt: skip
    """Return normal force [N] that one fingertip can press with, F_max: as hand.yaml's `force` says, a number, or from
    the servo's torque limits: `press`, a simulated press on a ball (for pads that form a lattice), else the levers.

    finger: by default the middle one of those beside the opposing fingers. drive: share of the torque that reaches the
    joints (the mean efficiency and strength of randomized servos). stiffness N/m, flexion rad: of the simulated press.
    """
    if isinstance(hand.force, float):
        return hand.force
    if finger is None:
        finger = hand.finger_names[hand.others[(len(hand.others) - 1) // 2]]
    own, table = hand.fingers[hand.finger_names.index(finger)], ServoTable.from_dict(servo)
    limits = [table.value(hand.joints[j], "torque_limit") for j in own.flexion]
    limit = []
    for j, v in zip(own.flexion, limits, strict=True):
        if v.value is None:
            raise UserError(
                f"hand {hand.folder}: force: cannot be told: the servo's torque_limit of {hand.joints[j]} is unknown;"
                " state it in the servo table, or force [N] in hand.yaml"
            )
        limit.append(drive * v.value)
    if hand.force == "press":
        return _pressed(hand, own, limit, stiffness, flexion)
    return by_levers(hand, own, limit)


def by_levers(hand: Hand, finger: Finger, limit: list[float]) -> float:
    """Return static force [N] along a fingertip's normal at its end, open pose: tau_j = F n . dp/dq_j of every flexion
    joint must stay within its limit [N m]. No friction, no weight."""
    model = hand.compiled
    data = mujoco.MjData(model)
    hand.couplings.put(data, hand.pose("open"))
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    body = data.body(finger.body)
    turn, jacobian = body.xmat.reshape(3, 3), np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, body.xpos + turn @ np.array(finger.position), model.body(finger.body).id)
    levers = hand.couplings.along(turn @ np.array(finger.normal) @ jacobian, data.qpos)
    arms = [abs(levers[j]) for j in finger.flexion]
    force = min(tau / max(arm, 1e-3) for tau, arm in zip(limit, arms, strict=True))
    if not np.isfinite(force):
        raise UserError(
            f"hand {hand.folder}: force: cannot be told: the servo's torque_limit of {hand.joints[finger.flexion[0]]}"
            " is infinite; state torque_limit in the servo table, or force [N] in hand.yaml"
        )
    return float(force)


def _pressed(hand: Hand, finger: Finger, limit: list[float], stiffness: float, flexion: float) -> float:
    """Return normal force [N] on a fixed ball when the finger's first flexion joint pulls at its torque limit, and the
    second holds with no more than its own. Limits N m.

    The finger is slightly bent (`flexion` rad in both joints), the ball (12 mm radius) lies against the
    middle of the pad's distal half; the other joints hold. Static: C MuJoCo until at rest.
    """
    layout = hand_layout(hand)
    own = hand.fingers.index(finger)
    if layout is None or not layout.rows[own] or len(finger.flexion) < 2:
        raise UserError(
            f"hand {hand.folder}: force (press): needs pads whose taxels form a lattice (rows) and two flexion joints;"
            " state a force [N], or null"
        )
    root, second = (hand.joints[j] for j in finger.flexion[:2])
    spec = hand.spec()
    spec.option.timestep = 0.001
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_MULTICCD
    anvil = spec.worldbody.add_body(name="anvil", mocap=True)
    anvil.add_geom(
        name="anvil", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], contype=1, conaffinity=2, condim=1
    )
    for other in hand.joints:
        if other != root:  # the rest of the hand holds its pose: too heavy to move
            spec.joint(other).armature = 1e3
    model = spec.compile()
    data = mujoco.MjData(model)
    for j, closes in zip((root, second), finger.closes, strict=False):
        data.qpos[model.joint(j).qposadr[0]] = flexion * closes
    mujoco.mj_forward(model, data)
    body = data.body(finger.body)
    points = layout.point[own, : layout.count[own]]
    half = layout.rows[own] // 2
    centre = body.xmat.reshape(3, 3) @ points.reshape(-1, layout.rows[own], 3)[:, half:].mean((0, 1)) + body.xpos
    normal = body.xmat.reshape(3, 3) @ np.array(finger.normal)
    top = (body.xmat.reshape(3, 3) @ points.T).T @ normal + body.xpos @ normal
    data.mocap_pos[0] = centre + normal * (top.max() - centre @ normal + RADIUS)
    tips = [model.geom(g).id for g in finger.geoms]
    a = model.body_invweight0[model.geom_bodyid[tips[0]], 0]
    d = 0.95
    model.geom_solimp[tips] = [d, d, 1e-3, 0.5, 2]
    k = stiffness * (1 - d) * a
    model.geom_solref[tips] = [-k, -2 * np.sqrt(k)]
    dof = model.joint(root).dofadr[0]
    for i in range(1500):
        data.qfrc_applied[dof] = finger.closes[0] * limit[0] * min(1.0, i / 500)
        data.qvel[dof] *= 0.98  # settle
        mujoco.mj_step(model, data)
    force = np.zeros(6)
    total = 0.0
    for c in range(data.ncon):
        if set(tips) & set(data.contact[c].geom.tolist()):
            mujoco.mj_contactForce(model, data, c, force)
            total += force[0]
    # The locked second joint carried whatever it had to: a static force scales with what that joint can carry.
    carried = abs(data.qfrc_constraint[model.joint(second).dofadr[0]])
    return float(total * min(1.0, limit[1] / max(carried, 1e-9)))
