"""Declares what stands around a hand: how it is mounted, its object, a table, further objects, imported machines.

    class Turn(Task):
        scene = Scene(object=Hinge(at=(0.07, 0, 0.06), axis=(0, 0, 1), range=(-10, 10), friction=0.01))

The world's frame is the palm frame of a hand that is fixed: origin at the palm's centre, x along the fingers, z out of
the palm. A hand on a `Base` begins with its palm's centre in the origin, and z is up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from dexsim import files, model_file
from dexsim.assets.objects import library
from dexsim.assets.objects.own import is_own, own_shape
from dexsim.assets.objects.shape import Shape
from dexsim.errors import UserError
from dexsim.hand.model import HAND_BIT, OBJECT_BIT
from dexsim.sim.scene import OBJECT, add_shape
from dexsim.surface import geom_surface
from dexsim.tactile.shapes import TouchShape, bake_convex

Vector = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]

AXES = ("x", "y", "z")
BASE = (*(f"base_{a}" for a in AXES), *(f"base_r{a}" for a in AXES))
"""Joints of a `Base`: three slides [m], then three hinges [rad]."""


@dataclass(frozen=True)
class Free:
    """The object moves freely."""


@dataclass(frozen=True)
class Jointed:
    """The object moves along or about one axis. at: m; axis: unit vector; range: rad, of a slide m; friction: N.m of
    dry friction, N; damping: N.m.s/rad, N.s/m; armature: kg.m2, kg; quat: w x y z."""

    at: Vector = (0.07, 0.0, 0.06)
    axis: Vector = (0.0, 0.0, 1.0)
    range: tuple[float, float] | None = None
    friction: float = 0.0
    damping: float = 1e-4
    armature: float = 1e-6
    quat: Wxyz = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Hinge(Jointed):
    """The object turns about one axis: a knob, a lever, a door."""


@dataclass(frozen=True)
class Slide(Jointed):
    """The object moves along one axis: a drawer, a button."""

    axis: Vector = (1.0, 0.0, 0.0)
    damping: float = 0.1
    armature: float = 1e-3


@dataclass(frozen=True)
class Screw(Jointed):
    """The object turns and moves along the same axis, `pitch` m a turn."""

    pitch: float = 0.002


@dataclass(frozen=True)
class Base:
    """Six servos that carry the hand: slides along x, y, z of the world, then hinges about them at the palm's centre.

    palm: where it looks at first. travel m, turn rad: how far either way. scale: m and rad that an action of 1 moves a
    target in a control step; lead: m and rad that a target may be ahead. stiffness N/m and N.m/rad, damping N.s/m and
    N.m.s/rad, limit N and N.m of each servo.
    """

    palm: Literal["up", "down", "side"] = "down"
    travel: float = 0.3
    turn: float = 0.8
    scale: tuple[float, float] = (0.01, 0.04)
    lead: tuple[float, float] = (0.04, 0.15)
    stiffness: tuple[float, float] = (3000.0, 60.0)
    damping: tuple[float, float] = (110.0, 1.5)
    limit: tuple[float, float] = (80.0, 8.0)

    def servos(self) -> dict[str, dict[str, float]]:
        """Return entries of a servo table for the six joints: drives without any imperfection."""
        out = {}
        for k, name in enumerate(BASE):
            i = k // 3
            out[name] = {
                "kp": self.stiffness[i], "kd": self.damping[i], "torque_limit": self.limit[i], "no_load_speed": 1e3,
                "delay": 0.0, "coulomb_friction": 0.0, "viscous_friction": 0.0,
            }  # fmt: skip
        return out


@dataclass(frozen=True)
class Table:
    """A box to put things on. top: m, height of its top, along z of the world; centre x, y and size x, y: m."""

    top: float = -0.1
    centre: tuple[float, float] = (0.05, 0.0)
    size: tuple[float, float] = (0.5, 0.5)


@dataclass(frozen=True)
class Thing:
    """One more free object. shape: of the library, or a mesh file; size: factor on it; mass kg; at: m."""

    name: str
    shape: str = "box"
    size: float = 1.0
    mass: float = 0.1
    at: Vector = (0.1, 0.0, 0.1)

    def __post_init__(self) -> None:
        for name in ("size", "mass"):
            value = getattr(self, name)
            if not isinstance(value, (int, float)) or not 0 < value < float("inf"):
                raise UserError(f"Thing {self.name}: {name}={value}: must be a number above 0")


@dataclass(frozen=True)
class Tree:
    """An imported machine: any MJCF or URDF file (or its text), with all its joints. at: m, quat: w x y z of its root
    in the world. The hand meets its geoms and feels its bodies."""

    name: str
    file: str
    at: Vector = (0.1, 0.0, 0.0)
    quat: Wxyz = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Scene:
    """What a task's world holds beside the hand. object: how the object moves, whose shapes `task.objects` names; None:
    there is none. base: None where the hand is fixed."""

    object: Free | Jointed | None = Free()
    base: Base | None = None
    table: Table | None = None
    things: Sequence[Thing] = ()
    trees: Sequence[Tree] = ()

    def __post_init__(self) -> None:
        for name, kind in (("things", Thing), ("trees", Tree)):
            value = getattr(self, name)
            if not isinstance(value, (list, tuple)) or not all(isinstance(x, kind) for x in value):
                raise UserError(f"Scene: {name}={value!r}: must be a list of {kind.__name__}(...)")

    @property
    def free(self) -> bool:
        """Whether there is one object, which moves freely."""
        return isinstance(self.object, Free)


@dataclass(frozen=True)
class Part:
    """A body of a scene beside the hand and its object, as built. touch: what pads feel of it."""

    body: str
    touch: TouchShape
    size: np.ndarray


@dataclass
class Built:
    """What `build` added. parts: bodies that pads feel; joints: names of the joints of each tree, "tree/joint"."""

    parts: list[Part]
    joints: dict[str, list[str]]


def mount(spec: mujoco.MjSpec, base: Base) -> None:
    """Put the hand on six joints, its palm where `base` says."""
    root = spec.worldbody.bodies[0]
    if base.palm not in ("up", "down", "side"):
        raise UserError(f"scene: Base(palm={base.palm!r}): must be up, down or side")
    angle = {"up": 0.0, "side": np.pi / 2, "down": np.pi}[base.palm]
    turn = np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])  # about the fingers
    place, quat, mat = np.zeros(3), np.zeros(4), np.zeros(9)
    mujoco.mju_rotVecQuat(place, np.asarray(root.pos, float), turn)
    mujoco.mju_mulQuat(quat, turn, np.asarray(root.quat, float))
    root.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    root.pos, root.quat = place, quat
    mujoco.mju_quat2Mat(mat, quat)
    to_local = mat.reshape(3, 3).T
    origin = to_local @ -place
    for k, name in enumerate(BASE):
        kind = mujoco.mjtJoint.mjJNT_SLIDE if k < 3 else mujoco.mjtJoint.mjJNT_HINGE
        far = base.travel if k < 3 else base.turn
        root.add_joint(
            name=name, type=kind, axis=to_local @ np.eye(3)[k % 3], pos=origin, range=[-far, far],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )  # fmt: skip


def fasten(body: mujoco.MjsBody, how: Jointed, spec: mujoco.MjSpec) -> None:
    """Give the object's body its joint in place of a free one."""
    axis = np.asarray(how.axis, float)
    if not np.linalg.norm(axis) > 0:
        raise UserError(f"scene: {type(how).__name__}(axis={how.axis}): must have a length")
    body.pos, body.quat = how.at, how.quat
    turns = not isinstance(how, Slide)
    kind = mujoco.mjtJoint.mjJNT_HINGE if turns else mujoco.mjtJoint.mjJNT_SLIDE
    joint = body.add_joint(name=f"{OBJECT}_joint", type=kind, axis=axis / np.linalg.norm(axis))
    joint.frictionloss, joint.armature = how.friction, how.armature
    joint.damping = [how.damping, 0.0, 0.0]
    if how.range is not None:
        joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, how.range
        # a stop of metal: MuJoCo's default gives way by tenths of a radian to what a finger presses with
        joint.solref_limit, joint.solimp_limit = [0.014, 1.0], [0.95, 0.99, 1e-3, 0.5, 2.0]
    if isinstance(how, Screw):
        along = body.add_joint(name=f"{OBJECT}_along", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=joint.axis)
        along.armature = 1e-4
        line = np.zeros(mujoco.mjNEQDATA)
        line[1] = how.pitch / (2 * np.pi)
        spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=along.name, name2=joint.name,
                          objtype=mujoco.mjtObj.mjOBJ_JOINT, data=line)  # fmt: skip


