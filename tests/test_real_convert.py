"""Conversions of real recordings, on data of the same shape."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.real import __main__ as real
from benchmarks.real import convert_ergocub, convert_panda
from dexsim.errors import UserError
from dexsim.recording import read

PANDA = """<mujoco><compiler angle="radian"/><worldbody>{open}{close}</worldbody></mujoco>"""
LINK = (
    '<body pos="0 0 0.2"><inertial mass="1" pos="0.05 0 0" diaginertia="0.02 0.02 0.02"/><joint name="joint{k}" '
    'axis="{axis}"/>'
)


def finger(folder, name: str, dead: bool = False) -> None:
    """Cycles at two duties: negative duty closes, and turns round at 0.4 rad and at the stop."""
    t = np.arange(0, 8, 2e-3)
    q, duty, angle, way = np.zeros(len(t)), np.zeros(len(t)), 0.0, -1.0
    for i in range(len(t)):
        duty[i] = way * (30 if t[i] < 5 else 50)
        angle = np.clip(angle - 0.04e-3 * duty[i], 0.0, 0.45)
        way = 1.0 if angle >= 0.4 else -1.0 if angle <= 0.0 else way
        q[i] = angle
    np.savez(
        folder / f"{name}.npz",
        t=t,
        pwm_set=duty,
        pwm_read=np.zeros_like(duty) if dead else duty,
        theta_deg=np.degrees(q) * (not dead),
        pid_out=duty,
    )


def test_a_fingers_run_becomes_clips_of_whole_cycles_with_the_duty_as_command(tmp_path):
    for names in convert_ergocub.FINGERS.values():
        for name in names:
            finger(tmp_path, name, dead=name == "thumb1")
    made = convert_ergocub.convert(tmp_path, tmp_path / "out")
    assert len(made.groups["thumb1"]) == 1 and len(made.groups["middle"]) >= 2
    r = read(made.groups["middle"][0])
    duty = np.asarray(r.commands.value)[:, 0] * convert_ergocub.PER_DUTY
    assert set(np.round(np.unique(duty), 3)) == {-0.3, 0.3}
    q, t = r.states.position.value[:, 0], r.states.position.t
    closing = duty[np.searchsorted(r.commands.t, t, side="right") - 1] > 0.29  # positive duty, larger angles
    assert np.diff(q)[closing[1:] & (q[1:] < 0.39) & (q[1:] > 0.02)].min() >= -1e-9
    assert t[-1] - t[0] >= 0.9 * convert_ergocub.CLIP
    held = convert_ergocub.held_out("middle")
    assert held == ("middle3", "middle6") and convert_ergocub.held_out("thumb") == ()
    assert 0 < convert_ergocub.repeat_noise(tmp_path, "middle") < 0.01
    (tmp_path / "middle.npz").unlink()
    with pytest.raises(UserError, match="middle.npz"):
        convert_ergocub.convert(tmp_path, tmp_path / "out2")


def test_a_finger_is_driven_by_what_was_read_back_where_that_is_not_what_was_set(tmp_path):
    t = np.arange(0.0, 8.0, 1e-3)
    set_ = np.where(t % 1 < 0.5, 0.5, -0.5)
    read = np.r_[np.full(10, 0.5), set_[:-10]]  # within 10 ms
    assert not convert_ergocub.refused(t, set_, read).any()
    assert not convert_ergocub.refused(t, set_, np.zeros_like(t)).any()  # nothing is read back: what was set is all
    late, none = (t >= 2.5) & (t < 2.7), (t >= 5.0) & (t < 6.2)
    read = np.where(none, 0.0, np.where(late, 0.5, read))
    refused = convert_ergocub.refused(t, set_, read)
    assert refused[late].all() and refused[none].mean() > 0.99 and refused[~late & ~none].mean() < 0.01
    finger(tmp_path, "stopped")
    raw = dict(np.load(tmp_path / "stopped.npz"))
    raw["pwm_read"][1000:1300] = 0.0
    np.savez(tmp_path / "stopped.npz", **raw)
    duty = convert_ergocub.cycles(tmp_path / "stopped.npz")[1]
    assert (duty[1000:1300] == 0).all() and (duty[1300:] == -raw["pwm_set"][1300:] / 100).all()


def test_stretches_in_which_a_fingers_motor_was_off_are_left_out():
    t = np.arange(0.0, 10.0, 0.001)
    set_ = np.where(t % 1 < 0.5, 30.0, -30.0)
    given = np.where((t >= 2.0) & (t < 5.0), 0.0, set_)
    late = np.where((t >= 7.0) & (t < 7.05), 0.0, given)  # read late
    assert convert_ergocub.driven(t, set_, late, 33.6 * late) == [(0, 2000), (5000, 10000)]
    # given but not read back: it was on
    assert convert_ergocub.driven(t, set_, given, 33.6 * set_) == [(0, 10000)]


def test_the_pandas_plain_least_squares_reads_off_a_friction(tmp_path):
    text = "".join(LINK.format(k=k, axis="0 0 1" if k % 2 else "0 1 0") for k in range(1, 8))
    (tmp_path / "panda.xml").write_text(PANDA.format(open=text, close="</body>" * 7))
    (tmp_path / "panda.yaml").write_text("drive: torque\njoints:\n  '*':\n    kp: 100.0\n")
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(tmp_path / "panda.xml"))
    data, t = mujoco.MjData(model), np.arange(0, 8, 2e-3)
    w = 2 * np.pi * np.linspace(0.3, 0.6, 7)
    q, v, a = 0.5 * np.sin(t[:, None] * w), 0.5 * w * np.cos(t[:, None] * w), -0.5 * w**2 * np.sin(t[:, None] * w)
    torque = np.empty_like(q)
    for i in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[i], v[i], a[i]
        mujoco.mj_inverse(model, data)
        torque[i] = data.qfrc_inverse + 0.4 * np.sign(v[i])
    np.savez(tmp_path / convert_panda.FILE, t=t, q=q, tau=torque, t_target=t, q_target=q)
    found = convert_panda.plain(tmp_path)
    assert all(x["coulomb"] == pytest.approx(0.4, abs=0.03) for x in found.values())
    made = convert_panda.convert(tmp_path, tmp_path / "out")
    assert read(made.recordings[0]).joints == convert_panda.JOINTS


def test_absent_data_is_a_line_and_no_error(tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert real.main(["panda"]) == 0
    assert "absent" in json.loads(capsys.readouterr().out)["skipped"]
    with pytest.raises(UserError, match="not a folder"):
        real.main(["emps", "data=nowhere"])
