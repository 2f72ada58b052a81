"""A hand with one free object whose shape, size, mass and centre of mass differ by world.

One compiled model serves every shape: the object body carries geom slots (a box, a sphere, a capsule, and three convex
hulls or as many as the shapes need), of which a world uses those that its shape needs; the others are parked a
kilometre away (they turn with the object, so such a scene must not have planes, which have no end). Per world only
`geom_*` and `body_*` fields differ, so that topology, kernels and graphs are shared. Measured against one model a shape
group, this needs one graph and one compile (see lab/results/speed.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from dexsim.assets.objects import Shape

OBJECT = "object"
HULL_SLOTS = 3
SLOTS = ("object_box", "object_sphere", "object_capsule", *(f"object_hull{i}" for i in range(HULL_SLOTS)))
_PRIMITIVE_SLOT = {"box": 0, "sphere": 1, "capsule": 2}
_PARKED = np.array([0.0, 0.0, 1000.0])
# Placement of slots and of the centre of mass at compile time: three different frames, or MuJoCo marks geoms or inertia
# as "same frame" and ignores the per-world values.
_OFFSET = [1e-3, 2e-3, 3e-3]
_TILT = [0.99995, 0.01, 0.0, 0.0]
_IPOS = [-2e-3, 1e-3, 1e-3]
_IQUAT = [0.9998, 0.0, 0.02, 0.0]

OBJECT_FIELDS = (
    "body_mass", "body_inertia", "body_ipos", "body_iquat", "geom_pos", "geom_quat", "geom_size", "geom_dataid",
    "geom_rbound", "geom_aabb", "geom_friction", "geom_solref", "opt.gravity",
)  # fmt: skip
"""Model fields that vary by world in this scene."""


@dataclass(frozen=True)
class Variant:
    """One shape at one baked scale. Primitives have scale 1 and take their size from the world."""

    shape: Shape
    scale: float


@dataclass
class Scene:
    """The spec, and the table from which a world's object is set.

    variants: list of V variants; slots: names of the object's S geoms, `SLOTS` and one more for each hull beyond three
    that a shape has. Per variant and slot: dataid [V, S] int, pos [V, S, 3], quat [V, S, 4],
    size [V, S, 3], rbound [V, S], aabb [V, S, 6]; unit inertia about the centre of mass per kg at scale 1 [V, 3, 3]
    (zero for primitives: from their size).
    """

    spec: mujoco.MjSpec
    variants: list[Variant]
    slots: tuple[str, ...]
    dataid: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    size: np.ndarray
    rbound: np.ndarray
    aabb: np.ndarray


def _mesh_name(shape: Shape, scale: float, part: int) -> str:
    return f"{shape.name}_{scale:.3f}_{part}".replace(".", "p")


def hand_object_scene(hand: mujoco.MjSpec, shapes: Sequence[Shape], scales: Sequence[float], timestep: float) -> Scene:
    """Add the object to `hand` (changed in place) and build the table of its variants.

    scales: the sizes at which hulls are baked (a mesh cannot be scaled by world); a shape of true size gets 1 alone.
    """
    variants: list[Variant] = []
    spec = hand
    spec.option.timestep = timestep
    for shape in shapes:
        if shape.kind in _PRIMITIVE_SLOT:
            variants.append(Variant(shape, 1.0))
            continue
        for scale in (1.0,) if shape.true_size else scales:
            variants.append(Variant(shape, float(scale)))
            for k, vertices in enumerate(shape.hulls):
                spec.add_mesh(name=_mesh_name(shape, scale, k), uservert=(np.asarray(vertices) * scale).ravel())
    # the largest of each slot at compile time, so that bounding volumes made by the compiler hold in every world
    body = spec.worldbody.add_body(name=OBJECT, pos=[0.05, 0, 0.1])
    body.add_freejoint(name="object_free")
    body.explicitinertial = True
    body.mass, body.ipos, body.iquat = 0.1, _IPOS, _IQUAT
    body.inertia = [4e-5, 4.1e-5, 4.2e-5]
    common = dict(
        pos=_OFFSET, quat=_TILT, contype=1, conaffinity=2, condim=4, group=3, rgba=[0.85, 0.45, 0.2, 1.0],
        friction=[1e-3, 1e-4, 1e-4],
    )  # fmt: skip
    g = mujoco.mjtGeom
    body.add_geom(name=SLOTS[0], type=g.mjGEOM_BOX, size=[0.08, 0.08, 0.08], **common)
    body.add_geom(name=SLOTS[1], type=g.mjGEOM_SPHERE, size=[0.08, 0, 0], **common)
    body.add_geom(name=SLOTS[2], type=g.mjGEOM_CAPSULE, size=[0.08, 0.08, 0], **common)
    hulls = [v for v in variants if v.shape.kind not in _PRIMITIVE_SLOT]
    if not hulls:  # the slots still need a mesh
        spec.add_mesh(
            name="placeholder", uservert=np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]], float).ravel()
        )
        placeholder = "placeholder"
    else:
        placeholder = _mesh_name(hulls[0].shape, hulls[0].scale, 0)
    most = max([HULL_SLOTS, *(len(v.shape.hulls) for v in hulls)])
    slots = (*SLOTS[:3], *(f"object_hull{i}" for i in range(most)))
    for slot in slots[3:]:
        body.add_geom(name=slot, type=g.mjGEOM_MESH, meshname=placeholder, **common)
    return Scene(spec, variants, slots, *_variant_table(spec, variants, slots))


def add_shape(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, shape: Shape, size: np.ndarray, **common: Any
) -> None:
    """Add a shape's geoms to a body: a primitive of `size`, as MuJoCo counts it, or hulls times size[0]."""
    if shape.kind in _PRIMITIVE_SLOT:
        body.add_geom(name=name, type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}"), size=size, **common)
        return
    for k, hull in enumerate(shape.hulls):
        spec.add_mesh(name=f"{name}_{k}", uservert=(np.asarray(hull) * size[0]).ravel())
        body.add_geom(name=f"{name}_{k}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{name}_{k}", **common)


