"""BAM's parameter files: read, written, and the same motion as BAM's equations integrated here on their own."""

from __future__ import annotations

import json
import math

import mujoco
import numpy as np
import pytest
import yaml

from dexsim.actuator import bam
from dexsim.actuator.columns import INDEX
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX as PLANT
from dexsim.gap.read import Run
from dexsim.paths import CONFIGS
from dexsim.recording.mechanism import drive, mechanism
from dexsim.recording.schema import COMMANDS, Series

M2 = {"kt": 0.38, "R": 3.6, "armature": 0.0019, "q_offset": 0.0, "friction_base": 0.0186, "friction_stribeck": 0.011,
      "dtheta_stribeck": 1.0, "alpha": 2.0, "friction_viscous": 0.004, "model": "m2", "actuator": "xl330"}  # fmt: skip
OF = {
    "m1": {},
    "m2": {},
    "m3": {"load_friction_base": 0.26},
    "m4": {"load_friction_base": 0.2, "load_friction_stribeck": 0.12},
    "m5": {
        "load_friction_motor": 0.1,
        "load_friction_external": 0.13,
        "load_friction_motor_stribeck": 0.1,
        "load_friction_external_stribeck": 0.15,
    },
}
"""Load terms of each model, and Stribeck's speed above, so that each is felt on this pendulum: the squares are far
beyond BAM's bound of 0.01."""
OF["m6"] = OF["m5"] | {"load_friction_motor_quad": 8.0, "load_friction_external_quad": 3.0}
FITTED = {
    "kt": 0.286, "R": 2.0, "armature": 0.00257, "friction_base": 0.0023, "friction_stribeck": 0.0002,
    "load_friction_motor": 0.23, "load_friction_external": 0.26, "load_friction_motor_stribeck": 0.0,
    "load_friction_external_stribeck": 0.15, "load_friction_motor_quad": 0.0056, "load_friction_external_quad": 0.0038,
    "dtheta_stribeck": 0.115, "alpha": 1.0, "friction_viscous": 0.0185, "model": "m6", "actuator": "xl330",
}  # fmt: skip
"""The figures of one of BAM's own fits to an XL330, rounded."""
FALL = ("friction_stribeck", "dtheta_stribeck", "alpha")
KP, VOLT, MASS, LENGTH = 1.15, 5.0, 0.3, 0.1


def of(model: str, **terms: float) -> dict:
    """Return a file of a model: M2's figures and the model's load terms, but for those given."""
    own = {k: v for k, v in M2.items() if model not in ("m1", "m3") or k not in FALL}
    return own | OF[model] | terms | {"model": model}


def budget(p: dict, motor: float, external: float, v: float) -> float:
    """Return what friction can hold, by the models' equations as published (arXiv 2410.08650, section III; m5's and
    m6's loads as the method's code has them: weighted, then subtracted). A term that p does not name is 0."""
    falls = p["model"] not in ("m1", "m3")
    peak = math.exp(-(abs(v / p["dtheta_stribeck"]) ** p["alpha"])) if falls else 0.0
    said = lambda name: p.get(f"load_friction_{name}", 0.0)  # noqa: E731
    most = p["friction_base"] + p["friction_viscous"] * abs(v) + peak * p.get("friction_stribeck", 0.0)
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
    """Return BAM's pendulum: torque kt U / R - kt^2 / R dq; friction is what would stop the joint within the step,
    at most the budget. Semi-implicit Euler in steps of h [s]."""
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


def ours(tmp_path, file: dict, stamps: np.ndarray, goals: np.ndarray, seconds: float, step: float = 5e-4):
    """Return the same by the servo table of the file, on the pendulum as a MuJoCo model."""
    (tmp_path / "m.json").write_text(json.dumps(file))
    table = bam.to_servo(bam.read(tmp_path / "m.json"), KP, VOLT)
    (tmp_path / "rig.xml").write_text(
        f"""<mujoco><option timestep="0.0005"/><worldbody><body name="link">
        <inertial pos="0 0 {-LENGTH}" mass="{MASS}" diaginertia="1e-12 1e-12 1e-12"/>
        <joint name="joint" axis="0 1 0" armature="{file['armature']}" solimpfriction="0.999 0.9999 0.001 0.5 2"
        solreffriction="0.002 1"/></body></worldbody></mujoco>"""
    )
    rig = mechanism(tmp_path / "rig.xml", table, gravity=(0, 0, -9.81))
    return drive(rig, Series(stamps, goals[:, None], COMMANDS), ("joint",), seconds, timestep=step)


