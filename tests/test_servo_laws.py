"""Laws of the drive that the training's servo, its NumPy reference and the search's plant share, against closed
forms."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from servo_reference import servo as servo_reference

from dexsim.actuator import COLUMNS, FIELDS, Servo, ServoTable, kernel, laws
from dexsim.actuator.columns import INDEX
from dexsim.actuator.laws import LEAST_ROTOR
from dexsim.actuator.reference import gear_load_friction, measured_position, torque_along, viscous
from dexsim.gap import demo
from dexsim.gap.judge.full_model import World, free_runs
from dexsim.gap.plant.batch import JointPlant, nominal_row
from dexsim.gap.plant.columns import SERIES, SERIES_INDEX
from dexsim.gap.plant.mechanics import JointConstants
from dexsim.sim import make_engine
from tests.test_servo import STICKS, drive, link_spec, run

FREE = {"kp": 100.0, "kd": 0.0, "torque_limit": 0.4, "no_load_speed": 10.0}
INERTIA = 1e-3


def servo_motion(columns: dict, times, targets, seconds: float, v0=0.0, dt=0.001, gravity=0.0) -> np.ndarray:
    """[steps, 3] q, v, motor torque at the begin of each step: a free link on the servo's kernel in C MuJoCo."""
    friction = STICKS + (HARD if gravity else "")
    engine = make_engine(link_spec(INERTIA, dt, gravity, friction), 1, engine="mujoco", fields=FIELDS, threads=1)
    servo = Servo(engine, ["joint"], ServoTable.from_dict({"joints": {"joint": columns}}), control_period=0.005)
    engine.t.qvel[:] = v0
    out, k = [], 0
    for i in range(round(seconds / dt)):
        while k < len(times) and times[k] <= i * dt + 1e-9:
            servo.send(torch.full((1, 1), float(targets[k])), stamp=float(times[k]))
            k += 1
        q, v = engine.t.qpos[0, 0].item(), engine.t.qvel[0, 0].item()
        engine.step(1, servo.before_each)
        out.append((q, v, servo.torque[0, 0].item()))
    return np.array(out)


def plant_motion(columns: dict, times, targets, seconds: float, v0=0.0, dt=0.001, gravity=0.0) -> np.ndarray:
    """[steps, 2] q, motor torque of the same link in the search's plant."""
    steps = round(seconds / dt)
    t = dt * np.arange(steps)
    constants = JointConstants(0.0, 0.0, -1e6, 1e6, False, 0.0, INERTIA)
    plant = JointPlant("joint", constants, dt, False, "joint", "joint")
    series = np.zeros((2, len(SERIES)))
    for name, value in (
        ("inertia", INERTIA),
        ("supply", 1.0),
        ("enabled", 1.0),
        ("warmth", columns.get("warmth", 0.0)),
        ("gravity_cos", 0.1 * gravity * 0.008),
    ):
        series[:, SERIES_INDEX[name]] = value
    row = nominal_row(ServoTable.from_dict({"joints": {"joint": columns}}).nominal(["joint"])[0], 0.0)
    early = [-2.0, *times], [0.0, *targets]
    plant.add(
        row, np.array([0.0, seconds]), series, *(np.array(x, float) for x in early), t, np.zeros(steps), None, {}
    )
    plant.finish()
    q, torque = plant.simulate(plant.base()[None], plant.windows(None), np.array([[0.0, v0]]))
    return np.stack([q[0], torque[0]], 1)


# -- the torque limit in four quadrants
# --------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [1.0, 0.4, 0.0, -1.0])
def test_torque_limit_in_four_quadrants(slope):
    """limit = tau0 max(0, 1 - b |v| / v0), b = 1 where torque and speed agree, braking_slope where they do not: kernel,
    reference."""
    tau0, v0 = FREE["torque_limit"], FREE["no_load_speed"]
    cases = [(sign * v, toward) for v in (0.0, 3.0, 9.0, 14.0) for sign in (1, -1) for toward in (1, -1)]
    engine = make_engine(link_spec(1.0, 1e-4), len(cases), engine="mujoco", fields=FIELDS, threads=1)
    table = ServoTable.from_dict({"joints": {"joint": FREE | {"braking_slope": slope}}})
    servo = Servo(engine, ["joint"], table)
    engine.t.qvel[:, 0] = torch.tensor([v for v, _ in cases])
    servo.send(torch.tensor([[50.0 * toward] for _, toward in cases]))
    servo.before_each()
    v, toward = np.array(cases, float).T
    b = np.where(v * toward < 0, slope, 1.0)
    expected = toward * tau0 * np.maximum(0.0, 1.0 - b * np.abs(v) / v0)
    np.testing.assert_allclose(servo.torque[:, 0].numpy(), expected, atol=1e-6)
    params = np.tile(table.nominal(["joint"]), (len(cases), 1))
    np.testing.assert_allclose(
        servo_reference(params, 50.0 * toward, 0.0, v, dt=1e-4, features=("braking",))["torque"], expected, atol=1e-12
    )


