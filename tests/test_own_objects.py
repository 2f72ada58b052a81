"""A user's own objects: meshes split, felt, cached, named in settings, refused."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from dexsim import import_object
from dexsim.assets.objects import decompose, library, mesh, own, parts
from dexsim.assets.objects.geometry import _triangle_distance, signed_distance
from dexsim.cli import objects as settings
from dexsim.errors import UserError
from dexsim.sim.scene import SLOTS, hand_object_scene
from dexsim.tasks.env import HandEnv
from dexsim.tasks.grasp import GraspEnv
from dexsim.tasks.rotate import RotateEnv
from dexsim.tasks.rotate_fingertips import FingertipEnv


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("DEXSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
    own._cached.cache_clear()


def box(half, centre=(0.0, 0.0, 0.0)) -> np.ndarray:
    return np.array(centre) + np.array(half) * (np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1)


def u_shape() -> list[np.ndarray]:
    """Return a U of three bars that touch and do not overlap, 60 mm wide."""
    return [box((0.03, 0.015, 0.005), (0, 0, -0.025)), box((0.006, 0.015, 0.02), (-0.024, 0, 0)),
            box((0.006, 0.015, 0.02), (0.024, 0, 0))]  # fmt: skip


def u_mesh() -> trimesh.Trimesh:
    outline = np.array([(-30, -30), (30, -30), (30, 20), (18, 20), (18, -20), (-18, -20), (-18, 20), (-30, 20)]) * 1e-3
    faces = [(0, 1, 4), (0, 4, 5), (1, 2, 4), (2, 3, 4), (0, 5, 6), (0, 6, 7)]
    low = np.insert(outline, 1, -0.015, axis=1)
    high = np.insert(outline, 1, 0.015, axis=1)
    n = len(outline)
    sides = [t for k in range(n) for t in ((k, (k + 1) % n, k + n), ((k + 1) % n, (k + 1) % n + n, k + n))]
    solid = trimesh.Trimesh(np.concatenate([low, high]), [(a, c, b) for a, b, c in faces]
                            + [(a + n, b + n, c + n) for a, b, c in faces] + sides, process=True)  # fmt: skip
    solid.fix_normals()
    assert solid.is_watertight and solid.volume > 0
    return solid


def test_cuts_between_parts_are_no_surface():
    """Eight small cubes that touch are one cube."""
    small = [box((0.01,) * 3, c) for c in 0.01 * (np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1)]
    points = np.random.default_rng(0).uniform(-0.025, 0.025, (4000, 3))
    exact = signed_distance([box((0.02,) * 3)], points)
    found = parts.distance(small, points)
    inside = exact < 0
    np.testing.assert_allclose(found[inside], exact[inside], atol=4e-4)
    assert np.abs(found[inside] - exact[inside]).mean() < 5e-5
    faces = ~inside & ((np.abs(points) > 0.02).sum(axis=1) == 1)
    np.testing.assert_allclose(found[faces], exact[faces], atol=1e-9)
    assert (found[~inside] <= exact[~inside] + 1e-9).all() and (found[~inside] > 0).all()
    # cut by cut, without that, the middle of the cube would lie on a surface
    assert parts.distance(small, np.zeros((1, 3)) + 1e-4)[0] < -0.019


@pytest.mark.slow
def test_a_hollow_mesh_is_split_and_its_notch_stays_open(tmp_path, monkeypatch):
    path = tmp_path / "u.stl"
    u_mesh().export(path)
    monkeypatch.setattr(decompose, "decompose", lambda *a: u_shape())
    shape = own.own_shape(str(path), parts=8)
    assert len(shape.hulls) == 3 and shape.true_size and shape.name == str(path)
    assert shape.volume == pytest.approx(u_mesh().volume, rel=1e-6)
    middle = (np.array([[0.0, 0.0, 0.005]]) - shape.file_centre) @ shape.file_axes
    assert shape.grid.sample(middle)[0] == pytest.approx(0.018, abs=1e-3)  # to the walls, not inside
    wall = (np.array([[0.024, 0.0, -0.0195]]) - shape.file_centre) @ shape.file_axes  # in the wall, at the cut
    assert shape.grid.sample(wall)[0] == pytest.approx(-0.006, abs=6e-4)
    assert any("split into 3 convex parts" in n for n in shape.notes)
    hull = own.own_shape(str(path), parts=1)
    assert len(hull.hulls) == 1 and hull.grid.sample(middle)[0] < 0


def mug_of_bodies() -> trimesh.Trimesh:
    """Return a mug as CAD programs write it: wall, bottom and handle closed each, with faces in common."""
    wall = trimesh.creation.annulus(r_min=0.03, r_max=0.035, height=0.08, sections=32)
    bottom = trimesh.creation.cylinder(0.03, 0.005, sections=32)
    bottom.apply_translation((0, 0, -0.0375))
    handle = trimesh.creation.box((0.02, 0.008, 0.05))
    handle.apply_translation((0.045, 0, 0))
    return trimesh.util.concatenate([wall, bottom, handle])


def test_a_mug_of_bodies_that_share_faces_is_split_body_by_body(tmp_path, monkeypatch):
    taken = []

    def run_coacd(given, max_convex_hull, **_):
        taken.append((trimesh.Trimesh(*given), max_convex_hull))
        return [given]

    monkeypatch.setitem(sys.modules, "coacd", SimpleNamespace(
        Mesh=lambda v, f: (v, f), run_coacd=run_coacd, set_log_level=lambda _: None))  # fmt: skip
    monkeypatch.setattr(decompose, "available", lambda: True)
    mug = mug_of_bodies()
    mug.merge_vertices()
    hulls = decompose.decompose(mug.vertices, np.asarray(mug.faces), 8, "mug.stl")
    ((wall, room),) = taken
    assert wall.is_watertight and wall.volume == pytest.approx(np.pi * (0.035**2 - 0.03**2) * 0.08, rel=0.01)
    assert room == 6 and len(hulls) == 3  # bottom and handle are convex, the wall has the rest
    volumes = sorted(ConvexHull(h).volume for h in hulls)
    assert volumes[0] == pytest.approx(0.02 * 0.008 * 0.05) and volumes[1] == pytest.approx(1.4e-5, rel=0.02)
    with pytest.raises(UserError, match="mug.stl: is made of 3 closed bodies.*object_hulls=12"):
        decompose.decompose(mug.vertices, np.asarray(mug.faces), 2, "mug.stl")


@pytest.mark.slow
def test_what_was_worked_out_is_kept_and_a_broken_cache_is_made_anew(tmp_path, monkeypatch):
    path = tmp_path / "u.stl"
    u_mesh().export(path)
    monkeypatch.setattr(decompose, "decompose", lambda *a: u_shape())
    first = own.own_shape(str(path))
    own._cached.cache_clear()

    def not_again(*a):
        raise AssertionError("worked out twice")

    monkeypatch.setattr(mesh, "load_mesh", not_again)
    again = own.own_shape(str(path))
    np.testing.assert_array_equal(first.grid.data, again.grid.data)
    np.testing.assert_allclose(np.concatenate(first.hulls), np.concatenate(again.hulls), atol=1e-9)
    monkeypatch.undo()
    monkeypatch.setenv("DEXSIM_CACHE", str(own.cache_folder().parent))
    for saved in own.cache_folder().glob("*.npz"):
        saved.write_bytes(saved.read_bytes()[:100])
    own._cached.cache_clear()
    monkeypatch.setattr(decompose, "decompose", lambda *a: u_shape())
    assert own.own_shape(str(path)).volume == pytest.approx(first.volume)


def test_without_coacd_a_hollow_mesh_is_refused_and_a_convex_one_is_not(tmp_path, monkeypatch):
    monkeypatch.setattr(decompose, "available", lambda: False)
    u_mesh().export(tmp_path / "u.stl")
    trimesh.creation.box((0.05, 0.04, 0.03)).export(tmp_path / "block.stl")
    with pytest.raises(UserError, match=r"u\.stl.*pip install coacd.*object_hulls=1"):
        own.own_shape(str(tmp_path / "u.stl"))
    assert len(own.own_shape(str(tmp_path / "block.stl")).hulls) == 1


def test_names_paths_and_folders(tmp_path):
    for name in ("b.stl", "a.stl"):
        trimesh.creation.box((0.05, 0.04, 0.03)).export(tmp_path / name)
    (tmp_path / "notes.txt").write_text("x")
    assert own.expand(["box", str(tmp_path)]) == ["box", str(tmp_path / "a.stl"), str(tmp_path / "b.stl")]
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="neither object.npz .* nor meshes"):
        own.expand([str(tmp_path / "empty")])
    found = own.named(
        {"train": ["box", str(tmp_path / "a.stl")], "held_out": ["cross"], "own": {"scale": 1.0, "hulls": 4}}
    )
    assert list(found) == ["box", str(tmp_path / "a.stl"), "cross"]
    with pytest.raises(UserError, match="no shape 'mugg'"):
        own.named({"train": ["mugg"], "held_out": []})
    with pytest.raises(UserError, match="does not exist"):
        own.named({"train": ["gone.stl"], "held_out": []})


def _plain(**given):
    task = {"name": "grasp", "objects": {"train": ["box"], "held_out": ["cross"]}}
    return {"objects": None, "kept_out": None, "object_scale": 1.0, "object_hulls": 16, "task": task} | given


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"objects": 3}, "objects=3: must be a list"),
        ({"objects": ["cross"]}, "kept_out: 'cross' is trained on as well"),
        ({"objects": ["box"], "object_scale": 0}, "object_scale=0: must be a positive number"),
        ({"objects": ["box"], "object_hulls": 99}, "object_hulls=99: must be a whole number from 1 to 32"),
        ({"objects": ["box"], "task": {"name": "press"}}, "task=press: no such task; task can be grasp"),
        (
            {"kept_out": ["m.stl"], "task": {"name": "rotate"}, "choices": {"task": "rotate_fingertips"}},
            "kept_out=.*task=rotate_fingertips.*kept_out= is for tasks that take others",
        ),
    ],
)
def test_wrong_settings(given, said):
    with pytest.raises(UserError, match=said):
        settings.apply(_plain(**given))


@pytest.mark.parametrize(
    ("kind", "takes"), [(GraspEnv, True), (RotateEnv, True), (FingertipEnv, False), (HandEnv, False)]
)
def test_a_task_made_from_another_takes_objects_as_that_does(monkeypatch, kind, takes):
    """By its class, whatever it is called."""
    monkeypatch.setattr("dexsim.tasks.registry.task_class", lambda cfg: type("Lift", (kind,), {}))
    plain = _plain(objects=["box"], kept_out=["cross"])
    plain["task"]["name"] = "lift"
    if takes:
        settings.apply(plain)
        assert plain["task"]["objects"]["own"] == {"scale": 1.0, "hulls": 16}
    else:
        with pytest.raises(UserError, match="task=lift has its own object.*TAKES_OBJECTS = True"):
            settings.apply(plain)


def test_settings_reach_the_task(tmp_path):
    trimesh.creation.box((50, 40, 30)).export(tmp_path / "block.stl")
    plain = _plain(objects=[str(tmp_path)], kept_out=["box"], object_scale=0.001)
    settings.apply(plain)
    objects = plain["task"]["objects"]
    assert objects == {
        "train": [str(tmp_path / "block.stl")],
        "held_out": ["box"],
        "own": {"scale": 0.001, "hulls": 16},
    }
    settings.apply(plain)  # a resumed run has them already
    assert plain["task"]["objects"] == objects
    np.testing.assert_allclose(sorted(own.named(objects)[objects["train"][0]].extents), [0.03, 0.04, 0.05])
    untouched = _plain()
    settings.apply(untouched)
    assert untouched == _plain()


def test_a_scene_has_a_slot_for_every_part_and_true_sizes():
    import mujoco

    def hand() -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        spec.worldbody.add_body(name="hand").add_geom(size=[0.01, 0, 0])
        return spec

    many = replace(
        library()["rock"], name="many", hulls=[box((0.01,) * 3, (0.03 * k, 0, 0)) for k in range(5)], true_size=True
    )
    scene = hand_object_scene(hand(), [library()["box"], many, library()["rock"]], [1.25, 1.5], 0.005)
    assert scene.slots == (*SLOTS, "object_hull3", "object_hull4") and scene.dataid.shape == (4, 8)
    assert [v.scale for v in scene.variants] == [1.0, 1.0, 1.25, 1.5]
    near = np.linalg.norm(scene.pos, axis=2) < 1
    assert near.sum(axis=1).tolist() == [1, 5, 1, 1]
    plain = hand_object_scene(hand(), [library()["box"], library()["rock"]], [1.25], 0.005)
    assert plain.slots == SLOTS  # nothing changes where nothing of a user's own is named


@pytest.mark.slow
def test_import_object_writes_what_a_task_takes(tmp_path, capsys, monkeypatch):
    u_mesh().export(tmp_path / "u.stl")
    monkeypatch.setattr(decompose, "decompose", lambda *a: u_shape())
    out = tmp_path / "objects" / "u"
    assert import_object.main([str(tmp_path / "u.stl"), f"out={out}"]) == 0
    assert {p.name for p in out.iterdir()} >= {"object.npz", "picture.png", "part_0.obj", "part_2.obj"}
    assert "3 convex part(s)" in capsys.readouterr().out
    wall = trimesh.load(out / "part_1.obj")
    # the file's frame
    np.testing.assert_allclose(wall.bounds, [[-0.030, -0.015, -0.02], [-0.018, 0.015, 0.02]], atol=1e-5)
    shape = own.named({"train": [str(out)], "held_out": []})[str(out)]
    assert len(shape.hulls) == 3 and shape.name == str(out)
    assert import_object.main([str(tmp_path / "u.stl"), f"out={out}"]) == 0  # its own files it may write again
    (out / "object.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(UserError, match="import the mesh again"):
        own.named({"train": [str(out)], "held_out": []})


def test_import_object_refuses(tmp_path):
    trimesh.creation.box((80, 60, 40)).export(tmp_path / "mug.stl")
    with pytest.raises(UserError, match=r"8e\+04 mm.*millimetres: .*import-object: scale=0\.001"):
        import_object.main([str(tmp_path / "mug.stl"), f"out={tmp_path / 'o'}"])
    with pytest.raises(UserError, match="out=FOLDER"):
        import_object.main([str(tmp_path / "mug.stl")])
    with pytest.raises(UserError, match="expected key=value"):
        import_object.main([str(tmp_path / "mug.stl"), "colour=red"])
    assert not (tmp_path / "o").exists()


BALL = 0.006  # m, radius of the ball that looks for contact
BAND = 0.008  # m from the mesh to the ball's surface, at most


def winding(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the winding number [P] of a closed surface about points [P, 3]: 1 inside, 0 outside (Van Oosterom and
    Strackee 1983, The solid angle of a plane triangle)."""
    out = np.empty(len(points))
    for k, p in enumerate(points):
        a, b, c = (triangles[:, i] - p for i in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        over = np.einsum("ti,ti->t", a, np.cross(b, c))
        under = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        out[k] = 2 * np.arctan2(over, under).sum() / (4 * np.pi)
    return out


def mesh_distance(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the exact signed distance [P] m, negative inside."""
    far = np.concatenate([_triangle_distance(points[k : k + 1000], triangles) for k in range(0, len(points), 1000)])
    return np.where(winding(points, triangles) > 0.5, -far, far)


def places(triangles: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Centres [count, 3] of balls about a surface."""
    rng = np.random.default_rng(seed)
    size = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    chosen = triangles[rng.choice(len(triangles), count, p=size / size.sum())]
    points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), count), chosen)
    way = rng.normal(size=(count, 3))
    return points + way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0, BALL + BAND, (count, 1))


