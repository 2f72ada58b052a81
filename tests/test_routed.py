"""Routed tendons as fixed coefficients: the same lengths and forces where pulleys turn about the joints."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.import_hand import poses, routed
from dexsim.import_hand.importing import import_hand
from tests.test_couplings import _alone, _reached
from tests.test_import_faithful import jaws, settings

NEAR, FAR = 0.006, 0.004  # m, radii of the pulleys, whose axes are the joints'


def _pulley(name: str, radius: float) -> str:
    return (f'<geom name="{name}" type="cylinder" size="{radius} 0.004" quat="0.70710678 0.70710678 0 0" contype="0"'
            ' conaffinity="0" mass="0"/>')  # fmt: skip


def _routed(radius: float = NEAR, own: str = "", more: str = "") -> str:
    """Return a claw whose fingers are on tendons around pulleys of both joints, on their outer sides."""
    ease = 'stiffness="0.02" damping="0.005" armature="2e-5"'
    text = jaws(joint=ease, ranges=((-1.2, 0.0), (-1.2, 0.0)), after="<tendon>{}</tendon>")
    paths = []
    for k in range(3):
        a = 2 * np.pi * k / 3
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        x, y, z = np.array([0.045 * np.cos(a), 0.045 * np.sin(a), 0.02]) + turn @ [NEAR, 0, -0.02]
        text = text.replace("<geom type=\"cylinder\" size=\"0.05 0.01\"/>",
                            f"<geom type=\"cylinder\" size=\"0.05 0.01\"/><site name=\"a{k}\" pos=\"{x} {y} {z}\"/>")
        text = text.replace(f'<body name="far{k}"', f'{_pulley(f"near_p{k}", radius)}<site name="s{k}" pos="0.02 0 0"/>'
                            f'<site name="b{k}" pos="{FAR} 0 0.02"/><body name="far{k}"')  # fmt: skip
        far = '<geom type="capsule" size="0.008" fromto="0 0 0.012 0 0 0.04"/>'
        at = text.index(far, text.index(f'<body name="far{k}"'))
        text = (text[:at] + _pulley(f"far_p{k}", FAR) + f'<site name="t{k}" pos="0.02 0 0"/>'
                f'<site name="c{k}" pos="{FAR} 0 0.03"/>' + text[at:])  # fmt: skip
        way = f'<geom geom="near_p{k}" sidesite="s{k}"/><site site="b{k}"/><geom geom="far_p{k}" sidesite="t{k}"/>'
        paths.append(f'<spatial name="pulled{k}" {own}><site site="a{k}"/>{way}<site site="c{k}"/></spatial>')
    gains = 'kp="55000" kv="1400" ctrlrange="0.06 0.09" forcerange="-100 100"'
    acts = "".join(f'<position name="pull{k}" tendon="pulled{k}" {gains}/>' for k in range(3))
    text = text.replace("<tendon>{}</tendon>", f"<tendon>{''.join(paths)}{more}</tendon>")
    return text.replace("<actuator></actuator>", f"<actuator>{acts}</actuator>")


def test_forces_are_those_of_the_routed_tendon():
    before = mujoco.MjSpec.from_string(_routed(own='stiffness="800" springlength="0.07" damping="3"'))
    after, notes = before.copy(), []
    assert routed.straighten(after, notes) == {} and len(notes) == 3 and "near" not in notes[0]
    assert "-6.00 mm/rad of first0, -4.00 mm/rad of second0" in notes[0]
    one, two = before.compile(), after.compile()
    a, b = mujoco.MjData(one), mujoco.MjData(two)
    assert (two.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT).all()
    draw = np.random.default_rng(1)
    for _ in range(20):
        for m, d in ((one, a), (two, b)):
            d.ctrl[:] = m.actuator_ctrlrange[:, 0]
        a.qpos[:] = b.qpos[:] = draw.uniform(one.jnt_range[:, 0], one.jnt_range[:, 1])
        a.qvel[:] = b.qvel[:] = draw.normal(0, 1, one.nv)
        mujoco.mj_forward(one, a)
        mujoco.mj_forward(two, b)
        np.testing.assert_allclose(b.qfrc_passive, a.qfrc_passive, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(b.qfrc_actuator, a.qfrc_actuator, rtol=1e-3, atol=2e-3)


def test_what_carries_nothing_is_left_out_and_what_bends_is_refused(tmp_path):
    idle = '<spatial name="drawn"><site site="c0"/><site site="c1"/></spatial>'
    spec, notes = mujoco.MjSpec.from_string(_routed(more=idle)), []
    assert routed.straighten(spec, notes) == {} and notes[-1] == "left out: tendons that carry nothing: drawn"
    (tmp_path / "jaws.xml").write_text(_routed(more=idle.replace('"drawn"', '"drawn" stiffness="5"')))
    (tmp_path / "broken.xml").write_text(_routed().replace('"capsule" size="0.008"', '"capsule" size="0"'))
    with pytest.raises(UserError, match=r"model .*broken.xml: .*size 0 must be positive"):
        import_hand(tmp_path / "broken.xml", tmp_path / "hand", settings(), picture=False)
    with pytest.raises(UserError, match=r"tendon 'drawn' is routed over sites or geoms, off a line by \d+ % of its"):
        import_hand(tmp_path / "jaws.xml", tmp_path / "hand", settings(), picture=False)


@pytest.mark.slow
def test_a_finger_on_a_routed_tendon_is_pulled_as_far_as_its_file_says(tmp_path, monkeypatch):
    monkeypatch.setattr(poses, "STARTS", 1)
    (tmp_path / "jaws.xml").write_text(_routed())
    import_hand(tmp_path / "jaws.xml", tmp_path / "hand", settings(), picture=False)
    hand = load_hand(tmp_path / "hand")
    assert hand.joints == ("pull0", "pull1", "pull2")
    np.testing.assert_allclose(hand.efforts, 100 * NEAR, rtol=1e-3)  # N m at a drum as large as the larger pulley
    run = _reached(hand, np.ones(3), 3.0, _alone)
    q = run.qpos[-1]
    near, far = (np.array([run.model.joint(f"{j}{k}").qposadr[0] for k in range(3)]) for j in ("first", "second"))
    np.testing.assert_allclose(q[near] + FAR / NEAR * q[far], -1.0, atol=0.05)
    np.testing.assert_allclose(q[far] / q[near], FAR / NEAR, atol=0.05)  # equal springs, torques as the radii
