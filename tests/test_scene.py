"""What is written of each world's object: derived constants, surfaces, isolation of worlds, no compounding."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from worlds import ALL, grasp_env, hand_scene, put_object, random_values, write

from dexsim.assets.objects import library
from dexsim.sim.scene import HULL_SLOTS, SLOTS
from dexsim.tactile import reference

WRITTEN = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "geom_dataid",
    "geom_rbound",
    "geom_aabb",
    "geom_friction",
    "geom_solref",
    "body_invweight0",
    "body_subtreemass",
)


@pytest.fixture(scope="module")
def scene():
    return hand_scene(32, scales=(1.1, 1.4))


@pytest.fixture(scope="module")
def warp_scene():
    return hand_scene(32, scales=(1.1, 1.4), kind="warp")


# -- what MuJoCo derives
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_derived_constants_equal_mj_setconst(scene, seed):
    """Closed forms (1/m, mean inverse inertia, tree masses) against mj_setConst on the world's own model."""
    e, s, objects = scene
    write(objects, **random_values(e.n, len(s.variants), seed))
    for w in range(e.n):
        m = e.batch.get_model(w)
        weight, tree = m.body_invweight0.copy(), m.body_subtreemass.copy()
        mujoco.mj_setConst(m, mujoco.MjData(m))
        np.testing.assert_allclose(weight, m.body_invweight0, rtol=2e-6, atol=1e-9)
        np.testing.assert_allclose(tree, m.body_subtreemass, rtol=1e-6)


def test_derived_constants_equal_the_engines_set_const(warp_scene):
    e, s, objects = warp_scene
    write(objects, **random_values(e.n, len(s.variants), 5))
    before = {k: e.field(k).clone() for k in ("body_invweight0", "body_subtreemass")}
    qpos = e.t.qpos.clone()
    e.set_const()
    np.testing.assert_allclose(before["body_invweight0"], e.field("body_invweight0"), rtol=2e-5, atol=1e-6)
    np.testing.assert_allclose(before["body_subtreemass"], e.field("body_subtreemass"), rtol=1e-5)
    assert torch.equal(qpos, e.t.qpos)


def test_mass_properties_are_those_of_the_shape(scene):
    """Against MuJoCo's own: primitives from a compiled geom, irregular shapes from the library's exact mesh
    integrals."""
    e, s, objects = scene
    v = write(objects, **random_values(e.n, len(s.variants), 1))
    b = objects.body
    for w in range(e.n):
        variant = s.variants[int(v["variant"][w])]
        m = e.batch.get_model(w)
        mass = float(v["mass"][w])
        assert m.body_mass[b] == pytest.approx(mass)
        if variant.shape.kind == "grid":
            inertia = np.diag(variant.shape.inertia_unit) * variant.scale**2 * mass
            off = variant.shape.inertia_unit - np.diag(np.diag(variant.shape.inertia_unit))
            assert np.abs(off).max() < 1e-6 * np.diag(variant.shape.inertia_unit).max(), "the shape frame is principal"
            extent = max(variant.shape.extents) * variant.scale
        else:
            size = (variant.shape.size * v["scale"][w].numpy()).tolist()
            x = mujoco.MjModel.from_xml_string(
                f'<mujoco><worldbody><body><freejoint/><geom type="{variant.shape.kind}" mass="{mass}" '
                f'size="{" ".join(map(str, size))}"/></body></worldbody></mujoco>')
            inertia = x.body_inertia[1]
            if variant.shape.kind != "sphere":  # MuJoCo orders principal axes by size; undo it
                r = np.zeros(9)
                mujoco.mju_quat2Mat(r, x.body_iquat[1])
                inertia = np.diag(r.reshape(3, 3) @ np.diag(inertia) @ r.reshape(3, 3).T)
            extent = 2 * {"box": max(size), "sphere": size[0], "capsule": size[0] + size[1]}[variant.shape.kind]
        np.testing.assert_allclose(m.body_inertia[b], inertia, rtol=1e-5)
        np.testing.assert_allclose(m.body_ipos[b], v["com"][w] * extent, rtol=1e-4, atol=1e-8)
        np.testing.assert_allclose(m.body_iquat[b], [1, 0, 0, 0])


