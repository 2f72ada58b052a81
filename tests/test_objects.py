"""Object shapes against closed forms, MuJoCo's mesh inertia, Monte Carlo and plane distances; bad meshes are named."""

from __future__ import annotations

import subprocess
import sys

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from dexsim.assets.objects import library, load_mesh, names, primitive_mass_properties
from dexsim.assets.objects.baking import UNIT, bake_grid, pack, shape_from_hulls, unpack
from dexsim.assets.objects.geometry import (
    hull_planes,
    hull_vertices,
    mass_properties,
    principal_axes,
    signed_distance,
    simplify_hull,
    union_boundary,
)
from dexsim.errors import UserError
from tools.assets.objects import contact_sheet
from tools.assets.shapes import SHAPES, hulls_of

GRID_SHAPES = list(SHAPES)
CONVEX = [n for n in GRID_SHAPES if len(library()[n].hulls) == 1]
UNIONS = [n for n in GRID_SHAPES if len(library()[n].hulls) > 1]


def cube(half: float, centre=(0.0, 0.0, 0.0)) -> np.ndarray:
    return np.array(centre) + half * (np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1)


def inside_any(hulls, points) -> np.ndarray:
    planes = [ConvexHull(h).equations for h in hulls]
    return np.any([(points @ p[:, :3].T + p[:, 3]).max(axis=1) <= 0 for p in planes], axis=0)


def near_surface(shape, n: int, band: float, seed: int = 1) -> np.ndarray:
    """Return the random points within `band` of the exact surface, wherever they are along it."""
    points = np.random.default_rng(seed).uniform(-0.55, 0.55, (60 * n, 3)) * (shape.extents + 2 * band)
    return points[np.abs(signed_distance(shape.hulls, points)) < band][:n]


# ---- the library


def test_what_the_library_holds():
    shapes = library()
    irregular = [n for n in shapes if n not in ("box", "sphere", "capsule", "cylinder")]
    assert {"box", "sphere", "capsule", "cylinder"} <= set(shapes) and len(irregular) >= 8
    assert names(True) == [n for n in irregular if shapes[n].held_out] and len(names(True)) == 4
    assert {len(shapes[n].hulls) == 1 for n in names(True)} == {True, False}  # convex and not
    assert {len(shapes[n].hulls) == 1 for n in names(False) if n in irregular} == {True, False}
    assert names() == list(shapes) and set(names(False)) | set(names(True)) == set(names())


@pytest.mark.parametrize("name", list(library()))
def test_sizes_and_limits(name):
    shape = library()[name]
    assert np.isclose(shape.extents.max(), 0.060, atol=1e-6) and shape.extents.min() > 0.020
    assert 10e-6 < shape.volume < 150e-6
    if shape.kind != "grid":
        assert shape.hulls == [] and shape.grid is None
        return
    assert 1 <= len(shape.hulls) <= 3
    for hull in shape.hulls:
        assert len(hull) <= 32 and len(ConvexHull(hull).vertices) == len(hull)  # every vertex is a corner
    points = np.concatenate(shape.hulls)
    top = shape.grid.origin + shape.grid.spacing * (np.array(shape.grid.data.shape) - 1)
    assert (points.min(axis=0) - shape.grid.origin >= 8e-3).all() and (top - points.max(axis=0) >= 8e-3).all()
    assert max(shape.grid.data.shape) <= 65 and shape.grid.data.dtype == np.float32


def test_nobody_can_change_the_shared_library():
    with pytest.raises(ValueError):
        library()["rock"].grid.data[0, 0, 0] = 0
    changed = library()
    changed.pop("rock")
    assert "rock" in library()


def test_loading_needs_no_trimesh():
    code = "import sys; from dexsim.assets.objects import library; library(); assert 'trimesh' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["wedge", "tee"])
