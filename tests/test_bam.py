"""BAM's parameter files: read, written, and the same motion as BAM's equations integrated here on their own."""

from __future__ import annotations

import json
import math

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
LOADS = (
    "load_friction_base", "load_friction_stribeck", "load_friction_motor", "load_friction_external",
    "load_friction_motor_stribeck", "load_friction_external_stribeck", "load_friction_motor_quad",
    "load_friction_external_quad",
)  # fmt: skip
OF = {"m3": LOADS[:1], "m4": LOADS[:2], "m5": LOADS[2:6], "m6": LOADS[2:]}
KP, VOLT, MASS, LENGTH = 1.15, 5.0, 0.3, 0.1


def of(model: str, **terms: float) -> dict:
    """A file of a model: M2's figures, each load term that the model has 0 but for those given."""
    return M2 | dict.fromkeys(OF.get(model, ()), 0.0) | terms | {"model": model}


def budget(p: dict, motor: float, external: float, v: float) -> float:
    """What friction can hold, by the models' equations as published (arXiv 2410.08650, section III; m5's and m6's
    loads as the method's code has them: weighted, then subtracted). A term that p does not name is 0."""
    peak = math.exp(-(abs(v / p["dtheta_stribeck"]) ** p["alpha"])) if p["model"] not in ("m1", "m3") else 0.0
    said = lambda name: p.get(f"load_friction_{name}", 0.0)  # noqa: E731
    most = p["friction_base"] + p["friction_viscous"] * abs(v) + peak * p["friction_stribeck"]
    if p["model"] in ("m3", "m4"):
        most += (said("base") + peak * said("stribeck")) * abs(external - motor)
    elif p["model"] in ("m5", "m6"):
        most += abs(said("external") * external - said("motor") * motor)
        most += peak * abs(said("external_stribeck") * external - said("motor_stribeck") * motor)
    if p["model"] == "m6" and math.copysign(1, external) != math.copysign(1, motor):
        carried = (said("external_quad") * external**2, said("motor_quad") * motor**2)
        most += peak * (carried[0] if abs(external) < abs(motor) else carried[1] if abs(external) > abs(motor) else 0)
    return most


def theirs(p: dict, stamps: np.ndarray, goals: np.ndarray, seconds: float, h: float = 1e-4) -> tuple:
    """BAM's pendulum: torque kt U / R - kt^2 / R dq; friction is what would stop the joint within the step, at most the
    budget. Semi-implicit Euler in steps of h [s]."""
    inertia, q, v = MASS * LENGTH**2 + p["armature"], 0.0, 0.0
    out = np.zeros(int(seconds / h))
    at = np.maximum(np.searchsorted(stamps, h * np.arange(len(out)), side="right") - 1, 0)
    for i, goal in enumerate(goals[at].tolist()):
        volts = VOLT * min(max(KP * (goal - q), -1.0), 1.0)
        motor, outside = p["kt"] * volts / p["R"] - p["kt"] ** 2 * v / p["R"], -MASS * 9.81 * LENGTH * math.sin(q)
        torque, most = motor + outside, budget(p, motor, outside, v)
        stop = -(inertia * v / h + torque)
        v += h * (torque + min(max(stop, -most), most)) / inertia
        q += h * v
        out[i] = q
    return out, h


@pytest.mark.parametrize(("model", "load"), [("m1", 0.0), ("m2", 0.0), ("m5", 0.27)])
def test_the_motion_is_bams_within_a_hundredth(tmp_path, model, load):
    """Of m5 with the motor's share of a published fit."""
    file = of(model, load_friction_motor=load) if load else of(model)
    (tmp_path / "m.json").write_text(json.dumps(file))
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
    want, h = theirs(file, t, goals, 3.0)
    want = np.interp(run.t, h * np.arange(1, len(want) + 1), want)
    apart = run.position[:, 0] - want
    assert np.sqrt(np.mean(apart**2)) < 0.01 * np.ptp(want), "root mean square over the range"
    less = of(model) if load else M2 | {"model": "m1", "friction_base": 0.0, "friction_viscous": 0.0}
    without = theirs(less, t, goals, 3.0)[0]
    without = np.interp(run.t, h * np.arange(1, len(without) + 1), without)
    assert np.sqrt(np.mean((without - want) ** 2)) > 0.02 * np.ptp(want), "friction (by load) matters here"


