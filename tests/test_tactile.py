"""Normal touch: the kernel against NumPy, closed forms, symmetry, and the figures that are promised."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from tactile_fixtures import SPRING, flat_layout, primitives, random_rotation, touch

from dexsim.assets.objects import Grid, library
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tactile import ShapeSet, TaxelLayout, hand_layout, load_layout
from dexsim.tactile.lanes import lane_ballot, lane_from, lanes_min, lanes_sum, lanes_sum4, lowest_bit
from dexsim.tactile.pressing import skin_of
from dexsim.tactile.sdf import Shapes, distance, normal
from dexsim.tactile.sensors import Sensors
from dexsim.tactile.shapes import TouchShape, bake_convex
from tools.assets import presses as ref
from tools.assets import xhand

SIZES = {"box": (0.03, 0.024, 0.02), "sphere": (0.03, 0, 0), "capsule": (0.019, 0.011, 0), "cylinder": (0.02, 0.03, 0)}


@cache
def hand() -> TaxelLayout:
    return hand_layout(load_hand())


@cache
def tips() -> list[np.ndarray]:
    return [xhand.tip_skin_mesh(f)[0] for f in xhand.FINGERS]


@cache
def shapes() -> list:
    return [*primitives(), library()["rock"], library()["bracket"]]


def contact_poses(n: int, seed: int):
    """Return n worlds: a random shape, its size, and poses of object and hand bodies that overlap some pads."""
    rng = np.random.default_rng(seed)
    out = []
    for i in range(n):
        shape = shapes()[i % len(shapes())]
        size = np.array(SIZES.get(shape.name, (rng.uniform(0.8, 1.3), 0, 0)))
        obj = (rng.uniform(-0.05, 0.05, 3), random_rotation(rng))
        bodies = []
        for f in range(5):
            # a taxel near the surface: move the finger so that a random taxel lies 0.5..1 mm inside
            r = random_rotation(rng)
            k = rng.integers(120)
            q = rng.normal(size=3) * 0.02
            for _ in range(60):
                d = ref.distance(shape.kind, size, q, getattr(shape, "grid", None))
                if abs(d + 0.7e-3) < 3e-4:
                    break
                q = q - (d + 0.7e-3) * ref.normal(shape.kind, size, q, getattr(shape, "grid", None), 1e-5)
            taxel = obj[1] @ q + obj[0]
            bodies.append((taxel - r @ hand().point[f, k], r))
        out.append((i % len(shapes()), shape, size, obj, bodies))
    return out


def set_poses(engine, tactile, poses) -> None:
    for w, (index, _, size, obj, bodies) in enumerate(poses):
        engine.place(w, "object", *obj)
        tactile.shape_id[w] = index
        tactile.shape_size[w] = torch.as_tensor(size, dtype=torch.float32)
        for name, pose in zip(hand().bodies, bodies, strict=True):
            engine.place(w, name, *pose)


def expected_distance(pose, f: int) -> np.ndarray:
    _, shape, size, (po, ro), bodies = pose
    pf, rf = bodies[f]
    q = (hand().point[f] @ rf.T + pf - po) @ ro
    return ref.distance(shape.kind, size, q, getattr(shape, "grid", None))


@pytest.mark.slow
@pytest.mark.parametrize("law", ["linear", "hertz", "mooney_rivlin"])
def test_spring_sum_equals_the_numpy_reference(law):
    poses = contact_poses(24, 0)
    cfg = {**SPRING, "law": law, "raw": True, "others": False, "threshold": 1e-3}
    engine, tactile = touch(24, hand(), shapes(), cfg)
    set_poses(engine, tactile, poses)
    tactile.launch()
    stiffness = SPRING["stiffness"][law]
    lit = 0
    for w, pose in enumerate(poses):
        for f in range(5):
            d = expected_distance(pose, f)
            force = ref.taxel_force(law, -d, hand().area[f], stiffness, tactile.cfg.rubber, 1e-3)
            # float32 poses: 1e-8 m on the depth, so compare with the force of that depth besides 1e-4
            deeper = ref.taxel_force(law, np.maximum(-d, 0) + 3e-8, hand().area[f], stiffness, tactile.cfg.rubber)
            slack = deeper - ref.taxel_force(law, -d, hand().area[f], stiffness, tactile.cfg.rubber)
            got = tactile.raw_clean[w, f].numpy()
            near = np.abs(force - 1e-3) > 2e-4
            assert np.all(np.abs(got - force)[near] <= (1e-4 * force + 2 * slack)[near])
            assert tactile.force_clean[w, f].item() == pytest.approx(got.sum(), rel=1e-5, abs=1e-7)
            if got.sum() > 0.0:
                lit += 1
                pf, rf = pose[4][f]
                centre = rf @ (got.astype(float) @ hand().point[f] / got.sum(dtype=float)) + pf
                np.testing.assert_allclose(tactile.centre_clean[w, f].numpy(), centre, atol=3e-7)
    assert lit > 60


def test_solver_sum_is_the_solvers_force_spread_as_in_the_reference_and_never_lost():
    poses = contact_poses(18, 1)
    engine, tactile = touch(18, hand(), shapes(), {"sum": "solver", "raw": True, "others": False})
    set_poses(engine, tactile, poses)
    rng = np.random.default_rng(2)
    given = torch.as_tensor(rng.uniform(0.01, 20.0, (18, 5)), dtype=torch.float32)
    given[:, 4] = 0.0
    engine.t.pair_normal[:] = given
    # retreat half of the worlds by a millimetre: contacts that light no taxel
    for w in range(0, 18, 2):
        for f in range(5):
            engine.t.xpos[w, engine.body(hand().bodies[f])] *= 1.2
    tactile.launch()
    np.testing.assert_allclose(tactile.force.numpy(), given.numpy(), rtol=1e-5)
    np.testing.assert_allclose(tactile.raw.sum(-1).numpy(), given.numpy(), rtol=1e-5, atol=1e-9)
    assert (tactile.raw[:, 4] == 0.0).all()
    for w in range(1, 18, 2):
        for f in range(4):
            d = expected_distance(poses[w], f)
            want = ref.spread(float(given[w, f]), d, hand().area[f], tactile.cfg.reach)
            np.testing.assert_allclose(tactile.raw[w, f].numpy(), want, atol=2e-3 * float(given[w, f]))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["spring", "solver"])
def test_a_warp_a_pad_equals_the_serial_kernel(mode, monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    poses = contact_poses(6, 3)
    stiffness = {"hertz": 5e6}
    out = []
    for lanes in (False, True):
        cfg = {"sum": mode, "raw": True, "stiffness": stiffness}
        engine, tactile = touch(6, hand(), shapes(), cfg, tips=tips(), lanes=lanes)
        set_poses(engine, tactile, poses)
        # two fingers into each other
        index, mid = hand().bodies[1], hand().bodies[2]
        engine.place(0, index, [0.5, 0, 0], np.eye(3))
        engine.place(0, mid, [0.5 + 0.021, 0.002, 0.001], np.diag([-1.0, -1.0, 1.0]))
        engine.t.pair_normal[:] = torch.linspace(0, 8, 30).reshape(6, 5)
        tactile.launch()
        out.append([x.clone().numpy() for x in (tactile.force, tactile.centre, tactile.force_other, tactile.raw)])
    for a, b in zip(*out, strict=True):
        # poses are composed in another order: 1e-7 m of rounding in the depth, under a root
        np.testing.assert_allclose(a, b, rtol=3e-4, atol=3e-5)
    assert out[0][2][0, 1] > 0.0 and out[0][2][0, 2] > 0.0


@pytest.mark.slow
def test_a_warp_a_pad_takes_ragged_pads_several_objects_and_other_fingers(monkeypatch):
    """Pads of 70, 1 and 33 taxels (whole and broken rounds of 32 lanes), two objects, other tips in the readings."""
    from dexsim.tactile import Tactile
    from dexsim.tactile.posed import PosedEngine

    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    rng = np.random.default_rng(6)
    corners = np.array(np.meshgrid([-5e-3, 5e-3], [-5e-3, 5e-3], [-6e-3, 0.0])).reshape(3, -1).T
    pads = []
    for name, n in (("a", 70), ("b", 1), ("c", 33)):
        p = np.c_[rng.uniform(-4e-3, 4e-3, (n, 2)), np.zeros(n)]
        area = rng.uniform(1e-6, 3e-6, n)
        pads.append({"name": name, "body": name, "point": p, "normal": np.tile([0, 0, 1.0], (n, 1)), "area": area})
    layout = TaxelLayout.build(pads)
    engine = PosedEngine(3, ["x", "a", "b", "c", "one", "two"], [f"{p}{o}" for p in "abc" for o in "12"])
    flip = np.diag([1.0, -1.0, -1.0])
    for w in range(3):
        engine.place(w, "a", [0, 0, 0], np.eye(3))
        engine.place(w, "b", [0.03, 0, 0], random_rotation(rng))
        engine.place(w, "c", [1e-3, 5e-4, -4e-4 * (w - 1)], flip)  # apart, touching, pressed
        engine.place(w, "one", [1e-3, 0, 0.02 - 6e-4], random_rotation(rng))
        engine.place(w, "two", [0.03 - 2e-3, 1e-3, 0.02 - 6e-4], random_rotation(rng))
    engine.t.pair_normal[:] = torch.as_tensor(rng.uniform(0, 5, (3, 6)), dtype=torch.float32)
    for cfg in (
        {"sum": "spring", "law": "mooney_rivlin", "threshold": 1e-3, "stiffness": {"mooney_rivlin": 1.0}},
        {"sum": "solver", "stiffness": {"hertz": 5e6}},
    ):
        out = []
        for lanes in (False, True):
            tactile = Tactile(
                engine, layout, ShapeSet(primitives()), ["one", "two"], {**cfg, "raw": True, "feel_others": True},
                pairs=[["a1", "a2"], ["b1", "b2"], ["c1", "c2"]], tips=[corners] * 3, lanes=lanes,
            )  # fmt: skip
            tactile.shape_id[:] = torch.tensor([[1, 0], [2, 1], [3, -1]])
            tactile.shape_size[:] = 0.02
            for x in (tactile.force_clean, tactile.force_other, tactile.raw_clean):
                x.fill_(7.0)
            tactile.launch()
            x = (tactile.force_clean, tactile.centre_clean, tactile.force_other, tactile.raw_clean)
            out.append([y.clone().numpy() for y in x])
        for a, b in zip(*out, strict=True):
            np.testing.assert_allclose(a, b, rtol=3e-4, atol=3e-6)
        force, _, other, raw = out[1]
        assert force[:, 0].min() > 0.1 and other[2, 0] > 0.1 and other[0, 0] == 0.0
        np.testing.assert_allclose(raw.sum(-1), force + other, rtol=1e-4, atol=1e-6)
        assert (raw[:, 1, 1:] == 0.0).all() and (raw[:, 2, 33:] == 0.0).all()


@wp.kernel(enable_backward=False)
def _exchanges(
    v: wp.array(dtype=wp.vec4), low: wp.array(dtype=float), total: wp.array(dtype=float), sums: wp.array(dtype=wp.vec4),
    seventh: wp.array(dtype=float), bits: wp.array(dtype=int), first: wp.array(dtype=int),
):  # fmt: skip
    i = wp.tid()
    lane = i & 31
    x = v[i]
    low[i] = lanes_min(x[0], 32)
    total[i] = lanes_sum(x[1], 32)
    sums[i] = lanes_sum4(x, lane, 32)
    seventh[i] = lane_from(x[2], 7)
    said = lane_ballot(x[3] > 0.5)
    bits[i] = said
    first[i] = lowest_bit(said)


@pytest.mark.slow
def test_lanes_exchange_within_their_warp(monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    n = 128  # two blocks of two warps
    v = np.random.default_rng(3).uniform(-1, 1, (n, 4)).astype(np.float32)
    out = [wp.zeros(n, dtype=t, device="cpu") for t in (float, float, wp.vec4, float, int, int)]
    wp.launch(_exchanges, dim=n, inputs=[wp.array(v, dtype=wp.vec4, device="cpu"), *out], block_dim=64, device="cpu")
    low, total, sums, seventh, bits, first = (x.numpy().reshape(4, 32, -1) for x in out)
    warps = v.reshape(4, 32, 4)
    assert np.array_equal(low[..., 0], np.repeat(warps[..., 0].min(1), 32).reshape(4, 32))
    np.testing.assert_allclose(total[..., 0], np.repeat(warps[..., 1].sum(1), 32).reshape(4, 32), atol=1e-5)
    np.testing.assert_allclose(sums, np.repeat(warps.sum(1), 32, axis=0).reshape(4, 32, 4), atol=1e-5)
    assert np.array_equal(seventh[..., 0], np.repeat(warps[:, 7, 2], 32).reshape(4, 32))
    said = (warps[..., 3] > 0.5).astype(np.int64) @ (1 << np.arange(32, dtype=np.int64))
    assert np.array_equal(bits[..., 0].astype(np.int64) & 0xFFFFFFFF, np.repeat(said, 32).reshape(4, 32))
    assert np.array_equal(first[..., 0], np.repeat(np.argmax(warps[..., 3] > 0.5, axis=1), 32).reshape(4, 32))


@pytest.mark.parametrize("mode", ["spring", "solver"])
def test_no_contact_is_exactly_zero_with_the_centre_on_the_pad(mode):
    engine, tactile = touch(2, hand(), shapes(), {**SPRING, "sum": mode, "raw": True}, tips=tips())
    tactile.shape_id[:] = 0
    tactile.shape_size[:] = 0.02
    turn = random_rotation(np.random.default_rng(5))
    for w in range(2):
        for f, body in enumerate(hand().bodies):
            engine.place(w, body, [0.0, 0.1 * f, 0.3], turn)
    tactile.force_clean.fill_(7.0)
    tactile.launch()
    for x in (tactile.force, tactile.force_other, tactile.raw):
        assert (x == 0.0).all()
    want = hand().centre() @ turn.T + np.array([[0.0, 0.1 * f, 0.3] for f in range(5)])
    np.testing.assert_allclose(tactile.centre[1].numpy(), want, atol=1e-7)


@pytest.mark.parametrize("depth", [0.3e-3, 1.0e-3])
def test_sphere_on_a_flat_pad_is_the_closed_form_foundation(depth):
    """Overlap depth - s^2 / 2R: linear sums to pi k R depth^2, the root to 4/3 pi k R depth^1.5 (both to depth / R);
    and linear, integrated over the exact sphere, to pi k (R a^2 - 2/3 (R^3 - (R - depth)^3)), a the contact's radius.
    """
    radius, layout = 30e-3, flat_layout()
    for law, k, want in (
        ("linear", 2e8, np.pi * 2e8 * radius * depth**2),
        ("hertz", 5e6, 4 / 3 * np.pi * 5e6 * radius * depth**1.5),
    ):
        engine, tactile = touch(1, layout, primitives(), {**SPRING, "law": law})
        tactile.shape_id[:], tactile.shape_size[:] = 1, torch.tensor([radius, 0, 0])
        engine.place(0, "object", [2e-4, -1e-4, radius - depth])
        tactile.launch()
        assert tactile.force.item() == pytest.approx(want, rel=depth / radius)
        if law == "linear":
            z = radius - depth
            exact = np.pi * k * (radius * (radius**2 - z**2) - 2 / 3 * (radius**3 - z**3))
            assert tactile.force.item() == pytest.approx(exact, rel=2e-3)
        np.testing.assert_allclose(tactile.centre[0, 0, :2].numpy(), [2e-4, -1e-4], atol=2e-5)


def test_mirrored_contact_is_felt_mirrored():
    """The pads are mirror images of themselves: thumb about x = 0, fingers about y = 0 of the distal link."""
    rng = np.random.default_rng(7)
    for f, axis in ((0, 0), (2, 1)):
        mirror = np.ones(3)
        mirror[axis] = -1.0
        point = hand().point[f]
        engine, tactile = touch(2, hand(), shapes(), {**SPRING, "others": False})
        tactile.shape_id[:], tactile.shape_size[:] = 2, torch.tensor(SIZES["capsule"])
        k = 40  # a taxel off the middle
        n = hand().normal[f, k]
        at = point[k] + n * (0.019 - 0.9e-3)
        a = np.cross(n, rng.normal(size=3))
        a /= np.linalg.norm(a)
        for w, m in enumerate((np.ones(3), mirror)):
            z = a * m
            x = np.cross([0.3, 0.5, 0.8], z)
            x /= np.linalg.norm(x)
            engine.place(w, "object", at * m, np.stack([x, np.cross(z, x), z], axis=1))
        tactile.launch()
        assert tactile.force[0, f] > 1.0
        np.testing.assert_allclose(tactile.force[1, f], tactile.force[0, f], rtol=2e-3)
        np.testing.assert_allclose(tactile.centre[1, f].numpy(), tactile.centre[0, f].numpy() * mirror, atol=2e-5)


@wp.kernel
def _probe(
    s: Shapes, i: int, size: wp.vec3, q: wp.array(dtype=wp.vec3), d: wp.array(dtype=float), n: wp.array(dtype=wp.vec3)
):
    t = wp.tid()
    d[t] = distance(s, i, size, q[t])
    n[t] = normal(s, i, size, q[t])


def probe(shape_set: ShapeSet, i: int, size, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    q = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    d, n = wp.zeros(len(points), dtype=float, device="cpu"), wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    wp.launch(_probe, dim=len(points), inputs=[shape_set.wp, i, wp.vec3(*map(float, size)), q, d, n], device="cpu")
    return d.numpy(), n.numpy()


@pytest.mark.slow
def test_distances_and_normals_on_the_device_are_the_references():
    rng = np.random.default_rng(8)
    points = rng.uniform(-0.06, 0.06, (3000, 3))
    shape_set = ShapeSet(shapes())
    for i, shape in enumerate(shapes()):
        size = SIZES.get(shape.name, (1.2, 0, 0))
        d, n = probe(shape_set, i, size, points)
        want = ref.distance(shape.kind, np.array(size), points, getattr(shape, "grid", None))
        np.testing.assert_allclose(d, want, atol=2e-7)
        if shape.kind != "grid":
            eps = ref.normal(shape.kind, np.array(size), points, eps=1e-5)
            # the difference quotient carries float32 noise; edges are left out by the median
            assert np.median(np.abs(n - eps).max(1)) < 0.01


def test_grid_distance_is_exact_near_faces_and_a_lower_bound_outside():
    half = np.array([0.02, 0.015, 0.01])
    h = 1e-3
    axes = [np.arange(-a - 4e-3, a + 4e-3 + h / 2, h) for a in half]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    grid = Grid(np.array([a[0] for a in axes]), h, ref.distance("box", half, lattice).astype(np.float32))
    shape_set = ShapeSet([TouchShape("g", "grid", grid)])
    rng = np.random.default_rng(9)
    for scale in (1.0, 1.7):
        p = rng.uniform(-0.05, 0.05, (20000, 3)) * scale
        d, _ = probe(shape_set, 0, (scale, 0, 0), p)
        exact = ref.distance("box", half * scale, p)
        inside = exact < 2e-3
        assert np.abs(d - exact)[inside].max() < 0.35 * h * scale  # worst at an edge, where the distance has a kink
        q = np.sort(np.abs(p) - half * scale, axis=1)
        face = inside & (q[:, 2] - q[:, 1] > 2 * h * scale) & (q[:, 1] < -2 * h * scale)
        assert face.sum() > 100 and np.abs(d - exact)[face].max() < 1e-6
        far = np.any(np.abs(p) > scale * (half + 4.5e-3), axis=1)
        assert np.all(d[far] > 0.0) and np.all(d[far] <= exact[far] + 0.35 * h * scale)


def test_convex_bake_is_the_plane_distance():
    corners = np.array(np.meshgrid([-0.01, 0.01], [-0.006, 0.006], [-0.02, 0.02])).reshape(3, -1).T
    grid = bake_convex(corners, spacing=0.5e-3)
    p = np.random.default_rng(1).uniform(-1, 1, (2000, 3)) * [0.01, 0.006, 0.02]
    got, want = ref.distance("grid", np.ones(3), p, grid), (np.abs(p) - [0.01, 0.006, 0.02]).max(1)
    np.testing.assert_allclose(got, want, atol=2e-4)


def test_a_scaled_world_feels_the_scaled_shape():
    """A grid sphere at scale s against an exact sphere of that radius, world by world."""
    h = 0.5e-3
    axis = np.arange(-0.024, 0.0241, h)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    grid = Grid(np.full(3, axis[0]), h, (np.linalg.norm(lattice, axis=-1) - 0.02).astype(np.float32))
    layout = flat_layout(n=41)
    engine, tactile = touch(6, layout, [TouchShape("g", "grid", grid), TouchShape("s", "sphere")], SPRING)
    for w in range(6):
        scale = (0.7, 1.0, 1.4)[w % 3]
        engine.place(w, "object", [0, 0, 0.02 * scale - 0.8e-3])
        tactile.shape_id[w] = w // 3
        tactile.shape_size[w] = torch.tensor([scale if w < 3 else 0.02 * scale, 0, 0])
    tactile.launch()
    f = tactile.force[:, 0].numpy()
    np.testing.assert_allclose(f[:3], f[3:], rtol=0.01)
    np.testing.assert_allclose(f[3:] / f[4], [0.7, 1.0, 1.4], rtol=0.03)


def test_worlds_do_not_depend_on_each_other():
    poses = contact_poses(12, 11)
    order = np.random.default_rng(0).permutation(12)
    out = []
    for chosen in (poses, [poses[i] for i in order], poses[3:4]):
        engine, tactile = touch(len(chosen), hand(), shapes(), {**SPRING, "raw": True, "others": False})
        set_poses(engine, tactile, chosen)
        tactile.launch()
        out.append((tactile.force.clone(), tactile.centre.clone(), tactile.raw.clone()))
    for a, b, c in zip(*out, strict=True):
        assert torch.equal(a[order], b)
        assert torch.equal(a[3:4], c)


def test_fingers_feel_each_other_apart_from_the_object():
    engine, tactile = touch(1, hand(), shapes(), {**SPRING, "raw": True}, tips=tips())
    for f, body in enumerate(hand().bodies):
        engine.place(0, body, [0.3 * f, 0, 0], np.eye(3))
    # pads face to face (+x of the distal links), tip centres on one line: 10.9 mm each less 0.8 mm of overlap
    mid = hand().bodies[2]
    engine.place(0, mid, [0.3 + 0.0210, 0, 0], np.diag([-1.0, -1.0, 1.0]))
    tactile.launch()
    other = tactile.force_other[0].numpy()
    assert other[1] > 0.5 and other[1] == pytest.approx(other[2], rel=0.05)
    assert (other[[0, 3, 4]] == 0.0).all() and (tactile.force == 0.0).all() and (tactile.raw == 0.0).all()


def test_several_objects_add_up():
    layout = flat_layout(n=21)
    from tactile_fixtures import PosedEngine

    from dexsim.tactile import Tactile

    engine = PosedEngine(1, ["pad", "a", "b"], ["pa", "pb"])
    for cfg, want in ((SPRING, None), ({"sum": "solver"}, 5.0)):
        tactile = Tactile(engine, layout, ShapeSet(primitives()), ["a", "b"], cfg, pairs=[["pa", "pb"]])
        tactile.shape_id[:] = 1
        tactile.shape_size[:] = torch.tensor([0.01, 0, 0])
        engine.place(0, "a", [-5e-3, 0, 0.01 - 5e-4])
        engine.place(0, "b", [5e-3, 0, 0.01 - 5e-4])
        engine.t.pair_normal[:] = torch.tensor([2.0, 3.0])
        tactile.launch()
        if want:
            assert tactile.force.item() == pytest.approx(want)
            assert tactile.centre[0, 0, 0].item() == pytest.approx(1e-3, rel=0.05)
        else:
            assert tactile.centre[0, 0, 0].item() == pytest.approx(0.0, abs=1e-6) and tactile.force.item() > 0.1


def _press_errors(mode: str, kind: str, size, depth: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of the centre [mm] over random presses on thumb and index, through the kernel; and how far (m)
    the true centre lies from the pad's border."""
    rng = np.random.default_rng(12)
    layout = hand()
    shape = SimpleNamespace(name=kind, kind=kind, grid=None)
    size = np.array(size, dtype=float)
    pressed = []
    for f in (0, 1):
        skin = skin_of(layout, f, xhand.COLUMNS, xhand.ROWS, tips()[f])
        lattice = layout.point[f].reshape(xhand.COLUMNS, xhand.ROWS, 3)
        border = np.concatenate([lattice[0], lattice[-1], lattice[:, 0], lattice[:, -1]])
        for p in ref.presses(rng, layout, f, skin, shape, size, (depth,), count, tilt=0.0):
            truth = p.at
            if kind == "box":  # a flat face: centroid of the overlap of skin and face
                d = ref.distance(kind, size, (skin.points - p.position) @ p.rotation)
                w = skin.area * np.maximum(-d, 0.0)
                truth = w @ skin.points / w.sum()
            pressed.append((f, p, truth, np.linalg.norm(border - truth, axis=1).min()))
    cfg = {"sum": mode, "others": False, "stiffness": {"hertz": 5e6}}
    engine, tactile = touch(len(pressed), layout, [TouchShape(kind, kind)], cfg, tips=tips())
    tactile.shape_id[:], tactile.shape_size[:] = 0, torch.as_tensor(size, dtype=torch.float32)
    engine.t.pair_normal[:] = 3.0
    for w, (f, p, _, _) in enumerate(pressed):
        engine.place(w, "object", p.position, p.rotation)
        for g, body in enumerate(layout.bodies):
            engine.place(w, body, [0.0, 0.0, 0.0] if g == f else [0.0, 0.0, 2.0 + g])
    tactile.launch()
    error = [np.linalg.norm(tactile.centre[w, f].numpy() - truth) for w, (f, _, truth, _) in enumerate(pressed)]
    return np.array(error) * 1e3, np.array([b for *_, b in pressed])


