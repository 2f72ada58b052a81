"""A hand of a robot's file: what is found, guessed, checked, written; what a person corrects; what is refused."""

from __future__ import annotations

import csv
import re
import shutil
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh
import yaml
from scipy.spatial import ConvexHull

from dexsim import outputs
from dexsim.cli import stable_grasps
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.hand.places import places
from dexsim.import_hand import command, drop_region, geometry, importing, moves, poses, shapes, taxels
from dexsim.import_hand.importing import Settings, import_hand
from dexsim.surface import geom_surface
from dexsim.tactile.layout import hand_layout
from dexsim.tasks import held_drops, make_fingertip_grasps
from dexsim.tasks.reach import Reach
from dexsim.tasks.stable_grasps import GraspSet
from tests import hands
from tests.made_hand import made_hand


@pytest.fixture(scope="module", autouse=True)
def nothing_dropped():
    """Yield the search for where objects are held, which takes half a minute, has a test of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importing, "DROPS", 0)
        yield


@pytest.fixture(scope="module")
def claw(tmp_path_factory) -> Path:
    """Return the made-up hand imported once; not to be changed."""
    place = tmp_path_factory.mktemp("claw")
    import_hand(hands.write(place / "robot"), place / "hand", picture=False)
    return place / "hand"


@pytest.fixture
def one_start(monkeypatch):
    """One of the starts of the search for a cupped pose, of which `claw` takes all: for tests of something else."""
    monkeypatch.setattr(poses, "STARTS", 1)


def test_what_the_tree_and_the_axes_say(claw):
    hand = load_hand(claw)
    assert [f.name for f in hand.fingers] == ["thumb", "index", "middle", "ring"]
    assert [hand.joints[j] for j in hand.fingers[0].joints] == ["thumb_turn", "thumb_1", "thumb_2"]
    assert [hand.joints[j] for j in hand.fingers[0].flexion] == ["thumb_1", "thumb_2"]
    assert [hand.joints[j] for j in hand.fingers[2].flexion] == ["middle_1", "middle_2"]
    assert all(c == 1 for f in hand.fingers for c in f.closes)
    assert hand.opposing == (0,) and hand.handedness == "right" and hand.palm_body == "base"
    np.testing.assert_allclose(hand.file.palm.forward, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(hand.file.palm.normal, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(hand.fingers[1].normal, [0, 0, 1], atol=0.02)  # a finger's tip looks where it closes to
    assert 0.02 < hand.fingers[1].position[0] < 0.045 and abs(hand.fingers[1].position[1]) < 1e-3
    assert (hand.efforts == 0.6).all() and (hand.speeds == 7).all()  # the file's own <limit effort= velocity=>


def test_a_gripper_with_slides_looks_along_its_fingers(one_start, tmp_path):
    links = ""
    for name, side in (("left", 1), ("right", -1)):
        inertia = hands._inertial(0.05, (0.06, 0.012, 0.02), (0.05, 0, 0))
        links += (
            f'<link name="{name}">{inertia}' + hands._shape('<box size="0.06 0.012 0.02"/>', (0.05, 0, 0)) + "</link>"
        )
        joint = hands._joint(f"slide_{name}", "base", name, f"0.03 {0.05 * side} 0", f"0 {-side} 0", 0.0, 0.04)
        links += joint.replace("revolute", "prismatic")
    base = hands._inertial(0.5, (0.06, 0.12, 0.04), (0, 0, 0)) + hands._shape('<box size="0.06 0.12 0.04"/>', (0, 0, 0))
    path = tmp_path / "gripper.urdf"
    path.write_text(f'<robot name="gripper"><link name="base">{base}</link>{links}</robot>')
    result = import_hand(path, tmp_path / "hand", picture=False)
    hand = load_hand(tmp_path / "hand")
    np.testing.assert_allclose(hand.file.palm.normal, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(np.abs(hand.file.palm.forward), [0, 1, 0], atol=1e-6)
    assert result.hand["handedness"] == "none" and len(hand.joints) == 2
    drive = yaml.safe_load((tmp_path / "hand" / "servo.yaml").read_text())["joints"]["slide_left"]
    assert drive["kp"] * 0.04 == pytest.approx(drive["torque_limit"] / 0.178, rel=0.01)  # a slide's travel is no radian
    assert all(m.closer > 0.002 for m in moves.moves(hand))


def test_mirrored_it_is_a_left_hand(one_start, tmp_path):
    result = import_hand(hands.write(tmp_path / "robot", mirrored=True), tmp_path / "hand", picture=False)
    assert result.hand["handedness"] == "left"


def _depth(model: mujoco.MjModel, q: np.ndarray) -> float:
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return max((-c.dist for c in data.contact[: data.ncon]), default=0.0)


def test_fingertips_approach_each_other_and_no_link_is_in_another(claw):
    hand = load_hand(claw)
    model = hand.spec().compile()
    ids = [int(model.joint(j).qposadr[0]) for j in hand.joints]
    gaps, facing = [], []
    for name in ("open", "cupped"):
        data = mujoco.MjData(model)
        data.qpos[ids] = hand.pose(name)
        mujoco.mj_kinematics(model, data)
        at = np.array(
            [data.body(f.body).xpos + data.body(f.body).xmat.reshape(3, 3) @ f.position for f in hand.fingers]
        )
        normals = np.array([data.body(f.body).xmat.reshape(3, 3) @ f.normal for f in hand.fingers])
        gaps.append(np.linalg.norm(at[0] - at[1:].mean(0)))
        way = at[1:].mean(0) - at[0]
        facing.append(normals[0] @ way / np.linalg.norm(way))
        assert _depth(model, data.qpos) < 0.002
        if name == "cupped":
            assert (at[:, 2] > 0.012).all()  # before the palm, which is 12 mm thick from its frame on
    assert gaps[1] < 0.6 * gaps[0] and facing[1] > 0.5
    assert hand.span == pytest.approx(0.085, abs=1e-3) and hand.span < gaps[0]  # its fingers are 45 and 40 mm long


def test_fingertips_are_laid_against_the_sides_of_a_cube(claw):
    hand = load_hand(claw)
    reach, middle = Reach(hand, np.random.default_rng(0)), hand_layout(hand).centre()
    edge, yaw = 0.55 * hand.span, 1.3
    centre = places(hand).catch + [0.0, 0.0, edge / 2]
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    model, found = hand.compiled, 0
    for k, finger in enumerate(hand.fingers):
        rows = reach.fitting(k, centre, yaw, edge)
        found += len(rows) > 0
        for row in rows[:3]:
            data = mujoco.MjData(model)
            for j, angle in zip(finger.joints, reach.q[k][row], strict=True):
                data.joint(hand.joints[j]).qpos[0] = angle
            mujoco.mj_kinematics(model, data)
            body = data.body(finger.body)
            pad, out = body.xpos + body.xmat.reshape(3, 3) @ middle[k], body.xmat.reshape(3, 3) @ finger.normal
            at = (pad - centre) @ turn
            face = int(np.abs(at[:2]).argmax())
            assert abs(at[face]) == pytest.approx(edge / 2, abs=0.011) and abs(at[2]) < edge / 2
            assert -np.sign(at[face]) * (out @ turn)[face] > 0.5  # the pad looks at the face
    assert found >= 2
    assert not len(reach.fitting(0, centre + [0.0, 0.0, 5 * hand.span], yaw, edge))


def _briefly(real, *args):
    """Return what a search keeps after a moment, whether it holds or not."""
    out = real(*args)
    return (out[0], torch.ones_like(out[1])) if isinstance(out, tuple) else torch.ones_like(out)


@pytest.mark.slow
def test_fingertips_alone_take_hold_of_opposite_faces(claw, tmp_path, monkeypatch):
    """Whatever the hand: an opposing finger on one face, two others on the other, forces that sum to zero."""
    hand, rng = load_hand(claw), np.random.default_rng(0)
    pads = make_fingertip_grasps.Pads(hand, rng)
    sizes = (0.4 * hand.span, 0.6 * hand.span)
    grasps, share = make_fingertip_grasps.candidates(3, sizes, pads, rng)
    assert np.abs(share.sum(1).numpy()).max() < 1e-12 and (share[:, 0].norm(dim=1) > 0).all()
    assert ((share[:, 1:].norm(dim=2) > 0).sum(1) >= 2).all()
    low, high = hand.limits.T
    assert ((grasps.hand.numpy() >= low - 1e-5) & (grasps.hand.numpy() <= high + 1e-5)).all()
    with pytest.raises(UserError, match="no opposing finger and 2 others reach opposite faces"):
        make_fingertip_grasps.candidates(1, (5 * hand.span, 6 * hand.span), pads, rng)
    for part in ("settle", "holds"):  # both are physics of seconds; what is around them runs as it is
        real = getattr(make_fingertip_grasps, part)
        monkeypatch.setattr(make_fingertip_grasps, part, partial(_briefly, real))
    monkeypatch.setattr(make_fingertip_grasps, "FIRM", 0.05)
    for name in ("WEIGHTLESS", "HOLD"):
        monkeypatch.setattr(make_fingertip_grasps, name, 0.05)
    wanted = ["hold=fingertips", f"hand={claw}", "count=2", "worlds=3", "sim.threads=1", f"out={tmp_path / 'held.npz'}"]
    assert stable_grasps.main(wanted) == 0
    assert GraspSet.load(tmp_path / "held.npz").hand.shape == (2, len(hand.joints))


def test_shapes_are_capsules_and_cores_with_the_rubbers_margin(claw):
    hand = load_hand(claw)
    model = hand.spec().compile()
    kinds = {"link": set(), "tip": set()}
    for g in range(model.ngeom):
        if model.geom_contype[g]:
            kinds["tip" if model.geom(g).name.startswith("tip_") else "link"].add(int(model.geom_type[g]))
    assert kinds == {"link": {int(mujoco.mjtGeom.mjGEOM_CAPSULE)} | kinds["link"] & {int(mujoco.mjtGeom.mjGEOM_SPHERE)},
                     "tip": {int(mujoco.mjtGeom.mjGEOM_MESH)}}  # fmt: skip
    for finger in hand.fingers:
        g = model.geom(finger.geoms[0]).id
        assert model.geom_margin[g] == pytest.approx(shapes.MARGIN)
        core = geom_surface(model, g)[0]
        assert len(core) <= shapes.CORNERS
        skin = np.array([[float(x) for x in line.split()[1:]] for line in
                         (claw / f"skin_{finger.name}.obj").read_text().splitlines() if line[0] == "v"])  # fmt: skip
        planes = ConvexHull(skin).equations
        inside = -(core @ planes[:, :3].T + planes[:, 3]).max(1)
        assert (inside > shapes.MARGIN - 2e-5).all() and inside.min() < shapes.MARGIN + 3e-4


def test_taxels_lie_on_the_palmar_side_and_cover_it(claw):
    with open(claw / "taxels_middle.csv", newline="") as f:
        rows = list(csv.DictReader(f))
    point = np.array([[float(r[c]) for c in "xyz"] for r in rows])
    normal = np.array([[float(r[c]) for c in ("nx", "ny", "nz")] for r in rows])
    assert len(rows) == 48 and (point[:, 2] > 0).all() and (normal[:, 2] > taxels.STEEPEST - 0.1).all()
    # the tip is a capsule of 7.5 mm along x: on its side, this far from its axis (its facets sag 0.37 mm)
    straight = (point[:, 0] > 0.0135) & (point[:, 0] < 0.036)
    assert np.linalg.norm(point[straight, 1:], axis=1) == pytest.approx(0.0075, abs=4e-4)
    lattice = point.reshape(6, 8, 3)
    assert (np.diff(lattice[:, :, 0], axis=1) > 0).all()  # rows run from the joint to the tip
    spread = np.ptp(point, axis=0)
    assert spread[0] > 0.008 and spread[1] > 0.008
    area = sum(float(r["area"]) for r in rows)
    assert area > 0.8 * spread[0] * spread[1]


def test_a_second_run_changes_nothing(claw, tmp_path):
    shutil.copytree(claw.parent, tmp_path / "all")
    hand = tmp_path / "all" / "hand"
    before = {p.relative_to(hand): p.read_bytes() for p in hand.rglob("*") if p.is_file() and p.name != ".import.json"}
    result = import_hand(tmp_path / "all" / "robot" / "claw.urdf", hand, picture=False)
    after = {p.relative_to(hand): p.read_bytes() for p in hand.rglob("*") if p.is_file() and p.name != ".import.json"}
    assert before == after and result.corrected == [] and result.carried == []


def test_what_a_person_corrects_stays_and_is_no_guess_any_more(claw, one_start, tmp_path):
    shutil.copytree(claw.parent, tmp_path / "all")
    hand = tmp_path / "all" / "hand"
    text = (hand / "hand.yaml").read_text()
    content = yaml.safe_load(text)
    effort = content["joints"][0]["effort"]
    content["joints"][0]["effort"] = effort + 0.3
    content["joints"] = [*content["joints"][3:], *content["joints"][:3]]  # another order on the wire
    content["poses"]["cupped"]["thumb_turn"] = 1.9
    content["palm"]["position"] = [0.01, 0.0, 0.012]
    content["fingers"][1]["name"] = "pointer"
    content["joints"][2]["armature"] = 3e-4  # optional places, which the importer itself does not fill
    content["places"] = {"catch": [0.05, 0.0, 0.02]}
    content["guessed"].remove("fingers.middle.tip.normal")  # confirmed as it is
    (hand / "hand.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    (hand / "servo.yaml").write_text((hand / "servo.yaml").read_text() + "# measured\n")
    (hand / "notes.txt").write_text("mine")
    with outputs.staged(hand) as stage:  # as `check` does
        (stage / "check.png").write_bytes(b"a picture")
    result = import_hand(tmp_path / "all" / "robot" / "claw.urdf", hand, picture=False)
    now = yaml.safe_load((hand / "hand.yaml").read_text())
    assert now["joints"][-3] == {"name": "thumb_turn", "effort": pytest.approx(effort + 0.3), "speed": 7}
    assert now["palm"]["position"] == [0.01, 0.0, 0.012]
    assert now["poses"]["cupped"]["thumb_turn"] == 1.9
    assert now["joints"][2]["armature"] == 3e-4 and now["places"] == {"catch": [0.05, 0.0, 0.02]}
    assert [f["name"] for f in now["fingers"]] == ["thumb", "pointer", "middle", "ring"]
    for place in ("palm.position", "fingers.middle.tip.normal"):
        assert place not in now["guessed"]
    assert "palm.normal" in now["guessed"] and "poses.cupped" in now["guessed"]
    assert sorted(result.carried) == ["notes.txt", "servo.yaml"] and "palm.position" in result.corrected
    assert (hand / "servo.yaml").read_text().endswith("# measured\n") and (hand / "notes.txt").read_text() == "mine"
    assert (hand / "check.png").read_bytes() == b"a picture"
    again = import_hand(tmp_path / "all" / "robot" / "claw.urdf", hand, picture=False)
    assert yaml.safe_load((hand / "hand.yaml").read_text()) == now, again.lines
    load_hand(hand)


def _broken(tmp_path: Path, change) -> Path:
    path = hands.write(tmp_path / "robot")
    path.write_text(change(path.read_text()))
    return path


BAD = {
    "missing mesh": (lambda t: t.replace("meshes/tip.stl", "meshes/gone.stl"), r"mesh meshes/gone\.stl: no such file"),
    "missing package": (
        lambda t: t.replace("meshes/tip.stl", "package://none/tip.stl"),
        r"package://none/tip\.stl: no such file.*packages=",
    ),
    "no inertia": (
        lambda t: t.replace(
            t[t.index("<inertial>", t.index("ring_far")) : t.index("</inertial>", t.index("ring_far")) + 11], "", 1
        ),
        r"link index_far without <inertial>.*density=",
    ),
    "zero limits": (
        lambda t: t.replace('lower="-0.2" upper="1.7"', 'lower="0" upper="0"', 1),
        r"joint 'index_1' has limits 0 to 0 rad; give it two, low < high",
    ),
    "limits the wrong way round": (
        lambda t: t.replace('lower="-0.2" upper="1.7"', 'lower="1.7" upper="-0.2"', 1),
        r"joint 'index_1' has limits 1.7 to -0.2 rad; give it two, low < high",
    ),
    "an effort below zero": (
        lambda t: t.replace('effort="0.6"', 'effort="-0.6"', 1),
        r"joint 'index_1': <limit effort=\"-0.6\">: must be a number above 0",
    ),
    "an effort that is no number": (
        lambda t: t.replace('effort="0.6"', 'effort="nan"', 1),
        r"joint 'index_1': <limit effort=\"nan\">: must be a number above 0",
    ),
    "an endless speed": (
        lambda t: t.replace('velocity="7"', 'velocity="inf"', 1),
        r"joint 'index_1': <limit velocity=\"inf\">: must be a number above 0.*rad/s",
    ),
    "a mass below zero": (
        lambda t: t.replace('mass value="0.3"', 'mass value="-0.3"', 1),
        r"link 'base': <mass value=\"-0.3\">: must be a number of kg",
    ),
    "an inertia of nothing": (
        lambda t: re.sub('ixx="[^"]*"', 'ixx="0"', t),
        r"9 moving links with moments of inertia that no body has.*'index_near' 0 .*'thumb_far'.*inertia=shapes",
    ),
    "an axis of nothing": (
        lambda t: t.replace('axis xyz="0 -1 0"', 'axis xyz="0 0 0"', 1),
        r"axis too small.*'index_1'.*must not be 0 0 0",
    ),
    "a parent that is not there": (
        lambda t: t.replace('<parent link="base"/>', '<parent link="bass"/>', 1), r"must name links of the file",
    ),
    "links in a ring": (
        lambda t: t.replace('<parent link="base"/><child link="index_near"/>',
                            '<parent link="index_far"/><child link="index_near"/>', 1), r"must be one tree",
    ),
    "degrees": (lambda t: t.replace('upper="1.7"', 'upper="97"', 1), r"joint 'index_1'.*in degrees"),
    "radians read as degrees": (
        lambda t: re.sub(r'(lower|upper)="([-0-9.]+)"', lambda x: f'{x[1]}="{np.deg2rad(float(x[2])):.5f}"', t),
        r"no joint turns farther than 0.0\d+ rad: .*read as degrees",
    ),
    "endless": (
        lambda t: t.replace('name="ring_1" type="revolute"', 'name="ring_1" type="continuous"'),
        r"joint 'ring_1' has no limits",
    ),
    "one name twice": (lambda t: t.replace("ring_far", "middle_far"), r"two links have the name 'middle_far'"),
    "millimetres": (lambda t: _scaled(t), r"longest finger is .* m, allowed .*millimetres"),
    "xacro": (
        lambda t: t.replace(
            '<robot name="claw">', '<robot name="claw" xmlns:xacro="http://x/xacro"><xacro:macro name="a"/>'
        ),
        r"run xacro",
    ),
    "xacro's value": (lambda t: t.replace('xyz="0.045 0 0"', 'xyz="${near} 0 0"', 1), r"run xacro"),
    "not finite": (
        lambda t: t.replace('xyz="0.045 0 0"', 'xyz="nan 0 0"', 1),
        r"position of 'index_far' is nan 0 0: must be numbers",
    ),
    "an encoding": (lambda t: '<?xml version="1.0" encoding="x-none"?>' + t.partition("?>")[2], r"is not XML"),
    "not XML": (lambda t: "solid tip\n", r"is not XML"),
    "not a robot": (lambda t: "<html/>", r"root element is <html>"),
    "one finger": (
        lambda t: "\n".join(
            line for line in t.splitlines() if not any(f in line for f in ("index", "middle", "thumb"))
        ),
        r"1 finger",
    ),
}


def _scaled(text: str) -> str:
    """Return a hand drawn in millimetres, read as metres."""

    def times(match: re.Match[str]) -> str:
        return f'{match[1]}="{" ".join(str(1000 * float(x)) for x in match[2].split())}"'

    return re.sub(r'\b(xyz|size|radius)="([-0-9. e]+)"(?=/>)', times, text).replace(
        'axis xyz="0.0 -1000.0 0.0"', 'axis xyz="0 -1 0"'
    )


@pytest.mark.parametrize("case", BAD)
def test_bad_files_get_one_line_and_nothing_is_written(case, tmp_path, monkeypatch, capfd):
    change, said = BAD[case]
    path = _broken(tmp_path, change)
    assert path.read_text() != hands.urdf(), "nothing was broken"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")  # MuJoCo writes its warnings where the user is
    with pytest.raises(UserError, match=said) as error:
        import_hand(path, tmp_path / "hand", picture=False)
    assert "\n" not in str(error.value) and (str(path) in str(error.value) or "mesh" in str(error.value))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["here", "robot"] and not any(Path().iterdir())
    assert capfd.readouterr() == ("", "")  # the line is the error's; no library adds one


@pytest.mark.parametrize(("old", "new", "said"), [
    ('damping="0.01"', 'damping="-0.01"', "damping of 'a_spread' is -0.01: must be numbers from 0"),
    ('armature="4e-4"', 'armature="nan"', "armature of 'a_spread' is nan: must be numbers from 0"),
    ('range="0 2.1"', 'range="0 0"', "joint 'a_curl' has no limits; give it two, low < high"),
    ('mass="0.015"', 'mass="-0.015"', "'a_end'.*a moving link without mass; give its <inertial>")])  # fmt: skip
def test_bad_figures_in_an_mjcf_get_one_line(old, new, said, tmp_path, monkeypatch, capfd):
    path = made_hand(tmp_path / "made", pads=False) / "made.xml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(UserError, match=said):
        import_hand(path, tmp_path / "hand", picture=False)
    assert not (tmp_path / "hand").exists() and not any(Path().iterdir()) and capfd.readouterr() == ("", "")


def test_of_a_tip_with_a_hole_the_hull_is_taken_or_it_is_refused(one_start, tmp_path):
    path = hands.write(tmp_path / "robot")
    hands.tip(tmp_path / "robot" / "meshes" / "tip.stl", hole=True)
    with pytest.raises(UserError, match=r"finger thumb: the mesh of its tip is not closed, \d+ edges"):
        import_hand(path, tmp_path / "hand", Settings(holes="refuse"), picture=False)
    assert not (tmp_path / "hand").exists()
    lines = import_hand(path, tmp_path / "hand", picture=False).lines
    assert sum("its mesh is not closed" in line for line in lines if line.startswith("pad")) == 4
    load_hand(tmp_path / "hand")


def test_self_collision_at_the_open_pose_is_refused_and_the_old_folder_stays(claw, one_start, tmp_path):
    shutil.copytree(claw.parent, tmp_path / "all")
    hand = tmp_path / "all" / "hand"
    content = yaml.safe_load((hand / "hand.yaml").read_text())
    loaded, rng = load_hand(hand), np.random.default_rng(0)
    model = loaded.spec().compile()
    ids = [int(model.joint(j).qposadr[0]) for j in loaded.joints]
    q = np.zeros(model.nq)
    while _depth(model, q) < 0.004:
        q[ids] = rng.uniform(*loaded.limits.T).round(3)
    content["poses"]["open"] = dict(zip(loaded.joints, map(float, q[ids])))
    (hand / "hand.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    before = {p: p.read_bytes() for p in hand.rglob("*") if p.is_file()}
    with pytest.raises(UserError, match=r"self-collision at the open pose: '.*' and '.*' overlap by [\d.]+ mm"):
        import_hand(tmp_path / "all" / "robot" / "claw.urdf", hand, picture=False)
    assert before == {p: p.read_bytes() for p in hand.rglob("*") if p.is_file()}
    assert sorted(p.name for p in hand.parent.iterdir()) == ["hand", "robot"]


def test_a_folder_that_is_not_ours_is_not_touched(tmp_path):
    path = hands.write(tmp_path / "robot")
    (tmp_path / "hand").mkdir()
    (tmp_path / "hand" / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="not a folder that import-hand wrote"):
        import_hand(path, tmp_path / "hand", picture=False)


@pytest.mark.slow
def test_coupled_joints_are_driven_alone_only_when_asked(one_start, tmp_path):
    path = hands.write(tmp_path / "robot")
    start, joint, rest = path.read_text().partition('<joint name="index_2"')
    path.write_text(start + joint + rest.replace("</joint>", '<mimic joint="index_1"/></joint>', 1))
    result = import_hand(path, tmp_path / "hand", Settings(coupled="independent", pads=None), picture=False)
    assert any("taken apart" in line and "index_2" in line for line in result.lines)
    assert "index_2" in load_hand(tmp_path / "hand").joints
    result = import_hand(path, tmp_path / "tied", Settings(pads=None), picture=False)
    assert any("coupled" in line and "index_2" in line for line in result.lines)
    assert load_hand(tmp_path / "tied").couplings.passive == ("index_2",)


def test_a_package_path_is_found_beside_and_above_the_file(one_start, tmp_path):
    robot = tmp_path / "claw"
    path = hands.write(robot / "urdf", mesh="package://claw/meshes/tip.stl")
    shutil.move(robot / "urdf" / "meshes", robot / "meshes")
    import_hand(path, tmp_path / "hand", Settings(pads=None), picture=False)
    assert not load_hand(tmp_path / "hand").touches
    away = tmp_path / "elsewhere" / "claw.urdf"
    away.parent.mkdir()
    shutil.copy(path, away)
    shutil.move(robot, tmp_path / "packages" / "claw")
    with pytest.raises(UserError, match="packages="):
        import_hand(away, tmp_path / "other", picture=False)
    import_hand(away, tmp_path / "other", Settings(packages=[tmp_path / "packages"], pads=None), picture=False)


def test_missing_inertia_from_a_density(one_start, tmp_path):
    path = _broken(tmp_path, BAD["no inertia"][0])
    import_hand(path, tmp_path / "hand", Settings(density=1000.0, pads=None), picture=False)
    model = load_hand(tmp_path / "hand").spec().compile()
    volume = trimesh.load(tmp_path / "robot" / "meshes" / "tip.stl").volume
    assert model.body("index_far").mass[0] == pytest.approx(1000 * volume, rel=0.02)


def test_absurd_figures_are_named(one_start, tmp_path):
    path = hands.write(tmp_path / "robot")
    text = path.read_text().replace('effort="0.6" velocity="7"', 'effort="600" velocity="7"', 1)
    at = text.index('<mass value="', text.index("ring_far"))
    text = text[:at] + '<mass value="20"/>' + text[text.index("/>", at) + 2 :]
    path.write_text(text)
    lines = "\n".join(import_hand(path, tmp_path / "hand", Settings(pads=None), picture=False).lines)
    assert "joint 'index_1': effort 600 N m is unusual" in lines
    assert "link 'ring_far': mass 20 kg: heavy for a finger; in grams?" in lines
    assert "link 'ring_far': inertia" in lines and "too small" in lines


def test_the_best_place_of_drops_is_in_the_middle_of_those_held():
    rng = np.random.default_rng(5)
    place = rng.uniform([0.0, -0.045], [0.09, 0.045], (256, 2))
    middle, start = np.array([0.06, 0.01]), np.array([0.03, -0.02])
    held = np.linalg.norm(place - middle, axis=1) < 0.03
    found = held_drops.Drops(place, held).best(1.0, start)
    assert np.linalg.norm(found - middle) < 0.012
    assert np.linalg.norm(found - start) < np.linalg.norm(middle - start)  # of those as good, the nearest to the start
    half = held_drops.Drops(place[:128], held[:128]) + held_drops.Drops(place[128:], held[128:])
    np.testing.assert_array_equal(half.best(1.0, start), found)
    for alike in (np.ones(256, bool), np.zeros(256, bool)):  # nothing speaks for another
        np.testing.assert_array_equal(held_drops.Drops(place, alike).best(1.0, start), start)
    spread = held_drops.scattered(middle, 0.02, 64, seed=3).numpy() - middle
    counts, *_ = np.histogram2d(*spread.T, bins=8, range=[[-0.02, 0.02]] * 2)
    assert (counts == 1).all()


@pytest.mark.slow
def test_where_objects_are_held_is_found(claw, tmp_path, monkeypatch):
    """From a place 45 mm beside the hand's middle, over no finger, back to where it holds them."""
    monkeypatch.setattr(drop_region, "WORLDS", 32)
    middle = places(load_hand(claw)).catch
    wrong = shutil.copytree(claw, tmp_path / "wrong")
    data = yaml.safe_load((wrong / "hand.yaml").read_text())
    data["places"] = {"catch": [float(middle[0]), float(middle[1]) + 0.045, float(middle[2])]}
    (wrong / "hand.yaml").write_text(yaml.safe_dump(data))
    found = drop_region.search(wrong, 64)
    assert found.catch is not None and found.middle is not None and found.drops == 32
    assert np.linalg.norm(found.catch[:2] - middle[:2]) < 0.02, found
    assert found.moved > 0.025 and found.catch[2] == pytest.approx(middle[2], abs=0.005)
    assert found.held > 20 and found.middle < 10, found