@pytest.mark.parametrize("model", ["m1", "m2", "m5"])
def test_there_and_back_again(tmp_path, model):
    source, servo, back = (tmp_path / n for n in ("a.json", "servo.yaml", "b.json"))
    own = {"load_friction_motor": 0.27} if model == "m5" else {}
    source.write_text(json.dumps(of(model, command_delay=0.004, q_offset=0.02, **own)))
    assert bam.main([f"in={source}", f"out={servo}", f"kp={KP}", f"supply_voltage={VOLT}"]) == 0
    assert bam.main([f"in={servo}", f"out={back}", "armature=0.0019"]) == 0
    one, two = bam.read(source), bam.read(back)
    for name in ("kt", "R", "armature", "friction_base", "friction_viscous", "q_offset", "command_delay"):
        assert getattr(one, name) == pytest.approx(getattr(two, name), rel=1e-9), name
    if model != "m1":
        assert (one.friction_stribeck, one.alpha) == pytest.approx((two.friction_stribeck, two.alpha))
    assert two.model == model and all(getattr(one, name) == getattr(two, name) for name in LOADS)
    if model == "m5":  # m6 without its squares; BAM has one figure for both
        source.write_text(json.dumps(of("m6", command_delay=0.004, q_offset=0.02, **own)))
        assert bam.to_servo(bam.read(source), KP, VOLT)["joints"] == yaml.safe_load(servo.read_text())["joints"]
        said = yaml.safe_load(servo.read_text())
        said["joints"]["*"]["load_friction_backdriven"] = 0.1
        servo.write_text(yaml.safe_dump(said))
        with pytest.raises(UserError, match=r"load_friction \(0.27\), load_friction_backdriven \(0.1\)"):
            bam.main([f"in={servo}", f"out={back}", "armature=0.0019"])


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


@pytest.mark.parametrize(("model", "term"), [(m, t) for m, ts in OF.items() for t in ts if t != LOADS[2]])
def test_a_load_term_is_refused_by_its_name_and_read_where_it_is_0(tmp_path, model, term):
    """m3 to m6 with no load are m1 and m2; nothing of a term that the servo table lacks is left out in silence."""
    path, servo = tmp_path / "m.json", tmp_path / "servo.yaml"
    path.write_text(json.dumps(of(model, **{term: 0.12})))
    with pytest.raises(UserError) as error:
        bam.main([f"in={path}", f"out={servo}", f"kp={KP}", f"supply_voltage={VOLT}"])
    assert f"m.json: {term} (0.12): model {model}" in str(error.value) and "\n" not in str(error.value)
    path.write_text(json.dumps({k: v for k, v in of(model).items() if k != term}))
    with pytest.raises(UserError, match=f"m.json: {term}: missing in a file of model {model}"):
        bam.main([f"in={path}", f"out={servo}", f"kp={KP}", f"supply_voltage={VOLT}"])
    assert not servo.exists()
    path.write_text(json.dumps(of(model)))
    alike, ours = of("m1" if model == "m3" else "m2"), bam.to_servo(bam.read(path), KP, VOLT)
    none = dict.fromkeys(bam.LOADED, 0.0)
    ours["joints"]["*"] = {k: v for k, v in ours["joints"]["*"].items() if none.get(k) != v}
    assert ours == bam.to_servo(bam.Bam(**alike), KP, VOLT)


@pytest.mark.parametrize("name", ["xl330_m288", "xc330_m288"])
def test_the_published_motors_are_of_one_piece(name):
    """Stall torque, current and no-load speed of a DC motor: torque constant and back-EMF constant agree within 30 %,
    gears' losses between them."""
    table = ServoTable.load(CONFIGS / "servo" / f"{name}.yaml")
    per_amp, per_speed = 1 / table.current_per_torque, table.supply_voltage / table.value("*", "no_load_speed").value
    assert 0.7 < per_amp / per_speed < 1.0
