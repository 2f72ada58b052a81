"""A hand's model as tasks need it: read, checked, put into the palm frame, with the collision bits of scenes."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from dexsim import model_file
from dexsim.errors import UserError
from dexsim.hand.couplings import Couplings
from dexsim.hand.schema import HandFile
from dexsim.surface import rotation

OBJECT_BIT, HAND_BIT = 1, 2
"""Collision bits. Colliding hand geoms have contype HAND_BIT and conaffinity OBJECT_BIT, objects' geoms contype
OBJECT_BIT and conaffinity HAND_BIT; bits 4 and up are the hand's own, about itself."""
DRIVE = "drive_"
"""Begins the names of bodies that are no link but the drum or nut of an actuator, which pulls joints by a tendon."""
LINK_SOLREF = [0.005, 1.0]
TIES = (mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON)
"""Constraints that may hold a hand's joints together."""
ONE_DOF = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def prepared(file: HandFile, path: Path, where: str) -> tuple[mujoco.MjSpec, list[tuple[str, ...]]]:
    """Return the model in the palm frame, and the names of each fingertip's geoms. Raises UserError."""
    at = path.parent / file.model
    spec = model_file.read(at, f"{where}: model ({file.model})")
    _alone(spec, f"{where}: model ({file.model})")
    _joints(spec, file, where)
    for group in (spec.actuators, spec.sensors, spec.keys, spec.lights, spec.cameras):
        for item in list(group):
            spec.delete(item)
    tips = _tips(spec, file, where)
    for body in spec.bodies:
        for k, g in enumerate(g for g in body.geoms if g.contype or g.conaffinity):
            g.name = g.name or f"link_{body.name}_{k}"
    _collide(spec, {g for names in tips for g in names})
    _place(spec, file, where)
    return spec, tips


def limits(spec: mujoco.MjSpec, joints: list[str], where: str) -> np.ndarray:
    """Return position limits [J, 2] of these joints."""
    m = spec.copy().compile()
    out = []
    for name in joints:
        j = m.joint(name).id
        low, high = m.jnt_range[j]
        if not m.jnt_limited[j] or not low < high:
            raise UserError(
                f"{where}: joint '{name}' of the model has the range [{low:g}, {high:g}] rad"
                f"{'' if m.jnt_limited[j] else ', not limited'}; give it two limits, low < high"
            )
        out.append((low, high))
    return np.array(out)


def root_body(spec: mujoco.MjSpec, joints: list[str], tip: str, palm: str) -> str:
    """Return name of the body where a finger begins: the one that its first joint moves; of a finger that is pulled
    by a tendon, or follows another, alone, the one on the palm."""
    if joints and not (first := spec.joint(joints[0]).parent.name).startswith(DRIVE):
        return str(first)
    body = spec.body(tip)
    while body.parent.name not in (palm, "world"):
        body = body.parent
    return str(body.name)


def _alone(spec: mujoco.MjSpec, where: str) -> None:
    """Refuse what no servo moves, and what is not the hand."""
    for equality in spec.equalities:
        if equality.type not in TIES:
            raise UserError(
                f"{where}: equality constraint '{equality.name or equality.name1}' is neither of joints nor of tendons:"
                " take it out"
            )
    for joint in spec.joints:
        if joint.type not in ONE_DOF:
            kind = "free" if joint.type == mujoco.mjtJoint.mjJNT_FREE else "ball"
            raise UserError(
                f"{where}: joint '{joint.name}' is a {kind} joint; a hand has hinges and slides, its base fixed"
            )
    if list(spec.worldbody.geoms):
        name = spec.worldbody.geoms[0].name or "unnamed"
        raise UserError(f"{where}: geom '{name}' belongs to the world, not to the hand (a floor?): take it out")
    roots = [b.name for b in spec.worldbody.bodies]
    if len(roots) != 1:
        raise UserError(
            f"{where}: {len(roots)} bodies hang on the world ({', '.join(roots[:4])}); must be one, the hand"
        )


def _joints(spec: mujoco.MjSpec, file: HandFile, where: str) -> None:
    theirs, ours = [j.name for j in spec.joints], [j.name for j in file.joints]
    for name in ours:
        if name not in theirs:
            raise UserError(f"{where}: joints: '{name}' is not in the model; its joints: {', '.join(theirs)}")
    for equality in spec.equalities:
        if equality.type == mujoco.mjtEq.mjEQ_JOINT and equality.name1 in ours:
            raise UserError(
                f"{where}: joints: '{equality.name1}' follows '{equality.name2}' in the model, it has no drive of its"
                " own: take it out of joints, or the equality out of the model"
            )
    loose = Couplings(spec.copy().compile(), ours, where).loose
    if loose:
        raise UserError(
            f"{where}: joints: lacks '{loose[0]}' of the model ({len(loose)} in all); name every hinge and slide that"
            " no equality and no tendon moves, or fix it in the model"
        )
    for entry in file.joints:
        if entry.armature is not None:
            spec.joint(entry.name).armature = entry.armature
    m = spec.copy().compile()
    for k in range(m.njnt):
        if not m.dof_M0[m.jnt_dofadr[k]] > 0:
            raise UserError(f"{where}: joint '{m.joint(k).name}' moves nothing that has mass; give its body an inertia")