@pytest.mark.parametrize("which", ["scene", "warp_scene"])
def test_mass_and_centre_act_in_the_engine(which, request):
    """A force at the centre of mass accelerates it by F/m without turning; under gravity it falls with g."""
    e, s, objects = request.getfixturevalue(which)
    v = write(objects, **random_values(e.n, len(s.variants), 2))
    put_object(e, (0.0, 0.0, 1.0))
    e.t.xfrc_applied[:, objects.body, 0] = 0.1
    e.step(5)
    t = 5 * e.dt
    dof = e.mjm.jnt_dofadr[e.joint("object_free")]
    speed = e.t.qvel[:, dof:dof + 6].double().numpy()
    np.testing.assert_allclose(speed[:, 0], 0.1 / v["mass"].numpy() * t, rtol=2e-4)
    np.testing.assert_allclose(speed[:, 2], -9.81 * t, rtol=2e-4)
    assert np.abs(speed[:, 3:]).max() < 2e-3


# -- the collision surface
# --------------------------------------------------------------------------------------------------


def _touching(e, w: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    m = e.batch.get_model(w)
    d = mujoco.MjData(m)
    d.qpos[:] = e.t.qpos[w]
    mujoco.mj_kinematics(m, d)
    return m, d


@pytest.mark.slow
def test_collision_surface_is_where_touch_has_it(scene):
    """A small probe ball against the engine's slots (mj_geomDistance of the world's own model), in ten directions and
    at a turned pose: the same distance as touch's signed distance, within the grid's error."""
    e, s, objects = scene
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(10, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    worst = {}
    for first in range(0, len(s.variants), e.n):
        v = write(objects, variant=(first + torch.arange(e.n)) % len(s.variants), scale=[[1.2, 1.0, 1.3]])
        quat = np.array([0.8, 0.3, -0.4, 0.33])
        quat /= np.linalg.norm(quat)
        put_object(e, (0.1, -0.2, 0.7), quat)
        r = np.zeros(9)
        mujoco.mju_quat2Mat(r, quat)
        r = r.reshape(3, 3)
        for w in range(min(e.n, len(s.variants) - first)):
            variant = s.variants[int(v["variant"][w])]
            m, d = _touching(e, w)
            own = [
                objects.slots[k].item() for k in range(len(SLOTS)) if np.linalg.norm(m.geom_pos[objects.slots[k]]) < 1
            ]
            assert len(own) == max(len(variant.shape.hulls), 1)
            probe = int(e.geom("tip_mid"))
            m.geom_type[probe], m.geom_size[probe], m.geom_dataid[probe] = (
                mujoco.mjtGeom.mjGEOM_SPHERE,
                [1e-4, 0, 0],
                -1,
            )
            kind, grid = variant.shape.kind, variant.shape.grid
            touch = objects.size[w].double().numpy()
            for u in directions:
                p = _march(kind, touch, grid, u * (objects.radius[w].item() + 1e-3), -u)
                d.geom_xpos[probe] = r @ p + [0.1, -0.2, 0.7]
                gap = min(mujoco.mj_geomDistance(m, d, probe, g, 1.0, None) for g in own) + 1e-4
                worst[variant.shape.name] = max(worst.get(variant.shape.name, 0.0), abs(gap))
    assert set(worst) == set(ALL)
    for name, error in worst.items():
        assert error < (3e-6 if library()[name].kind != "grid" else 6e-4), (name, error)


def _march(kind, size, grid, p, u):
    """Return the point nearest to the end of the ray p + s u through the origin's neighbourhood where touch's
    distance is 0."""
    inside, outside = p + u * np.linalg.norm(p), p
    assert (
        reference.distance(kind, size, inside[None], grid)[0]
        < 0
        < reference.distance(kind, size, outside[None], grid)[0]
    )
    for _ in range(40):  # a star-shaped view is not needed: any crossing is on the surface
        mid = (inside + outside) / 2
        inside, outside = (mid, outside) if reference.distance(kind, size, mid[None], grid)[0] < 0 else (inside, mid)
    return mid


FLOOR = -0.5


def _floor(spec: mujoco.MjSpec) -> None:
    # a box, not a plane: parked slots turn with the object, and a plane has no end
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.3, 0.3, 0.05],
        pos=[0, 0, FLOOR - 0.05],
        contype=2,
        conaffinity=1,
        friction=[1, 0.005, 1e-4],
    )
    # faces on faces: one point a pair would rock
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)


def _lowest(variant, size: np.ndarray, rot: np.ndarray) -> float:
    """Return the height of the lowest point below the body frame, of the shape turned by rot [3, 3]."""
    down = -rot[2]  # world -z in the body frame
    if variant.shape.kind == "grid":
        return max(float((h * variant.scale @ down).max()) for h in variant.shape.hulls)
    if variant.shape.kind == "sphere":
        return float(size[0])
    return float(np.abs(down) @ size) if variant.shape.kind == "box" else float(size[0] + abs(down[2]) * size[1])


