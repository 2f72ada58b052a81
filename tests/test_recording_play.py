"""Simulated recordings: mechanisms driven by commands, hardware-like sampling, a play recorded and replayed."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import yaml
from rig import pendulum_spec

from dexsim.actuator.table import ServoTable
from dexsim.cli import recorded as replay_cli
from dexsim.cli import start
from dexsim.errors import UserError
from dexsim.paths import CONFIGS
from dexsim.recording import Series, read, write
from dexsim.recording import mechanism as mech
from dexsim.recording.audit import audit, table
from dexsim.recording.compare import compare
from dexsim.recording.realistic import Hardware, realistic, sample_times
from tools.assets import xhand

torch.set_num_threads(1)
SERVO = {
    "joints": {
        "*": {
            "kp": 2.0,
            "kd": 0.05,
            "torque_limit": 1.0,
            "no_load_speed": 12.0,
            "delay": 0.013,
            "coulomb_friction": 0.01,
        }
    },
    "current_per_torque": 0.9,
}


def pendulum(servo=None, **options):
    spec = pendulum_spec(**options)
    return mech.Mechanism(spec, ("joint",), ServoTable.from_dict(servo or SERVO), "pendulum")


def sines(seconds, joints, period=0.02, size=0.3, centre=0.0):
    t = np.arange(0, seconds, period)
    return Series(t, centre + size * np.sin(2 * np.pi * np.linspace(0.4, 0.9, joints) * t[:, None]))


@pytest.fixture(scope="module")
def hand_run():
    m = mech.mechanism()
    limits = m.limits
    commands = sines(3.0, 12)
    commands.value = limits.mean(1) + 0.4 * (limits[:, 1] - limits[:, 0]) * commands.value
    return m, commands, mech.drive(m, commands, m.joints, 3.0, commands.value[0], timestep=0.004)


def test_statics_of_a_driven_pendulum():
    # at rest kp (target - q) = m g l sin q, to the friction's width
    m = pendulum({"joints": {"*": {"kp": 0.5, "kd": 0.02}}}, mass=0.2, length=0.1)
    target = 0.9
    run = mech.drive(m, Series(np.zeros(1), np.array([[target]])), ("joint",), 4.0)
    q = run.position[-1, 0]
    assert 0.5 * (target - q) == pytest.approx(0.2 * 9.81 * 0.1 * np.sin(q), abs=1e-4)
    assert run.torque[-1, 0] == pytest.approx(0.5 * (target - q), abs=1e-4)


def test_targets_act_at_their_stamps_whatever_the_step():
    m = pendulum({"joints": {"*": {"kp": 2.0, "kd": 0.2, "delay": 0.02}}})
    runs = [
        mech.drive(m, Series(np.array([0.0, 0.1237]), np.array([[0.0], [0.3]])), ("joint",), 0.4, timestep=h)
        for h in (0.0005, 0.004)
    ]
    fine, coarse = runs
    assert np.abs(np.interp(coarse.t, fine.t, fine.position[:, 0]) - coarse.position[:, 0]).max() < 0.01
    assert np.abs(coarse.position[coarse.t < 0.1437, 0]).max() < 1e-12  # not before stamp and delay


def test_a_recorded_run_replays_the_same(hand_run, tmp_path):
    m, commands, run = hand_run
    recording = mech.recorded(run, m, commands, m.joints, rate=250.0)
    write(tmp_path / "a.mcap", recording)
    back = read(tmp_path / "a.mcap")
    assert not [f for f in back.findings if f.severity != "info"], table(back.findings)
    again = mech.replay(back, mech.for_recording(back), timestep=0.004)
    n = len(run.t)
    # times pass through whole nanoseconds, values through float64: tolerance 1e-6 rad, 1e-5 N.m
    assert np.abs(again.position[:n] - run.position).max() < 1e-6
    assert np.abs(again.torque[:n] - run.torque).max() < 1e-5
    twice = mech.replay(back, mech.for_recording(back), timestep=0.004)
    np.testing.assert_array_equal(twice.position, again.position)


def test_a_freed_joint_swings():
    m = pendulum({"joints": {"*": {"kp": 5.0, "kd": 0.2}}})
    commands = Series(np.array([0.0]), np.array([[1.0]]))
    enabled = Series(np.array([0.0, 2.0]), np.array([[1.0], [0.0]]))
    run = mech.drive(m, commands, ("joint",), 4.0, np.array([1.0]), enabled=enabled)
    assert abs(run.position[run.t < 2.0][-1, 0] - 1.0) < 0.05 and run.position[:, 0].min() < -0.5
    assert np.abs(run.torque[run.t > 2.01]).max() == 0


def test_the_servo_of_a_recording_wins_over_the_believed_one(hand_run):
    m, commands, run = hand_run
    recording = mech.recorded(run, m, commands, m.joints)
    recording.meta["servo"] = yaml.safe_dump({"joints": {"index_joint1": {"kp": 9.0}}})
    recording.meta["gravity"] = "0 0 9.81"
    other = mech.for_recording(recording)
    believed = mech.mechanism().table
    assert other.table.value("index_joint1", "kp").value == 9.0
    assert other.table.value("mid_joint1", "kp").value == believed.value("mid_joint1", "kp").value
    assert other.spec.option.gravity[2] == 9.81


def test_a_recording_of_another_mechanism_is_refused(hand_run, tmp_path):
    m, commands, run = hand_run
    model, servo = _saved_pendulum(tmp_path)
    with pytest.raises(UserError, match="joints that the model has not: thumb_bend_joint.*its joints: joint"):
        mech.for_recording(mech.recorded(run, m, commands, m.joints), model, servo)


# --- sampled like the hardware


def test_hardware_sampling(hand_run):
    m, commands, run = hand_run
    dense = mech.recorded(run, m, commands, m.joints, rate=250.0)
    touch = np.zeros((len(dense.states.position), 5, 120, 3))
    touch[..., 2] = 0.04
    touch[:, 1, 3] = [0.31, -0.52, 40.0]
    dense.tactile = Series(dense.states.position.t, touch, "/tactile")
    dense.meta |= {"tactile_unit": "N", "tactile_lsb": "1"}
    r = realistic(dense, seed=3, current_per_torque=0.9)
    q, lsb = r.states.position, 2 * np.pi / 4096
    counts = q.value / lsb
    assert np.abs(counts - np.round(counts)).max() < 1e-6
    truth = np.stack([np.interp(q.t, dense.states.position.t, x) for x in dense.states.position.value.T], 1)
    assert np.abs(q.value - truth).max() <= lsb / 2 + 1e-12
    amperes = r.states.effort.value * 1e3
    assert np.abs(amperes - np.round(amperes)).max() < 1e-9 and r.states.velocity is None
    torque = np.stack([np.interp(q.t, dense.states.effort.t, x) for x in dense.states.effort.value.T], 1)
    assert np.abs(r.signed_effort().value - 0.9 * torque).max() <= 0.5e-3 + 1e-12 and list(r.effort_sign) == [-1] * 12
    assert list(r.tactile.value[0, 1, 3]) == [-3, 5, 255] and r.tactile.value[0, 0, 0, 2] == 0
    np.testing.assert_allclose(r.tactile_newtons().value[0, 1, 3], [0.3, -0.5, 25.5], atol=1e-12)
    assert len(r.commands) == len(dense.commands) and dense.effort_is == "torque_Nm"
    assert [f for f in audit(r) if f.severity == "error"] == []


def test_reading_times():
    rng = np.random.default_rng(0)
    rates, lost = [], []
    for _ in range(20):
        t = sample_times(0.0, 60.0, rng)
        dt = np.diff(t)
        rates.append(1 / np.median(dt))
        lost.append((dt > 1.6 * np.median(dt)).sum() / len(t))
        assert (dt > 0).all() and 0.003 < dt[dt < 1.5 * np.median(dt)].std() / np.median(dt) < 0.05
    assert 82 < min(rates) and max(rates) < 105 and np.ptp(rates) > 10
    assert 0.003 < np.mean(lost) < 0.008
    none = sample_times(0.0, 10.0, rng, Hardware(rates=(100.0, 100.0), jitter=0.0, late=0.0, drop=0.0))
    np.testing.assert_allclose(np.diff(none), 0.01)


# --- play.py replay=FILE


def _saved_pendulum(folder):
    folder.mkdir(exist_ok=True)
    (folder / "rig.xml").write_text(pendulum_spec().to_xml())
    (folder / "rig.yaml").write_text(yaml.safe_dump(SERVO))
    return folder / "rig.xml", folder / "rig.yaml"


def test_replay_of_a_bench_recording(tmp_path, capsys):
    model, servo = _saved_pendulum(tmp_path / "rig")
    truth = pendulum()
    commands = sines(3.0, 1, size=0.5)
    dense = mech.recorded(
        mech.drive(truth, commands, ("joint",), 3.0, np.zeros(1)), truth, commands, ("joint",), rate=500.0
    )
    hardware = realistic(dense, 1, truth.table.current(("joint",)))
    hardware.meta["servo"] = ""
    write(tmp_path / "bench.mcap", hardware)
    ready = start.for_play(
        [
            f"replay={tmp_path / 'bench.mcap'}",
            f"model={model}",
            f"servo={servo}",
            f"out={tmp_path / 'out'}",
            "video=false",
            "timestep=0.002",  # the one that it was recorded with
            "meta.robot=bench",
        ],
        CONFIGS,
    )
    from dexsim.cli import play

    assert play.run(ready) == 0
    about = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (
        about["position_rmse_rad"]["joint"] < 1e-3 and about["torque_rmse_Nm"]["joint"] < 2e-3
    )  # a quantum is 1.5 mrad
    assert about["current_per_torque_fitted"] == [] and about["current_per_torque"]["joint"] == 0.9
    for name in ("position.png", "effort.png", "simulated.mcap"):
        assert (tmp_path / "out" / name).stat().st_size > 1000
    assert not (tmp_path / "out" / "force.png").exists() and "position RMSE" in capsys.readouterr().out
    # the wrong servo shows
    wrong = mech.Mechanism(
        truth.spec, ("joint",), ServoTable.from_dict(mech.merged(SERVO, {"joints": {"*": {"delay": 0.06}}})), "pendulum"
    )
    r = read(tmp_path / "bench.mcap")
    assert compare(r, mech.replay(r, wrong), wrong).position_rmse()[0] > 10 * about["position_rmse_rad"]["joint"]


def test_an_unknown_current_constant_is_fitted_and_said():
    truth = pendulum()
    commands = sines(3.0, 1, size=0.5)
    run = mech.drive(truth, commands, ("joint",), 3.0, np.zeros(1))
    r = realistic(mech.recorded(run, truth, commands, ("joint",)), 1, 1.7)
    m = pendulum({k: v for k, v in SERVO.items() if k != "current_per_torque"})
    c = compare(r, mech.replay(r, m, 0.002), m)
    assert c.fitted.all() and c.effort_scale[0] == pytest.approx(1.7, rel=0.02)


@pytest.mark.parametrize("argv, text", [
    (["replay=x.mcap", "episodes=3"], "expected key=value with one of the keys replay, model"),
    (["replay=x.mcap", "servo=idael"], "must be a servo.yaml file, or one of ideal"),
    (["replay=x.mcap", "timestep=1"], "from 0.0001 to 0.02"),
    (["replay=x.mcap", "hold=still"], "hold=still: must be recorded or limp"),
    (["replay=x.mcap", "start=-1"], "start=-1: must be a number from 0"),
    (["replay=x.mcap", "video=maybe"], "must be true or false"),
    (["replay=x.mcap", "hand_mirror=1"], "hand_mirror=1: must be true or false"),
    (["replay=x.mcap", "hand=xhnd"], "hand=xhnd: must be one of xhand"),
    (["replay=x.mcap", "model=a.xml", "hand=xhand"], "model=a.xml: is not simulated beside hand="),
])  # fmt: skip
def test_bad_replay_settings(argv, text):
    with pytest.raises(UserError, match=text):
        start.for_play(argv, CONFIGS)


def test_a_model_without_its_servo_or_joints(tmp_path):
    model, servo = _saved_pendulum(tmp_path)
    with pytest.raises(UserError, match="say which servo"):
        mech.mechanism(model)
    with pytest.raises(UserError, match="no.xml does not exist"):
        mech.mechanism(tmp_path / "no.xml", servo)
    with pytest.raises(UserError, match="joint 'elbow' is not in"):
        mech.mechanism(model, servo, ("elbow",))
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody><geom/></worldbody></mujoco>")
    with pytest.raises(UserError, match="bad.xml"):
        mech.mechanism(tmp_path / "bad.xml", servo)


ARM = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="shoulder" axis="0 1 0" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.6" contype="0"/><body pos="0 0 -0.3">
<joint name="elbow" axis="0 1 0" armature="0.005"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0"/></body></body></worldbody>
%s</mujoco>"""
OWN = """<tendon><fixed name="both"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-1"/></fixed></tendon>
<actuator><position name="hold" joint="shoulder" kp="60"/><motor name="pull" tendon="both"/></actuator>
<equality><joint joint1="elbow" joint2="shoulder"/></equality><sensor><actuatorfrc actuator="hold"/></sensor>
<keyframe><key ctrl="1 1"/></keyframe>"""
LOOPS = {"joints": {"shoulder": {"kp": 20.0, "kd": 1.0}, "elbow": {"kp": 9.0, "kd": 0.4}}}