@pytest.mark.slow
def test_where_objects_are_let_fall_is_a_guess_and_a_persons_place_stays(one_start, tmp_path, monkeypatch):
    found = drop_region.Region(np.array([0.05, 0.004, 0.013]), 60, 64, 0.01, 50, 0.006)
    path = hands.write(tmp_path / "robot")
    monkeypatch.setattr(drop_region, "search", lambda folder, count: found)
    result = import_hand(path, tmp_path / "hand", Settings(pads=None, drops=96), picture=False)
    assert "places.catch" in result.hand["guessed"]
    np.testing.assert_allclose(places(load_hand(tmp_path / "hand")).catch, found.catch, atol=1e-4)
    assert result.lines[-1] == (
        "drops    60 of 64 objects let fall within 10 mm of (50 4) mm are held, 6 mm from the middle of the cupped"
        " pose, where 50 are"
    )
    file = tmp_path / "hand" / "hand.yaml"
    text = file.read_text()
    at = text.index("catch: [")
    file.write_text(text[:at] + "catch: [0.07, 0.01, 0.02]" + text[text.index("]", at) + 1 :])
    monkeypatch.setattr(drop_region, "search", None)
    result = import_hand(path, tmp_path / "hand", Settings(pads=None, drops=96), picture=False)
    assert "places.catch" in result.corrected and "places.catch" not in result.hand["guessed"]
    np.testing.assert_allclose(places(load_hand(tmp_path / "hand")).catch, [0.07, 0.01, 0.02])