def both(tmp_path, file: dict, terms) -> tuple[float, dict[str, float]]:
    """Return root mean square, over the range, of how far our motion is from BAM's, and BAM's own without a term."""
    t = np.arange(0.0, 3.0, 0.01)
    goals = 1.2 * np.sin(2 * np.pi * 0.4 * t) + 0.15 * np.sin(2 * np.pi * 1.7 * t)
    run = ours(tmp_path, file, t, goals, 3.0)

    def at_the_same(file: dict) -> np.ndarray:
        want, h = theirs(file, t, goals, 3.0)
        return np.interp(run.t, h * np.arange(1, len(want) + 1), want)

    want = at_the_same(file)
    off = lambda q: float(np.sqrt(np.mean((q - want) ** 2)) / np.ptp(want))  # noqa: E731
    return off(run.position[:, 0]), {term: off(at_the_same(file | {term: 0.0})) for term in terms}


@pytest.mark.parametrize("model", [pytest.param(m, marks=pytest.mark.slow) if m != "m6" else m for m in OF])
def test_the_motion_is_bams_within_a_hundredth(tmp_path, model):
    """Also that each term of the model matters to it: BAM's own motion without it is another. The terms of m3 and m5
    are among those of m4 and m6."""
    distance, without = both(tmp_path, of(model), OF[model] or ("friction_base",))
    assert distance < 0.002, "a fifth of what is asked, so that each term can be told"
    assert min(without.values()) > 5 * distance, without


def test_the_search_believes_a_bam_table_as_the_servo_moves_by_it(tmp_path):
    """A recording of BAM's joint needs nothing beside its own table: the search's plant goes where the servo goes."""
    t = np.arange(0.0, 3.0, 0.01)
    goals = 1.2 * np.sin(2 * np.pi * 0.4 * t) + 0.15 * np.sin(2 * np.pi * 1.7 * t)
    file = of("m6")
    run = ours(tmp_path, file, t, goals, 3.0)
    rows, table = slice(0, None, 10), ServoTable.from_dict(bam.to_servo(bam.Bam(**file), KP, VOLT))
    seen = Run("x", ("joint",), t, goals[:, None], run.t[rows], run.position[rows], table, np.array([0, 0, -9.81]))
    plant = build(mujoco.MjModel.from_xml_path(str(tmp_path / "rig.xml")), [seen])[0].plant

    def off(**columns: float) -> float:
        params = plant.base()[None].copy()
        for name, value in columns.items():
            params[..., PLANT[name]] = value
        q = plant.simulate(params, plant.windows(None))[0][0]
        return float(np.sqrt(np.mean((q - run.position[rows, 0]) ** 2)) / np.ptp(run.position))

    distance = off()
    assert distance < 0.01
    assert min(off(**{name: 0.0}) for name in bam.LOADED if name != "load_friction_backdriven") > 2 * distance


def test_the_motion_of_a_published_fit_is_bams_within_a_hundredth(tmp_path):
    distance, without = both(tmp_path, FITTED, ("load_friction_motor", "load_friction_external"))
    assert distance < 0.01 < 0.02 < min(without.values())


@pytest.mark.parametrize("model", list(OF))
def test_there_and_back_again(tmp_path, model):
    source, servo, back = (tmp_path / n for n in ("a.json", "servo.yaml", "b.json"))
    source.write_text(json.dumps(of(model, command_delay=0.004, q_offset=0.02)))
    assert bam.main([f"in={source}", f"out={servo}", f"kp={KP}", f"supply_voltage={VOLT}"]) == 0
    assert bam.main([f"in={servo}", f"out={back}", "armature=0.0019"]) == 0
    one, two = json.loads(source.read_text()), json.loads(back.read_text())
    assert one.keys() == two.keys() and one["model"] == two["model"] == model
    for name in one.keys() - {"model", "actuator"}:
        assert two[name] == pytest.approx(one[name], rel=1e-9), name
    # and the table once more: nothing that it says is lost by BAM's file
    assert bam.main([f"in={back}", f"out={tmp_path / 'c.yaml'}", f"kp={KP}", f"supply_voltage={VOLT}"]) == 0
    first, again = (ServoTable.load(path).nominal(["a"]) for path in (servo, tmp_path / "c.yaml"))
    np.testing.assert_allclose(again, first, rtol=1e-9)