@pytest.mark.parametrize("slope", [1.0, 0.5, 0.0, -0.5, -1.0])
@pytest.mark.parametrize("motion", [servo_motion, plant_motion])
def test_braking_follows_the_closed_form(motion, slope):
    """I v' = -tau0 (1 - b v / v0) from 0.8 v0 until it stands: v0/b - (v0/b - v) exp(b r t); then the driving line, b =
    -1."""
    tau0, no_load, v0 = FREE["torque_limit"], FREE["no_load_speed"], 8.0
    out = motion(FREE | {"braking_slope": slope}, [0.0], [-1e4], 0.08, v0)
    t = 0.001 * np.arange(len(out))
    r = tau0 / no_load / INERTIA

    def fall(t):
        return (
            v0 - tau0 / INERTIA * t if slope == 0 else no_load / slope - (no_load / slope - v0) * np.exp(slope * r * t)
        )

    stands = v0 * INERTIA / tau0 if slope == 0 else -np.log(1 - slope * v0 / no_load) / (slope * r)
    v = np.where(t < stands, fall(t), -no_load * (1 - np.exp(-r * (t - stands))))
    q = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1])) * 0.001])
    assert 0.01 < stands < 0.06
    assert np.abs(out[:, 0] - q).max() < (0.012 if motion is servo_motion else 0.005)


def test_braking_slope_round_trip_and_range(tmp_path):
    table = ServoTable.from_dict(
        {"joints": {"*": {"kp": 1.0, "braking_slope": [-1.0, 0.0]}, "a": {"braking_slope": 0.5}}}
    )
    table.save(tmp_path / "servo.yaml")
    again = ServoTable.load(tmp_path / "servo.yaml")
    np.testing.assert_array_equal(again.nominal(["a", "b"])[:, INDEX["braking_slope"]], [0.5, -0.5])
    assert COLUMNS[INDEX["braking_slope"]].neutral == 1.0
    low, high = again.bounds(["b"])
    assert (low[0, INDEX["braking_slope"]], high[0, INDEX["braking_slope"]]) == (-1.0, 0.0)


# -- the controller's other terms
# --------------------------------------------------------------------------------------------

LOOP = {"kp": 2.0, "kd": 0.04, "viscous_friction": 0.01}
TERMS = [
    {"speed_feedforward": 0.05},
    {"speed_feedforward": 0.05, "acceleration_feedforward": 1e-3},
    {"integral_gain": 20.0},
    {"integral_gain": 20.0, "torque_limit": 0.06, "no_load_speed": 40.0},  # winds up but for the limit
]


def controller(columns: dict, times, targets, seconds: float, fine: float = 2e-5) -> np.ndarray:
    """Return [n] q at every `fine` s of the same link: explicit Euler of the controller's law as `laws.py` states
    it, written apart."""
    c = {
        "speed_feedforward": 0.0,
        "acceleration_feedforward": 0.0,
        "integral_gain": 0.0,
        "torque_limit": np.inf,
        "no_load_speed": np.inf,
    }
    c |= columns
    q = v = integral = 0.0
    r, rate, bend, until = 0.0, 0.0, 0.0, np.inf
    k, out = 0, []
    for i in range(round(seconds / fine)):
        now = i * fine
        if k < len(times) and times[k] <= now + 1e-9:
            if k:
                span = times[k] - times[k - 1]
                new = (targets[k] - r) / span
                rate, bend, until = new, (new - rate) / span, now + 2 * span
            r, k = targets[k], k + 1
        if now >= until - 1e-9:
            rate, bend = 0.0, 0.0
        e = r - q
        requested = (
            c["kp"] * e - c["kd"] * v + c["speed_feedforward"] * rate + c["acceleration_feedforward"] * bend + integral
        )
        limit = c["torque_limit"] * max(0.0, 1.0 - abs(v) / c["no_load_speed"])
        if abs(requested) <= limit or requested * e < 0:
            integral += fine * c["integral_gain"] * e
        out.append(q)
        v += fine * (min(max(requested, -limit), limit) - c["viscous_friction"] * v) / INERTIA
        q += fine * v
    return np.array(out)


