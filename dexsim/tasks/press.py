"""The static press from which the force scale F_max comes: how hard a fingertip presses at full motor torque."""

from __future__ import annotations

import mujoco
import numpy as np

from dexsim.actuator.table import ServoTable
from dexsim.assets import xhand

RADIUS = 0.012  # m, of the ball that is pressed


def fingertip_press(
    servo: dict, finger: str = "mid", stiffness: float = 7000.0, flexion: float = 0.2, drive: float = 1.0
) -> float:
    """Normal force [N] of one fingertip on a fixed ball when its first flexion joint pulls at its torque limit, and the
    second holds with no more than its own.

    drive: share of the torque that reaches the joints (the mean efficiency and strength of randomized servos).

    The finger is slightly bent (`flexion` rad in both joints), the ball (12 mm radius) lies against the
    middle of the pad's distal half; the other joints hold. Static: C MuJoCo until at rest. All four fingers share this
    geometry.
    """
    table = ServoTable.from_dict(servo)
    root = xhand.JOINTS[xhand.FLEXION_ROOT[finger]]
    limit = drive * table.value(root, "torque_limit").value
    spec = xhand.hand_spec()
    spec.option.timestep = 0.001
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_MULTICCD
    anvil = spec.worldbody.add_body(name="anvil", mocap=True)
    anvil.add_geom(
        name="anvil", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], contype=1, conaffinity=2, condim=1
    )
    for other in xhand.JOINTS:
        if other != root:  # the rest of the hand holds its pose: too heavy to move
            spec.joint(other).armature = 1e3
    model = spec.compile()
    data = mujoco.MjData(model)
    second = xhand.JOINTS[xhand.FLEXION_ROOT[finger] + 1]
    for j in (root, second):
        data.qpos[model.joint(j).qposadr[0]] = flexion
    mujoco.mj_forward(model, data)
    body = data.body(xhand.TIP_BODIES[xhand.FINGERS.index(finger)])
    table_ = xhand.taxel_table(finger)
    centre = body.xmat.reshape(3, 3) @ table_["position"].reshape(10, 12, 3)[:, 6:].mean((0, 1)) + body.xpos
    normal = body.xmat.reshape(3, 3) @ np.array([1.0, 0.0, 0.0])  # the pad faces +x of the distal link
    top = (body.xmat.reshape(3, 3) @ table_["position"].T).T @ normal + body.xpos @ normal
    data.mocap_pos[0] = centre + normal * (top.max() - centre @ normal + RADIUS)
    tip = model.geom(f"tip_{finger}").id
    a = model.body_invweight0[model.geom_bodyid[tip], 0]
    d = 0.95
    model.geom_solimp[tip] = [d, d, 1e-3, 0.5, 2]
    k = stiffness * (1 - d) * a
    model.geom_solref[tip] = [-k, -2 * np.sqrt(k)]
    dof = model.joint(root).dofadr[0]
    for i in range(1500):
        data.qfrc_applied[dof] = limit * min(1.0, i / 500)
        data.qvel[dof] *= 0.98  # settle
        mujoco.mj_step(model, data)
    force = np.zeros(6)
    total = 0.0
    for c in range(data.ncon):
        if tip in data.contact[c].geom:
            mujoco.mj_contactForce(model, data, c, force)
            total += force[0]
    # The locked second joint carried whatever it had to: a static force scales with what that joint can carry.
    carried = abs(data.qfrc_constraint[model.joint(second).dofadr[0]])
    return float(total * min(1.0, drive * table.value(second, "torque_limit").value / max(carried, 1e-9)))