def test_the_first_model_that_says_it_is_written(tmp_path):
    """m6 without squares is m5, m5 with the same shares on both sides m4, without Stribeck's part m3; no load: m2."""
    squares = {"load_friction_motor_quad": 0.0, "load_friction_external_quad": 0.0}
    same = {name: 0.2 for name in OF["m5"]}
    steady = same | {"load_friction_motor_stribeck": 0.0, "load_friction_external_stribeck": 0.0}
    none = dict.fromkeys(OF["m6"], 0.0)
    for file, model in (
        (of("m6", **squares), "m5"), (of("m6", **same, **squares), "m4"),
        (of("m5", **steady, friction_stribeck=0.0), "m3"), (of("m5", **steady), "m4"), (of("m6", **none), "m2"),
    ):  # fmt: skip
        (tmp_path / "m.json").write_text(json.dumps(file))
        table = ServoTable.from_dict(bam.to_servo(bam.read(tmp_path / "m.json"), KP, VOLT))
        out = bam.to_bam(table, "*", 0.0019)
        assert out["model"] == model
        (tmp_path / "m.json").write_text(json.dumps(out))
        again = ServoTable.from_dict(bam.to_servo(bam.read(tmp_path / "m.json"), KP, VOLT))
        said = [INDEX[c] for c in (*bam.LOADED, "coulomb_friction", "stribeck_peak", "viscous_friction")]
        np.testing.assert_allclose(again.nominal(["a"])[0, said], table.nominal(["a"])[0, said], rtol=1e-9)


def test_one_figure_for_both_directions(tmp_path):
    table = ServoTable.from_dict(bam.to_servo(bam.Bam(**of("m5")), KP, VOLT))
    table.set("*", "load_friction_backdriven", 0.2)
    with pytest.raises(UserError, match=r"load_friction \(0.1\), load_friction_backdriven \(0.2\)"):
        bam.to_bam(table, "*", 0.002)


def test_a_gain_that_was_fitted_is_the_loops(tmp_path):
    gain = bam.to_servo(bam.Bam(**of("m2", error_gain_ratio=1.25)), KP, VOLT)["joints"]["*"]["kp"]
    assert gain == pytest.approx(1.25 * KP)


def test_what_cannot_be_said_is_one_line(tmp_path):
    path = tmp_path / "m.json"
    for change, said in (
        ({"model": "m7"}, "model ('m7')"), ({"kt": -1.0}, "kt (-1.0)"), ({"R": "a"}, "R ('a')"),
        ({"current_limit": 1.5}, "current_limit: unknown; valid ones: model, actuator, kt"),
        ({"actuator": "erob80_50"}, "actuator ('erob80_50'): BAM drives it by current or torque; must be"),
    ):  # fmt: skip
        path.write_text(json.dumps(M2 | change))
        with pytest.raises(UserError, match="m.json") as error:
            bam.read(path)
        assert said in str(error.value) and "\n" not in str(error.value)
    for text, said in (("{", "not JSON"), ("[" * 100_000, "not JSON"), ("[]", "is a list, must map keys to values")):
        path.write_text(text)
        with pytest.raises(UserError, match=said):
            bam.read(path)
    table = ServoTable.from_dict(yaml.safe_load((CONFIGS / "servo" / "xc330_m288.yaml").read_text()))
    assert bam.to_bam(table, "*", 0.002)["kt"] == pytest.approx(5.0 / 8.48)
    with pytest.raises(UserError, match="actuator=unitree_go1"):
        bam.to_bam(table, "*", 0.002, "unitree_go1")
    table.set("*", "backlash", 0.01)
    with pytest.raises(UserError, match="backlash"):
        bam.to_bam(table, "*", 0.002)


@pytest.mark.parametrize(("model", "term"), [(m, t) for m, ts in OF.items() for t in ts] + [("m2", t) for t in FALL])
def test_a_term_that_a_model_has_must_be_said(tmp_path, model, term):
    """BAM takes a figure of its own for one that its file lacks."""
    path, servo = tmp_path / "m.json", tmp_path / "servo.yaml"
    path.write_text(json.dumps({k: v for k, v in of(model).items() if k != term}))
    with pytest.raises(UserError, match=f"m.json: {term}: missing in a file of model {model}") as error:
        bam.main([f"in={path}", f"out={servo}", f"kp={KP}", f"supply_voltage={VOLT}"])
    assert "\n" not in str(error.value) and not servo.exists()


@pytest.mark.parametrize("name", ["xl330_m288", "xc330_m288"])
def test_the_published_motors_are_of_one_piece(name):
    """Stall torque, current and no-load speed of a DC motor: torque constant and back-EMF constant agree within 30 %,
    gears' losses between them."""
    table = ServoTable.load(CONFIGS / "servo" / f"{name}.yaml")
    per_amp, per_speed = 1 / table.current_per_torque, table.supply_voltage / table.value("*", "no_load_speed").value
    assert 0.7 < per_amp / per_speed < 1.0