def model_of(shape):
    """Return the object, fixed, and a ball."""
    spec = mujoco.MjSpec()
    for k, hull in enumerate(shape.hulls):
        spec.add_mesh(name=f"part{k}", uservert=np.asarray(hull).ravel())
        spec.worldbody.add_geom(name=f"part{k}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part{k}")
    ball = spec.worldbody.add_body(name="ball", pos=[0, 0, 0.2])
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BALL, 0, 0], density=1000)
    return spec.compile()


def contact_distance(shape, centres):
    """Return what MuJoCo measures [P] m from the ball's surface to the nearest of the object's geoms."""
    spec_model = model_of(shape)
    data = mujoco.MjData(spec_model)
    body, ball = spec_model.body("ball").id, spec_model.geom("ball").id
    out = np.full(len(centres), np.inf)
    for k, centre in enumerate(centres):
        spec_model.body_pos[body] = centre
        mujoco.mj_kinematics(spec_model, data)
        for g in range(len(shape.hulls)):
            out[k] = min(out[k], mujoco.mj_geomDistance(spec_model, data, g, ball, 1.0, None))
    return out


@pytest.mark.slow
def test_a_pipe_split_by_coacd_is_open_for_contact_and_touch(tmp_path):
    pytest.importorskip("coacd")
    solid = trimesh.creation.annulus(r_min=0.018, r_max=0.026, height=0.07, sections=24)
    solid.export(tmp_path / "pipe.stl")
    error = {}
    for most in (1, 16):
        shape = own.own_shape(str(tmp_path / "pipe.stl"), parts=most)
        triangles = (np.asarray(solid.triangles) - shape.file_centre) @ shape.file_axes
        centres = places(triangles, 300)
        true = mesh_distance(centres, triangles)
        centres, true = centres[true > 0.004], true[true > 0.004]
        error[most] = np.abs(contact_distance(shape, centres) - (true - BALL)).mean()
    assert error[16] < 0.1 * error[1] and error[16] < 5e-4