def arm(folder, more="", servo=None):
    (folder / "arm.xml").write_text(ARM % more)
    return mech.mechanism(folder / "arm.xml", servo or LOOPS)


def swung(m):
    """Return a recording of both joints, in which each shakes the other."""
    t = np.arange(0, 3.0, 0.01)
    commands = Series(t, np.stack([0.5 * np.sin(5 * t), np.sin(7 * t)], 1))
    run = mech.drive(m, commands, m.joints, 3.0, np.zeros(2), timestep=5e-4)
    r = mech.recorded(run, m, commands, m.joints, rate=500.0)
    r.meta["servo"] = ""
    return r


def test_a_models_own_actuators_tendons_and_couplings_of_driven_joints_are_left_out(tmp_path):
    r = swung(arm(tmp_path))
    plain, own = (mech.replay(r, arm(tmp_path, more)) for more in ("", OWN))
    assert np.abs(plain.position - own.position).max() < 1e-9
    assert compare(r, own, arm(tmp_path)).position_rmse().max() < 1e-4


@pytest.mark.slow
def test_a_joint_without_a_servo_or_not_fitted_to_follows_its_recording(tmp_path):
    """And pulls at the others as it did: they move as if it were driven, whose drive nobody knows."""
    r = swung(arm(tmp_path))
    alone = arm(tmp_path, servo={"joints": {"shoulder": LOOPS["joints"]["shoulder"]}})
    fitted = arm(tmp_path, servo=LOOPS | {"fitted": {"shoulder": {}}})
    fitted.table.set("elbow", "kp", 0.5)
    for m in (alone, fitted):
        assert mech.held_joints(m, r.joints) == ["elbow"]
        c = compare(r, mech.replay(r, m), m)
        assert c.position_rmse().max() < 2e-3 < 0.1 < np.ptp(r.states.position.value, 0).min()
        part = compare(r, mech.replay(r, m, start=1.2, end=2.5), m)
        assert part.t[0] >= 1.2 and part.t[-1] <= 2.51 and part.position_rmse().max() < 4e-3
    limp = mech.replay(r, alone, hold="limp")
    assert compare(r, limp, alone).position_rmse()[1] > 0.1


