"""Joints that follow others: placed where MuJoCo's constraints hold them, driven through the drives that they have."""

from __future__ import annotations

import re
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.hand.couplings import Couplings
from dexsim.hand.places import fingertips
from dexsim.import_hand import poses
from dexsim.import_hand.importing import import_hand
from dexsim.recording.mechanism import drive, of_hand
from dexsim.recording.schema import Series
from dexsim.tactile.layout import hand_layout
from tests.test_import_faithful import jaws, settings


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(poses, "STARTS", 1)


CHAIN = """<mujoco><compiler angle="radian"/>
<worldbody><body><joint name="a" range="-2 2" armature="0.01"/><geom size="0.01" mass="0.01"/>
<body pos="0.1 0 0"><joint name="b" range="-2 2" armature="0.01" damping="0.05"/><geom size="0.01" mass="0.01"/>
<body pos="0.1 0 0"><joint name="c" range="-0.5 1" armature="0.01" damping="0.05"/><geom size="0.01" mass="0.01"/>
</body></body></body></worldbody>{}</mujoco>"""


def test_polynomials_are_followed_in_a_chain():
    text = CHAIN.format(
        '<equality><joint joint1="b" joint2="a" polycoef="0.1 0.5 0.2 -0.1 0.05"/><joint joint1="c" joint2="b"'
        ' polycoef="0 0.4 0 0 0"/></equality>'
    )
    m = mujoco.MjModel.from_xml_string(text)
    couplings = Couplings(m, ["a"])
    assert couplings.passive == ("b", "c") and couplings.loose == ()
    x = torch.tensor([[0.7, 9.0, 9.0], [-1.1, 9.0, 9.0]], dtype=torch.float64)
    q = couplings.complete(x).numpy()
    a = x[:, 0].numpy()
    b = 0.1 + 0.5 * a + 0.2 * a**2 - 0.1 * a**3 + 0.05 * a**4
    np.testing.assert_allclose(q, np.stack([a, b, 0.4 * b], 1))
    d = mujoco.MjData(m)
    couplings.put(d, np.array([0.7]))
    mujoco.mj_forward(m, d)
    assert np.abs(d.efc_pos[: d.ne]).max() < 1e-12  # no constraint is violated
    slope = 0.5 + 0.4 * 0.7 - 0.3 * 0.7**2 + 0.2 * 0.7**3
    np.testing.assert_allclose(couplings.motion(d.qpos)[:, 0], [1, slope, 0.4 * slope], rtol=1e-6)


def test_a_tied_tendon_is_shared_within_the_joints_limits():
    text = CHAIN.format(
        '<tendon><fixed name="t"><joint joint="a" coef="-1"/><joint joint="b" coef="1"/><joint joint="c" coef="2"/>'
        '</fixed></tendon><equality><tendon tendon1="t"/></equality>'
    )
    m = mujoco.MjModel.from_xml_string(text)
    couplings = Couplings(m, ["a"])
    q = couplings.complete(torch.tensor([[1.0, 0, 0], [-1.9, 0, 0]], dtype=torch.float64)).numpy()
    np.testing.assert_allclose(q @ [-1, 1, 2], 0, atol=2e-3)
    np.testing.assert_allclose(q[0], [1, 0.2, 0.4], atol=1e-9)  # the nearest to rest
    assert q[1, 2] == -0.5 and q[1, 1] == pytest.approx(-0.9, abs=2e-3)  # c is at its limit


def test_a_tendon_may_follow_another_tendon(tmp_path):
    ties = "".join(f'<fixed name="{n}{k}"><joint joint="{j}{k}" coef="1"/></fixed>' for k in range(3)
                   for n, j in (("near", "first"), ("far", "second")))  # fmt: skip
    follows = "".join(f'<tendon tendon1="far{k}" tendon2="near{k}" polycoef="0.1 0.7 0 0 0"/>' for k in range(3))
    text = jaws(after=f"<tendon>{ties}</tendon><equality>{follows}</equality>")
    hand, said = _imported(tmp_path, text)
    assert hand.joints == ("first0", "first1", "first2") and said.count("coupled: tendon equality") == 3
    m, d = hand.compiled, mujoco.MjData(hand.compiled)
    hand.couplings.put(d, np.array([0.5, -0.4, 0.2]))
    mujoco.mj_forward(m, d)
    assert np.abs(d.efc_pos[: d.ne]).max() < 1e-9
    assert d.joint("second0").qpos[0] == pytest.approx(0.1 + 0.7 * 0.5)