@pytest.mark.parametrize("kind", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
def test_every_shape_comes_to_lie_on_its_surface(kind):
    """In the engine itself, dropped on a slab: the lowest point of the shape's own geometry touches it, less the
    depth of MuJoCo's soft default contact (deep for a moment at 0.3 m/s)."""
    names = ALL
    e, s, objects = hand_scene(len(names), names, kind, scales=(1.25,), edit=_floor)
    write(objects, scale=torch.full((e.n, 3), 1.25))
    quat = np.array([0.9, 0.3, 0.2, 0.1]) / np.linalg.norm([0.9, 0.3, 0.2, 0.1])
    put_object(e, torch.stack([torch.zeros(e.n), torch.zeros(e.n), FLOOR + 0.005 + objects.radius], 1).numpy(), quat)
    a = e.mjm.jnt_qposadr[e.joint("object_free")]
    for _ in range(10):
        e.step(40)
        low = [
            float(e.t.qpos[w, a + 2])
            - FLOOR
            - _lowest(s.variants[w], objects.size[w].double().numpy(), e.t.xmat[w, objects.body].double().numpy())
            for w in range(e.n)
        ]
        assert min(low) > -7e-3, dict(zip(names, low, strict=True))
    assert max(low) < 1e-3 and min(low) > -1.5e-3, dict(zip(names, low, strict=True))


def test_bounding_volumes_hold_each_slot(scene):
    """Broad phases trust them: a sphere and a box about each slot in use, no smaller than it and hardly larger."""
    e, s, objects = scene
    write(objects, **random_values(e.n, len(s.variants), 12))
    for w in range(e.n):
        m = e.batch.get_model(w)
        for g in objects.slots.tolist():
            if np.linalg.norm(m.geom_pos[g]) > 1:
                continue
            kind, (a, b, c) = mujoco.mjtGeom(m.geom_type[g]), m.geom_size[g]
            if kind == mujoco.mjtGeom.mjGEOM_MESH:
                mesh = m.geom_dataid[g]
                v = m.mesh_vert[m.mesh_vertadr[mesh]:m.mesh_vertadr[mesh] + m.mesh_vertnum[mesh]]
                low, high, radius = v.min(0), v.max(0), np.linalg.norm(v, axis=1).max()
            else:
                high = np.array(
                    {"BOX": (a, b, c), "SPHERE": (a, a, a), "CAPSULE": (a, a, a + b)}[kind.name.removeprefix("mjGEOM_")]
                )
                low, radius = (
                    -high,
                    {"BOX": np.hypot(np.hypot(a, b), c), "SPHERE": a, "CAPSULE": a + b}[
                        kind.name.removeprefix("mjGEOM_")
                    ],
                )
            box = m.geom_aabb[g]
            assert radius * 0.99999 <= m.geom_rbound[g] < 1.8 * radius, (w, g)
            assert (box[:3] - box[3:] <= low + 1e-6).all() and (box[:3] + box[3:] >= high - 1e-6).all()
            assert (box[3:] < 1.2 * (high - low) / 2 + 1e-4).all()


@pytest.mark.parametrize("which", ["scene", "warp_scene"])
def test_parked_slots_are_far_and_per_world_frames_are_used(which, request):
    e, s, objects = request.getfixturevalue(which)
    v = write(objects, **random_values(e.n, len(s.variants), 9))
    # where the compiler finds two frames equal it marks them, and per-world values would be ignored
    assert not e.mjm.geom_sameframe[objects.slots].any() and not e.mjm.body_sameframe[objects.body]
    assert not e.mjm.body_simple[objects.body]
    pos = e.field("geom_pos")[:, objects.slots].double()
    near = pos.norm(dim=-1) < 0.5
    for w in range(e.n):
        variant = s.variants[int(v["variant"][w])]
        slots = {"box": [0], "sphere": [1], "capsule": [2]}.get(
            variant.shape.kind, [3 + k for k in range(len(variant.shape.hulls))]
        )
        assert near[w].nonzero()[:, 0].tolist() == slots, variant.shape.name
    assert bool((pos[~near].norm(dim=-1) > 900).all())


def test_parked_slots_never_collide(scene):
    """Primitives in the middle of the hand: every contact of the object is of the one slot in use."""
    e, s, objects = scene
    write(objects, scale=torch.full((e.n, 3), 1.3))
    put_object(e, (0.09, 0.0, 0.02))
    slots = set(objects.slots.tolist())
    seen = 0
    for w in range(e.n):
        m, d = _touching(e, w)
        mujoco.mj_forward(m, d)
        variant = s.variants[int(objects.variant[w])]
        own = {"box": [0], "sphere": [1], "capsule": [2]}.get(variant.shape.kind, [3 + k for k in range(HULL_SLOTS)])
        allowed = {int(objects.slots[k]) for k in own}
        for c in range(d.ncon):
            used = slots & set(d.contact[c].geom.tolist())
            assert used <= allowed
            seen += bool(used)
    assert seen > e.n / 2


# -- worlds and time
# -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["scene", "warp_scene"])
def test_masked_worlds_keep_their_object(which, request):
    e, s, objects = request.getfixturevalue(which)
    write(objects, **random_values(e.n, len(s.variants), 3))
    names = ("variant", "size", "mass", "com", "friction", "stiffness", "damping_ratio", "radius")
    fields = {f: e.field(f).clone() for f in WRITTEN}
    own = {k: getattr(objects, k).clone() for k in names}
    mask = torch.arange(e.n) % 3 == 0
    write(objects, mask, **random_values(e.n, len(s.variants), 4))
    for f, v in fields.items():
        assert torch.equal(e.field(f)[~mask], v[~mask]), f
    for k, v in own.items():
        assert torch.equal(getattr(objects, k)[~mask], v[~mask]), k
    assert not torch.equal(e.field("body_mass")[mask], fields["body_mass"][mask])


def test_writing_again_gives_the_same_and_never_compounds(scene):
    """After a hundred other objects, the first one's fields are bitwise as at first; the hand's own rows never move."""
    e, s, objects = scene
    first = random_values(e.n, len(s.variants), 6)
    write(objects, **first)
    fields = {f: e.field(f).clone() for f in WRITTEN}
    for k in range(100):
        write(
            objects,
            torch.rand(e.n, generator=torch.Generator().manual_seed(k)) < 0.7,
            **random_values(e.n, len(s.variants), 100 + k),
        )
    write(objects, **first)
    for f, v in fields.items():
        assert torch.equal(e.field(f), v), f
    hand = [b for b in range(1, e.mjm.nbody) if b != objects.body]
    for f in ("body_mass", "body_inertia", "body_ipos"):
        assert np.array_equal(e.field(f)[0, hand], getattr(e.mjm, f)[hand]), f


def test_friction_and_rubber_are_written_by_world(scene):
    e, s, objects = scene
    v = write(objects, **random_values(e.n, len(s.variants), 8))
    for w in (0, e.n - 1):
        m = e.batch.get_model(w)
        tips = objects.tips.tolist()
        np.testing.assert_allclose(m.geom_friction[objects.hand_geoms.tolist(), 0], float(v["friction"][w]), rtol=1e-6)
        a = m.body_invweight0[m.geom_bodyid[tips], 0] + m.body_invweight0[objects.body, 0]
        k = float(v["stiffness"][w]) * 0.05 * a
        np.testing.assert_allclose(m.geom_solref[tips, 0], -k, rtol=1e-5)
        np.testing.assert_allclose(m.geom_solref[tips, 1], -2 * float(v["damping_ratio"][w]) * np.sqrt(k), rtol=1e-5)
        assert m.geom_friction[objects.slots.tolist(), 0].max() < 0.01  # the hand's friction counts: the larger of two


# -- environments
# ---------------------------------------------------------------------------------------------------------------


def test_fifty_resets_stay_in_the_ranges():
    env = grasp_env(worlds=8)
    nominal = env.servo.nominal.clone()
    ranges = env.sampler.ranges
    mass, friction, ratio = [], [], []
    for _ in range(50):
        env.reset_all()
        mass.append(env.objects.mass.clone())
        friction.append(env.engine.field("geom_friction")[:, env.objects.hand_geoms, 0].clone())
        ratio.append((env.servo.column("kp") / nominal[:, 0]).clone())
    assert torch.equal(env.servo.nominal, nominal)
    kp = ranges["servo.kp"]
    for name, values, (low, high, log) in (
        ("mass", torch.cat(mass), ranges["object.mass"]),
        ("friction", torch.cat(friction), ranges["object.friction"]),
        ("kp", torch.cat(ratio), kp),
    ):
        values = values.double()
        assert low * (1 - 1e-5) <= float(values.min()) and float(values.max()) <= high * (1 + 1e-5), name
        u = ((values / low).log() / np.log(high / low)) if log else (values - low) / (high - low)
        u = u if u.dim() == 1 else u[:, 0]  # one draw a world (friction), or a joint's
        assert abs(float(u.mean()) - 0.5) < 4 * 0.289 / len(u) ** 0.5, name  # the draw is the fresh one, not a walk
        assert float(u.min()) < 0.05 and float(u.max()) > 0.95, name
