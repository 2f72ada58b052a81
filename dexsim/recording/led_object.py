"""The object of a simulated recording, put back into the scene and led along its recorded path."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import yaml

from dexsim.assets import xhand
from dexsim.assets.objects import library
from dexsim.recording.mechanism import Mechanism
from dexsim.recording.schema import Recording
from dexsim.sim import ContactPair

NAME, JOINT = "object", "object_free"
TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
PAIRS = tuple(
    ContactPair(f, ("geom", geom), ("body", NAME)) for f, geom in zip(xhand.FINGERS, xhand.TIP_GEOMS, strict=True)
)
"""Fingertip on object, one a finger."""


def add_object(m: Mechanism, recording: Recording) -> bool:
    """Add the recorded object to the hand's scene (in place), with its contact stiffness and friction; False where
    the recording does not say what it was, or its path is missing. The object follows its recorded path: fingers
    press on it, it does not yield, so forces follow the error of the joints rather than the balance of a grasp."""
    config = yaml.safe_load(recording.config) if recording.config else None
    about = (config or {}).get("recorded_world", {}).get("object") if isinstance(config, dict) else None
    if not about or recording.object_pose is None or m.robot != "xhand_right" or about["shape"] not in library():
        return False
    shape, size = library()[about["shape"]], np.array(about["size"], float)
    body = m.spec.worldbody.add_body(name=NAME, pos=recording.object_pose.value[0, :3])
    body.add_freejoint(name=JOINT)
    common: dict[str, Any] = dict(
        contype=xhand.OBJECT_BIT, conaffinity=xhand.HAND_BIT, condim=4, density=0.0, friction=[1e-3, 1e-4, 1e-4]
    )
    if shape.kind in TYPES:
        body.add_geom(type=TYPES[shape.kind], size=size, **common)
    else:
        for k, hull in enumerate(shape.hulls):
            m.spec.add_mesh(name=f"led_{k}", uservert=(np.asarray(hull) * size[0]).ravel())
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"led_{k}", **common)
    extent = shape.extents.max() * size.max() if shape.kind == "grid" else 2 * size.max()
    body.explicitinertial, body.mass = True, about["mass"]
    body.inertia = [0.1 * about["mass"] * extent**2] * 3
    contact = config.get("task", {}).get("contact", {})
    _contact(m.spec, about, float(contact.get("impedance", 0.9)))
    _solver(m.spec, config.get("sim", {}))
    return True


def _contact(spec: mujoco.MjSpec, about: dict[str, Any], d: float) -> None:
    """Friction on the hand, stiffness and damping of the tips: see `tasks.objects.Objects`."""
    model = spec.compile()
    for geom in spec.geoms:
        if not geom.contype or geom.parent.name == NAME:
            continue
        geom.friction[0] = about["friction"]
        if geom.name in xhand.TIP_GEOMS:
            a = (
                model.body_invweight0[model.geom(geom.name).bodyid[0], 0]
                + model.body_invweight0[model.body(NAME).id, 0]
            )
            k = about["stiffness"] * (1 - d) * a
            geom.solimp = [d, d, 1e-3, 0.5, 2.0]
            geom.solref = [-k, -2 * about["damping_ratio"] * np.sqrt(k)]


def _solver(spec: mujoco.MjSpec, sim: dict[str, Any]) -> None:
    """As in the hand's tasks (`tasks.env`), so that a play is repeated as it was."""
    for joint in spec.joints:
        if joint.name in xhand.JOINTS:
            joint.solimp_friction, joint.solref_friction = [0.97, 0.99, 1e-3, 0.5, 2.0], [0.02, 1.0]
    for key in ("impratio", "iterations", "ls_iterations", "noslip_iterations"):
        if key in sim:
            setattr(spec.option, key, sim[key])
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