# --- play.py record=FILE


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Return two worlds of the grasp task, recorded through one episode, and what the environment itself showed."""
    from dexsim.recording.tap import PlayRecorder
    from dexsim.tasks import make_env

    cfg = start.for_train(["task=grasp", "preset=none", "worlds=4", "device=cpu", "tactile=raw"], CONFIGS).cfg
    env = make_env(cfg, 4, "cpu", 0, "mujoco")
    recorder = PlayRecorder(env, [0, 1], cfg)
    env.reset_all()
    seen = []
    generator = torch.Generator().manual_seed(0)
    for _ in range(30):
        _, _, done, _ = env.step(0.2 * (2 * torch.rand(4, 12, generator=generator) - 1))
        if done[:2].any():
            break
        seen.append(
            (
                env.q[:2].clone(),
                env.torque[:2].clone(),
                env.target[:2].clone(),
                env.touch.raw[:2].clone(),
                env.object_pose[:2].clone(),
                (torch.cat([env.finger_force, env.palm_force[:, None]], 1)[:2] > 0).any(1),
            )
        )
    folder = tmp_path_factory.mktemp("played")
    paths = recorder.save(folder / "p.mcap")
    recorder.save(folder / "r.mcap", realistic=True)
    return env, seen, paths, folder


def test_a_play_in_another_world_does_not_tell_its_drives(tmp_path):
    """What such a recording says of the drives is what the policy believes of them, as one of a real hand would."""
    from worlds import grasp_env

    from dexsim.recording.tap import PlayRecorder

    env = grasp_env(worlds=2)
    said = []
    for config in ({}, {"belief": {"servo": {"joints": {"*": {"kp": 3.25}}}}}):
        recorder = PlayRecorder(env, 1, config)
        env.reset_all()
        for _ in range(8):
            env.step(torch.zeros(2, 12))
        said.append(yaml.safe_load(read(recorder.save(tmp_path / f"{len(said)}.mcap")[0]).meta["servo"])["joints"])
        recorder.detach()
    assert said[1] == {"*": {"kp": 3.25}} and said[0]["mid_joint1"]["kp"] > 2.0  # its own: 4.0, randomized


def test_a_play_is_recorded_as_its_encoders_show_it(tmp_path):
    """An eccentric encoder's position and speed, as the policy has them."""
    from worlds import grasp_env

    from dexsim.recording.tap import PlayRecorder

    servo = ServoTable.load(CONFIGS / "servo" / "xhand.yaml")
    for joint in xhand.JOINTS:
        servo.set(joint, "eccentric_sin", 0.2)
        servo.set(joint, "eccentric_cos", 0.1)
    servo.save(tmp_path / "servo.yaml")
    env = grasp_env(f"servo_file={tmp_path / 'servo.yaml'}", worlds=1)
    recorder = PlayRecorder(env, 1, {})
    env.reset_all()
    seen = []
    for _ in range(6):
        env.step(0.3 * torch.ones(1, 12))
        seen.append([x.numpy().copy() for x in (env.q[0], env.qd[0], env.engine.t.qpos[0, env.joint_q])])
    states = read(recorder.save(tmp_path / "p.mcap")[0]).states
    for k, (q, qd, _) in enumerate(seen[:-1]):
        row = (k + 1) * env.decimation  # the state after step k is the one before the first physics step of k + 1
        np.testing.assert_allclose(states.position.value[row], q, atol=1e-6)
        np.testing.assert_allclose(states.velocity.value[row], qd, atol=1e-4)
    assert max(np.abs(q - true).max() for q, _, true in seen) > 0.02