@pytest.mark.parametrize(
    ("kind", "size", "allowed"),
    [("box", (0.2, 0.2, 0.2), 1.0), ("sphere", (0.01, 0, 0), 2.0), ("sphere", (0.03, 0, 0), 2.0)],
)
def test_centre_of_pressure_lies_where_the_contact_is(kind, size, allowed):
    """At 0.7 mm depth; true centre at least 4 mm (two rows) inside the pad's border. The rest: bounded, 3.5 mm."""
    error, border = _press_errors("solver", kind, size, 0.7e-3, 60)
    inner = border > 4e-3
    assert inner.sum() > 40
    p95, edge = np.percentile(error[inner], 95), np.percentile(error[~inner], 95)
    print(f"{kind} {size[0]}: inner 95 % {p95:.2f} mm of {inner.sum()}, edge 95 % {edge:.2f} mm of {(~inner).sum()}")
    assert p95 <= allowed
    assert edge <= 3.5


@pytest.mark.slow
def test_spring_sum_agrees_with_the_contact_law_in_the_median():
    import yaml

    from dexsim.tactile.config import tactile_config
    from tools.assets.fit_stiffness import CONTACT_STIFFNESS, press_library

    path = CONFIGS / "tactile" / "default.yaml"
    cfg = tactile_config(yaml.safe_load(path.read_text()))
    for pad in (0, 1):
        pressed = press_library(Sensors(load_hand()), pad, 20, seed=3)
        k = cfg.stiffness["hertz"][hand().kinds[pad]]
        for depth in (0.7e-3, 1.0e-3):
            at = [p for p in pressed if p.depth == depth]
            r = [ref.hertz_force(-p.d, hand().area[pad], k).sum() / (CONTACT_STIFFNESS * depth) for p in at]
            error = 1.25 * np.std(r) / np.sqrt(len(r))  # of the median of that many presses
            assert np.median(r) == pytest.approx(1.0, abs=0.1 + 2.5 * error)