def test_where_every_joint_is_driven_nothing_changes():
    hand = load_hand("xhand")
    couplings = hand.couplings
    assert couplings.passive == () == couplings.loose
    q = torch.rand(3, hand.compiled.nq)
    assert torch.equal(couplings.complete(q), q)
    columns = np.random.default_rng(0).normal(size=(3, hand.compiled.nv))
    np.testing.assert_array_equal(couplings.along(columns, q[0].numpy()), columns[:, couplings.dof])


def _imported(tmp_path, text):
    (tmp_path / "jaws.xml").write_text(text)
    lines = import_hand(tmp_path / "jaws.xml", tmp_path / "hand", settings(), picture=False).lines
    return load_hand(tmp_path / "hand"), "\n".join(lines)


def _reached(hand, target, seconds=1.0, spec=None):
    """Return qpos at the end, of the hand sent to target [J] from its open pose."""
    m = of_hand(hand, gravity=(0, 0, 0))
    if spec is not None:
        spec(m.spec)
    commands = Series(np.array([0.0]), np.array([target]))
    return drive(m, commands, hand.joints, seconds, hand.pose("open"))


def _alone(spec):
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # fingers meet in the middle


MIMIC = "".join(f'<joint joint1="second{k}" joint2="first{k}" polycoef="0 0.8 0 0 0"/>' for k in range(3))


@pytest.mark.slow
def test_joints_that_mimic_have_no_drive_and_follow_the_one_that_has(tmp_path):
    hand, said = _imported(tmp_path, jaws(after=f"<equality>{MIMIC}</equality>"))
    assert hand.joints == ("first0", "first1", "first2") and hand.couplings.passive == ("second0", "second1", "second2")
    assert said.count("coupled: mimic or joint equality") == 3
    target = hand.pose("cupped")
    run = _reached(hand, target)
    m, q = run.model, run.qpos[-1]
    for k, name in enumerate(hand.joints):
        assert run.position[-1, k] == pytest.approx(target[k], abs=0.02)
        follows = q[m.joint(f"second{name[-1]}").qposadr[0]]
        assert follows == pytest.approx(0.8 * q[m.joint(name).qposadr[0]], abs=2e-3)
    tips = [fingertips(hand, hand.pose(p)) for p in ("open", "cupped")]
    assert all(np.linalg.norm(t[0] - t[1]) > 1e-3 for t in zip(*tips, strict=True))


PULLED = (
    "<tendon>" + "".join(f'<fixed name="t{k}"><joint joint="first{k}" coef="1"/><joint joint="second{k}" coef="1"/>'
                         "</fixed>" for k in range(3)) + "</tendon>"
)  # fmt: skip
PULL = "".join(f'<position name="pull{k}" tendon="t{k}" kp="2" kv="0.05" forcerange="-0.6 0.6"/>' for k in range(3))


def _pulled():
    own = 'stiffness="0.02" damping="0.005" armature="2e-5"'
    text = jaws(joint=own, ranges=((-1.2, 0.2), (-1.2, 0.2)), after=PULLED)
    return text.replace("<actuator></actuator>", f"<actuator>{PULL}</actuator>")


@pytest.mark.slow
def test_a_tendon_is_pulled_by_a_drive_of_its_own_until_the_finger_meets_something(tmp_path):
    hand, _ = _imported(tmp_path, _pulled())
    assert hand.joints == ("pull0", "pull1", "pull2")
    np.testing.assert_allclose(hand.limits, [[-2.4, 0.4]] * 3)
    assert hand.efforts.tolist() == [0.6] * 3 and [f.closes for f in hand.fingers] == [(-1,)] * 3
    target = np.full(3, -1.0)

    free = _reached(hand, target, 3.0, _alone)
    m = free.model
    near, far = (np.array([m.joint(f"{j}{k}").qposadr[0] for k in range(3)]) for j in ("first", "second"))
    q = free.qpos[-1]
    np.testing.assert_allclose(q[near] + q[far], -1.0, atol=0.05)  # what the tendon took in
    np.testing.assert_allclose(q[near], q[far], atol=0.05)  # equal springs share it

    def blocked(spec):
        _alone(spec)
        for k in range(3):
            spec.joint(f"first{k}").range = [-0.1, 0.2]  # as a thing in its way would

    met = _reached(hand, target, 3.0, blocked).qpos[-1]
    assert (met[near] > -0.15).all() and (met[far] < -0.8).all()  # the outer joint goes on


