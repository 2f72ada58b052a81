"""What follows what in a maker's file, how far it goes, and what is said of it."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
import trimesh

from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.import_hand import drives, poses, source, ties
from dexsim.import_hand.importing import import_hand
from tests import hands
from tests.test_import_faithful import jaws, settings


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(poses, "STARTS", 1)


def robot(tmp_path, *changes):
    """Write the made URDF hand with some changes; return its path."""
    path = hands.write(tmp_path / "robot")
    text = path.read_text()
    for change in changes:
        text = change(text)
    path.write_text(text)
    return path


def mimic(joint, other, multiplier=1.0, offset=0.0):
    tag = f'<mimic joint="{other}" multiplier="{multiplier}" offset="{offset}"/></joint>'
    return lambda t: re.sub(rf'(<joint name="{joint}".*?)</joint>', lambda x: x[1] + tag, t, count=1, flags=re.S)


def endless(joint):
    return lambda t: re.sub(
        rf'(<joint name="{joint}" type=")revolute(".*?)<limit [^>]*/>', r"\1continuous\2", t, count=1, flags=re.S
    )


@pytest.mark.parametrize(("changes", "said"), [
    ([mimic("index_2", "nowhere")], "'index_2' mimics 'nowhere', which is no joint of the file"),
    ([lambda t: t.replace('"index_1" type="revolute"', '"index_1" type="fixed"'), mimic("index_2", "index_1")],
     "'index_2' mimics 'index_1', which does not move"),
    ([mimic("index_2", "index_2")], "index_2 follow each other in a ring"),
])  # fmt: skip
def test_a_joint_that_mimics_what_does_not_move_is_refused(tmp_path, changes, said):
    with pytest.raises(UserError, match=said):
        source.read(robot(tmp_path, *changes))


def test_a_continuous_joint_gets_the_limits_of_those_it_is_tied_to(tmp_path):
    laws = (("index_2", "index_1", -0.5, 0.1), ("ring_2", "ring_1", 0.8, 0.2), ("middle_2", "ring_1", 2.0))
    path = robot(tmp_path, *(endless(j) for j in ("index_2", "ring_1", "middle_2")), *(mimic(*law) for law in laws))
    m = source.read(path).model
    np.testing.assert_allclose(m.joint("index_2").range, [0.1 - 0.85, 0.1 + 0.1])  # index_1: -0.2 to 1.7
    np.testing.assert_allclose(m.joint("ring_1").range, [-0.25, 1.75])  # ring_2: 0 to 1.6
    np.testing.assert_allclose(m.joint("middle_2").range, [-0.5, 3.5])
    assert m.jnt_limited.all()


def _tied(**laws):
    """Return jaws whose second joint of finger k follows, by the coefficients laws["_k"]."""
    rows = "".join(f'<joint joint1="second{k[1]}" joint2="first{k[1]}" polycoef="{v}"/>' for k, v in laws.items())
    text = jaws(ranges=((-0.5, 1.5), (-1.0, 1.0)), after=f"<equality>{rows}</equality>")
    return mujoco.MjModel.from_xml_string(text)


def test_how_far_a_drive_goes_before_its_follower_is_at_a_limit():
    m = _tied(_0="0 2.5 0 0 0", _1="0.5 -1 0 0 0", _2="0 0.6 0 0 0")
    found = ties.reach(m, [m.joint(f"first{k}").id for k in range(3)], "model")
    assert [m.joint(j).name for j in found] == ["first0"]  # second1: -1 to 1, second2: -0.3 to 0.9
    low, high, follower = found[m.joint("first0").id]
    assert (low, high) == pytest.approx((-0.4, 0.4), abs=0.02) and follower == "second0"
    with pytest.raises(UserError, match="'second0' follows 'first0' beyond its limits, wherever"):
        ties.reach(_tied(_0="3 0.5 0 0 0"), [0], "model")
    held = '<equality><joint joint1="second0" polycoef="1.2 0 0 0 0"/></equality>'
    m = mujoco.MjModel.from_xml_string(jaws(ranges=((-0.5, 1.5), (-1.0, 1.0)), after=held))
    with pytest.raises(UserError, match="'second0' is held at 1.2, beyond its limits -1 to 1"):
        ties.reach(m, [0], "model")


def test_a_drive_that_its_follower_stops_short_is_said_and_poses_stay_within(tmp_path):
    path = robot(tmp_path, mimic("index_2", "index_1", 2.5))
    lines = import_hand(path, tmp_path / "hand", settings(), picture=False).lines
    assert any("'index_1' goes from -0.01" in x and "'index_2', which follows it" in x for x in lines)
    hand = load_hand(tmp_path / "hand")
    assert hand.limits[hand.joints.index("index_1")].tolist() == [-0.2, 1.7]  # the file's own
    for pose in ("open", "cupped"):
        d = mujoco.MjData(hand.compiled)
        hand.couplings.put(d, hand.pose(pose))
        assert -0.04 <= d.joint("index_2").qpos[0] <= 1.64


def test_a_joint_that_follows_the_wrist_stands_where_the_held_wrist_leaves_it(tmp_path):
    wrist = (
        '<link name="arm"/><joint name="wrist" type="revolute"><parent link="arm"/><child link="base"/>'
        '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint><link name="base">'
    )
    path = robot(tmp_path, lambda t: t.replace('<link name="base">', wrist), mimic("index_2", "wrist", 1.0, 0.3))
    import_hand(path, tmp_path / "hand", settings(), picture=False)
    hand = load_hand(tmp_path / "hand")
    d = mujoco.MjData(hand.compiled)
    hand.couplings.put(d, hand.pose("open"))
    assert hand.couplings.passive == ("index_2",) and d.joint("index_2").qpos[0] == pytest.approx(0.3)


ACTUATED = "<actuator>" + "".join(f'<position joint="first{k}" kp="2"/>' for k in range(3)) + "</actuator>"


def _mjcf(tmp_path, equalities="", tendons="", actuators=ACTUATED, **given):
    after = f"<tendon>{tendons}</tendon><equality>{equalities}</equality>"
    text = jaws(after=after, **given).replace("<actuator></actuator>", actuators)
    path = tmp_path / "jaws.xml"
    path.write_text(text)
    return path


def test_of_two_joints_on_a_line_the_one_without_a_motor_follows(tmp_path):
    path = _mjcf(tmp_path, "".join(f'<joint joint1="first{k}" joint2="second{k}" polycoef="0.1 -1.25 0 0 0"/>'
                                   for k in range(3)))  # fmt: skip
    read = source.read(path)
    assert read.passive == {"second0", "second1", "second2"}
    np.testing.assert_allclose(read.model.eq_data[:, :5], [[0.08, -0.8, 0, 0, 0]] * 3)
    path = _mjcf(tmp_path, '<joint joint1="first0" joint2="second0" polycoef="0.1 -1.25 0.2 0 0"/>')
    with pytest.raises(UserError, match="joint 'first0' has an actuator, and follows 'second0'"):
        source.read(path)


def test_a_joint_that_follows_two_is_refused(tmp_path):
    both = "".join(f'<joint joint1="second0" joint2="first{k}"/>' for k in range(2))
    with pytest.raises(UserError, match="joint 'second0' follows two joints"):
        source.read(_mjcf(tmp_path, both))


def test_what_is_not_taken_of_ties_is_said(tmp_path):
    both = '<joint joint="first0" coef="1"/><joint joint="second0" coef="1"/>'
    fixed = f'<fixed name="t" margin="0.1" armature="2e-4">{both}</fixed>'
    read = source.read(_mjcf(tmp_path, '<joint joint1="second1" joint2="first1" solref="0.05 1"/>', fixed))
    said = "\n".join(read.notes)
    assert "not used: margin of tendons t" in said and "not used: solref of equalities second1" in said
    assert read.model.tendon_armature.tolist() == [2e-4]


def _pulls(actuators, own=""):
    fixed = f'<fixed name="t" {own}><joint joint="first0" coef="1"/><joint joint="second0" coef="1"/></fixed>'
    text = jaws(after=f"<tendon>{fixed}</tendon>").replace("<actuator></actuator>", f"<actuator>{actuators}</actuator>")
    return drives.read(mujoco.MjSpec.from_string(text))


def test_a_pulled_tendon_goes_as_far_as_its_commands_or_its_limits():
    found = _pulls('<position name="p" tendon="t" kp="2" ctrlrange="-2 0.4" gear="2" kv="0.1"/>')
    assert found.pulls == [drives.Pull("p", {"first0": 1.0, "second0": 1.0}, (-1.0, 0.2))]
    assert (found.kp["p"], found.kd["p"]) == (8.0, 0.4)
    torque = _pulls('<motor name="p" tendon="t" ctrlrange="-1 1" gear="0.3"/>')
    assert torque.pulls[0].range is None and torque.effort == {"p": 0.3}
    assert _pulls('<position name="p" tendon="t" kp="2"/>', 'range="-0.5 0.1"').pulls[0].range == (-0.5, 0.1)
    assert _pulls('<position name="p" tendon="t" kp="2"/>', 'limited="false" range="-0.5 0.1"').pulls[0].range is None
    assert _pulls('<position name="p" tendon="t" kp="2"/>', 'actuatorfrcrange="-0.7 0.7"').effort == {"p": 0.7}


def test_delays_of_actuators_and_joints_in_the_parents_frame_are_taken():
    late = '<position joint="{joint}" kp="3" delay="0.02" nsample="5"/>'
    found = drives.read(mujoco.MjSpec.from_string(jaws(actuators=late)))
    assert set(found.delay.values()) == {0.02} and len(found.delay) == 6
    found = drives.read(mujoco.MjSpec.from_string(jaws(actuators='<motor jointinparent="{joint}" ctrlrange="-1 1"/>')))
    assert found.notes == [] and set(found.effort.values()) == {1.0}


def test_two_actuators_on_one_tendon_are_one_drive():
    found = _pulls('<position name="p" tendon="t" kp="2"/><velocity name="d" tendon="t" kv="0.3"/>')
    assert [p.name for p in found.pulls] == ["p"] and (found.kp, found.kd) == ({"p": 2.0}, {"p": 0.3})


def test_one_tendon_that_pulls_two_jaws_is_one_drive_of_both(tmp_path):
    split = '<fixed name="split"><joint joint="first0" coef="0.5"/><joint joint="first1" coef="0.5"/></fixed>'
    path = _mjcf(
        tmp_path, '<joint joint1="first0" joint2="first1"/>', split, kind="slide", axes=("-1 0 0", "0 0 1"),
        ranges=((0, 0.04), (0, 0.001)), fingers=2, actuators='<actuator><general name="grip" tendon="split"'
        ' ctrlrange="0 255" forcerange="-100 100" gainprm="0.0157 0 0" biasprm="0 -100 -10" biastype="affine"/>'
        "</actuator>",
    )  # fmt: skip
    path.write_text(re.sub(r'<joint name="second[^/]*/>', "", path.read_text()))
    import_hand(path, tmp_path / "hand", settings(), picture=False)
    hand = load_hand(tmp_path / "hand")
    assert hand.joints == ("grip",) and [f.closes for f in hand.fingers] == [(1,), (1,)]
    np.testing.assert_allclose(hand.limits, [[0, 0.04]], atol=1e-4)
    d = mujoco.MjData(hand.compiled)
    hand.couplings.put(d, np.array([0.03]))
    assert [d.joint(f"first{k}").qpos[0] for k in range(2)] == pytest.approx([0.03, 0.03], abs=1e-4)


def test_a_joint_that_no_actuator_of_the_file_moves_is_said(tmp_path):
    path = _mjcf(tmp_path)
    lines = import_hand(path, tmp_path / "hand", settings(), picture=False).lines
    assert "check:   no actuator of the file moves second0, second1, second2: each has a motor of its own here" in lines


def test_bodies_whose_names_differ_in_case_and_files_with_dashes(tmp_path):
    path = tmp_path / "my---hand--.xml"
    path.write_text(jaws().replace('"far0"', '"tip"').replace('"far1"', '"TIP"'))
    import_hand(path, tmp_path / "hand", settings(), picture=False)
    assert load_hand(tmp_path / "hand").compiled.body("TIP").id


def test_all_that_links_lack_is_said_at_once(tmp_path):
    path = robot(
        tmp_path, lambda t: re.sub(r'(name="index_far">)<inertial>.*?</inertial>', r"\1", t, flags=re.S),
        lambda t: re.sub(r'(name="ring_far".*?)ixx="[^"]*"', r'\1ixx="1"', t, count=1, flags=re.S),
    )  # fmt: skip
    with pytest.raises(UserError, match="link index_far without <inertial>.*density=.*inertia=shapes.*'ring_far'"):
        source.read(path)


def test_a_link_with_neither_mass_nor_shape_between_two_joints_is_a_speck(tmp_path):
    before, last = '<link name="index_far">', '<parent link="index_near"/><child link="{}"/>'
    joint = (
        '<joint name="index_3" type="revolute"><parent link="virtual"/><child link="index_far"/><axis xyz="0 0 1"/>'
        '<limit lower="-0.3" upper="0.3" effort="1" velocity="1"/></joint></robot>'
    )

    def virtual(text):
        text = text.replace(before, '<link name="virtual"/>' + before).replace("</robot>", joint)
        return text.replace(last.format("index_far"), last.format("virtual"))

    read = source.read(robot(tmp_path, virtual))
    assert read.bare == [] and 0 < read.model.body("virtual").mass[0] < 1e-4
    assert "link 'virtual' has neither mass nor shape: 0.01 g taken" in read.notes


def test_a_mass_of_zero_is_none_and_figures_that_are_no_numbers_are_named(tmp_path):
    text = lambda old, new: lambda t: re.sub(rf'(name="index_far".*?){old}', rf"\1{new}", t, count=1, flags=re.S)  # noqa: E731
    zero = robot(tmp_path, text('<mass value="[^"]*"', '<mass value="0"'))
    with pytest.raises(UserError, match="link index_far without <inertial>, or without mass in it"):
        source.read(zero)
    assert source.read(zero, density=1000.0).model.body("index_far").mass[0] > 1e-3
    with pytest.raises(UserError, match="link 'index_far': <inertia ixx=\"nan\">: must be a finite number"):
        source.read(robot(tmp_path / "nan", text('ixx="[^"]*"', 'ixx="nan"')))


@pytest.mark.slow
def test_what_an_mjcf_says_of_impossible_inertias_is_done(tmp_path):
    path = tmp_path / "jaws.xml"
    text = jaws(head='<compiler angle="radian" {}/>').replace("2e-5 2e-5 5e-6", "2e-6 3e-6 1e-5", 1)
    for word in ('balanceinertia="true"', 'inertiafromgeom="true"', 'boundinertia="1e-5"'):
        path.write_text(text.replace("{}", word))
        assert source.read(path).mended == {}
    path.write_text(text.replace("{}", ""))
    assert list(source.read(path).mended) == ["near0"]


@pytest.mark.parametrize(("factor", "unit"), [(100.0, "centimetres or inches"), (1 / 0.0254, "inches")])
def test_one_small_mesh_in_another_unit_is_named(tmp_path, factor, unit):
    path = robot(tmp_path, lambda t: t.replace('<box size="0.040 0.015 0.015"/>', '<mesh filename="meshes/box.stl"/>'))
    box = trimesh.creation.box(extents=np.array([0.04, 0.015, 0.015]) * factor)
    box.export(path.parent / "meshes" / "box.stl")
    with pytest.raises(UserError, match=f"mesh 'box' of 'index_near' is .* m across .in {unit}"):
        import_hand(path, tmp_path / "hand", settings(), picture=False)
