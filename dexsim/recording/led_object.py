"""The object of a recording, put back into the scene and led along its recorded path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import mujoco
import numpy as np

from dexsim.assets.objects import library
from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.hand.model import HAND_BIT, OBJECT_BIT
from dexsim.recording import attached
from dexsim.recording.mechanism import Mechanism
from dexsim.recording.schema import Recording
from dexsim.sim import ContactPair
from dexsim.sim.make import solver_iterations
from dexsim.sim.scene import add_shape

NAME, JOINT = "object", "object_free"
MARKER = 0.015  # m, radius of what stands for an object of unknown shape: seen, not felt


def pairs(hand: Hand) -> tuple[ContactPair, ...]:
    """Return fingertip on object, one a finger."""
    return tuple(ContactPair(f.name, f.presses, ("body", NAME)) for f in hand.fingers)


@dataclass(frozen=True)
class Stated:
    """An object as somebody describes it. shape: of the library; size [1 to 3] m: its extents (box: x y z; sphere:
    diameter; capsule: diameter, length; other shapes: the longest extent), empty: as the library has it."""

    shape: str
    size: tuple[float, ...] = ()
    mass: float = 0.1
    friction: float = 0.8

    def about(self) -> attached.Thing:
        """Return the object as a recorded play states it, in MuJoCo's sizes. Raises UserError."""
        shapes = library()
        if self.shape not in shapes:
            raise UserError(f"object={self.shape}: must be one of {', '.join(shapes)}")
        shape = shapes[self.shape]
        count = {"box": 3, "sphere": 1, "capsule": 2}.get(shape.kind, 1)
        own = [2 * x for x in _library_size(shape)] if shape.kind != "grid" else [float(shape.extents.max())]
        size = [float(x) for x in self.size] or own
        if len(size) != count or not all(1e-3 <= x <= 1.0 for x in size):
            raise UserError(
                f"object_size={','.join(f'{x:g}' for x in size)}: a {self.shape} has {count} extent{'s' * (count > 1)}"
                " from 0.001 to 1 m"
            )
        if shape.kind == "capsule" and size[1] <= size[0]:
            raise UserError(
                f"object_size={size[0]:g},{size[1]:g}: a capsule's length (with its caps) must be over its diameter"
            )
        if shape.kind == "capsule":
            half = [size[0] / 2, (size[1] - size[0]) / 2, 0.0]
        elif shape.kind != "grid":
            half = [x / 2 for x in size] + [0.0] * (3 - count)
        else:
            half = [size[0] / float(shape.extents.max())] * 3
        return attached.Thing(shape.kind, self.shape, half, self.mass, self.friction, 7000.0, 0.8)


def _library_size(shape: Any) -> list[float]:
    """Return half extents of a primitive of the library as its kind counts them."""
    e = [float(x) / 2 for x in shape.extents]
    return {"box": e, "sphere": e[:1], "capsule": [min(e), max(e)]}[shape.kind]


def add_object(m: Mechanism, recording: Recording, stated: Stated | None = None) -> str:
    """Add the recorded object to the hand's scene (in place), with its contact stiffness and friction: "led". The
    object follows its recorded path: fingers press on it, it does not yield, so forces follow the error of the joints
    rather than the balance of a grasp. "marked": its path is known and its shape is not, a small ball that touches
    nothing shows where it was. "none": no path was recorded, or the mechanism is not a hand. stated: what it is;
    default: what the recording says."""
    config = attached.config(recording.config, recording.path)
    world = config.recorded_world
    about = stated.about() if stated is not None else world.object if world is not None else None
    pose = recording.object_pose
    if pose is None or m.hand is None or not np.isfinite(pose.value).all(1).any():
        return "none"
    body = m.spec.worldbody.add_body(name=NAME, pos=pose.value[0, :3])
    body.add_freejoint(name=JOINT)
    if about is None or about.shape not in library():
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[MARKER, 0, 0], contype=0, conaffinity=0, rgba=[0.9, 0.6, 0.1, 0.8],
            mass=0.01,
        )  # fmt: skip
        return "marked"
    shape, size = library()[about.shape], np.array(about.size, float)
    common: dict[str, Any] = dict(
        contype=OBJECT_BIT, conaffinity=HAND_BIT, condim=4, density=0.0, friction=[1e-3, 1e-4, 1e-4]
    )
    add_shape(m.spec, body, "led", shape, size, **common)
    extent = shape.extents.max() * size.max() if shape.kind == "grid" else 2 * size.max()
    body.explicitinertial, body.mass = True, about.mass
    body.inertia = [0.1 * about.mass * extent**2] * 3
    contact = config.task.contact if config.task is not None else None
    _contact(m.spec, m.hand, about, contact.impedance if contact is not None and contact.impedance else 0.9)
    sim = msgspec.structs.asdict(config.sim or attached.Sim())
    _solver(m.spec, m.hand, {k: v for k, v in sim.items() if v is not None})
    return "led"


def _contact(spec: mujoco.MjSpec, hand: Hand, about: attached.Thing, d: float) -> None:
    """Set friction on the hand, stiffness and damping of the tips: see `tasks.objects.Objects`."""
    model = spec.compile()
    for geom in spec.geoms:
        if not geom.contype or geom.parent.name == NAME:
            continue
        geom.friction[0] = about.friction
        if geom.name in hand.tip_geoms:
            a = (
                model.body_invweight0[model.geom(geom.name).bodyid[0], 0]
                + model.body_invweight0[model.body(NAME).id, 0]
            )
            k = about.stiffness * (1 - d) * a
            geom.solimp = [d, d, 1e-3, 0.5, 2.0]
            geom.solref = [-k, -2 * about.damping_ratio * np.sqrt(k)]


def _solver(spec: mujoco.MjSpec, hand: Hand, sim: dict[str, Any]) -> None:
    """Set the solver as in the hand's tasks (`tasks.env`), so that a play is repeated as it was."""
    for joint in spec.joints:
        if joint.name in hand.joints:
            joint.solimp_friction, joint.solref_friction = [0.97, 0.99, 1e-3, 0.5, 2.0], [0.02, 1.0]
    for key in ("impratio", "noslip_iterations"):
        if key in sim:
            setattr(spec.option, key, sim[key])
    if "iterations" in sim:
        spec.option.iterations, spec.option.ls_iterations = solver_iterations(sim, "mujoco")
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