@pytest.mark.slow
def test_a_tendon_has_play_friction_and_elasticity_of_its_own(tmp_path):
    hand, _ = _imported(tmp_path, _pulled())
    file = tmp_path / "hand" / "servo.yaml"
    text = file.read_text()
    file.write_text(text.replace("pull1: {", "pull1: {backlash: 0.2, softness: 0.3, ").replace(
        "loop_encoder: joint", "loop_encoder: motor"))  # fmt: skip
    run = _reached(load_hand(tmp_path / "hand"), np.full(3, -1.0), 3.0, _alone)
    off = np.abs(run.position[-1] + 1.0)
    assert off[1] > 3 * off[0] and off[0] == pytest.approx(off[2], abs=5e-3)


@pytest.mark.parametrize(("after", "said"), [
    ('<equality><joint joint1="first0" joint2="second0"/><joint joint1="second0" joint2="first0"/></equality>',
     "jaws.xml: joints first0, second0 follow each other in a ring"),
    ('<equality><connect body1="far0" body2="far1" anchor="0 0 0"/></equality>',
     r"a closed loop \(connect far0, far1\)"),
    ('<equality><weld body1="far0" body2="far1"/></equality>', r"a weld \( far0, far1\)"),
    (PULLED.replace('"t0"', '"loose"'), "no actuator moves any of the joints of tendon 'loose'")])  # fmt: skip
def test_what_ties_joints_otherwise_is_refused_by_name(tmp_path, after, said):
    with pytest.raises(UserError, match=said + ("" if "ring" in said else ".*coupled=independent")):
        _imported(tmp_path, jaws(after=after))
    assert not (tmp_path / "hand").exists()


def test_a_second_finger_may_follow_the_first(tmp_path):
    text = jaws(kind="slide", axes=("-1 0 0", "0 0 1"), ranges=((0, 0.04), (0, 0.001)), fingers=2)
    text = re.sub(r'<joint name="second[^/]*/>', "", text)
    text = text.replace("</mujoco>", '<equality><joint joint1="first1" joint2="first0"/></equality></mujoco>')
    hand, _ = _imported(tmp_path, text)
    assert hand.joints == ("first0",) and [f.closes for f in hand.fingers] == [(1,), (1,)]
    opened, closed = (fingertips(hand, hand.pose(p)) for p in ("open", "cupped"))
    assert np.linalg.norm(closed[0] - closed[1]) < np.linalg.norm(opened[0] - opened[1])


@pytest.mark.slow
def test_a_driven_joint_that_follows_another_is_refused(tmp_path):
    hand, _ = _imported(tmp_path, jaws(after=f"<equality>{MIMIC}</equality>"))
    path = hand.folder / "hand.yaml"
    text = path.read_text()
    at = text.index("- {name: first0")
    path.write_text(text[:at] + "- {name: second0, effort: 1, speed: 1}\n  " + text[at:])
    with pytest.raises(UserError, match="'second0' follows 'first0' in the model"):
        load_hand(hand.folder)


def test_a_diagnosis_takes_the_inertia_that_the_drive_feels():
    from dexsim.gap.plant.mechanics import along

    text = CHAIN.format('<equality><joint joint1="b" joint2="a" polycoef="0 0.5 0 0 0"/><joint joint1="c" joint2="b"/>'
                        '</equality>')  # fmt: skip
    m = mujoco.MjModel.from_xml_string(text)
    t = np.linspace(0, 2, 401)
    q = 0.6 * np.sin(3 * t)[:, None]
    run = SimpleNamespace(
        t=t, fine=None, qs=q, vs=1.8 * np.cos(3 * t)[:, None], as_=-5.4 * np.sin(3 * t)[:, None],
        gravity=np.zeros(3), smooth=lambda: None)  # fmt: skip
    times, values, _ = along(m, run, ("a",), added=False)
    from dexsim.gap.plant.columns import SERIES_INDEX

    k = len(times) // 3
    moves = np.array([1.0, 0.5, 0.5])
    d = mujoco.MjData(m)
    at = 0.6 * np.sin(3 * times[k])
    d.qpos[:] = [at, 0.5 * at, 0.5 * at]
    mujoco.mj_forward(m, d)
    full = np.zeros((3, 3))
    mujoco.mj_fullM(m, d, full)
    assert values[0, k, SERIES_INDEX["inertia"]] == pytest.approx(moves @ full @ moves, rel=1e-4)


