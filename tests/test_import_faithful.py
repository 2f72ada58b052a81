"""What a maker's file says of a hand's joints, drives, inertias and meshes is in the hand, or a line says that it is
not."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
import yaml

from dexsim import model_file
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.import_hand import poses, source
from dexsim.import_hand.importing import Settings, import_hand
from tests import hands


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(poses, "STARTS", 1)


def settings(**given) -> Settings:
    return Settings(**({"pads": None, "drops": 0} | given))


def jaws(
    joints=("first", "second"), ranges=((-1.5, 1.5), (-1.5, 1.5)), axes=("0 1 0", "0 1 0"), joint="", kind="hinge",
    actuators="", fingers=3, base="", after="", head='<compiler angle="radian"/>',
) -> str:  # fmt: skip
    """Return a claw's MJCF: fingers of two links around a disc, which stand up from it; closing turns them inwards,
    about -y of their own frame."""
    out = [f'<mujoco model="jaws">{head}<worldbody><body name="disc">{base}<inertial pos="0 0 0" mass="0.3" '
           'diaginertia="1e-4 1e-4 1e-4"/><geom type="cylinder" size="0.05 0.01"/>']  # fmt: skip
    for k in range(fingers):
        a = 2 * np.pi * k / fingers
        x, y = 0.045 * np.cos(a), 0.045 * np.sin(a)
        names = [f"{j}{k}" for j in joints]
        low = [f'name="{n}" type="{kind}" axis="{axis}" range="{r[0]} {r[1]}" actuatorfrcrange="-0.8 0.8" {joint}'
               for n, axis, r in zip(names, axes, ranges, strict=True)]  # fmt: skip
        out.append(
            f'<body name="near{k}" pos="{x} {y} 0.02" quat="{np.cos(a / 2)} 0 0 {np.sin(a / 2)}"><joint {low[0]}/>'
            '<inertial pos="0 0 0.02" mass="0.05" diaginertia="2e-5 2e-5 5e-6"/>'
            '<geom type="box" size="0.008 0.008 0.016" pos="0 0 0.02"/>'
            f'<body name="far{k}" pos="0 0 0.04"><joint {low[1]}/>'
            '<inertial pos="0 0 0.02" mass="0.04" diaginertia="2e-5 2e-5 5e-6"/>'
            '<geom type="capsule" size="0.008" fromto="0 0 0.012 0 0 0.04"/></body></body>'
        )
    acts = "".join(actuators.format(joint=f"{j}{k}") for k in range(fingers) for j in joints) if actuators else ""
    return "".join(out) + f"</body></worldbody><actuator>{acts}</actuator>{after}</mujoco>"


def imported(tmp_path: Path, text: str, suffix: str = ".xml", **given):
    tmp_path.mkdir(exist_ok=True)
    path = tmp_path / f"jaws{suffix}"
    path.write_text(text)
    result = import_hand(path, tmp_path / "hand", settings(**given), picture=False)
    return load_hand(tmp_path / "hand"), "\n".join(result.lines), result


def test_names_of_any_kind_read_back(tmp_path):
    expected = ["1.", "2.", "on", "null", "0x", "1e", "-a 0", "~b", "a: b#", 'q"', "é.j", "="]
    text = jaws(fingers=6)
    for k, name in enumerate(expected):
        text = text.replace(f'"{("first", "second")[k % 2]}{k // 2}"', '"' + name.replace('"', "&quot;") + '"')
    hand, _, _ = imported(tmp_path, text)
    assert list(hand.joints) == expected and sorted(hand.file.poses.open) == sorted(expected)
    content = yaml.safe_load((tmp_path / "hand" / "hand.yaml").read_text())
    content["joints"][1]["armature"] = 3e-4  # a place that no step asks for
    content["poses"]["open"][expected[0]] += 0.01
    (tmp_path / "hand" / "hand.yaml").write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
    import_hand(tmp_path / "jaws.xml", tmp_path / "hand", settings(), picture=False)
    again = load_hand(tmp_path / "hand")
    assert again.file.joints[1].armature == 3e-4
    assert again.file.poses.open[expected[0]] == pytest.approx(content["poses"]["open"][expected[0]])


def test_joint_names_that_are_numbers(tmp_path):
    path = hands.write(tmp_path / "robot")
    text = path.read_text()
    for k, name in enumerate(re.findall(r'joint name="([^"]+)"', text)):
        text = text.replace(f'"{name}"', f'"{k}"')
    path.write_text(text)
    import_hand(path, tmp_path / "hand", settings(), picture=False)
    assert sorted(load_hand(tmp_path / "hand").joints, key=int) == [str(k) for k in range(9)]


@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_a_joint_drawn_at_a_ref_has_its_links_where_the_file_has_them(tmp_path, kind):
    ranges = ((0.2, 1.2), (-0.1, 1.4)) if kind == "hinge" else ((0.01, 0.03), (0.0, 0.02))
    refs = (0.5, -0.3) if kind == "hinge" else (0.02, 0.01)
    text = jaws(ranges=ranges, kind=kind, axes=("0 1 0", "0 1 0") if kind == "hinge" else ("-1 0 0", "0 0 1"))
    for j, ref in zip(("first", "second"), refs, strict=True):
        text = text.replace(f'name="{j}', f'ref="{ref}" name="{j}')
    hand, _, _ = imported(tmp_path, text)
    theirs, ours = mujoco.MjModel.from_xml_string(text), hand.compiled
    for share in (0.0, 0.4, 1.0):
        places = []
        for m in (theirs, ours):
            d = mujoco.MjData(m)
            for j in hand.joints:
                low, high = theirs.joint(j).range
                d.joint(j).qpos[0] = low + share * (high - low)
            mujoco.mj_kinematics(m, d)
            base = d.body("disc").xmat.reshape(3, 3)
            places.append([(base.T @ (d.body(f"far{k}").xpos - d.body("disc").xpos),
                            base.T @ d.body(f"far{k}").xmat.reshape(3, 3)) for k in range(3)])  # fmt: skip
        for (p, r), (q, s) in zip(*places, strict=True):
            np.testing.assert_allclose(p, q, atol=1e-7)
            np.testing.assert_allclose(r, s, atol=1e-7)


def test_passive_figures_are_the_files(tmp_path):
    own = 'frictionloss="0.13" damping="0.021" armature="3e-4" stiffness="0.4" springref="-0.25"'
    hand, said, _ = imported(tmp_path, jaws(joint=own))
    m = hand.compiled
    np.testing.assert_allclose(m.dof_damping, 0.021)
    np.testing.assert_allclose(m.dof_armature, 3e-4)
    np.testing.assert_allclose(m.jnt_stiffness, 0.4)
    np.testing.assert_allclose(m.qpos_spring, -0.25)
    servo = yaml.safe_load((tmp_path / "hand" / "servo.yaml").read_text())
    assert {j["coulomb_friction"] for j in servo["joints"].values()} == {0.13}
    assert not m.dof_frictionloss.any()  # the servo has it: it would count twice
    assert "damping" not in said and "armature" not in said


def test_a_scaled_hand_keeps_the_places_of_refs_and_springs(tmp_path):
    own = 'stiffness="40" springref="0.004" ref="0.006"'
    hand, _, _ = imported(tmp_path, jaws(joint=own, kind="slide", ranges=((0, 0.02),) * 2, axes=("-1 0 0", "0 0 1")))
    large = load_hand(tmp_path / "hand", scale=2.0).compiled
    np.testing.assert_allclose(large.qpos0, 0.012)
    np.testing.assert_allclose(large.qpos_spring, 0.008)
    assert load_hand(tmp_path / "hand", mirror=True).compiled.qpos0[0] == pytest.approx(0.006)


def test_gains_and_torques_of_actuators_are_seen_at_the_joint(tmp_path):
    pd = '<position joint="{joint}" kp="3" kv="0.1" ctrlrange="0 1" forcerange="-0.3 0.3" gear="2"/>'
    _, said, result = imported(tmp_path, jaws(actuators=pd))
    servo = yaml.safe_load((tmp_path / "hand" / "servo.yaml").read_text())["joints"]["first0"]
    assert (servo["kp"], servo["kd"], servo["torque_limit"]) == (12.0, 0.4, 0.6)
    assert re.search(r"not used: ctrlrange.*first0, second0", said)
    assert result.hand["joints"][0]["effort"] == 0.6


def test_a_guessed_torque_carries_the_links(tmp_path):
    """Where no file says a motor's torque: what presses with a fingertip, and twice the weight of what it moves."""
    plain = jaws().replace('actuatorfrcrange="-0.8 0.8"', "")
    heavy = plain.replace('pos="0 0 0.02" mass="0.05"', 'pos="0.3 0 0.02" mass="0.5"')
    efforts = [imported(tmp_path / str(k), x)[0].efforts[:2] for k, x in enumerate((plain, heavy))]
    assert efforts[0][0] == pytest.approx(5.0 * 0.078, rel=0.02)
    weight = 9.81 * (0.5 * np.hypot(0.3, 0.02) + 0.04 * 0.06)
    assert efforts[1][0] == pytest.approx(2 * weight, rel=0.02) and efforts[1][1] == efforts[0][1]