PLATE = """<mujoco><asset><mesh name="plate" builtin="plate" params="9 9" scale="0.008 0.008 0.008"/></asset>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size="0.01 0.01 0.01"/></body>
    <body name="object"><freejoint/><geom name="object" type="sphere" size="0.02"/></body>
  </worldbody>
  <sensor><tactile geom="pad" mesh="plate"/></sensor></mujoco>"""


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("sphere", (0.02, 0, 0)),
        ("box", (0.005, 0.006, 0.004)),
        ("capsule", (0.006, 0.005, 0)),
        ("cylinder", (0.006, 0.005, 0)),
    ],
)
def test_depths_are_those_of_mujocos_tactile_sensor(kind, size):
    """MuJoCo's `tactile` sensor reports the depth at each vertex of a mesh (in the frame of its geom)."""
    spec = mujoco.MjSpec.from_string(PLATE)
    geom = spec.geom("object")
    geom.type, geom.size = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), np.array(size, float)
    model = spec.compile()
    data = mujoco.MjData(model)
    points = model.mesh_vert.astype(float)
    n, worlds = len(points), 8
    layout = TaxelLayout.build(
        [{"name": "p", "body": "pad", "point": points, "normal": np.tile([0, 0, 1.0], (n, 1)), "area": np.ones(n)}]
    )
    cfg = {**SPRING, "stiffness": {"linear": 1.0}, "raw": True}
    engine, tactile = touch(worlds, layout, [TouchShape(kind, kind)], cfg)
    tactile.shape_id[:], tactile.shape_size[:] = 0, torch.tensor(size, dtype=torch.float32)
    rng = np.random.default_rng(3)
    want = np.zeros((worlds, n))
    for w in range(worlds):
        rotation = random_rotation(rng)
        q = rng.normal(size=3) * 0.01  # where a taxel is in the object's frame: 0.8 mm deep
        for _ in range(60):
            q = q - (ref.distance(kind, np.array(size), q) + 0.8e-3) * ref.normal(kind, np.array(size), q)
        position = points[rng.integers(n)] - rotation @ q
        engine.place(w, "object", position, rotation)
        data.qpos[:3] = position
        mujoco.mju_mat2Quat(data.qpos[3:], rotation.reshape(-1))
        mujoco.mj_forward(model, data)
        assert data.ncon > 0
        want[w] = data.sensordata[:n]
    tactile.launch()
    assert (want > 0).sum() > 20
    got = tactile.raw[:, 0].numpy()
    if kind == "box":
        # MuJoCo's value inside a box is no distance (up to 6 mm in a box of 4 mm half width): compare where it is felt
        sure = np.abs(want) > 1e-6
        assert ((got > 0) == (want > 0))[sure].all() and (got <= want + 2e-7).all()
    else:
        np.testing.assert_allclose(got, want, atol=2e-7)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [True, False])