def test_a_slack_tendon_drags_its_follower_only_when_it_is_taut():
    text = CHAIN.format(
        '<tendon><fixed name="t" range="-0.1 0.1"><joint joint="b" coef="1"/><joint joint="a" coef="-0.5"/></fixed>'
        "</tendon><equality><joint joint1=\"c\" polycoef=\"0 0 0 0 0\"/></equality>"
    )
    m = mujoco.MjModel.from_xml_string(text)
    a = np.concatenate([np.linspace(0, 1, 101), np.linspace(1, 0, 101)[1:]])
    q, moves = Couplings(m, ["a"]).dragged(np.stack([a, 0 * a, 0 * a], 1))
    np.testing.assert_allclose(q[:101, 1], np.maximum(0.5 * a[:101] - 0.1, 0), atol=1e-9)
    np.testing.assert_allclose(q[101:, 1], np.minimum(0.4, 0.5 * a[101:] + 0.1), atol=1e-9)  # it stays, then returns
    taut = np.r_[False, np.abs(np.diff(q[:, 1])) > 1e-9]
    np.testing.assert_allclose(moves[:, 1, 0], np.where(taut, 0.5, 0.0), atol=1e-9)
    assert 0.35 < taut.mean() < 0.75


def test_a_diagnosis_feels_the_damping_of_what_follows():
    from dexsim.gap.plant.columns import SERIES_INDEX
    from dexsim.gap.plant.mechanics import along

    text = CHAIN.format('<equality><joint joint1="b" joint2="a" polycoef="0 0.5 0 0 0"/><joint joint1="c"/></equality>')
    m = mujoco.MjModel.from_xml_string(text)
    t = np.linspace(0, 2, 401)
    q, v = 0.5 * t[:, None], np.full((401, 1), 0.5)
    run = SimpleNamespace(t=t, fine=None, qs=q, vs=v, as_=0 * v, gravity=np.zeros(3), smooth=lambda: None)
    loads = []
    for damping, friction in ((0.0, 0.0), (0.2, 0.03)):
        m.dof_damping[1], m.dof_frictionloss[1] = damping, friction
        loads.append(along(m, run, ("a",), added=False)[1][0, :, SERIES_INDEX["rest"]])
    np.testing.assert_allclose(loads[1] - loads[0], 0.5 * (0.2 * 0.25 + 0.03), rtol=1e-6)


def test_a_joint_without_a_name_is_one_that_nobody_drives():
    m = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="a"/><geom size=".1"/><body><joint/><geom size=".1"/></body></body>'
        "</worldbody></mujoco>"
    )
    assert Couplings(m, ["a"]).passive == ("",) and not Couplings(m, ["a"]).tied


@pytest.mark.slow
def test_a_press_of_a_coupled_finger_obeys_virtual_work(tmp_path):
    """The fingertip's force times its way is the drive's torque times its own, what follows moving along."""
    from dexsim.calibration.simulate import press_recording

    (tmp_path / "jaws.xml").write_text(jaws(after=f"<equality>{MIMIC}</equality>"))
    import_hand(tmp_path / "jaws.xml", tmp_path / "hand", settings(pads=(3, 3)), picture=False)
    hand = load_hand(tmp_path / "hand")
    pressed = press_recording(hand, "first0", levels=4)
    taxels, torque = pressed.tactile.value, pressed.states.effort.value[:, 0]  # [T, F, K, 3]
    at = pressed.tactile.t > 0.5 * pressed.tactile.t[-1]  # let go step by step
    force = np.linalg.norm(taxels.sum((1, 2)), axis=1)[at]
    torque = np.abs(np.interp(pressed.tactile.t[at], pressed.states.effort.t, torque))
    layout, share = hand_layout(hand), taxels[at, 0, :, 2].sum(0)
    point, normal = (x[0, : len(share)].T @ share / share.sum() for x in (layout.point, layout.normal))

    def place(moved):
        m, d = hand.compiled, mujoco.MjData(hand.compiled)
        hand.couplings.put(d, hand.pose("open") + moved * np.eye(len(hand.joints))[0])
        mujoco.mj_kinematics(m, d)
        tip = d.body(hand.tip_bodies[0])
        return tip.xmat.reshape(3, 3) @ point + tip.xpos, tip.xmat.reshape(3, 3) @ normal

    way = abs((place(1e-4)[0] - place(-1e-4)[0]) @ place(0.0)[1]) / 2e-4
    assert np.polyfit(torque, force, 1)[0] * way == pytest.approx(1.0, abs=0.06)
