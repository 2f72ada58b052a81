"""A hand's folder: read, checked against its model, put into the palm frame, mirrored and scaled."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dexsim import yaml_text
from dexsim.errors import UserError
from dexsim.hand import load_hand, schema
from dexsim.hand.skin import tip_skins
from dexsim.import_hand.text import write
from tests.made_hand import _MODEL, content, made_hand
from tools.assets import xhand


def posed(hand, angles):
    model = hand.spec().compile()
    data = mujoco.MjData(model)
    for joint, q in zip(hand.joints, angles, strict=True):
        data.qpos[model.joint(joint).qposadr[0]] = q
    mujoco.mj_forward(model, data)
    return model, data


def tips(hand, data):
    return np.array([data.body(f.body).xpos + data.body(f.body).xmat.reshape(3, 3) @ f.position for f in hand.fingers])


def test_the_xhand_is_such_a_folder_to_the_last_bit():
    hand = load_hand("xhand")
    assert hand.joints == xhand.JOINTS and hand.finger_names == xhand.FINGERS and hand.robot == "xhand_right"
    for ours, theirs in (
        (hand.limits, xhand.joint_limits()), (hand.efforts, xhand.efforts()), (hand.speeds, xhand.speeds())
    ):  # fmt: skip
        assert np.array_equal(ours, theirs)
    assert hand.tip_geoms == xhand.TIP_GEOMS and hand.tip_bodies == xhand.TIP_BODIES and hand.opposing == (0,)
    a, b = hand.spec().compile(), xhand.hand_spec().compile()
    for name in ("body_pos", "body_quat", "body_inertia", "jnt_range", "geom_pos", "geom_quat", "geom_size",
                 "geom_contype", "geom_conaffinity", "geom_margin", "geom_solref", "dof_armature", "mesh_vert"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    for skin, finger in zip(tip_skins(hand), xhand.FINGERS, strict=True):
        assert np.array_equal(skin, xhand.tip_skin_mesh(finger)[0])


def test_world_is_the_palm_frame_whatever_the_file_has(tmp_path):
    hand = load_hand(made_hand(tmp_path / "made"))
    model, data = posed(hand, hand.pose("open"))
    palm = data.body("hull")
    assert np.allclose(palm.xpos + palm.xmat.reshape(3, 3) @ [0, 0, 0.002], 0, atol=1e-12)
    assert np.allclose(palm.xmat.reshape(3, 3) @ np.array([[0, 1, 0], [0, 0, 1]]).T, [[1, 0], [0, 0], [0, 1]])
    opened = tips(hand, data)
    assert (opened[:2, 0] > 0.1).all() and opened[2, 1] > 0.05, "fingers forward, a left hand's thumb at +y"
    _, data = posed(hand, hand.pose("cupped"))
    cupped = tips(hand, data)
    assert np.linalg.norm(cupped[2] - cupped[:2].mean(0)) < np.linalg.norm(opened[2] - opened[:2].mean(0))
    assert (cupped[:2, 2] > 0.045).all(), "both fingers close toward the palm, one with negative angles"
    assert hand.closing.tolist() == [0, 1, 1, 0, 0, 1, -1, 1, -1]
    assert hand.finger_of_joint == (2, 2, 2, 0, 1, 0, 1, 0, 1)
    assert model.nu == 0 and hand.handedness == "left"


def test_self_collision_stays_the_models_and_objects_meet_every_geom(tmp_path):
    model = load_hand(made_hand(tmp_path / "made")).spec().compile()
    seen = model.geom_contype == 0
    assert seen.sum() == 2 and (model.geom_conaffinity[seen] == 0).all()
    solid = ~seen
    assert (model.geom_contype[solid] & 2).all() and (model.geom_conaffinity[solid] & 1).all()
    assert not (model.geom_contype & 1).any() and not (model.geom_conaffinity & 2).any()
    assert (model.geom_contype[solid] & model.geom_conaffinity[solid] & 4).all(), "1/1 of the file, two bits up"


@pytest.mark.parametrize("mirror, scale", [(True, 1.0), (False, 1.3), (True, 0.8)])
def test_mirror_and_scale_move_as_the_original(tmp_path, mirror, scale):
    """Positions, energies and torques of the derived hand are those of the original in a mirror, or larger."""
    for which in ("xhand", made_hand(tmp_path / "made")):
        one, other = load_hand(which), load_hand(which, mirror, scale)
        assert np.array_equal(one.limits, other.limits) and other.span == pytest.approx(one.span * scale)
        flip = np.array([1, -1 if mirror else 1, 1]) * scale
        rng = np.random.default_rng(3)
        q = one.limits[:, 0] + rng.random(len(one.joints)) * np.ptp(one.limits, axis=1)
        (m1, d1), (m2, d2) = posed(one, q), posed(other, q)
        assert np.allclose(d1.geom_xpos * flip, d2.geom_xpos, atol=1e-9)
        assert np.allclose(tips(one, d1) * flip, tips(other, d2), atol=1e-9)
        for (m, d), g in (((m1, d1), 1.0), ((m2, d2), scale)):  # without motors, in gravity that is larger too
            m.dof_armature[:] = m.dof_damping[:] = 0
            m.opt.gravity[:] = [1.0 * g, 0.0, -9.0 * g]
            d.qvel[:] = 1.0 + 0.1 * np.arange(m.nv)
            d.qacc[:] = 2.0 - 0.3 * np.arange(m.nv)
            mujoco.mj_inverse(m, d)
        free = d1.qfrc_inverse - d1.qfrc_constraint, d2.qfrc_inverse - d2.qfrc_constraint
        assert np.allclose(free[0] * scale**5, free[1], rtol=1e-6, atol=1e-12)
        assert (other.handedness == one.handedness) is not mirror
        for a, b in zip(tip_skins(one), tip_skins(other), strict=True):
            assert np.allclose(np.sort(a * flip, 0), np.sort(b, 0), atol=1e-6)


def _changed(path, value):
    """Return the content of hand.yaml with one place changed; value None: taken out."""
    data = content()
    *way, last = path
    node = data
    for key in way:
        node = node[key]
    if value is None:
        del node[last]
    else:
        node[last] = value
    return data


@pytest.mark.parametrize(
    "path, value, said",
    [
        (("format",), "other", "format: must be dexsim-hand"),
        (("version",), 2, "version"),
        (("span",), "wide", "span ('wide')"),
        (("span",), 80.0, "span (80.0)"),
        (("extra",), 1, "extra"),
        (("model",), "lost.xml", "model (lost.xml): no such file"),
        (("servo",), "lost.yaml", "servo (lost.yaml): no such file"),
        (("palm", "body"), "fist", "palm.body (fist): not in the model; it has"),
        (("palm", "forward"), [0.0, 0.0, 1.0], "palm.forward"),
        (("fingers", 0, "joints"), ["a_spread", "a_crul", "a_bend"], "did you mean a_curl?"),
        (("fingers", 0, "flexion"), ["b_curl"], "fingers.a.flexion: 'b_curl'"),
        (("fingers", 0, "closes"), [1], "must have 2 entries"),
        (("fingers", 0, "tip", "body"), "b_end", "'b_end' twice"),
        (("fingers", 1, "name"), "a", "fingers: 'a' twice"),
        (("fingers", 0, "tip", "geoms"), ["t_tip"], "not a colliding geom of a_end"),
        (("fingers", 0, "tip", "normal"), [0.0, 0.0, 0.0], "tip.normal"),
        (("fingers", 1, "pad"), None, "fingers.b.pad: has none, but others have"),
        (("opposing",), ["thumb"], "opposing: 'thumb' is not a finger"),
        (("opposing",), ["a", "b", "t"], "opposing names every finger"),
        (("poses", "open", "a_curl"), 2.5, "poses.open.a_curl (2.5): the model's range is [0, 2.1] rad"),
        (("poses", "cupped", "a_curl"), None, "poses.cupped: lacks joint 'a_curl'"),
        (("joints", 0, "effort"), 0.0, "joints[0].effort (0.0)"),
        (("joints", 0), None, "joints: 't_swing' is not in joints"),
    ],
)
def test_what_is_wrong_in_the_file_is_one_line(tmp_path, path, value, said):
    changed = _changed(path, value)
    folder = made_hand(tmp_path / "made")
    import yaml

    (folder / "hand.yaml").write_text(yaml.safe_dump(changed))
    with pytest.raises(UserError) as error:
        load_hand(folder)
    text = str(error.value)
    if path == ("joints", 0) and value is None:
        said = "fingers.t.joints: 't_swing' is not in joints"
    assert said in text and str(folder) in text and "\n" not in text and len(text) < 700, text


@pytest.mark.parametrize(
    "old, new, said",
    [
        ("<actuator>", '<equality><weld name="tie" body1="a_end" '
                       'body2="b_end"/></equality><actuator>', "'tie' is neither of joints nor of tendons"),
        ("<actuator>", '<equality><joint name="tie" joint1="a_curl" '
                       'joint2="a_bend"/></equality><actuator>', "'a_curl' follows 'a_bend' in the model"),
        ('<light pos="0 0 1"/>', '<geom name="floor" type="plane" size="1 1 1"/>', "geom 'floor' belongs to the world"),
        ('<light pos="0 0 1"/>', '<body name="cup"><freejoint/><geom size="0.1"/></body>', "is a free joint"),
        ('<light pos="0 0 '
         '1"/>', '<body name="cup"><geom size="0.1"/></body>', "2 bodies hang on the world (cup, hull)"),
        ('range="-0.6 0.8"', "", "joint 't_swing' of the model has the range [0, 0] rad, not limited"),
        ('<geom name="t_tip"', '<geom class="seen" name="t_tip"', "'t_tip' is not a colliding geom"),
        ('<joint name="t_bend"', '<joint name="extra" axis="1 0 0" range="0 1"/><joint '
                                 'name="t_bend"', "lacks 'extra' of the model"),
        ("<mujoco model", "<mujoco modle", "made.xml"),
    ],
)  # fmt: skip
def test_what_a_model_cannot_be_is_one_line(tmp_path, old, new, said):
    assert old in _MODEL
    folder = made_hand(tmp_path / "made", model=_MODEL.replace(old, new, 1))
    with pytest.raises(UserError) as error:
        load_hand(folder)
    assert said in str(error.value) and str(folder) in str(error.value), str(error.value)


def test_names_of_hands(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="did you mean xhand"):
        load_hand("xhnd")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="has no hand.yaml"):
        load_hand(tmp_path / "empty")
    monkeypatch.chdir(tmp_path)
    made = made_hand(tmp_path / "hands" / "leapt")
    assert load_hand("leapt").folder == made.resolve() == load_hand("hands/leapt").folder
    with pytest.raises(UserError, match="hand=leap: must be one of xhand, xhand_skin, leapt, .*did you mean leapt"):
        load_hand("leap")
    with pytest.raises(UserError, match="hand_scale=9"):
        load_hand("xhand", scale=9.0)


def test_written_and_read_again(tmp_path):
    folder = made_hand(tmp_path / "made")
    file = schema.read(folder / "hand.yaml")
    write(yaml_text.load(folder / "hand.yaml", "hand"), folder)
    assert schema.read(folder / "hand.yaml") == file
    assert load_hand(folder).file.guessed == ["palm.normal"]


def test_a_hand_goes_to_another_process():
    """The simulated hand in real time runs in a process of its own, and is handed the hand."""
    import pickle

    remaining = load_hand("xhand", mirror=True, scale=1.1)
    again = pickle.loads(pickle.dumps(remaining))
    assert (again.mirror, again.scale, again.joints) == (True, 1.1, remaining.joints)
    assert again.compiled.nq == remaining.compiled.nq and (again.limits == remaining.limits).all()