def test_velocity_beside_position_motors_and_other_laws(tmp_path):
    two = '<position joint="{joint}" kp="5"/><velocity joint="{joint}" kv="0.2"/>'
    imported(tmp_path, jaws(actuators=two))
    servo = yaml.safe_load((tmp_path / "hand" / "servo.yaml").read_text())["joints"]["first0"]
    assert (servo["kp"], servo["kd"], servo["torque_limit"]) == (5.0, 0.2, 0.8)
    spec = mujoco.MjSpec.from_string(jaws(actuators='<motor joint="{joint}" ctrlrange="-1 1" gear="0.5"/>'))
    from dexsim.import_hand import drives

    assert drives.read(spec).effort["second1"] == 0.5
    spec = mujoco.MjSpec.from_string(jaws(actuators='<muscle joint="{joint}" lengthrange="0.5 1"/>'))
    assert "neither motor, position nor velocity: 0" in "".join(drives.read(spec).notes).replace("first0", "0")


def _urdf(tmp_path: Path, change) -> Path:
    path = hands.write(tmp_path / "robot")
    path.write_text(change(path.read_text()))
    return path


IMPOSSIBLE = '<inertia ixx="2e-6" iyy="3e-6" izz="1e-5" ixy="0" ixz="0" iyz="0"/>'