@pytest.mark.parametrize("motion", [servo_motion, plant_motion])
@pytest.mark.parametrize("terms", TERMS)
def test_controller_terms_against_an_independent_integration(motion, terms):
    """A stream of targets 100 times a second that stops half way: what is commanded is still, and the speed's term with
    it."""
    times = np.arange(0.0, 0.3, 0.01)
    targets = 0.4 * np.sin(9.0 * times) ** 2
    steps = 50  # of the integration in a millisecond
    expected = controller(LOOP | terms, times, targets, 0.5)[::steps]
    plain = {k: v for k, v in terms.items() if k in ("torque_limit", "no_load_speed")}
    without = controller(LOOP | plain, times, targets, 0.5)[::steps]
    got = motion(LOOP | terms, times, targets, 0.5)[:, 0]
    error = np.sqrt(np.mean((got - expected) ** 2))
    assert error < 0.003, error
    assert error < 0.15 * np.sqrt(np.mean((without - expected) ** 2))


def test_a_speed_loop_inside_a_position_loop_is_these_columns():
    """The cascade of `laws.py`: P position loop with full speed feed-forward around a PI speed loop, integrated by
    itself."""
    k_pp, k_vp, k_vi, fine = 20.0, 0.05, 0.6, 2e-5
    times = np.arange(0.0, 0.3, 0.01)
    targets = 0.4 * np.sin(9.0 * times) ** 2
    q = v = i_v = 0.0
    expected, ramp = [], np.concatenate([[0.0], np.diff(targets) / 0.01])
    for i in range(round(0.3 / fine)):
        k = int((i + 0.5) * fine / 0.01)
        u = k_pp * (targets[k] - q) + ramp[k]
        # the integral of r' of held targets is r itself one interval late; the columns' kp acts on r: compare what both
        # see
        i_v += fine * (k_pp * (targets[k] - q) - v)
        tau = k_vp * (u - v) + k_vi * (i_v + targets[k])
        expected.append(q)
        v += fine * tau / INERTIA
        q += fine * v
    columns = {"kp": k_vp * k_pp + k_vi, "kd": k_vp, "speed_feedforward": k_vp, "integral_gain": k_vi * k_pp}
    got = servo_motion(columns, times, targets, 0.3, dt=0.0005)[:, 0]
    assert np.sqrt(np.mean((got - np.array(expected)[::25]) ** 2)) < 0.002


def test_an_integral_overcomes_dry_friction():
    """A step whose proportional torque is less than the dry friction: without an integral the joint never moves."""
    columns = {"kp": 2.0, "kd": 0.2, "integral_gain": 30.0, "coulomb_friction": 0.05}
    for motion in (servo_motion, plant_motion):
        with_, without = (motion(c, [0.0], [0.02], 1.0)[-1, 0] for c in (columns, columns | {"integral_gain": 0.0}))
        assert abs(with_ - 0.02) < 0.006 and abs(without) < 0.001


def test_a_replay_begins_with_the_load_in_the_integral():
    """A joint held against gravity by its integral since long stays where it is; one without sags by load / kp."""
    sags = []
    for gain in (10.0, 0.0):
        table = ServoTable.from_dict({"joints": {"*": {"kp": 2.0, "kd": 0.04, "integral_gain": gain}}})
        q, at, none = np.array([0.5]), np.array([0.0]), np.zeros((0, 1))
        world = World(table.nominal(["joint"]), table, np.array([0, 0, -9.81]), 0.3, q, 0 * at, q, np.zeros(0), none)
        moved = free_runs(mujoco.MjSpec.from_string(demo.MODEL), ["joint"], [world], engine="mujoco")[0]
        sags.append(np.abs(moved[:, 0] - 0.5).max())
    assert sags[0] < 1e-4 < 0.01 < sags[1]