def test_a_play_is_recorded_as_it_was(played):
    env, seen, paths, _ = played
    assert [p.name for p in paths] == ["p_w0.mcap", "p_w1.mcap"] and len(seen) > 5
    for w, path in enumerate(paths):
        r = read(path)
        assert not [f for f in r.findings if f.severity == "error"], table(r.findings)
        assert len(r.states.position) == len(r.commands) * env.decimation and np.diff(r.commands.t) == pytest.approx(
            env.dt
        )
        for k in range(len(seen) - 1):
            q, _, target, raw, pose, _ = (x[w].numpy() for x in seen[k])
            # the state after step k is the one before the first physics step of k + 1
            row = (k + 1) * env.decimation
            np.testing.assert_allclose(r.states.position.value[row], q + r_offset(env, w), atol=1e-6)
            np.testing.assert_allclose(r.commands.value[k], target, atol=1e-7)
            np.testing.assert_allclose(r.tactile.value[k, ..., 2], raw, atol=1e-6)
            np.testing.assert_allclose(r.object_pose.value[row], pose, atol=1e-6)
        assert yaml.safe_load(r.config)["recorded_world"]["index"] == w
        servo = ServoTable.from_dict(yaml.safe_load(r.meta["servo"])).nominal(r.joints)
        np.testing.assert_allclose(servo, env.servo.params[w].numpy(), rtol=1e-5, atol=1e-9) if not env.done[
            w
        ] else None