def _of(link: str):
    return lambda text: re.sub(rf'(name="{link}".*?)<inertia [^>]*>', rf"\1{IMPOSSIBLE}", text, count=1, flags=re.S)


def test_an_inertia_that_no_body_has_is_no_matter_where_the_base_is_held(tmp_path):
    path = _urdf(tmp_path, _of("base"))
    assert path.read_text() != hands.urdf()
    lines = import_hand(path, tmp_path / "hand", settings(), picture=False).lines
    assert any("'base' (2e-06 3e-06 1e-05 kg m2)" in line and "held fast" in line for line in lines)


def test_all_impossible_inertias_are_listed_at_once_and_mended_when_asked(tmp_path):
    path = _urdf(tmp_path, lambda t: _of("index_far")(_of("middle_near")(t)))
    with pytest.raises(
        UserError, match=r"2 moving links.*'index_far' 2e-06 3e-06 1e-05.*'middle_near'.*inertia=shapes"
    ):
        import_hand(path, tmp_path / "hand", settings(), picture=False)
    import_hand(path, tmp_path / "mean", settings(inertia="balance"), picture=False)
    import_hand(path, tmp_path / "shape", settings(inertia="shapes"), picture=False)
    plain = source.read(_urdf(tmp_path / "plain", lambda t: t)).model
    mean, shape = load_hand(tmp_path / "mean").compiled, load_hand(tmp_path / "shape").compiled
    np.testing.assert_allclose(mean.body("index_far").inertia, 5e-6)
    near = shape.body("middle_near")  # a box of 40 x 15 x 15 mm and 30 g about its own middle
    assert near.mass[0] == pytest.approx(0.03)
    box = 0.03 / 12 * np.array([0.04**2 + 0.015**2, 0.04**2 + 0.015**2, 2 * 0.015**2])
    np.testing.assert_allclose(np.sort(near.inertia), np.sort(box), rtol=1e-5)
    np.testing.assert_allclose(near.ipos, [0.0225, 0, 0], atol=1e-7)
    for m in (mean, shape):
        np.testing.assert_allclose(m.body("ring_far").inertia, plain.body("ring_far").inertia, rtol=1e-6)