def _tips(spec: mujoco.MjSpec, file: HandFile, where: str) -> list[tuple[str, ...]]:
    bodies = {b.name: b for b in spec.bodies}
    if file.palm.body not in bodies:
        raise UserError(f"{where}: palm.body ({file.palm.body}): not in the model; it has {', '.join(bodies)}")
    out = []
    for finger in file.fingers:
        field = f"{where}: fingers.{finger.name}"
        body = bodies.get(finger.tip.body)
        if body is None:
            raise UserError(f"{field}.tip.body ({finger.tip.body}): not in the model; it has {', '.join(bodies)}")
        above: list[str] = []
        b = body
        while b is not None and b.name != "world":
            above = [j.name for j in b.joints] + above
            b = b.parent
        elsewhere = [j for j in finger.joints if j not in above and spec.joint(j).parent.name.startswith(DRIVE)]
        if [j for j in above if j in finger.joints] + elsewhere != finger.joints:
            raise UserError(
                f"{field}.joints ({finger.joints}): must lie on the way from the palm to its tip, in this order; there"
                f" are {above}"
            )
        colliding = [g for g in body.geoms if g.contype or g.conaffinity]
        for k, g in enumerate(colliding):
            if not g.name:
                g.name = f"tip_{finger.name}_{k}"
        names = [g.name for g in colliding]
        for g in finger.tip.geoms or []:
            if g not in names:
                raise UserError(
                    f"{field}.tip.geoms: '{g}' is not a colliding geom of {body.name}; there are"
                    f" {', '.join(names) or 'none'}"
                )
        chosen = tuple(finger.tip.geoms or names)
        if not chosen:
            raise UserError(f"{field}.tip.body ({body.name}): none of its geoms collides: it cannot press anything")
        out.append(chosen)
    return out


def _collide(spec: mujoco.MjSpec, tips: set[str]) -> None:
    """Set bits and contact settings. A model whose bits are dexsim's already is left as it is, all of it; of another,
    its bits are about the hand itself: they move up by two, and every geom that collides meets objects too."""
    colliding = [g for g in spec.geoms if g.contype or g.conaffinity]
    ours = any(g.contype & HAND_BIT and g.conaffinity & OBJECT_BIT for g in colliding)
    if ours and not any(g.contype & OBJECT_BIT or g.conaffinity & HAND_BIT for g in colliding):
        return
    for g in colliding:
        g.contype = ((g.contype << 2) & 0x7FFFFFFC) | HAND_BIT
        g.conaffinity = ((g.conaffinity << 2) & 0x7FFFFFFC) | OBJECT_BIT
        # of the file's own contact law nothing is kept: the task writes the rubber's stiffness and the friction
        g.solref, g.solimp = LINK_SOLREF, [0.9, 0.95, 1e-3, 0.5, 2.0]
        g.condim, g.priority = (4, 1) if g.name in tips else (3, 0)
        g.margin = g.gap = 0.0


def _place(spec: mujoco.MjSpec, file: HandFile, where: str) -> None:
    """Move the root body so that the palm frame, in the open pose, is the world frame."""
    m = spec.copy().compile()
    d = mujoco.MjData(m)
    held = {n: a for n, a in file.poses.open.items() if mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_JOINT, n) >= 0}
    Couplings(m, held, where).put(d, np.array(list(held.values())))
    mujoco.mj_kinematics(m, d)
    z = np.array(file.palm.normal) / np.linalg.norm(file.palm.normal)
    x = np.array(file.palm.forward) - z * np.dot(z, file.palm.forward)
    x /= np.linalg.norm(x)
    body = d.body(file.palm.body)
    turn = body.xmat.reshape(3, 3) @ np.stack([x, np.cross(z, x), z], 1)
    origin = body.xpos + body.xmat.reshape(3, 3) @ np.array(file.palm.position)
    if np.abs(turn - np.eye(3)).max() < 1e-7 and np.abs(origin).max() < 1e-9:
        return  # it lies there already, to the last bit
    root = spec.worldbody.bodies[0]
    was = m.body(root.name)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, (turn.T @ rotation(was.quat)).ravel())
    root.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    root.pos, root.quat = turn.T @ (was.pos - origin), quat