def test_a_hand_that_holds_nothing_keeps_the_place_of_its_cupped_pose(one_start, tmp_path, monkeypatch):
    none = drop_region.Region(None, 2, 48, 0.012)
    monkeypatch.setattr(drop_region, "search", lambda folder, count: none)
    path = hands.write(tmp_path / "robot")
    result = import_hand(path, tmp_path / "hand", Settings(pads=None, drops=96), picture=False)
    assert result.lines[-1].startswith("check:   2 of 48 objects let fall where the cupped pose tells were held")
    assert "places" not in result.hand and "places.catch" not in result.hand["guessed"]


def test_a_base_without_mass_is_said_to_need_none(one_start, tmp_path):
    path = hands.write(tmp_path / "robot")
    plain = import_hand(path, tmp_path / "plain", Settings(pads=None), picture=False)
    assert not [line for line in plain.lines if line.startswith("no mass")]
    path.write_text(path.read_text().replace('mass value="0.3"', 'mass value="0"', 1))
    lines = import_hand(path, tmp_path / "hand", Settings(pads=None), picture=False).lines
    assert "no mass: 'base' (the base is held fast, its mass never counts)" in lines
    heavy, light = (load_hand(tmp_path / name).spec().compile() for name in ("plain", "hand"))
    data = [mujoco.MjData(m) for m in (heavy, light)]
    for m, d in zip((heavy, light), data, strict=True):
        for _ in range(50):
            mujoco.mj_step(m, d)
    assert np.abs(data[0].qpos).max() > 1e-3
    # the mass enters the solver's tolerance alone
    np.testing.assert_allclose(data[0].qpos, data[1].qpos, atol=1e-6)