@pytest.mark.parametrize("axes", [("0 1 0", "0 -1 0"), ("0 -1 0", "0 1 0"), ("0 1 0", "0 1 0")])
def test_fingers_of_joints_without_a_side_close_towards_each_other(tmp_path, axes):
    hand, _, result = imported(tmp_path, jaws(axes=axes))
    m = hand.compiled
    d = mujoco.MjData(m)
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    tips = np.array([d.body(f.body).xpos + d.body(f.body).xmat.reshape(3, 3) @ f.position for f in hand.fingers])
    for f, tip in zip(hand.fingers, tips, strict=True):
        turning = [c * d.xaxis[m.joint(hand.joints[j]).id] for j, c in zip(f.flexion, f.closes, strict=True)]
        assert turning[0] @ turning[1] == pytest.approx(1.0)
        inwards = tips.mean(0) - tip
        assert d.body(f.body).xmat.reshape(3, 3) @ f.normal @ inwards / np.linalg.norm(inwards) > 0.99
    gap = [np.linalg.norm(_tips(hand, which)[0] - _tips(hand, which)[1:].mean(0)) for which in ("open", "cupped")]
    assert gap[0] > gap[1]


def _tips(hand, which):
    from dexsim.hand.places import fingertips

    return fingertips(hand, hand.pose(which))


@pytest.mark.parametrize("closed", [0.0, 0.04])
def test_jaws_on_slides_close_where_they_meet_whichever_end_that_is(tmp_path, closed):
    axis = "1 0 0" if closed == 0.0 else "-1 0 0"  # outwards, or inwards
    text = jaws(kind="slide", axes=(axis, "0 0 1"), ranges=((0, 0.04), (0, 0.001)), fingers=2)
    text = re.sub(r'<joint name="second[^/]*/>', "", text)
    hand, said, _ = imported(tmp_path, text)
    assert all(f.closes == ((-1,) if closed == 0.0 else (1,)) for f in hand.fingers), said
    assert np.ptp(_tips(hand, "open"), axis=0).max() > np.ptp(_tips(hand, "cupped"), axis=0).max()


def test_what_neither_limits_nor_fingertips_tell_is_said(tmp_path):
    text = jaws(axes=("1 0 0", "1 0 0"))  # they sway around the middle
    _, said, _ = imported(tmp_path, text)
    assert re.search(r"neither its limits nor the other fingertips tell.*say fingers\.finger\d\.closes=\[", said)
    assert "neither its limits" not in imported(tmp_path / "sure", jaws())[1]