def _variant_table(spec: mujoco.MjSpec, variants: list[Variant], slots: tuple[str, ...]) -> tuple[np.ndarray, ...]:
    V, S = len(variants), len(slots)
    probe = spec.copy()
    probe_body = probe.worldbody.add_body(name="probe")
    for v in variants:
        if v.shape.kind not in _PRIMITIVE_SLOT:
            for k in range(len(v.shape.hulls)):
                name = _mesh_name(v.shape, v.scale, k)
                probe_body.add_geom(
                    name=f"probe_{name}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, mass=0, contype=0,
                    conaffinity=0,
                )  # fmt: skip
    m = probe.compile()
    dataid = np.full((V, S), m.geom(SLOTS[3]).dataid[0], dtype=np.int32)
    dataid[:, :3] = -1
    pos = np.tile(_PARKED, (V, S, 1))
    quat = np.tile(np.array([1.0, 0, 0, 0]), (V, S, 1))
    size = np.full((V, S, 3), 1e-3)
    rbound = np.full((V, S), 1e-3)
    aabb = np.zeros((V, S, 6))
    aabb[..., 3:] = 1e-3
    for i, v in enumerate(variants):
        if v.shape.kind in _PRIMITIVE_SLOT:
            s = _PRIMITIVE_SLOT[v.shape.kind]
            pos[i, s] = 0.0  # size, rbound and aabb follow the world's size
            continue
        for k in range(len(v.shape.hulls)):
            g = m.geom(f"probe_{_mesh_name(v.shape, v.scale, k)}")
            dataid[i, 3 + k] = g.dataid[0]
            pos[i, 3 + k], quat[i, 3 + k], size[i, 3 + k] = g.pos, g.quat, g.size
            rbound[i, 3 + k], aabb[i, 3 + k] = g.rbound[0], m.geom_aabb[g.id]
    return dataid, pos, quat, size, rbound, aabb