def test_committed_library_is_what_the_formulas_give(name):
    stored, again = library()[name], shape_from_hulls(name, hulls_of(name), SHAPES[name][1])
    for a, b in zip(stored.hulls, again.hulls, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
    assert stored.held_out == again.held_out and stored.grid.data.shape == again.grid.data.shape
    np.testing.assert_allclose(stored.grid.origin, again.grid.origin, atol=1e-8)
    assert np.abs(stored.grid.data - again.grid.data).max() <= 1.01 * UNIT


def test_shapes_are_drawn_to_a_file_named_by_text(tmp_path):
    contact_sheet(str(tmp_path / "shapes.png"), {n: library()[n] for n in GRID_SHAPES[:2]})
    assert (tmp_path / "shapes.png").read_bytes().startswith(b"\x89PNG")


def test_packing_keeps_every_stored_step():
    shape = library()["wedge"]
    back = unpack("wedge", pack(shape))
    np.testing.assert_array_equal(back.grid.data, shape.grid.data)
    np.testing.assert_array_equal(back.hulls[0], shape.hulls[0])


# ---- mass properties


def test_union_of_two_cubes_in_closed_form():
    """A cube and a cube half as wide across one of its faces: overlapping, abutting, and sharing planes."""
    for x in (1.2, 1.5):  # 0.2 deep in the big cube's face at x = 1 ... and touching it
        small = cube(0.5, (x, 0.5, 0.5))  # shares the planes y = 1 and z = 1 with the big one
        volume, centre, inertia = mass_properties(union_boundary([cube(1.0), small]))
        low, high = max(x - 0.5, 1.0), x + 0.5
        part, at = high - low, np.array([(low + high) / 2, 0.5, 0.5])
        assert np.isclose(volume, 8 + part)
        np.testing.assert_allclose(centre, part * at / volume, atol=1e-12)
        size, total = np.array([part, 1, 1]), np.zeros((3, 3))
        for m, c, s in ((8, np.zeros(3), np.full(3, 2.0)), (part, at, size)):
            r = c - centre
            total += m * (np.diag((s @ s - s**2) / 12) + (r @ r) * np.eye(3) - np.outer(r, r))
        np.testing.assert_allclose(inertia, total / volume, atol=1e-12)


def test_hull_volume_agrees_with_qhull_on_random_and_coplanar_points():
    rng = np.random.default_rng(0)
    for k in range(40):
        points = rng.normal(size=(rng.integers(5, 50), 3)) * [1, 1, rng.choice([1, 0.3, 0.05])]
        hull = hull_vertices(np.round(points, 1) if k % 2 else points)
        assert np.isclose(mass_properties(union_boundary([hull]))[0], ConvexHull(hull).volume, rtol=1e-9)


@pytest.mark.parametrize("name", GRID_SHAPES)
def test_closed_centred_and_principal(name):
    shape = library()[name]
    triangles = union_boundary(shape.hulls)
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2
    np.testing.assert_allclose(area.sum(axis=0), 0, atol=1e-10)  # closed: no net area (of about 1e-2 m^2)
    volume, centre, inertia = mass_properties(triangles)
    assert np.isclose(volume, shape.volume, rtol=1e-9) and np.abs(centre).max() < 1e-8
    np.testing.assert_allclose(inertia, shape.inertia_unit, atol=1e-15)
    assert np.abs(inertia - np.diag(np.diag(inertia))).max() < 1e-6 * np.trace(inertia)
    moments = np.sort(np.diag(inertia))
    assert moments[0] > 0 and moments[0] + moments[1] > moments[2]


@pytest.mark.parametrize("name", UNIONS)
def test_unions_against_monte_carlo(name):
    shape = library()[name]
    rng = np.random.default_rng(3)
    points = np.concatenate(shape.hulls)
    low, high = points.min(axis=0), points.max(axis=0)
    p = rng.uniform(low, high, (200_000, 3))
    p = p[inside_any(shape.hulls, p)]
    share = len(p) / 200_000
    assert np.isclose(shape.volume, share * np.prod(high - low), rtol=4 * np.sqrt((1 - share) / share / 200_000))
    assert np.abs(p.mean(axis=0)).max() < 4 * 0.02 / np.sqrt(len(p))
    second = p.T @ p / len(p)
    np.testing.assert_allclose(np.trace(second) * np.eye(3) - second, shape.inertia_unit, atol=0.01 * 5e-4)


@pytest.mark.parametrize("name", CONVEX)
def test_inertia_is_mujocos_own(name):
    """MuJoCo builds the mesh from the hull alone; its body inertia, turned to our frame, must be ours."""
    shape = library()[name]
    spec = mujoco.MjSpec()
    spec.add_mesh(name="m", uservert=shape.hulls[0].ravel())
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m", mass=0.2)
    model = spec.compile()
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[1])
    axes = axes.reshape(3, 3)
    np.testing.assert_allclose(axes @ np.diag(model.body_inertia[1]) @ axes.T / 0.2, shape.inertia_unit, atol=2e-9)
    np.testing.assert_allclose(model.body_ipos[1], 0, atol=1e-7)
    assert model.mesh_vertnum[0] == len(shape.hulls[0])


