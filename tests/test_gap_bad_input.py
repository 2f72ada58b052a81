"""Bad input of the diagnosis: signals that are not what they say, and recordings that cannot carry an answer, named."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.errors import UserError
from dexsim.gap import command, demo
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.finding import Finding
from dexsim.gap.judge import conclude
from dexsim.gap.judge.held_out import Split
from dexsim.gap.read import channels
from dexsim.recording import read, write


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    paths, model, servo, _ = demo.make(folder, "", seconds=4.0)
    return folder, paths, model, servo


def judged(rig, tmp_path, change, keep=(0, 2), **settings):
    """Return the diagnosis of two recordings, both changed, with one effect to consider: the signals are what is
    tested."""
    folder, paths, model, servo = rig
    out = []
    for k in keep:
        r = read(paths[k], joints=["joint"], audit=False)
        change(r)
        out.append(tmp_path / f"{k}.mcap")
        write(out[-1], r)
    s = Settings(
        out,
        tmp_path / "out",
        None,
        str(model),
        str(servo),
        next_recording=False,
        allowed=settings.pop("allowed", {"command_delay"}),
        **settings,
    )
    d = diagnose(s, say=lambda _: None)
    save(d, s.out)
    json.loads((s.out / "diagnosis.json").read_text())
    return d


def wrapped_effort(r):
    e = r.states.effort
    e.value = np.where(e.value < 0, e.value + 65.536, e.value)


def lost_sign(r):
    r.states.effort.value = np.abs(r.states.effort.value)


def repeated(r):
    p = r.states.position
    for a in range(20, len(p.t) - 30, 60):
        p.value[a : a + 25] = p.value[a]


def frozen_once(r):
    r.states.position.value[150:240] = r.states.position.value[150]


def degrees(r):
    r.states.position.value = np.degrees(r.states.position.value)


def degrees_everywhere(r):
    degrees(r)
    r.commands.value = np.degrees(r.commands.value)


def counts(r):
    r.states.position.value = np.round(r.states.position.value * 4096 / 2 / np.pi)


def drifting_stamp(r):
    r.states.position.stamp = r.states.position.t * 1.02 + 0.3


def late_commands(r):
    r.commands.t, r.commands.stamp = r.commands.t + 0.4, None


def reversed_commands(r):
    r.commands.value = -r.commands.value


def wrapped_position(r):
    r.states.position.value = np.mod(r.states.position.value, 2 * np.pi)


def stopped(r):
    r.states.position.value[150:] = r.states.position.value[150]


STILL = [
    ("wrap", wrapped_effort),
    ("lost_sign", lost_sign),
    ("stale", repeated),
    ("stale", frozen_once),
    ("clock_skew", drifting_stamp),
]
LOST = [
    ("unit", degrees),
    ("unit", degrees_everywhere),
    ("unit", counts),
    ("wrap", wrapped_position),
    ("sign", reversed_commands),
    ("stuck", stopped),
    ("clock_skew", late_commands),
]


def cases(changes, *quick):
    """Yield all of them; those that are not named `quick`, whose fault tests of the audit find too, are slow."""
    for kind, change in changes:
        marks = [] if change in quick else [pytest.mark.slow]
        yield pytest.param(kind, change, id=change.__name__, marks=marks)


@pytest.mark.parametrize(("kind", "change"), cases(STILL, wrapped_effort, drifting_stamp))
def test_a_bad_channel_is_named_and_the_rest_still_judged(rig, tmp_path, kind, change):
    d = judged(rig, tmp_path, change)
    bad = [f for f in d.data["findings"] if f["effect"] == "bad_channel"]
    assert [f["regime"].split(":")[0] for f in bad] == [kind] and bad[0]["where"]["topics"] and bad[0]["when"]
    assert (
        d.data["verdict"] == "explained"
        and d.data["held_out"]["before"] < (6 if change is repeated else 2) * d.data["noise_floor"]["position_rad"]
    )
    assert "not what it says" in d.sentence


@pytest.mark.parametrize(("kind", "change"), cases(LOST, degrees_everywhere, reversed_commands, stopped, late_commands))
def test_a_bad_position_or_command_makes_the_joint_unusable(rig, tmp_path, kind, change):
    d = judged(rig, tmp_path, change, keep=(1, 2) if change is late_commands else (0, 2))
    bad = [f["regime"].split(":")[0] for f in d.data["findings"]]
    assert kind in bad and all(f["effect"] == "bad_channel" for f in d.data["findings"])
    assert d.data["verdict"] == "unusable" and kind in d.sentence and d.data["held_out"]["before"] is None


def test_commands_that_are_stamped_late_in_all_recordings_are_no_term_of_the_loop(rig, tmp_path):
    """Their answer comes less than 60 ms before them, and in some motions that looks like a lag: each alone is no
    proof, and a feed-forward of speed follows them well."""

    def late(r):
        r.commands.t, r.commands.stamp = r.commands.t + 0.08, None

    d = judged(rig, tmp_path, late, keep=(0, 1, 2, 3), allowed={"controller_term", "inertia"})
    (found,) = d.data["findings"]
    assert found["effect"] == "bad_channel" and "in all recordings" in found["regime"]
    said = float(re.search(r"(\d+) ms before these", found["regime"])[1])
    assert abs(said - 80) < 3 and d.data["verdict"] == "unusable" and "clock_skew" in d.sentence


@pytest.mark.slow
def test_healthy_recordings_have_no_bad_channel(rig, tmp_path):
    d = judged(rig, tmp_path, lambda r: None, keep=(0, 1, 2, 3))
    assert d.data["verdict"] == "none" and not d.data["findings"]


def test_one_bad_recording_leaves_the_others(rig, tmp_path):
    folder, paths, model, servo = rig
    r = read(paths[3], audit=False)
    degrees(r)
    write(tmp_path / "wrong.mcap", r)
    s = Settings(
        [*paths[:2], tmp_path / "wrong.mcap"],
        tmp_path / "out",
        None,
        str(model),
        str(servo),
        next_recording=False,
        allowed={"command_delay"},
    )
    d = diagnose(s, say=lambda _: None)
    assert d.data["verdict"] == "explained" and any("wrong.mcap" in n and "left out" in n for n in d.notes)
    assert [f["effect"] for f in d.data["findings"]] == ["bad_channel"]


def test_effects_that_cannot_be_there_are_named(rig, tmp_path):
    d = judged(rig, tmp_path, lambda r: None, allowed={"supply_sag", "tactile_hysteresis"})
    assert any(n.startswith("supply_sag cannot be seen") for n in d.notes) and any(
        n.startswith("tactile_hysteresis cannot be seen") for n in d.notes
    )
    with pytest.raises(UserError, match="Did you mean 'backlash'"):
        command.main(["recordings=" + str(rig[1][0]), "effects=[backlas]", f"model={rig[2]}", f"servo={rig[3]}"])


def test_an_error_that_no_effect_allowed_could_make_is_unknown(rig, tmp_path):
    def softer(r):
        r.states.position.value = 0.8 * r.states.position.value

    d = judged(rig, tmp_path, softer, allowed={"supply_sag"})
    assert d.data["verdict"] == "unknown" and d.data["held_out"]["before"] > 5 * d.data["noise_floor"]["position_rad"]


def test_values_that_are_no_numbers_are_said_and_left_out(rig, tmp_path):
    def holes(r):
        r.states.position.value[50:90] = np.nan

    d = judged(rig, tmp_path, holes)
    assert d.data["verdict"] == "none" and any("not a finite number in 40" in n for n in d.notes)


def test_held_out_copies_are_refused(rig, tmp_path):
    folder, paths, model, servo = rig
    copy = tmp_path / "another_name.mcap"
    copy.write_bytes(paths[0].read_bytes())
    with pytest.raises(UserError, match="same readings"):
        diagnose(Settings(paths[:2], tmp_path, [copy], str(model), str(servo)), say=lambda _: None)


@pytest.mark.slow
def test_two_recordings_of_a_dead_encoder_are_no_copies(rig, tmp_path):
    """Both hold one reading for all their length: that is a fault of the signal, which is named, not one recording
    given twice."""
    folder, paths, model, servo = rig
    dead = []
    for k in (0, 1):
        r = read(paths[k], audit=False)
        r.states.position.value[:] = 0.25
        dead.append(tmp_path / f"dead_{k}.mcap")
        write(dead[-1], r)
    s = Settings(
        [*paths[2:], dead[0]],
        tmp_path / "out",
        [paths[0], dead[1]],
        str(model),
        str(servo),
        next_recording=False,
        allowed={"command_delay"},
    )
    d = diagnose(s, say=lambda _: None)
    assert "bad_channel" in [f["effect"] for f in d.data["findings"]]


def test_a_model_that_does_not_compile_still_says_what_the_recordings_are(rig, tmp_path):
    folder, paths, model, servo = rig
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(
        UserError, match=r"broken.xml.*of the recordings themselves: motion_1.mcap: 4.0 s of 1 joint, no fault"
    ) as error:
        diagnose(Settings(paths[:1], tmp_path, None, str(broken), str(servo)), say=lambda _: None)
    assert "\n" not in str(error.value)


def test_joints_on_one_side_only_are_said(rig, tmp_path):
    """The model has a joint that no recording has, the recording one that the model has not: both named, the common one
    judged."""
    folder, paths, model, servo = rig
    both = tmp_path / "two.xml"
    both.write_text(
        model.read_text().replace(
            '<body name="link">',
            '<body name="other"><joint name="wrist" type="hinge" axis="0 1 0"/>'
            '<geom size="0.01" mass="0.1" pos="0 0 0.05"/></body><body name="link">',
        )
    )
    out = []
    for k in (0, 2):
        r = read(paths[k], audit=False)
        twice = lambda s: np.concatenate([s.value, s.value], 1)  # noqa: E731
        r.joints = ("joint", "elbow")
        r.meta["joint_names"] = "joint,elbow"
        for s in (r.commands, r.states.position):
            s.value = twice(s)
        r.states.effort = None
        out.append(tmp_path / f"{k}.mcap")
        write(out[-1], r)
    s = Settings(out, tmp_path / "out", None, str(both), str(servo), next_recording=False, allowed={"command_delay"})
    d = diagnose(s, say=lambda _: None)
    assert d.data["verdict"] == "none" and set(d.joints) == {"joint"}
    assert any("elbow" in n for n in d.notes) and any("wrist" in n for n in d.notes)


def test_what_is_taken_for_repeated_readings():
    t = np.arange(0, 10, 0.01)

    def held(q, target):
        before = target[np.maximum(np.arange(len(t)) - round(channels.REACTS / 0.01), 0)]
        return channels._held(t, q, np.stack([target, before]))

    wanted = 0.3 * np.sin(2 * t)
    smooth = np.round(wanted / 1.5e-3) * 1.5e-3
    frozen = smooth.copy()
    for a in (157, 314, 471):  # in the middle of a motion
        frozen[a : a + 20] = frozen[a]
    assert held(frozen, wanted).sum() == 3 * 19
    assert not held(smooth, wanted).any()
    creeping = np.round(0.02 * np.sin(t) / 1.5e-3) * 1.5e-3
    assert not held(creeping, 0.02 * np.sin(t)).any()  # slow motion in whole counts
    goal = np.repeat(np.random.default_rng(0).uniform(-1, 1, 10), 100)
    servo = np.zeros_like(t)
    for i in range(1, len(t)):
        servo[i] = servo[i - 1] + 0.35 * (goal[i] - servo[i - 1])
    assert not held(np.round(servo / 1.5e-3) * 1.5e-3, goal).any()  # a joint that rests and then starts at once


def test_links_that_touch_each_other_are_cut_out():
    """Thumb against index in the xHand's own model: the stretch in which they press is no free air."""
    import mujoco

    from dexsim.gap.read import Run, inputs
    from tools.assets import xhand

    model = xhand.hand_spec().compile()
    data = mujoco.MjData(model)
    low, high = xhand.joint_limits().T
    rng = np.random.default_rng(0)
    while True:  # a pose in which the hand touches itself
        pose = rng.uniform(low, high)
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon and data.contact.dist[: data.ncon].min() < -2e-3:
            break
    t = np.arange(0, 8, 0.01)
    share = np.clip((t - 3.0) / 1.0, 0, 1) * np.clip((6.0 - t) / 1.0, 0, 1)  # open, closed from 4 to 5 s, open
    q = share[:, None] * pose[None]
    run = Run("a", xhand.JOINTS, t, q, t, q, None, np.zeros(3))
    spans = inputs.self_touch([run], model)["a"]
    assert len(spans) == 1 and 3.0 < spans[0][0] <= 4.0 and 5.0 <= spans[0][1] < 6.0
    assert inputs.merged_spans({"a": [(1.0, 2.0)]}, {"a": [(1.5, 3.0), (4.0, 5.0)]}) == {"a": [(1.0, 3.0), (4.0, 5.0)]}
    open_hand = Run("b", xhand.JOINTS, t, 0 * q, t, 0 * q, None, np.zeros(3))
    assert not inputs.self_touch([open_hand], model)


def test_what_is_wrong_in_a_recording_that_is_left_out_doubts_nothing_elsewhere():
    """A joint that is stuck in one of several recordings, which is left out: whole where it has no other joint."""
    stuck = lambda *names: Finding("", 0.9, "", ["joint"], when=[{"recording": n} for n in names])  # noqa: E731
    split_of = lambda **runs: Split(  # noqa: E731
        [SimpleNamespace(name=n, left_out=frozenset(x)) for n, x in runs.items()], [0], [1], None, None
    )
    assert conclude._elsewhere(stuck("b"), split_of(a=(), c=()))
    assert conclude._elsewhere(stuck("b", "c"), split_of(a=(), c=("joint",)))
    assert not conclude._elsewhere(stuck("b", "c"), split_of(a=(), c=()))
    assert not conclude._elsewhere(stuck("a"), split_of(a=(), c=()))