def furnish(spec: mujoco.MjSpec, scene: Scene) -> Built:
    """Add table, things and trees to a spec, in place. Raises UserError."""
    built = Built([], {})
    names = [OBJECT, "table", *(x.name for x in scene.things), *(x.name for x in scene.trees)]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise UserError(f"scene: two parts are called {twice!r}; give each a name of its own")
    if scene.table is not None:
        _table(spec, scene.table)
    for thing in scene.things:
        built.parts.append(_thing(spec, thing))
    for tree in scene.trees:
        parts, joints = _tree(spec, tree)
        built.parts += parts
        built.joints[tree.name] = joints
    return built


def _table(spec: mujoco.MjSpec, table: Table) -> None:
    """Build the table, which meets the hand and objects: bits of both."""
    thick = 0.02
    body = spec.worldbody.add_body(name="table", pos=[*table.centre, table.top - thick])
    both = OBJECT_BIT | HAND_BIT
    body.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=[table.size[0] / 2, table.size[1] / 2, thick],
        contype=both, conaffinity=both, condim=4, friction=[0.8, 1e-3, 1e-4], rgba=[0.55, 0.5, 0.45, 1.0], group=0,
    )  # fmt: skip


def _thing(spec: mujoco.MjSpec, thing: Thing) -> Part:
    shape = _shape(thing.shape)
    body = spec.worldbody.add_body(name=thing.name, pos=thing.at)
    body.add_freejoint(name=f"{thing.name}_free")
    body.explicitinertial = True
    inertia = np.diag(shape.inertia_unit) * thing.size**2 * thing.mass
    body.mass, body.inertia = thing.mass, np.maximum(inertia, 1e-9)
    common: dict[str, Any] = dict(
        contype=OBJECT_BIT, conaffinity=OBJECT_BIT | HAND_BIT, condim=4, friction=[0.8, 1e-3, 1e-4], group=0,
        rgba=[0.3, 0.55, 0.8, 1.0],
    )  # fmt: skip
    size = np.array([thing.size, 0.0, 0.0]) if shape.kind == "grid" else shape.size * thing.size
    add_shape(spec, body, thing.name, shape, size, **common)
    return Part(thing.name, TouchShape(thing.name, shape.kind, shape.grid), size)