@pytest.mark.parametrize(
    ("kind", "size"), [("box", (0.03, 0.02, 0.01)), ("sphere", (0.02, 0, 0)), ("capsule", (0.02, 0.015, 0))]
)
def test_primitive_inertia_is_mujocos_own(kind, size):
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=list(size), density=1000)
    model = spec.compile()
    volume, inertia = primitive_mass_properties(kind, np.array(size))
    assert np.isclose(model.body_mass[1], 1000 * volume)
    axes = np.zeros(9)  # MuJoCo sorts the moments and turns the inertial frame to match
    mujoco.mju_quat2Mat(axes, model.body_iquat[1])
    axes = axes.reshape(3, 3)
    theirs = axes @ np.diag(model.body_inertia[1]) @ axes.T
    np.testing.assert_allclose(theirs, model.body_mass[1] * np.diag(inertia), atol=1e-12)
    stacked = primitive_mass_properties(kind, np.tile(size, (4, 1)))
    assert stacked[0].shape == (4,) and stacked[1].shape == (4, 3)


def test_primitives_of_the_library():
    for kind in ("box", "sphere", "capsule"):
        shape = library()[kind]
        volume, inertia = primitive_mass_properties(kind, shape.size)
        assert shape.kind == kind and np.isclose(shape.volume, volume)
        np.testing.assert_allclose(shape.inertia_unit, np.diag(inertia))


def test_principal_axes_is_a_rotation_that_undoes_a_small_turn():
    angle = 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(principal_axes(turn @ np.diag([3.0, 1.0, 2.0]) @ turn.T), turn, atol=1e-12)


# ---- distances


def test_distance_of_a_cube_in_closed_form():
    p = np.random.default_rng(0).uniform(-2, 2, (2000, 3))
    q = np.abs(p) - 1
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    np.testing.assert_allclose(signed_distance([cube(1.0)], p), exact, atol=1e-9)


def test_inner_faces_of_a_union_do_not_count():
    """Two cubes end to end are one bar, whether they overlap or only touch."""
    p = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [1.9, 0.9, 0.9]
    exact = -np.minimum(1 - np.abs(p[:, 1:]).max(axis=1), 2 - np.abs(p[:, 0]))
    for shift in (1.0, 0.9):
        hulls = [cube(1.0, (-1, 0, 0)) * 1.0, cube(1.0, (1, 0, 0))]
        hulls[0][:, 0] = np.where(hulls[0][:, 0] > -1, 2 * (1 - shift), -2)  # reaches past the seam when shift < 1
        np.testing.assert_allclose(signed_distance(hulls, p), exact, atol=1e-9)