def test_kernels_compile_for_cuda_without_a_gpu(solver, tmp_path):
    """And exchange by shuffles of the whole warp, without a barrier, without local memory."""
    from dexsim.tactile.kernel import touch_kernel

    kernel = touch_kernel(True, solver, True, True, selves=solver)
    kernel.module.options["block_dim"] = 128
    text = wp.compile_aot_module(kernel.module, arch=90, use_ptx=True, module_dir=str(tmp_path))[0].read_text()
    for word in ("shfl.sync.bfly.b32", "shfl.sync.idx.b32", "vote.sync.ballot.b32", "ld.global.nc.v4"):
        assert word in text
    assert "bar.sync" not in text and ".local" not in text


@pytest.mark.parametrize("name", ["default", "paper", "raw", "full"])
def test_shipped_settings_are_valid_for_the_hand(name):
    from hydra import compose, initialize_config_dir

    from dexsim.tactile.config import stiffness_of, tactile_config

    folder = CONFIGS / "tactile"
    with initialize_config_dir(str(folder), version_base="1.3"):
        cfg = tactile_config(compose(name))
    assert all(k > 0.0 for k in stiffness_of(cfg, hand().kinds))
    assert cfg.measured == (name == "full") and cfg.sum == ("spring" if name == "paper" else "solver")