def r_offset(env, world):
    """Return what the encoders add to the joint position (nothing, unless randomized)."""
    return env.servo.column("position_offset")[world].numpy() if not env.done[world] else 0.0


def test_a_play_is_replayed_the_same_until_the_object_is_touched(played):
    from dexsim.recording import led_object

    env, seen, paths, _ = played
    r = read(paths[0])
    m = mech.for_recording(r)
    assert led_object.add_object(m, r) == "led"
    run = mech.replay(r, m, env.engine.dt, led_object.pairs(m.hand), led_object.JOINT)
    c = compare(r, run, m, forces=True)
    touched = [k for k, row in enumerate(seen) if row[-1][0]]
    free = c.t < (touched[0] + 0.1) * env.dt  # seen[k] is the end of step k, in which it may have touched
    assert free.sum() >= 3
    assert np.abs(c.position - c.position_simulated)[free].max() < 1e-5
    assert c.position_rmse().max() < 0.05 and c.finger_force[1].shape[1] == c.finger_force_simulated[1].shape[1] == 5


def test_a_play_sampled_like_the_hardware(played):
    _, _, _, folder = played
    r = read(folder / "r_w0.mcap")
    assert r.effort_is == "current_A" and set(r.effort_sign) == {-1.0} and r.meta["tactile_unit"] == "count"
    assert "2.7 A per N.m assumed" in r.meta["notes"] and r.states.velocity is None
    assert (r.tactile.value == np.round(r.tactile.value)).all() and r.tactile.value[..., 2].min() >= 0