def test_what_check_finds_wrong_is_said_by_the_import(tmp_path):
    path = tmp_path / "jaws.xml"
    path.write_text(jaws())
    wrong = {"fingers.finger1.closes": [1, 1]}
    lines = import_hand(path, tmp_path / "hand", settings(said=wrong), picture=False).lines
    assert sum("takes its fingertip away from those it presses against" in line for line in lines) == 2
    wrong = {"fingers.finger1.closes": [-1, -1]}
    lines = import_hand(path, tmp_path / "other", settings(said=wrong), picture=False).lines
    assert not any("takes its fingertip away" in line for line in lines)


def test_the_root_element_says_what_a_file_is(tmp_path):
    text = jaws(after="<contact/>")
    hand, _, _ = imported(tmp_path, text, suffix=".mjcf")
    part = re.search(r"<body name=\"near0\".*?</body></body>", text)[0]
    (tmp_path / "part.mjcf").write_text(f"<mujocoinclude>{part}</mujocoinclude>")
    (tmp_path / "whole.mjcf").write_text(text.replace(part, '<include file="part.mjcf"/>'))
    import_hand(tmp_path / "whole.mjcf", tmp_path / "whole", settings(), picture=False)
    np.testing.assert_array_equal(load_hand(tmp_path / "whole").limits, hand.limits)
    spec = model_file.read(tmp_path / "whole.mjcf", "model")
    assert spec.compile().nbody == mujoco.MjModel.from_xml_string(text).nbody
    with pytest.raises(UserError, match="part.mjcf.*mujocoinclude.*that includes it"):
        import_hand(tmp_path / "part.mjcf", tmp_path / "no", settings(), picture=False)


def test_meshes_beside_a_file_of_any_suffix_are_found(tmp_path, monkeypatch):
    (tmp_path / "m").mkdir()
    trimesh.creation.capsule(radius=0.008, height=0.03).export(tmp_path / "m" / "tip.stl")
    text = jaws(head='<compiler angle="radian" meshdir="m"/><asset><mesh name="tip" file="tip.stl"/></asset>')
    text = re.sub(r'<geom type="capsule"[^>]*>', '<geom type="mesh" mesh="tip" pos="0 0 0.012"/>', text)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    imported(tmp_path, text, suffix=".model")


@pytest.mark.parametrize("kind", ["free", "ball"])
def test_what_moves_the_base_is_left_out_with_a_note(tmp_path, kind):
    hand, said, _ = imported(tmp_path, jaws(base=f'<joint name="floats" type="{kind}"/>'))
    assert f"left out: {kind} joint 'floats' of 'disc': the hand's base is held" in said
    assert len(hand.joints) == 6


def test_what_fastens_the_base_or_is_switched_off_ties_no_joints(tmp_path):
    hand, said, _ = imported(
        tmp_path, jaws(after='<equality><weld body1="disc"/><joint joint1="first0" joint2="second0" active="false"/>'
                             '</equality>'))  # fmt: skip
    assert "left out: what fastens 'disc' to the world: the hand's base is held" in said
    assert "left out: equality 'first0', which the file switches off" in said
    assert len(hand.joints) == 6


def test_an_object_on_joints_beside_the_hand_is_left_out(tmp_path):
    ball = "".join(f'<joint name="ball_{k}" type="slide" axis="{k} 1 0"/>' for k in range(3))
    text = jaws().replace("</worldbody>", f'<body name="ball">{ball}<geom size="0.03"/></body></worldbody>')
    hand, said, _ = imported(tmp_path, text)
    assert "left out: 'ball' (another tree)" in said and len(hand.joints) == 6


def test_a_floating_joint_of_a_urdf_is_left_out_too(tmp_path):
    def floats(text: str) -> str:
        return text.replace(
            '<link name="base">', '<link name="world"/><joint name="floats" type="floating"><parent link="world"/>'
            '<child link="base"/></joint><link name="base">', 1)  # fmt: skip

    lines = import_hand(_urdf(tmp_path, floats), tmp_path / "hand", settings(), picture=False).lines
    assert "left out: free joint 'floats' of 'base': the hand's base is held" in lines


