"""A hand's mirror image, and a larger or smaller one: the same tree with its geometry and inertia transformed.

The mirror is palm y -> -y. With every body's own frame mirrored too (y -> -y in it), a vector v of any frame becomes
S v, S = diag(1, -1, 1), and a rotation R becomes S R S: of a quaternion, x and z change sign. A hinge's axis is a
pseudo-vector, -S a, so that joint angles keep their meaning and their limits. Scaled by s: lengths s, masses s^3,
inertias s^5; motors, their armature and damping are as they were.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from dexsim.errors import UserError

S = np.array([1.0, -1.0, 1.0])


def derived(spec: mujoco.MjSpec, mirror: bool, scale: float) -> mujoco.MjSpec:
    """Return the mirror image and/or the scaled version of a hand's model in the palm frame. Raises UserError for
    height fields, flexible bodies and composites."""
    if list(spec.hfields) or list(spec.flexes) or list(spec.skins):
        raise UserError("hand_mirror, hand_scale: not for models with height fields, flexes or skins; take them out")
    out = spec.copy()
    flip = S if mirror else np.ones(3)
    lengths = flip * scale

    def turned(q: np.ndarray) -> np.ndarray:
        return np.array(q) * (np.array([1.0, -1.0, 1.0, -1.0]) if mirror else 1.0)

    for mesh in out.meshes:
        mesh.scale = np.array(mesh.scale) * lengths
        mesh.refpos, mesh.refquat = np.array(mesh.refpos) * lengths, turned(mesh.refquat)
    for frame in out.frames:
        _plain(frame, "frame")
        frame.pos, frame.quat = np.array(frame.pos) * lengths, turned(frame.quat)
    for body in out.bodies:
        if body.name == "world":
            continue
        _plain(body, "body")
        body.pos, body.quat = np.array(body.pos) * lengths, turned(body.quat)
        if np.isfinite(np.array(body.ipos)).all():
            body.ipos = np.array(body.ipos) * lengths
        body.iquat = turned(body.iquat)
        body.mass = body.mass * scale**3
        body.inertia = np.array(body.inertia) * scale**5
        full = np.array(body.fullinertia) * scale**5  # xx yy zz xy xz yz, not a number where not given
        body.fullinertia = full * (np.array([1, 1, 1, -1, 1, -1]) if mirror else 1)
    for joint in out.joints:
        joint.pos = np.array(joint.pos) * lengths
        hinge = joint.type == mujoco.mjtJoint.mjJNT_HINGE
        joint.axis = np.array(joint.axis) * (-flip if hinge and mirror else flip)
        if not hinge:
            joint.range = np.array(joint.range) * scale
            joint.ref, joint.springref = joint.ref * scale, joint.springref * scale
    for geom in out.geoms:
        _plain(geom, "geom")
        geom.pos, geom.quat = np.array(geom.pos) * lengths, turned(geom.quat)
        geom.fromto = np.array(geom.fromto) * np.tile(lengths, 2)  # not a number where not given
        geom.size = np.array(geom.size) * scale
        geom.margin, geom.gap = geom.margin * scale, geom.gap * scale
        if np.isfinite(geom.mass):
            geom.mass = geom.mass * scale**3
    for site in out.sites:
        _plain(site, "site")
        site.pos, site.quat = np.array(site.pos) * lengths, turned(site.quat)
        site.size = np.array(site.size) * scale
    return out


def _plain(item: Any, kind: str) -> None:
    """Return its orientation as a quaternion: the other notations of MJCF are not rewritten."""
    if item.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:
        raise UserError(
            f"hand_mirror, hand_scale: {kind} '{item.name}' is turned by euler, axisangle, xyaxes or zaxis;"
            " save the model with quat (MuJoCo's `compile` program writes it so)"
        )