def test_recording_ends_with_the_episode(played):
    from dexsim.recording.tap import _Track

    g, side = np.array([0, 0, -9.81]), np.array([0, 9.81, 0.0])

    def feed(track, steps):
        clock = 0.0
        for k, (turned, done) in enumerate(steps):
            rows = np.zeros((2, 5))
            rows[:, 0] = clock, clock + 0.05
            track.add([np.full(1, k)], None, rows, np.full(2, float(k)), turned, np.array(done), None)
            clock = 0.0 if done else clock + 0.1
        track.finish()
        return track.episode

    e = feed(_Track(0, 0.1, 0.2), [(g, 0), (g, 0), (g, 1), (g, 0)])
    assert len(e.times) == 3 and [x[0] for x in e.targets] == [0.0, 1.0, 1.0] and e.about[0][0] == 0
    e = feed(_Track(0, 0.1, 0.2), [(g, 0), (g, 0), (side, 0), (side, 0)])
    assert len(e.times) == 2 and e.notes == ["ends where gravity turns"]
    # an object that fell at once gives way to the first episode that lasts; a later and longer one is not waited for
    steps = [(g, 0), (g, 1), *[(g, 0)] * 5, (g, 1), *[(g, 0)] * 9]
    track = _Track(0, 0.1, 0.5)
    e = feed(track, steps)
    assert len(e.times) == 6 and e.about[0][0] == 2 and track.over
    assert len(feed(_Track(0, 0.1, 9.0), steps).times) == 9, "else the longest"