def _shape(name: str) -> Shape:
    known = library()
    if name in known:
        return known[name]
    if is_own(name):
        return own_shape(name)
    raise UserError(f"scene: no shape '{name}'; shapes: {', '.join(known)}, or a mesh file")


def _tree(spec: mujoco.MjSpec, tree: Tree) -> tuple[list[Part], list[str]]:
    """Attach an imported file under the world. Its geoms keep meeting each other; they meet hand and objects too."""
    where = f"scene: tree {tree.name}"
    if tree.file.lstrip().startswith("<"):
        try:
            own = mujoco.MjSpec.from_string(tree.file)
        except ValueError as error:
            raise UserError(f"{where}: {error}") from None
    else:
        if not Path(files.place(tree.file)).is_file():
            raise UserError(f"{where}: {tree.file}: no such file")
        own = model_file.read(files.place(tree.file), f"{where}: {tree.file}")
    for group in (own.actuators, own.sensors, own.keys, own.lights, own.cameras):
        for item in list(group):
            own.delete(item)
    for item in list(own.worldbody.geoms):  # a floor, say: this scene has its own
        own.delete(item)
    for k, body in enumerate(own.bodies[1:]):
        body.name = body.name or f"body{k}"
    for k, joint in enumerate(own.joints):
        joint.name = joint.name or f"joint{k}"
    for geom in own.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = geom.contype << 2 | OBJECT_BIT, geom.conaffinity << 2 | HAND_BIT
            geom.condim = 4
    model = own.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parts = [_part(model, b, tree.name) for b in range(1, model.nbody) if _colliding(model, b)]
    joints = [f"{tree.name}/{joint.name}" for joint in own.joints]
    frame = spec.worldbody.add_frame(name=f"{tree.name}_frame", pos=tree.at, quat=tree.quat)
    spec.attach(own, prefix=f"{tree.name}/", frame=frame)
    return parts, joints


def _colliding(model: mujoco.MjModel, body: int) -> list[int]:
    return [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_contype[g]]


def _part(model: mujoco.MjModel, body: int, tree: str) -> Part:
    """Return what pads feel of a body: the convex hull of its colliding geoms."""
    surfaces = {g: geom_surface(model, g)[0] for g in _colliding(model, body)}
    if (flat := next((g for g, x in surfaces.items() if not len(x)), None)) is not None:
        kind = mujoco.mjtGeom(model.geom_type[flat]).name[7:].lower()
        raise UserError(f"scene: geom {model.geom(flat).name or flat} is a {kind}, which is not felt")
    points = np.concatenate([*surfaces.values()])
    name = f"{tree}/{model.body(body).name}"
    span = float(np.ptp(points, 0).max())
    grid = bake_convex(points, spacing=max(0.5e-3, span / 120), margin=max(2e-3, span / 40))
    return Part(name, TouchShape(name, "grid", grid), np.array([1.0, 0.0, 0.0]))