# -- friction and ripple
# -----------------------------------------------------------------------------------------------------

COAST = {"kp": 0.0}


def coast(torque, v0: float, seconds: float, fine: float = 1e-5) -> np.ndarray:
    """Return [ms] q of the link under torque(q, v), by the midpoint rule in steps of 10 us; it stands once its speed
    turns."""
    q, v, out = 0.0, v0, []
    for i in range(round(seconds / fine)):
        if i % round(1e-3 / fine) == 0:
            out.append(q)
        if v > 0.0:
            a = torque(q, v) / INERTIA
            a = torque(q + 0.5 * fine * v, v + 0.5 * fine * a) / INERTIA
            q, v = q + fine * (v + 0.5 * fine * a), max(v + fine * a, 0.0)
    return np.array(out)


@pytest.mark.parametrize("motion", [servo_motion, plant_motion])
@pytest.mark.parametrize("exponent", [2.0, 1.0, 0.5])
def test_stribeck_exponent(motion, exponent):
    """A link that coasts to its stop: I v' = -(c + peak exp(-(v / v_s)^n))."""
    columns = COAST | {
        "coulomb_friction": 0.02,
        "stribeck_peak": 0.03,
        "stribeck_speed": 1.5,
        "stribeck_exponent": exponent,
    }
    q = motion(columns, [0.0], [0.0], 0.25, v0=6.0)[:, 0]
    ends = {
        n: coast(lambda _, v, n=n: -0.02 - 0.03 * np.exp(-((v / 1.5) ** n)), 6.0, 0.25)[-1] for n in (2.0, 1.0, 0.5)
    }
    assert abs(q[-1] - ends[exponent]) < 0.012
    assert min(abs(a - ends[exponent]) for n, a in ends.items() if n != exponent) > 0.03  # a law of its own each


SPRING = {"softness": 0.01, "rotor": 0.3 * INERTIA, "rebound": 0.5}


@pytest.mark.parametrize("motion", [servo_motion, plant_motion])
@pytest.mark.parametrize("more", [{}, SPRING])
@pytest.mark.parametrize("half", [0.4, 3.0])
def test_thinning_friction(motion, more, half):
    """A link that coasts: I v' = -(b + a / (1 + |v| / v_h)) v, also where its motor is joined to it by a spring."""
    b, a = 0.004, 0.03
    columns = COAST | {"viscous_friction": b, "thinning_friction": a, "thinning_speed": half} | more
    q = motion(columns, [0.0], [0.0], 0.25, v0=6.0)[:, 0]
    ways = {h: coast(lambda _, v, h=h: -(b + a / (1 + v / h)) * v, 6.0, 0.25) for h in (0.4, 3.0, 1e9)}
    assert np.abs(q - ways[half]).max() < 0.012
    assert min(np.abs(ways[half] - w).max() for h, w in ways.items() if h != half) > 0.1  # a law of its own each


def test_thinning_friction_is_half_gone_at_its_speed_and_linear_without():
    row = ServoTable.from_dict({"joints": {"joint": {"viscous_friction": 0.01, "thinning_friction": 0.02,
                                                     "thinning_speed": 3.0}}}).nominal(["joint"])[0]  # fmt: skip
    p = {name: row[i] for name, i in INDEX.items()}
    np.testing.assert_allclose(viscous(p, np.array([0.0, 3.0, -3.0, 9.0])), [0.03, 0.02, 0.02, 0.015])
    assert viscous(p | {"thinning_friction": 0.0}, np.array([0.0, 7.0])).tolist() == [0.01, 0.01]
    assert viscous(p, 3.0, features=()) == 0.01


def sawtooth(angle):
    """Return a sawtooth by its Fourier series: rises through 0 at angle 0, drops at pi."""
    k = np.arange(1, 400)[:, None]
    return (2 / np.pi * (-1.0) ** (k + 1) / k * np.sin(k * angle)).sum(0)