@pytest.mark.slow
def test_the_object_of_a_real_recording_is_placed(played, tmp_path, monkeypatch):
    """A recording that knows only the object's path: a mark that touches nothing, or the object as it is stated to
    be."""
    from dataclasses import replace

    from dexsim.recording import led_object

    def panels(path, *rest):  # they take seconds, and are drawn by another test
        path.touch()
        return path

    monkeypatch.setattr("dexsim.recording.compare._panels", panels)
    env, seen, paths, _ = played
    real = replace(read(paths[0]), config=None, meta=read(paths[0]).meta | {"source": "real"})
    write(tmp_path / "real.mcap", real)
    r, forces = read(tmp_path / "real.mcap"), {}
    o = env.objects
    size = 2 * o.size[0].numpy()
    box = (
        led_object.Stated("box", tuple(size))
        if env.objects.scene.variants[int(o.variant[0])].shape.name == "box"
        else led_object.Stated("box", (0.05, 0.06, 0.05))
    )
    for name, stated in (("marked", None), ("led", box)):
        m = mech.for_recording(r)
        assert led_object.add_object(m, r, stated) == name
        run = mech.replay(r, m, env.engine.dt, led_object.pairs(m.hand), led_object.JOINT)
        forces[name] = run.pair_normal
        np.testing.assert_allclose(run.qpos[0, -7:-4], r.object_pose.value[0, :3], atol=1e-3)
        assert np.abs(np.diff(run.qpos[:, -7:-4], axis=0)).max() > 1e-4, "it moves along"
    assert (forces["marked"] == 0).all()
    out = tmp_path / "out"
    assert (
        replay_cli.run(replay_cli.settings([f"replay={tmp_path / 'real.mcap'}", f"out={out}", "video=false"], CONFIGS))
        == 0
    )
    assert json.loads((out / "metrics.json").read_text())["object"] == "marked"
    assert (
        replay_cli.run(
            replay_cli.settings(
                [f"replay={tmp_path / 'real.mcap'}", f"out={out}", "video=false", "object=sphere", "object_size=0.05"],
                CONFIGS,
            )
        )
        == 0
    )
    assert json.loads((out / "metrics.json").read_text())["object"] == "led" and (out / "force.png").is_file()


@pytest.mark.parametrize(
    "stated, half",
    [
        (("box", (0.05, 0.06, 0.07)), [0.025, 0.03, 0.035]),
        (("sphere", (0.05,)), [0.025, 0, 0]),
        (("capsule", (0.04, 0.1)), [0.02, 0.03, 0]),
        (("rock", (0.09,)), [1.5, 1.5, 1.5]),
        (("capsule", ()), [0.019, 0.011, 0]),
        (("sphere", ()), [0.03, 0, 0]),
    ],
)
def test_sizes_of_a_stated_object(stated, half):
    from dexsim.recording.led_object import Stated

    np.testing.assert_allclose(Stated(*stated).about().size, half, atol=1e-6)


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["object=blob"], "object=blob"),
        (["object_size=0.05"], "say object="),
        (["object=box", "object_size=0.05"], "has 3 extents"),
        (["object=sphere", "object_size=5"], "object_size=5"),
        (["object=box", "object_mass=heavy"], "object_mass=heavy"),
        (["object=capsule", "object_size=0.1,0.05"], "must be over its diameter"),
    ],
)
def test_an_impossible_object_is_named(arguments, says):
    with pytest.raises(UserError, match=says) as caught:
        replay_cli.settings(["replay=a.mcap", *arguments], CONFIGS)
    assert "\n" not in str(caught.value)


def test_settings_of_a_recorded_play():
    from dexsim import outputs
    from dexsim.recording.tap import PlayRecorder

    class Env:
        engine = servo = touch = objects = target = None
        num_envs = 4

    with pytest.raises(UserError, match="cannot write into"):
        outputs.recording("/proc/nowhere/x")
    for worlds in (9, 0, [1, 4], [1, 1], [], "some", [0, "x"]):
        with pytest.raises(UserError, match="record_worlds="):
            PlayRecorder(Env(), worlds, {})
    assert replay_cli.settings(["replay=a.mcap", "meta.gravity=0 0 1"], CONFIGS)["meta"] == {"gravity": "0 0 1"}