def test_a_ball_joint_inside_the_hand_is_refused_by_name(tmp_path):
    text = jaws().replace('name="second1" type="hinge"', 'name="second1" type="ball"')
    with pytest.raises(UserError, match="joint 'second1' of 'far1' is a ball joint inside the hand"):
        imported(tmp_path, re.sub(r'(type="ball") axis="[^"]*" range="[^"]*" actuatorfrcrange="[^"]*"', r"\1", text))


@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_a_mesh_in_another_unit_than_the_rest_is_named(tmp_path, factor):
    path = hands.write(tmp_path / "robot")
    text = path.read_text()
    box = trimesh.creation.box(extents=[0.09 * factor, 0.09 * factor, 0.024 * factor])
    box.export(tmp_path / "robot" / "meshes" / "palm.stl")
    path.write_text(text.replace('<box size="0.09 0.09 0.024"/>', '<mesh filename="meshes/palm.stl"/>'))
    words = "'palm' of 'base' is 90 m across \\(in millimetres" if factor > 1 else "'palm' of 'base' is 9e-05 m across"
    with pytest.raises(UserError, match=words):
        import_hand(path, tmp_path / "hand", settings(), picture=False)


def test_the_unit_of_a_collada_mesh_counts(tmp_path):
    path = hands.write(tmp_path / "robot")
    (tmp_path / "robot" / "meshes" / "palm.dae").write_text(_dae("0.001"))
    text = path.read_text()
    path.write_text(text.replace('<box size="0.09 0.09 0.024"/>', '<mesh filename="meshes/palm.dae"/>'))
    model = source.read(path).model
    body = model.body("base").id
    g = model.geom(int(model.body_geomadr[body]))
    np.testing.assert_allclose(2 * model.geom_aabb[g.id, 3:].max(), 0.09, atol=1e-6)
    (tmp_path / "robot" / "meshes" / "palm.dae").write_text(_dae("1"))
    with pytest.raises(UserError, match="'palm.*' of 'base' is 90 m across"):
        import_hand(path, tmp_path / "hand", settings(), picture=False)


def _dae(metres: str) -> str:
    """Return a box of 90 x 90 x 24 units."""
    box = trimesh.creation.box(extents=[90, 90, 24])
    points = " ".join(f"{x:g}" for x in box.vertices.ravel())
    faces = " ".join(str(i) for i in box.faces.ravel())
    return (
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>'
        f'<unit name="u" meter="{metres}"/><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>'
        f'<source id="p"><float_array id="a" count="24">{points}</float_array><technique_common><accessor source="#a"'
        ' count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/><param name="Z"'
        ' type="float"/></accessor></technique_common></source><vertices id="v"><input semantic="POSITION"'
        ' source="#p"/></vertices><triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/>'
        f"<p>{faces}</p></triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="
        '"s"><node><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>'
        '<instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def test_several_default_classes_and_names_with_dots(tmp_path):
    head = (
        '<compiler angle="radian"/><default><default class="a.one"><joint damping="0.02"/></default>'
        '<default class="a.two"><joint damping="0.03"/><geom rgba="1 0 0 1"/></default></default>'
    )
    text = jaws(joints=("f.1.", "f_1."), head=head).replace('name="f.1.', 'class="a.one" name="f.1.')
    text = (
        text.replace('name="f_1.', 'class="a.two" name="f_1.')
        .replace('"far0"', '"near.0"')
        .replace('"near1"', '"near_0"')
    )
    hand, _, _ = imported(tmp_path, text)
    m = hand.compiled
    assert m.joint("f.1.0").damping[0] == pytest.approx(0.02) and m.joint("f_1.0").damping[0] == pytest.approx(0.03)
    files = {mesh.file for mesh in hand.spec().meshes if mesh.file}
    assert len(files) == len(list((tmp_path / "hand" / "meshes").iterdir()))  # none overwrote another