def test_variants_of_a_shape_share_their_samples():
    rock = library()["rock"]
    both = ShapeSet([rock]), ShapeSet([rock])
    assert both[0].wp.data.ptr == both[1].wp.data.ptr  # whoever asks has the same
    assert ShapeSet([rock, rock, library()["box"], rock]).cells == np.prod(np.array(rock.grid.data.shape) - 1)


def test_bad_settings_are_one_clear_line(tmp_path):
    def build(cfg: dict, **kw):
        return touch(1, hand(), primitives(), cfg, **kw)

    for cfg, words in (
        ({"summ": "spring"}, "tactile.summ: unknown setting; valid ones"),
        ({"sum": "both"}, "must be one of solver, spring"),
        ({**SPRING, "stiffness": {"linear": {"thumb": -1.0}}}, "linear.thumb (-1.0): expected `float` >= 1e-09"),
        ({**SPRING, "stiffness": {"linear": {"thumb": 1e8}}}, "no value [N/m^3] for pads of kind 'finger'"),
        ({**SPRING, "noise": [0.2, 0.1]}, "must rise from low to high"),
        ({**SPRING, "delay": -0.1}, "tactile.delay=-0.1"),
        ({**SPRING, "feel_others": True}, "no tip surfaces"),
        ({**SPRING, "rubber": {"c20": 1.0}}, "tactile.rubber.c20"),
    ):
        with pytest.raises(UserError, match=".") as e:
            build(cfg)
        assert words in str(e.value) and "\n" not in str(e.value)
    with pytest.raises(UserError, match="unknown; choose one of box"):
        ShapeSet([TouchShape("t", "torus")])
    with pytest.raises(UserError, match="wider margin"):
        ShapeSet([TouchShape("g", "grid", Grid(np.zeros(3), 1e-3, -np.ones((4, 4, 4), np.float32)))])
    path = tmp_path / "pad.csv"
    path.write_text("x,y,z,nx,ny\n0,0,0,0,0\n")
    with pytest.raises(UserError, match="pad.csv: no column nz"):
        load_layout(path, "b")
    path.write_text("x,y,z,nx,ny,nz\n0,0,zero,0,0,1\n")
    with pytest.raises(UserError, match="line 2: z is 'zero', must be a finite number"):
        load_layout(path, "b")
    path.write_text("x,y,z,nx,ny,nz\n0,0,0,0,0,2\n")
    with pytest.raises(UserError, match="must have length 1"):
        TaxelLayout.build([load_layout(path, "b")])


def test_layouts_of_any_size():
    """A ragged layout of two pads, one of them of a single taxel, equals each pad alone."""
    a = {"name": "a", "body": "x", "point": [[0, 0, 0], [1e-3, 0, 0], [2e-3, 0, 0]], "normal": [[0, 0, 1]] * 3}
    a["area"] = [1e-6, 2e-6, 3e-6]
    b = {"name": "b", "body": "y", "point": [[0, 0, 0]], "normal": [[0, 0, 1]], "area": [4e-6]}
    layout = TaxelLayout.build([a, b])
    assert layout.point.shape == (2, 3, 3) and layout.count.tolist() == [3, 1]
    engine, tactile = touch(1, layout, primitives(), {**SPRING, "raw": True})
    tactile.shape_id[:], tactile.shape_size[:] = 0, 0.01
    engine.place(0, "object", [0, 0, 0.0095])
    tactile.launch()
    want = 2e8 * 5e-4 * np.array([[1e-6, 2e-6, 3e-6], [4e-6, 0, 0]])
    np.testing.assert_allclose(tactile.raw[0].numpy(), want, rtol=1e-4)
    assert tactile.centre[0, 0, 0].item() == pytest.approx(8e-3 / 6, rel=1e-4)