def test_taxels_from_a_csv_and_those_inside_the_finger(claw, one_start, tmp_path):
    path = hands.write(tmp_path / "robot")
    normals = {f.name: np.array(f.normal) for f in load_hand(claw).fingers}
    axis = {"thumb": np.array([0, -1.0, 0])}

    def table(depth: float) -> Path:
        lines = ["finger,x,y,z,nx,ny,nz"]
        for finger, n in normals.items():
            for s in (0.015, 0.02, 0.025):
                p = s * axis.get(finger, np.array([1.0, 0, 0])) + (0.0075 - (depth if finger == "ring" else 0.0)) * n
                lines.append(f"{finger}," + ",".join(f"{v:.6f}" for v in [*p, *n]))
        out = tmp_path / "taxels.csv"
        out.write_text("\n".join(lines) + "\n")
        return out

    import_hand(path, tmp_path / "hand", Settings(pads=table(0.0)), picture=False)
    assert len((tmp_path / "hand" / "taxels_ring.csv").read_text().splitlines()) == 4
    with pytest.raises(UserError, match=r"taxel 0 of finger ring lies 3\.\d mm inside the finger"):
        import_hand(path, tmp_path / "other", Settings(pads=table(0.003)), picture=False)
    (tmp_path / "taxels.csv").write_text("finger,x,y,z\nring,0,0,0\n")
    with pytest.raises(UserError, match="no column nx, ny, nz"):
        import_hand(path, tmp_path / "other", Settings(pads=tmp_path / "taxels.csv"), picture=False)
    assert not (tmp_path / "other").exists()