@pytest.mark.parametrize("name", CONVEX)
def test_grid_inside_a_convex_shape_is_the_largest_plane_distance(name):
    shape = library()[name]
    planes = ConvexHull(shape.hulls[0]).equations  # Qhull's own, not ours
    axes = [shape.grid.origin[k] + shape.grid.spacing * np.arange(n) for k, n in enumerate(shape.grid.data.shape)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    exact = (nodes @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    at_node = shape.grid.data.reshape(-1)
    inner = exact < 0
    assert inner.sum() > 5000 and np.abs(at_node[inner] - exact[inner]).max() < 0.51 * UNIT + 1e-8  # rounding only
    assert (at_node[~inner] >= exact[~inner] - 2 * UNIT).all()  # outside, planes are a lower bound


@pytest.mark.parametrize("name", GRID_SHAPES)
def test_grid_against_exact_distance_near_the_surface(name):
    shape = library()[name]
    p = near_surface(shape, 250, 2e-3)
    exact, sampled = signed_distance(shape.hulls, p), shape.grid.sample(p)
    error = np.abs(sampled - exact)
    # Kinks at edges cost up to a third of a cell there; over faces the distance is linear and the grid exact.
    assert error.mean() < 0.04e-3 and np.median(error) < 0.01e-3 and error.max() < 0.41 * shape.grid.spacing
    mean, largest = shape.grid_error
    assert np.isclose(mean, error.mean(), atol=0.02e-3) and largest < 0.41 * shape.grid.spacing
    sure = np.abs(exact) > 0.5e-3
    np.testing.assert_array_equal(np.sign(sampled[sure]), np.where(inside_any(shape.hulls, p[sure]), -1, 1))
    norm = np.linalg.norm(shape.grid.gradient(p), axis=1)
    assert np.quantile(np.abs(norm - 1), 0.6) < 0.02 and norm.max() < 1.1


def test_stored_step_is_below_five_micrometres():
    assert UNIT / 2 < 5e-6


def test_uniform_scale():
    """Doubling a shape: d(x) = 2 d(x / 2), volume 8 times, inertia per kg 4 times."""
    hulls = library()["bracket"].hulls
    p = np.random.default_rng(0).uniform(-0.08, 0.08, (500, 3))
    double = [2 * h for h in hulls]
    np.testing.assert_allclose(signed_distance(double, p), 2 * signed_distance(hulls, p / 2), atol=1e-9)
    volume, _, inertia = mass_properties(union_boundary(double))
    assert np.isclose(volume, 8 * library()["bracket"].volume)
    np.testing.assert_allclose(inertia, 4 * library()["bracket"].inertia_unit, atol=1e-12)


def test_grid_sampling_is_exact_for_a_linear_field():
    grid = bake_grid([cube(0.01)], spacing=2.5e-3, margin=5e-3)
    slope = np.array([0.3, -0.7, 0.2])
    axes = [grid.origin[k] + grid.spacing * np.arange(n) for k, n in enumerate(grid.data.shape)]
    grid.data[:] = np.einsum("kxyz,k->xyz", np.array(np.meshgrid(*axes, indexing="ij")), slope)
    p = np.random.default_rng(0).uniform(-0.012, 0.012, (200, 3))
    np.testing.assert_allclose(grid.sample(p), p @ slope, atol=1e-8)
    np.testing.assert_allclose(grid.gradient(p), np.tile(slope, (200, 1)), atol=1e-5)


# ---- a user's own mesh


def write(mesh: trimesh.Trimesh, path) -> str:
    mesh.export(path)
    return str(path)


def test_convex_mesh_in_millimetres(tmp_path):
    mesh = trimesh.creation.box((60, 40, 30))
    mesh.apply_translation((100, 0, 5))
    shape = load_mesh(write(mesh, tmp_path / "brick.stl"), scale=1e-3)
    assert shape.name == "brick" and shape.kind == "grid" and shape.notes == () and not shape.held_out
    assert np.isclose(shape.volume, 72e-6)
    np.testing.assert_allclose(np.diag(shape.inertia_unit) * 12e6, (2500, 4500, 5200), rtol=1e-6)
    np.testing.assert_allclose(shape.file_centre, (0.1, 0, 0.005), atol=1e-9)
    np.testing.assert_allclose(shape.grid.sample(np.array([[0.032, 0, 0], [0, 0, 0.013]])), (2e-3, -2e-3), atol=1e-5)


@pytest.mark.slow
def test_fine_convex_mesh_is_simplified_and_says_so(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    shape = load_mesh(write(ball, tmp_path / "ball.ply"))
    assert len(shape.hulls[0]) == 32 and "simplified to 32 corners" in shape.notes[0]
    hull, inside, outside = simplify_hull(np.asarray(ball.vertices), 32)
    assert np.isclose(ConvexHull(hull).volume, ball.volume)
    # The stated deviation is the true one: radii of the corners, and of the faces seen from the ball.
    assert np.isclose(np.linalg.norm(hull, axis=1).max() - 0.03, outside, atol=3e-4)
    assert np.isclose(0.03 + hull_planes(hull)[:, 3].max(), inside, atol=3e-4)


def test_mesh_that_is_not_convex_takes_its_hull_or_parts(tmp_path):
    ring = trimesh.creation.torus(0.02, 0.008)
    shape = load_mesh(write(ring, tmp_path / "ring.obj"))
    assert "not convex" in shape.notes[0] and "list" in shape.notes[0]
    assert np.isclose(shape.volume, ring.volume, rtol=1e-6)  # the mass is the mesh's own
    moments = np.linalg.eigvalsh(ring.moment_inertia / ring.mass)  # ascending
    np.testing.assert_allclose(moments, np.sort(np.diag(shape.inertia_unit)), rtol=1e-5)
    low, high = trimesh.creation.box((0.06, 0.02, 0.02)), trimesh.creation.box((0.02, 0.02, 0.06))
    high.apply_translation((0.02, 0, 0.02))
    parts = load_mesh([write(low, tmp_path / "low.stl"), write(high, tmp_path / "high.stl")])
    assert len(parts.hulls) == 2 and parts.notes == ()
    assert np.isclose(parts.volume, 2 * 24e-6 - 8e-6)  # the overlap counts once


def test_mesh_turned_inside_out_is_turned_back(tmp_path):
    box = trimesh.creation.box((0.06, 0.04, 0.03))
    box.invert()
    shape = load_mesh(write(box, tmp_path / "box.stl"))
    assert shape.volume > 0 and "looked inward" in shape.notes[0]


def bad_mesh(kind: str) -> trimesh.Trimesh:
    box = trimesh.creation.box((0.06, 0.04, 0.03))
    faces = np.array(box.faces)
    if kind == "hole":
        faces = faces[:-1]
    elif kind == "winding":
        faces[0] = faces[0][::-1]
    elif kind == "flat":
        return trimesh.Trimesh([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]], [[0, 1, 2], [0, 2, 1]], process=False)
    elif kind == "millimetres":
        box.apply_scale(1000)
    elif kind == "tiny":
        box.apply_scale(0.001)
    return trimesh.Trimesh(box.vertices, faces, process=False)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("hole", "not watertight, 3 of 18 edges"),
        ("winding", "inconsistent winding at 3 of 18 edges"),
        ("flat", "no volume"),
        ("millimetres", "probably in millimetres: pass object_scale=0.001 "),
        ("tiny", "allowed 5 to 300 mm; pass a scale"),
    ],
)
def test_bad_mesh_is_named(tmp_path, kind, said):
    path = write(bad_mesh(kind), tmp_path / f"{kind}.stl")
    with pytest.raises(UserError) as caught:
        load_mesh(path)
    message = str(caught.value)
    assert path in message and said in message and "\n" not in message


