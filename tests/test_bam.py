"""BAM's parameter files: read, written, and the same motion as BAM's equations integrated here on their own."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

from dexsim.actuator import bam
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.paths import CONFIGS
from dexsim.recording.mechanism import drive, mechanism
from dexsim.recording.schema import COMMANDS, Series

M2 = {"kt": 0.38, "R": 3.6, "armature": 0.0019, "q_offset": 0.0, "friction_base": 0.0186, "friction_stribeck": 0.011,
      "dtheta_stribeck": 0.26, "alpha": 2.0, "friction_viscous": 0.004, "model": "m2", "actuator": "xl330"}  # fmt: skip
KP, VOLT, MASS, LENGTH = 1.15, 5.0, 0.3, 0.1


def theirs(p: dict, stamps: np.ndarray, goals: np.ndarray, seconds: float, h: float = 2e-5) -> tuple:
    """BAM's pendulum: torque kt U / R - kt^2 / R dq; friction is what would stop the joint within the step, at most the
    budget. Semi-implicit Euler in steps of h [s]."""
    inertia, q, v = MASS * LENGTH**2 + p["armature"], 0.0, 0.0
    out = np.zeros(int(seconds / h))
    for i in range(len(out)):
        goal = goals[max(0, np.searchsorted(stamps, i * h, side="right") - 1)]
        volts = VOLT * np.clip(KP * (goal - q), -1, 1)
        torque = p["kt"] * volts / p["R"] - p["kt"] ** 2 * v / p["R"] - MASS * 9.81 * LENGTH * np.sin(q)
        most = p["friction_base"] + p["friction_viscous"] * abs(v)
        if p["model"] == "m2":
            most += p["friction_stribeck"] * np.exp(-(abs(v / p["dtheta_stribeck"]) ** p["alpha"]))
        stop = -(inertia * v / h + torque)
        v += h * (torque + np.clip(stop, -most, most)) / inertia
        q += h * v
        out[i] = q
    return out, h


@pytest.mark.parametrize("model", ["m1", "m2"])
def test_the_motion_is_bams_within_a_hundredth(tmp_path, model):
    (tmp_path / "m.json").write_text(json.dumps(M2 | {"model": model}))
    table = bam.to_servo(bam.read(tmp_path / "m.json"), KP, VOLT)
    (tmp_path / "rig.xml").write_text(
        f"""<mujoco><option timestep="0.0005"/><worldbody><body name="link">
        <inertial pos="0 0 {-LENGTH}" mass="{MASS}" diaginertia="1e-12 1e-12 1e-12"/>
        <joint name="joint" axis="0 1 0" armature="{M2['armature']}"/></body></worldbody></mujoco>"""
    )
    t = np.arange(0.0, 3.0, 0.01)
    goals = 0.9 * np.sin(2 * np.pi * 0.6 * t) + 0.3 * np.sin(2 * np.pi * 1.7 * t)
    rig = mechanism(tmp_path / "rig.xml", table, gravity=(0, 0, -9.81))
    run = drive(rig, Series(t, goals[:, None], COMMANDS), ("joint",), 3.0, timestep=5e-4)
    want, h = theirs(M2 | {"model": model}, t, goals, 3.0)
    want = np.interp(run.t, h * np.arange(1, len(want) + 1), want)
    apart = run.position[:, 0] - want
    assert np.sqrt(np.mean(apart**2)) < 0.01 * np.ptp(want), "root mean square over the range"
    without = theirs(M2 | {"model": "m1", "friction_base": 0.0, "friction_viscous": 0.0}, t, goals, 3.0)[0]
    without = np.interp(run.t, h * np.arange(1, len(without) + 1), without)
    assert np.sqrt(np.mean((without - want) ** 2)) > 0.02 * np.ptp(want), "friction matters in this motion"


@pytest.mark.parametrize("model", ["m1", "m2"])
def test_there_and_back_again(tmp_path, model):
    source, servo, back = (tmp_path / n for n in ("a.json", "servo.yaml", "b.json"))
    source.write_text(json.dumps(M2 | {"model": model, "command_delay": 0.004, "q_offset": 0.02}))
    assert bam.main([f"in={source}", f"out={servo}", f"kp={KP}", f"supply_voltage={VOLT}"]) == 0
    assert bam.main([f"in={servo}", f"out={back}", "armature=0.0019"]) == 0
    one, two = bam.read(source), bam.read(back)
    for name in ("kt", "R", "armature", "friction_base", "friction_viscous", "q_offset", "command_delay"):
        assert getattr(one, name) == pytest.approx(getattr(two, name), rel=1e-9), name
    if model == "m2":
        assert (one.friction_stribeck, one.alpha) == pytest.approx((two.friction_stribeck, two.alpha))
    assert two.model == model


def test_what_cannot_be_said_is_one_line(tmp_path):
    path = tmp_path / "m.json"
    for change, said in (
        ({"model": "m7"}, "model ('m7')"), ({"kt": -1.0}, "kt (-1.0)"), ({"R": "a"}, "R ('a')"),
    ):  # fmt: skip
        path.write_text(json.dumps(M2 | change))
        with pytest.raises(UserError, match="m.json") as error:
            bam.read(path)
        assert said in str(error.value)
    path.write_text("{")
    with pytest.raises(UserError, match="not JSON"):
        bam.read(path)
    table = ServoTable.from_dict(yaml.safe_load((CONFIGS / "servo" / "xc330_m288.yaml").read_text()))
    assert bam.to_bam(table, "*", 0.002)["kt"] == pytest.approx(5.0 / 8.48)
    table.set("*", "backlash", 0.01)
    with pytest.raises(UserError, match="backlash"):
        bam.to_bam(table, "*", 0.002)


@pytest.mark.parametrize(
    ("model", "term"),
    [("m3", "load_friction_base"), ("m4", "load_friction_stribeck"), ("m5", "load_friction_motor"),
     ("m5", "load_friction_external_stribeck"), ("m6", "load_friction_motor_quad")],
)  # fmt: skip
def test_a_load_term_is_refused_by_its_name_and_read_where_it_is_0(tmp_path, model, term):
    """m3 to m6 with no load are m1 and m2; nothing of a term that the servo table lacks is left out in silence."""
    path, servo = tmp_path / "m.json", tmp_path / "servo.yaml"
    path.write_text(json.dumps(M2 | {"model": model, term: 0.12}))
    with pytest.raises(UserError) as error:
        bam.main([f"in={path}", f"out={servo}", f"kp={KP}", f"supply_voltage={VOLT}"])
    assert f"m.json: {term} (0.12): model {model}" in str(error.value) and "\n" not in str(error.value)
    assert not servo.exists()
    path.write_text(json.dumps(M2 | {"model": model, term: 0.0}))
    alike = M2 | {"model": "m1" if model == "m3" else "m2"}
    assert bam.to_servo(bam.read(path), KP, VOLT) == bam.to_servo(bam.Bam(**alike), KP, VOLT)


@pytest.mark.parametrize("name", ["xl330_m288", "xc330_m288"])
def test_the_published_motors_are_of_one_piece(name):
    """Stall torque, current and no-load speed of a DC motor: torque constant and back-EMF constant agree within 30 %,
    gears' losses between them."""
    table = ServoTable.load(CONFIGS / "servo" / f"{name}.yaml")
    per_amp, per_speed = 1 / table.current_per_torque, table.supply_voltage / table.value("*", "no_load_speed").value
    assert 0.7 < per_amp / per_speed < 1.0