def test_rays_meet_the_nearest_face_and_holes_are_counted():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.01)
    surface = np.asarray(ball.vertices), np.asarray(ball.faces)
    origins = np.array([[0.0, 0.0, 0.05], [0.005, 0.0, 0.05], [0.02, 0.0, 0.05]])
    distance, normal = geometry.first_hits(surface, origins, np.array([0.0, 0, -1]))
    np.testing.assert_allclose(distance[:2], [0.04, 0.05 - np.sqrt(0.01**2 - 0.005**2)], atol=2e-5)
    assert np.isinf(distance[2])
    np.testing.assert_allclose(normal[1], [0.5, 0, np.sqrt(0.75)], atol=0.05)
    assert geometry.open_edges(surface) == 0
    assert geometry.open_edges((surface[0], surface[1][1:])) == 3


def test_check_tells_a_joint_that_opens_where_it_should_close(claw, tmp_path, capsys):
    shutil.copytree(claw, tmp_path / "hand")
    assert all(m.closer > 0.002 for m in moves.moves(load_hand(tmp_path / "hand")) if m.role.startswith("bends"))
    text = (tmp_path / "hand" / "hand.yaml").read_text()
    content = yaml.safe_load(text)
    content["fingers"][1]["closes"] = [-1, 1]
    (tmp_path / "hand" / "hand.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    wrong = [m.joint for m in moves.moves(load_hand(tmp_path / "hand")) if m.role.startswith("bends") and m.closer < 0]
    assert wrong == ["index_1"]


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["claw.urdf"], "out=FOLDER"),
        (["out=x"], "one model file is needed, 0 given"),
        (["a.urdf", "b.urdf", "out=x"], "2 given: a.urdf, b.urdf"),
        (["a.urdf", "out=x", "pads=8"], "pads=8: must be ROWSxCOLUMNS"),
        (["a.urdf", "out=x", "effort=-1"], "effort=-1: must be a number from 0.001"),
        (["a.urdf", "out=x", "drops=-1"], "drops=-1: must be a whole number from 0 to 100000"),
        (["a.urdf", "out=x", "drops=3.5"], "drops=3.5: must be a whole number"),
        (["a.urdf", "out=x", "drops=100001"], "drops=100001: must be a whole number"),
        (["a.urdf", "out=x", "coupled=maybe"], "coupled=maybe: must be keep or independent"),
        (["a.urdf", "out=x", "colour=red"], "'colour=red': expected key=value"),
        (["a.urdf", "out=x"], "a.urdf does not exist"),
    ],
)
def test_arguments(argv, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as error:
        command.main(argv)
    assert said in str(error.value) and not list(tmp_path.iterdir())


def test_check_of_the_mirror_image(claw, tmp_path, capsys, monkeypatch):
    displayed = []
    monkeypatch.setattr(moves, "_show", lambda hand, out, seconds, film: displayed.append(hand) or [])
    for k, mirror in enumerate(("false", "true")):
        assert moves.main([str(claw), f"out={tmp_path / str(k)}", f"hand_mirror={mirror}"]) == 0
    plain, mirrored = capsys.readouterr().out.split("joint  ")[1:]
    assert plain == mirrored  # joint angles keep their meaning
    assert [hand.mirror for hand in displayed] == [False, True]
    with pytest.raises(UserError, match="hand_mirror=left: must be true or false"):
        moves.main([str(claw), f"out={tmp_path / 'x'}", "hand_mirror=left"])


@pytest.mark.slow
def test_the_picture_shows_the_hand(claw, tmp_path):
    """Every panel has a hand in it: not one colour, and open differs from cupped."""
    from PIL import Image

    from dexsim.import_hand import picture

    picture.draw(load_hand(claw), tmp_path / "picture.png")
    image = np.asarray(Image.open(tmp_path / "picture.png").convert("L"), float)
    assert image.shape[1] > 1000 and image.std() > 20