@pytest.mark.parametrize("shape", [0.0, 1.0, -1.0, 0.4])
def test_ripple_shape(shape):
    """Kernel and reference against the sawtooth's Fourier series; the plant against an integration of the kernel's
    wave."""
    q = np.linspace(-1.0, 1.0, 57)
    angle = 9.0 * q + 0.3
    saw = sawtooth(angle) if shape >= 0 else -sawtooth(angle - np.pi)
    expected = 0.02 * ((1 - abs(shape)) * np.sin(angle) + abs(shape) * saw)
    columns = COAST | {"torque_ripple": 0.02, "ripple_per_turn": 9.0, "ripple_phase": 0.3, "ripple_shape": shape}
    engine = make_engine(link_spec(1.0, 1e-4), len(q), engine="mujoco", fields=FIELDS, threads=1)
    table = ServoTable.from_dict({"joints": {"joint": columns}})
    servo = Servo(engine, ["joint"], table)
    engine.t.qpos[:, 0] = torch.as_tensor(q)
    servo.before_each()
    # of the jump, where the series rings
    away = np.abs(np.mod(angle - (np.pi if shape > 0 else 0.0) + np.pi, 2 * np.pi) - np.pi) > 0.1
    np.testing.assert_allclose(engine.t.qfrc_applied[:, 0].numpy()[away], expected[away], atol=3e-4)
    params = np.tile(table.nominal(["joint"]), (len(q), 1))
    law = servo_reference(params, 0.0, q, 0.0 * q, dt=1e-4, features=("shape",))["qfrc_applied"]
    np.testing.assert_allclose(law[away], expected[away], atol=3e-4)
    fine = np.linspace(-10.0, 10.0, 200001)
    table_of = servo_reference(
        np.tile(params[:1], (len(fine), 1)), 0.0, fine, 0.0 * fine, dt=1e-9, features=("shape",)
    )["qfrc_applied"]
    moved = coast(lambda q, v: np.interp(q, fine, table_of), 3.0, 0.2, fine=1e-4)
    assert np.abs(plant_motion(columns, [0.0], [0.0], 0.2, v0=3.0)[:, 0] - moved).max() < 0.004
    assert np.abs(moved - 3e-3 * np.arange(200)).max() > 0.01


def dahl(amount: float, level: float, times, targets, seconds: float, fine: float = 1e-5) -> np.ndarray:
    """Return [ms] q of the link on a PD (2, 0.02) with Dahl's friction level z, dz = (1 - z sign(v)) v dt / amount, by
    explicit Euler."""
    q = v = z = 0.0
    out = []
    for i in range(round(seconds / fine)):
        if i % round(1e-3 / fine) == 0:
            out.append(q)
        r = targets[min(int((i + 0.5) * fine / 0.01), len(targets) - 1)]
        v += fine * (2.0 * (r - q) - 0.02 * v - level * z) / INERTIA
        z += fine * v / amount * (1.0 - z * np.sign(v))
        q += fine * v
    return np.array(out)


@pytest.mark.parametrize("motion", [servo_motion, plant_motion])
def test_presliding_is_dahls_law(motion):
    """Small motions inside the dry friction, then one out of it: with a stiff friction the small ones would not be
    there."""
    times = np.arange(0.0, 0.8, 0.01)
    targets = np.where(times < 0.5, 0.02 * np.sin(15.0 * times), 0.2)
    columns = {"kp": 2.0, "kd": 0.02, "coulomb_friction": 0.08, "presliding": 0.01}
    expected = dahl(0.01, 0.08, times, targets, 0.8)
    q = motion(columns, times, targets, 0.8)[:, 0]
    stiff = motion(columns | {"presliding": 0.0}, times, targets, 0.8)[:, 0]
    small = slice(0, 500)
    assert np.abs(stiff[small]).max() < 5e-4 < 2e-3 < np.abs(expected[small]).max()
    assert np.abs(q - expected)[small].max() < 4e-4, np.abs(q - expected)[small].max()
    assert np.abs(q - expected).max() < 0.01, np.abs(q - expected).max()