def test_bad_files_and_arguments(tmp_path):
    (tmp_path / "text.stl").write_text("not a mesh")
    (tmp_path / "text.xyzzy").write_text("not a mesh")
    good = write(trimesh.creation.box((0.05, 0.05, 0.05)), tmp_path / "good.stl")
    for path, scale, said in (
        (tmp_path / "none.stl", 1.0, "does not exist"),
        (tmp_path / "text.stl", 1.0, "text.stl"),
        (tmp_path / "text.xyzzy", 1.0, "cannot be read"),
        (good, 0.0, "must be a positive number"),
        (good, float("nan"), "must be a positive number"),
        (good, 0.001, "pass object_scale=1 "),
        ([good] * 4, 1.0, "4 files given, allowed 1 to 3"),
    ):
        with pytest.raises(UserError, match=said) as caught:
            load_mesh(path, scale)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["rock", "bracket", "peanut", "cross"])
def test_contact_sees_the_surface_that_touch_sees(name):
    """MuJoCo's distance from a small ball to the hulls is the exact distance that the grid is baked from."""
    shape, radius = library()[name], 0.004
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    for k, hull in enumerate(shape.hulls):
        spec.add_mesh(name=f"hull{k}", uservert=hull.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull{k}", name=f"hull{k}")
    probe = spec.worldbody.add_body(mocap=True)
    probe.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], name="ball")
    model = spec.compile()
    data = mujoco.MjData(model)
    points = np.random.default_rng(0).uniform(-0.04, 0.04, (150, 3))
    exact = signed_distance(shape.hulls, points)
    free = exact > radius + 5e-4
    assert free.sum() > 30
    for point, distance in zip(points[free], exact[free], strict=True):
        data.mocap_pos[0] = point
        mujoco.mj_forward(model, data)
        ball = model.geom("ball").id
        seen = [mujoco.mj_geomDistance(model, data, ball, g, 0.2, None) for g in range(model.ngeom) if g != ball]
        assert abs(min(seen) - (distance - radius)) < 1e-7