def test_presliding_is_stable_at_any_step_and_inertia():
    """A finger's last link of 1e-5 kg.m2 at 5 ms, friction of a twentieth of the stall torque: it holds still, off its
    target."""
    columns = {
        "kp": 1.5,
        "kd": 0.03,
        "torque_limit": 0.4,
        "no_load_speed": 14.38,
        "coulomb_friction": 0.02,
        "presliding": 0.002,
    }
    for extra, dt in (({}, 0.005), ({"softness": 0.3, "rotor": 1e-5}, 0.001)):
        engine, servo = drive(columns | extra, inertia=1e-5, dt=dt)
        servo.send(torch.full((1, 1), 0.5))
        out = run(engine, servo, 1.0)
        assert np.isfinite(out).all() and abs(out[-1, 0] - 0.5) < 0.03 and np.abs(out[-40:, 1]).max() < 0.02, (
            extra,
            out[-1],
        )


@pytest.mark.parametrize("motion", [servo_motion, plant_motion])
def test_warmth_acts_on_friction_that_grows_with_load(motion):
    """Constant motor torque T against load friction f T: I v' = T (1 - f (1 + k warmth)), 40 degrees warm."""
    columns = {"kp": 100.0, "torque_limit": 0.05, "load_friction": 0.5, "thermal_friction": -0.01, "warmth": 40.0}
    q = motion(columns, [0.0], [1e4], 0.2)[:, 0]
    assert q[-1] == pytest.approx(0.5 * 0.05 * (1 - 0.5 * 0.6) / INERTIA * 0.199**2, rel=0.02)


HARD = ' solreffriction="0.002 1"'  # dry friction that stops as the plant's does, not along an exponential of 20 ms
LOADED = {"load_friction_external": 0.4, "load_stribeck": 0.2, "load_stribeck_external": 0.4, "load_quadratic": 1e3,
          "load_quadratic_external": 20.0}  # fmt: skip


@pytest.mark.slow
def test_a_gears_load_from_both_sides_is_one_law_in_servo_and_plant():
    """A link under gravity that is lifted and let down: the two come together with the step; each column matters."""
    columns = {"kp": 0.3, "kd": 0.006, "load_friction": 0.2, "load_friction_backdriven": 0.2, "stribeck_speed": 0.6}
    times = np.arange(0.0, 2.0, 0.01)
    targets = 0.5 * np.sin(2 * np.pi * times) + 0.1 * np.sin(2 * np.pi * 2.3 * times)
    run_by = lambda motion, c, dt: motion(c, times, targets, 2.0, dt=dt, gravity=40.0)[:, 0]  # noqa: E731
    q = run_by(servo_motion, columns | LOADED, 2.5e-4)
    distance = np.abs(run_by(plant_motion, columns | LOADED, 2.5e-4) - q).max()
    coarse = run_by(plant_motion, columns | LOADED, 1e-3) - run_by(servo_motion, columns | LOADED, 1e-3)
    assert distance < 0.007 and distance < 0.4 * np.abs(coarse).max()
    for name in LOADED:
        without = np.abs(run_by(servo_motion, columns | LOADED | {name: 0.0}, 2.5e-4) - q).max()
        assert without > 3 * distance, name


def test_what_the_encoder_is_off_by_is_marked_as_the_encoders():
    """By the mark a servo knows that what is reported is no straight line in the position."""
    q = np.linspace(-1.5, 1.5, 7)
    neutral = {c.name: c.neutral for c in COLUMNS}
    for c in COLUMNS:
        displayed, slope = measured_position(neutral | {c.name: min(c.neutral + c.usual, c.high)}, q)
        assert c.encoder == (np.abs(np.diff(displayed, 2)).max() > 1e-3) == (np.ptp(slope + 0.0 * q) > 1e-3), c.name


@wp.kernel
def limited(slope: float, requested: wp.array(dtype=float), v: wp.array(dtype=float), out: wp.array2d(dtype=float)):
    i = wp.tid()
    ends = laws.torque_limits(0.4, wp.abs(v[i]) / 10.0, v[i], slope)
    out[i, 0] = wp.clamp(requested[i], -ends[0], ends[1])
    out[i, 1] = laws.voltage_torque(requested[i], 0.4, 1.2, 0.4 / 10.0, v[i])


@pytest.mark.parametrize("slope", [1.0, 0.3, 0.0, -0.8])
def test_the_torque_along_a_measured_motion_follows_the_kernels_laws(slope):
    rng = np.random.default_rng(0)
    requested, v = rng.uniform(-1.5, 1.5, 200), rng.uniform(-12.0, 12.0, 200)
    out = wp.zeros((200, 2), dtype=float, device="cpu")
    inputs = [wp.array(x, dtype=float, device="cpu") for x in (requested, v)]
    wp.launch(limited, 200, inputs=[slope, *inputs, out], device="cpu")
    torque = torque_along(requested, v, 0.4, 10.0, False, braking_slope=slope)
    duty = torque_along(requested, v, 0.4, 10.0, True, 1.2)
    assert np.allclose(out.numpy(), np.stack([torque, duty], 1), atol=1e-6) and np.abs(torque).max() > 0.35
    assert np.array_equal(torque_along(requested, v, np.inf, np.inf, False), requested)
    assert np.array_equal(torque_along(requested, v, 0.4, 10.0, False, limited=False), requested)


@wp.kernel
def searched(torque: wp.array(dtype=wp.float64), v: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    one = wp.float64(1.0)
    out[i, 0] = laws.sagged_torque(wp.float64(0.3), wp.float64(0.2), torque[i])
    out[i, 1] = laws.gear_load_friction(
        torque[i], v[i], wp.float64(0.1), wp.float64(0.4), wp.float64(1.5), wp.float64(2.0)
    )
    out[i, 2] = laws.gear_load_friction(torque[i], v[i], wp.float64(0.1), wp.float64(0.4), one, wp.float64(2.0))
    out[i, 3] = laws.duty_torque(torque[i], wp.float64(0.4), wp.float64(1.2), wp.float64(0.04), v[i])


def test_every_law_says_its_equation_units_and_source():
    """A unit in brackets, and where it is from: a publication or a standard, a law of physics or a definition, another
    law of the file, or ours."""
    functions = {name: x for name, x in vars(laws).items() if isinstance(x, wp.Function)}
    assert len(functions) > 30
    unit = re.compile(r"\[[^\]]*\b(1|s|rad|N\.m|N\.m\.s|kg\.m2|degC)\b[^\]]*\]")
    source = re.compile(
        r"\b(ours|geometry|by definition|source:|(19|20)\d\d|section \d|IEC|(Ohm|Kirchhoff)'s law|the paper's)(?!\w)",
        re.IGNORECASE,
    )
    for name, x in functions.items():
        said = " ".join((x.func.__doc__ or "").split())
        assert unit.search(said), f"{name}: no unit"
        assert source.search(said), f"{name}: no source"


def test_the_limits_of_the_numerics_that_kernel_and_check_share():
    """The check takes these from what it checks, which it could not see change."""
    assert (LEAST_ROTOR, kernel.BORROWED) == (0.03, 0.5)
    assert (kernel.STOP_RATE, kernel.STOP_GAIN) == (2 * np.pi * 40.0, 30.0)
    assert (kernel.SNAP, kernel.SEED, kernel.EDGE) == (1e-3, 1e-6, 1.0 + 1e-6)


def test_laws_that_only_the_search_has():
    """A drive weakened by its own torque and by others', down to a fifth; a gear's friction by a power of the torque
    that it hands on, linear at power 1; a motor at a duty beyond its supply."""
    rng = np.random.default_rng(1)
    torque, v = rng.uniform(-4.0, 4.0, 200), rng.uniform(-12.0, 12.0, 200)
    out = wp.zeros((200, 4), dtype=wp.float64, device="cpu")
    inputs = [wp.array(x, dtype=wp.float64, device="cpu") for x in (torque, v)]
    wp.launch(searched, 200, inputs=[*inputs, out], device="cpu")
    rest, friction, linear, duty = out.numpy().T
    size = np.abs(torque)
    share = np.where(torque * v < 0, 0.4, 0.1)
    assert np.allclose(rest, np.maximum(0.7 - 0.2 * size, 0.2)) and (rest == 0.2).any() and (rest > 0.2).any()
    assert np.allclose(friction, share * 2.0 * (size / 2.0) ** 1.5)
    assert np.allclose(linear, share * size)
    assert np.allclose(friction, gear_load_friction(torque, v, 0.1, 0.4, 1.5, 2.0), rtol=1e-12)
    assert np.allclose(duty, 0.4 * (1.2 * torque) - 0.04 * v)
