"""The second laws of the concealed benchmark: each differs from the first as it must, by formulas on the plant; drawing
them changes nothing else; what the truth reports of them is what it says."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.concealed import __main__ as command
from benchmarks.concealed import effects, generate, laws, plant, score, touch, touch_cases
from dexsim.errors import UserError
from dexsim.recording import read

pytestmark = pytest.mark.slow  # a benchmark's own machine

FREE = {"coulomb": 0.0, "viscous": 0.0, "kp": 20.0, "kd": 0.5, "torque_limit": 50.0, "no_load_speed": 1e6}
HEAVY = FREE | {"rotor": 1e6, "kp": 1.0, "kd": 0.0}  # does not move: what the drive gives is seen by itself
NOWHERE = np.zeros(3)


def run(
    rows: int, steps: int, goal=0.0, q0=0.0, external=None, gravity=NOWHERE, joints: int = 1, **values
) -> dict[str, np.ndarray]:
    """Return the outputs [rows, J, steps] of pendulums, without gravity; goal: command, broadcast."""
    rig = plant.pendulum(0.1, names=tuple("abcd"[:joints]))
    c = np.broadcast_to(np.asarray(goal, float), (rows, joints, steps))
    push = None if external is None else np.broadcast_to(np.asarray(external, float), (rows, joints, steps))
    p = plant.rows(rows, joints, **values)
    return plant.simulate(rig, p, c, q0=q0, gravity=np.broadcast_to(gravity, (rows, 3)), external=push)


def last(x: np.ndarray) -> np.ndarray:
    """Mean of the last 0.3 s: the loop's own encoder has counts, and its damping rattles on them."""
    return x[..., -300:].mean(-1)


def drag(speed: np.ndarray, external=0.0, **values) -> np.ndarray:
    """Return [rows] torque that moves rows at steady speeds, pushed by `external` (a number or one a row)."""
    t = np.arange(1500) * 1e-3
    push = np.broadcast_to(external, len(speed))[:, None, None]
    o = run(len(speed), 1500, (speed[:, None] * t)[:, None], external=push, **(FREE | values))
    return last(o["torque"][:, 0])


def test_friction_curves():
    """Five laws in the rows of one run, each absent in the others' rows."""
    v = [np.array([0.1, 0.2, 0.4, 0.8])] * 2 + [np.array([0.5, 1.5, 4.5])] * 2 + [np.array([1.0, 1.0, -1.0, -1.0])]
    row = np.repeat(np.arange(5), [len(x) for x in v])
    power = np.where(row == 4, np.tile([1.0, 2 / 3], 9), 1.0)
    on = lambda size, *rows: np.where(np.isin(row, rows), size, 0.0)  # noqa: E731
    force = drag(np.concatenate(v), on(-0.4, 4), coulomb=on(0.05, 0, 1), peak=on(0.1, 0, 1), peak_speed=0.2,
                 peak_power=np.where(row == 0, 2.0, 1.0), shear=on(0.02, 2), shear_speed=1.5, viscous=on(0.02, 3),
                 load=on(0.2, 4), load_back=on(0.3, 4), load_power=power, load_unit=0.1)  # fmt: skip
    for k, power_ in enumerate((2.0, 1.0)):  # at the speed v_s either has 1/e of its peak
        assert force[row == k] - 0.05 == pytest.approx(0.1 * np.exp(-((v[k] / 0.2) ** power_)), abs=1e-3)
    assert force[row == 2] == pytest.approx(0.02 * v[2] / (1 + v[2] / 1.5), rel=0.01)
    assert force[row == 3] == pytest.approx(0.02 * v[3], rel=0.01)
    bent = np.where(power[row == 4] < 1, 0.1 * 4 ** (2 / 3), 0.4)
    assert force[row == 4] - 0.4 == pytest.approx(np.where(v[4] > 0, 0.2, -0.3) * bent, rel=0.02)


def test_ideal_friction_does_not_give_way_below_its_level():
    bristle, asymmetry = np.array([1.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.4, 0.0, 0.4])
    o = run(4, 600, 0.01, kp=1.0, kd=0.0, coulomb=0.1, asymmetry=asymmetry, bristle=bristle, viscous=0.0)
    end = o["position"][:, 0, -1]
    assert (end[:2] > 5e-6).all() and (np.abs(end[2:]) < 1e-9).all()


def test_temperature_laws():
    v, warm = np.full(2, 1.0), 55.0
    law = np.array([0.0, 1.0])
    force = drag(v, coulomb=0.1, warm=warm, heat=0.0, cooling=1e9, thermal_friction=-0.02, exponential=law)
    assert force == pytest.approx([0.1 * (1 - 0.6), 0.1 * np.exp(-0.6)], rel=0.01)
    # the winding runs ahead of the housing, and the torque follows the winding
    o = run(
        2,
        1500,
        0.5,
        **(
            HEAVY | {"rotor": 1e3, "heat": 8.0, "thermal_torque": -0.1, "core": np.array([0.0, 40.0]), "core_time": 2.0}
        ),
    )
    t = np.arange(1500) * 1e-3
    assert o["winding"][1, 0] - o["temperature"][1, 0] == pytest.approx(40 * 0.25 * (1 - np.exp(-t / 2.0)), abs=0.1)
    assert o["winding"][0, 0] == pytest.approx(o["temperature"][0, 0])
    acceleration = np.diff(o["speed"][:, 0].astype(float), axis=1)[:, -1] * 1e6
    assert acceleration[1] / acceleration[0] == pytest.approx(
        (1 - 0.1 * (o["winding"][1, 0, -1] - 25)) / (1 - 0.1 * (o["temperature"][0, 0, -1] - 25)), rel=0.02
    )


def test_teeth_rebound():
    """Thrown at a flank the link comes back with most of its speed or with little of it; the play is as wide."""
    push = np.where(np.arange(1200) < 60, 0.02, 0.0)
    o = run(
        2,
        1200,
        0.0,
        external=push,
        **(FREE | {"rotor": 1.0, "kp": 0.0, "kd": 0.0, "play": 0.1, "impact": np.array([1.0, 0.1])}),
    )
    q = o["position"][:, 0]
    speed = np.gradient(q, 1e-3, axis=1)
    back = -speed.min(1) / speed.max(1)
    assert back[0] < 0.6 and back[1] > 0.85 and q.max(1) == pytest.approx([0.05, 0.05], abs=4e-3)


def test_spring_hardens():
    load = np.array([0.05, 0.2, 0.4])
    common = FREE | {"kp": 50.0, "motor_side": 1.0, "spring": 20.0}
    both = np.tile(load, 2)  # without and with hardening
    hardening = np.repeat([0.0, 0.3], 3)
    o = run(6, 1500, 0.0, external=both[:, None, None], hardening=hardening, **common)
    twist = last(o["position"][:, 0]) - both / 50
    assert last(o["torque"][:, 0]) == pytest.approx(-both, rel=0.01)
    assert twist[:3] == pytest.approx(load / 20, rel=0.02)
    assert 20 * twist[3:] * (1 + (20 * twist[3:] / 0.3) ** 2) == pytest.approx(load, rel=0.02)


def test_messages_are_late_one_more_one_less():
    goal = np.repeat(np.arange(100) * 0.01, 10)
    o = run(
        3, 1000, goal, delay=0.024, jitter=np.array([0.0, 0.5, 0.5]), jitter_from=np.array([0.0, 0.0, 997.0]), **HEAVY
    )["torque"][:, 0]
    acts = np.round(o / 0.01).astype(int)
    t = np.arange(1000) * 1e-3
    for row, start in ((1, 0), (2, 997)):
        at = plant.arrivals(0.024, 0.5, start, 100)
        assert np.all(np.diff(at) >= 0)
        assert acts[row, 40:] == pytest.approx(np.searchsorted(at, t[40:] + 1e-9, "right") - 1)
    late = plant.arrivals(0.024, 0.5, 0, 1000) - np.arange(1000) * 0.01
    assert late.min() > 0.0119 and late.max() < 0.0361 and late.std() > 4e-3
    assert (acts[1] != acts[0]).mean() > 0.1 and (acts[1] != acts[2]).any()
    assert laws.late(0.024, 0.5, 1, 7.0) == pytest.approx(late[:700].mean()) and laws.late(
        0.024, 0.0, 1, 7.0
    ) == pytest.approx(0.024)


@pytest.mark.slow
def test_second_order_lags_have_the_mean_delay_of_the_first():
    goal = np.where(np.arange(600) >= 100, 0.3, 0.0)
    o = run(2, 600, goal, lag=0.04, lag_order=np.array([1.0, 2.0]), **HEAVY)["torque"][:, 0, 100:] / 0.3
    t = np.arange(1, 501) * 1e-3
    assert o[0] == pytest.approx(1 - np.exp(-t / 0.04), abs=1e-3)
    assert o[1] == pytest.approx(1 - (1 + t / 0.02) * np.exp(-t / 0.02), abs=0.02)
    assert (1 - o).sum(1) * 1e-3 == pytest.approx([0.04, 0.04], rel=0.03)
    # of the loop's speed: a free swing, seen through the filter, which is read off a drive too weak to act
    swing = run(
        2,
        3000,
        0.0,
        q0=0.3,
        gravity=np.array([0, 0, -9.81]),
        **(FREE | {"kp": 0.0, "kd": 1e-7, "speed_lag": 0.08, "speed_order": np.array([1.0, 2.0])}),
    )
    w = 2 * np.pi / (2 * np.diff(np.flatnonzero(np.diff(np.sign(swing["position"][0, 0])))).mean() * 1e-3)
    ratio = (
        np.sqrt(2) * (swing["torque"][:, 0, 1500:] / 1e-7).std(1) / (np.sqrt(2) * swing["speed"][:, 0, 1500:].std(1))
    )
    assert ratio == pytest.approx([1 / np.hypot(1, w * 0.08), 1 / (1 + (w * 0.04) ** 2)], rel=0.03)


def test_limits():
    goal = np.array([0.2, 0.5, 1.0, 4.0])
    common = HEAVY | {"torque_limit": 0.5}
    for knee in (0.0, 4.0):
        for voltage in (0.0, 1.0):
            o = run(4, 5, goal[:, None, None], knee=knee, voltage=voltage, **common)["torque"][:, 0, -1]
            requested = goal * (0.5 if voltage else 1.0)  # a duty of 1 is the limit
            assert o == pytest.approx(
                requested / (1 + (requested / 0.5) ** 4) ** 0.25 if knee else np.minimum(requested, 0.5), rel=1e-4
            )
    o = run(
        2,
        400,
        50.0,
        **(
            FREE
            | {"torque_limit": 0.2, "no_load_speed": 10.0, "corner": np.array([0.0, 1.0]), "rotor": 2e-3, "kd": 0.0}
        ),
    )
    v, tau = o["speed"][:, 0, 5:].astype(float), o["torque"][:, 0, 5:]
    assert tau[0] == pytest.approx(0.2 * (1 - v[0] / 10), abs=4e-3)
    assert tau[1] == pytest.approx(0.2 * np.clip(2 * (1 - v[1] / 10), 0, 1), abs=8e-3)
    assert (v[1] < 4).sum() > 10 and v[1].max() > 8


def test_supply_sags_by_what_the_bus_feels():
    share = {"sag": np.array([[0.0, 0.5], [0.0, 0.0]]), "sag_duty": np.array([[0.0, 0.0], [0.0, 0.5]])}
    o = run(2, 50, np.array([0.4, 0.0])[None, :, None], joints=2, **(HEAVY | {"torque_limit": 0.8} | share))["supply"][
        :, 1, -1
    ]
    assert o == pytest.approx([1 - 0.5 * 0.4, 1 - 0.5 * 0.4 * 0.5])  # at rest the duty is the torque over its limit


def test_ripple_shapes():
    at, sawtooth = np.tile(np.linspace(0.0, 0.5, 9), 2), np.repeat([0.0, 1.0], 9)
    o = run(
        18, 1200, at[:, None, None], q0=at[:, None], ripple=0.05, per_turn=12.0, phase=0.4, sawtooth=sawtooth, **FREE
    )
    angle = 12 * last(o["position"][:, 0]) + 0.4
    wave = np.where(sawtooth > 0, np.mod(angle + np.pi, 2 * np.pi) / np.pi - 1, np.sin(angle))
    assert -last(o["torque"][:, 0]) == pytest.approx(0.05 * wave, abs=1.5e-3)


def test_a_lever_couples_by_its_sine():
    row = {"couple": np.array([[0.0, 0.3]] * 2), "couple_from": 0.0, "arm": np.array([[0.0, 0.0], [0.0, 1.0]])}
    goal = np.array([1.0, 0.0])[None, :, None]
    ramp = goal * np.minimum(np.arange(1500) / 1000, 1)
    # energy is neither made nor lost: what the source feels is the load of the other times the lever's slope
    push = np.stack([np.zeros(1500), np.full(1500, 0.2)])
    o = run(2, 1500, ramp, joints=2, motor_side=1.0, external=push, **(FREE | row))
    q = last(o["position"])
    gives = 0.2 / 20  # the loop of the dragged joint
    assert q[:, 0] == pytest.approx([1, 1], abs=6e-3) and q[:, 1] - gives == pytest.approx(
        [0.3, 0.3 * np.sin(1.0)], abs=3e-3
    )
    assert last(o["torque"][:, 0]) == pytest.approx([-0.2 * 0.3, -0.2 * 0.3 * np.cos(1.0)], rel=0.02)


@pytest.mark.slow
def test_encoder_payload_and_deadband():
    q = run(2, 1500, 0.4, eccentric=0.05, eccentric_at=0.3, second_harmonic=np.array([0.0, 0.35]), **FREE)["position"][
        :, 0, -1
    ]
    for k, second in enumerate((0.0, 0.35)):
        assert plant.encoded(q[k], 1.0, 0.0, 0.05, 0.3, second) == pytest.approx(0.4, abs=1e-4)
    assert abs(q[1] - q[0]) > 5e-3
    o = run(
        2,
        2000,
        0.0,
        q0=0.1,
        gravity=np.array([0, 0, -9.81]),
        **(FREE | {"kp": 0.0, "kd": 0.0, "extra": 0.15, "bulk": np.array([0.0, 0.8])}),
    )["position"][:, 0]
    period = [2e-3 * np.diff(np.flatnonzero(np.diff(np.sign(x)))).mean() for x in o]
    inertia = 0.3 * 0.1**2 + 4e-4 + np.array([0.0, 0.4 * 0.15 * 0.08**2])
    assert period == pytest.approx(2 * np.pi * np.sqrt(inertia / (0.3 * 9.81 * 0.1)) * (1 + 0.1**2 / 16), rel=5e-3)
    goal = np.array([-0.05, -0.01, 0.01, 0.05])
    for subtract in (0.0, 1.0):
        tau = run(4, 5, goal[:, None, None], deadband=0.02, subtract=subtract, **HEAVY)["torque"][:, 0, -1]
        assert tau == pytest.approx(np.where(np.abs(goal) < 0.02, 0, goal - subtract * 0.02 * np.sign(goal)), abs=1e-4)


def test_current_sensor():
    tau = np.linspace(-3, 3, 101)
    over = np.arange(101) / 101
    for second in (False, True):
        c = laws.HEALTHY | laws.fault("current_gain", second, 0.5, 0.25)
        seen = laws.effort(tau, c, over)
        assert seen == pytest.approx(1.5 * np.tanh(tau) if second else 1.5 * tau)
        c = laws.HEALTHY | laws.fault("current_offset", second, 0.5, 0.2)
        zero = laws.effort(0 * tau, c, over)
        assert zero == pytest.approx(
            0.1 * (0.5 + over) if second else np.full(101, 0.1)
        ) and zero.mean() == pytest.approx(0.1, rel=0.01)


def test_touch_laws():
    t = np.arange(3000) * 1e-3
    hold = np.where(t > 0.5, 2.0, 0.0)[:, None]
    y = touch.relaxing({"fraction": 0.4, "time_constant": 0.8, "branches": 2.0}, hold)[501:, 0]
    s = t[1:2500]
    assert y == pytest.approx(2.0 * 0.2 * (np.exp(-s / 0.8) + np.exp(-s / 0.1)), abs=2e-3)
    reported = touch_cases.SECOND["hysteresis"].report(
        None, [hold[:, 0]], {"fraction": 0.4, "time_constant": 0.8, "branches": 2.0}
    )
    near = touch.relaxing({**reported, "branches": 1.0}, hold)[501:, 0]
    assert 0.1 < reported["time_constant"] < 0.8 and np.sqrt(np.mean((near - y) ** 2)) < 0.25 * np.sqrt(np.mean(y**2))
    one = touch_cases._one_branch(None, [hold[:, 0]], {"fraction": 0.4, "time_constant": 0.8, "branches": 1.0})
    assert one == pytest.approx({"fraction": 0.4, "time_constant": 0.8}, rel=0.05)

    square = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]]) * 0.02
    xy = np.stack(np.meshgrid(np.arange(-4, 5) * 4e-3, np.arange(-4, 5) * 4e-3), -1).reshape(-1, 2)
    pad = touch.Pad(
        square,
        1e-4,
        np.c_[xy, np.zeros(len(xy))],
        np.tile([0, 0, 1.0], (len(xy), 1)),
        np.full(len(xy), 4e-6),
        np.array([0, 0, 0.0121]),
        np.array([0, 0, -1.0]),
        np.array([1.0, 0, 0]),
        0.012,
        np.zeros(3),
    )
    q, force = np.zeros((2, 400)), np.minimum(np.arange(400) * 0.02, 4.0)
    plain = touch.readings(pad, touch.DEFAULTS, q, force)
    first = touch.readings(pad, touch.DEFAULTS | {"crosstalk": 0.3}, q, force)
    second = touch.readings(pad, touch.DEFAULTS | {"crosstalk": 0.3, "rings": 2.0}, q, force)
    centre = len(xy) // 2
    assert plain[-1].argmax() == centre and (second[-1] > 1e-3).sum() > (first[-1] > 1e-3).sum()
    assert second[-1].sum() == pytest.approx(plain[-1].sum(), rel=0.01) == first[-1].sum()
    remaining = touch_cases.SECOND["crosstalk"].report(pad, [], {"crosstalk": 0.3})["fraction"]
    assert second[-1, centre] == pytest.approx((1 - remaining) * plain[-1, centre], rel=0.05)
    late = [touch.readings(pad, touch.DEFAULTS | {"delay": 0.03, "window": w}, q, force).sum(1) for w in (0.0, 1.0)]
    # of what grows evenly both are late by the same
    assert late[0][100:190] == pytest.approx(late[1][100:190], abs=1e-6)
    assert late[1][215] < late[0][240] and late[1][210] > late[0][195]
    # and the corner is round
    assert np.interp(3.9, late[1], np.arange(400)) > np.interp(3.9, late[0], np.arange(400)) + 3


def log(**signals) -> dict[str, np.ndarray]:
    return {k: np.asarray(v, float) for k, v in signals.items()}


def test_what_is_told_is_the_first_law_that_does_the_same():
    n = {"viscous": 0.01, "shear": 0.02, "shear_speed": 1.5}
    assert laws._viscous(log(speed=[-3.0] * 4), n)["coefficient"] == pytest.approx(0.01 + 0.02 / 3)
    n = {"load": 0.2, "load_back": 0.3, "load_power": 2 / 3, "load_unit": 0.1}
    both = laws._load(log(load=[0.8, 0.8], speed=[1.0, -2.0]), n)
    assert both == pytest.approx({"fraction": 0.2 / 2, "fraction_backdriven": 0.3 / 2})
    x = 0.1 / 20  # twist at which k d = 0.1
    n = {"spring": 20.0, "hardening": 0.2}
    rms = 0.1 * (1 + 0.25)
    assert laws._stiffness(log(load=[rms, -rms]), n)["stiffness"] == pytest.approx(rms / x)
    assert laws.SECOND["sag"].report(log(supply=[0.9, 0.8], others=[1.0, 2.0]), {})["sag"] == pytest.approx(0.1)
    n = {"thermal_torque": -0.01, "thermal_friction": -0.02, "couple": 0.1}
    assert laws.SECOND["warm_motor"].report(log(winding=[55.0], temperature=[45.0]), n)["per_degree"] == pytest.approx(
        -0.015
    )
    assert laws.SECOND["warm_grease"].report(log(temperature=[65.0]), n)["per_degree"] == pytest.approx(
        np.expm1(-0.8) / 40
    )
    assert laws.SECOND["coupling"].report(log(source=[0.8, -0.8]), n)["ratio"] == pytest.approx(0.1 * np.sin(0.8) / 0.8)
    n = {"eccentric": 0.05, "eccentric_at": 0.3, "second_harmonic": 0.0}
    angles = np.linspace(-0.8, 0.8, 50)
    assert laws._eccentricity(log(position=angles), n)["eccentricity"] == pytest.approx(0.05)
    assert laws._eccentricity(log(position=angles), n | {"second_harmonic": 0.35})["eccentricity"] != pytest.approx(
        0.05, rel=0.05
    )
    n = laws.HEALTHY | laws.fault("current_gain", True, 0.5, 0.25)
    assert laws.SECOND["current_gain"].report(log(torque=[1.0, -1.0]), n)["gain"] == pytest.approx(1.5 * np.tanh(1.0))


def test_laws_are_drawn_by_a_generator_of_their_own():
    kinds = sorted(laws.SECOND)
    torque, duty = {"voltage": 0.0}, {"voltage": 1.0}
    seconds = sum(law is not None for n in range(20) for law in laws.draw(kinds, [torque] * len(kinds), "two", 9, n))
    assert 0.38 * 20 * len(kinds) < seconds < 0.62 * 20 * len(kinds)
    assert laws.draw(kinds, [torque] * len(kinds), "one", 9, 0) == [None] * len(kinds)
    # back-EMF is a line
    assert all(laws.draw(["speed_limit", "offset"], [duty] * 2, "two", 9, n) == [None, None] for n in range(20))
    assert laws.draw(kinds, [torque] * len(kinds), "two", 9, 4) == laws.draw(kinds, [torque] * len(kinds), "two", 9, 4)
    with pytest.raises(ValueError, match="must be two or one"):
        laws.draw(["lag"], [torque], "three", 9, 0)
    with pytest.raises(UserError, match="laws=3: must be two or one"):
        command.parse(["laws=3"])
    assert 10_000 <= command.parse(["seed=source"])[0]["seed"] < 100_000
    assert {k for k in laws.SECOND} <= set(effects.KINDS) and set(touch_cases.SECOND) <= set(touch_cases.KINDS)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(generate, "SECONDS", 0.6)
    monkeypatch.setattr(generate, "SIZES", 3)


def case(kind: str, number: int, which: str, where, shape: str = "one") -> tuple[dict, dict, bytes]:
    """Return (truth, the case's own files' texts and commands, reported positions) of one case of seed 3."""
    entry = {"group": "effect", "kinds": [kind], "tier": "easy", "shape": shape, "joints": []}
    made = generate.build(entry, number, 3, where / "cases", where / "truth", which)
    folder = where / "cases" / made["name"]
    r = read(folder / "a.mcap")
    seen = {
        "rig": (folder / "rig.xml").read_text(),
        "servo": (folder / "servo.yaml").read_text(),
        "commands": r.commands.value.tobytes(),
        "times": r.states.position.t.tobytes(),
        "meta": json.dumps(r.meta, sort_keys=True),
    }
    return (
        generate.reveal(where / "truth" / f"{made['name']}.json", made["digest"]),
        seen,
        np.asarray(r.states.position.value),
    )


@pytest.mark.slow
def test_a_seed_gives_the_same_rig_and_motion_whichever_law_is_drawn(quick, tmp_path):
    number = next(n for n in range(50) if laws.draw(["stribeck"], [{}], "two", 3, n)[0] is not None)
    first, seen_first, position_first = case("stribeck", number, "one", tmp_path / "one")
    second, seen_second, position_second = case("stribeck", number, "two", tmp_path / "two")
    assert seen_first == seen_second and not np.array_equal(position_first, position_second)
    a, b = first["effects"][0], second["effects"][0]
    assert (
        (a["law"], b["law"]) == ("first", "second")
        and b["law_is"] == "exp(-|v|/vs)"
        and a["parameters"]["v_s"] == b["parameters"]["v_s"]
    )
    assert case("offset", number, "two", tmp_path / "only")[0]["effects"][0]["law"] == "only"


# seed 3, number 0, a Stribeck peak of SECONDS 0.6 and SIZES 3, made by the code of before
BEFORE = {
    "size": 1.2,
    "ratio": 36.944731183786004,
    "parameters": {"peak": 0.14381910678750132, "v_s": 0.14487758575503695},
    "positions": 2.4129517793441133,
    "samples": 56,
}


def test_the_first_law_is_what_it_was_before_there_was_a_second(quick, tmp_path):
    """A case made by the code of before, which the published seeds rest on."""
    truth, _, position = case("stribeck", 0, "one", tmp_path)
    assert truth["effects"][0]["facts"]["size"] == BEFORE["size"]
    assert truth["effects"][0]["facts"]["ratio"] == pytest.approx(BEFORE["ratio"], rel=1e-7)
    assert truth["effects"][0]["parameters"] == pytest.approx(BEFORE["parameters"], rel=1e-12)
    assert position[:, 0].sum() == pytest.approx(BEFORE["positions"], abs=2e-3) and len(position) == BEFORE["samples"]


@pytest.mark.slow
def test_every_second_law_can_be_made_and_told(quick, tmp_path, monkeypatch):
    """Each through the generator: finite sizes, the names of the catalogue, an own size that stays in proportion."""
    monkeypatch.setattr(generate, "SECONDS", 0.4)
    monkeypatch.setattr(generate, "SIZES", 2)
    monkeypatch.setattr(laws, "draw", lambda kinds, p, which, seed, number: [laws.SECOND[k] for k in kinds])
    for kind in laws.SECOND:
        shape = "bench2" if effects.KINDS[kind].joints > 1 else "one"
        truth, _, _ = case(kind, 1, "two", tmp_path / kind, shape)  # number 1: driven by a torque
        e = truth["effects"][0]
        assert not truth["voltage"] and e["law"] == "second" and e["law_is"] == laws.SECOND[kind].second
        assert all(np.isfinite(v) for v in e["parameters"].values()), kind
        assert np.isfinite(e["facts"]["ratio"]), kind
        if kind not in ("torque_limit", "speed_limit"):  # which so short a motion does not reach
            assert e["when"] and e["facts"]["ratio"] > 1.0, kind


def test_rates_by_law_and_by_confidence():
    def result(law, right, confidence, error, covered, tier="easy"):
        return {
            "group": "effect",
            "decoy": "",
            "shape": "one",
            "tier": tier,
            "hidden": [("lag", "j")],
            "kinds": ["lag"],
            "laws": [law],
            "right": right,
            "alone": right,
            "confidence": confidence,
            "said": [("lag" if right else "payload", "j", confidence, [])],
            "wrong_sure": False,
            "f1": [1, 1, 1],
            "parameter_errors": [error],
            "covered": [covered],
            "removed": None,
            "ratio": 10.0,
            "verdict": "explained",
            "name": "x",
        }

    results = [
        result("first", True, 0.9, 0.02, True),
        result("first", True, 0.6, 0.04, True),
        result("second", True, 0.6, 0.2, False),
        result("second", False, 0.9, 0.3, False),
        result("only", True, 0.95, 0.01, True),
    ]
    lines = score.by_law(results)
    value = lambda line: {k: v["value"] for k, v in lines[line].items()}  # noqa: E731
    assert value("right effect first, easy") == {"first": 1.0, "second": 0.5, "only": 1.0}
    assert value("named alone at 0.8 or more, all") == {"first": 0.5, "second": 0.0, "only": 1.0}
    assert value("parameter error, median") == pytest.approx({"first": 0.03, "second": 0.25, "only": 0.01})
    assert value("90 % interval covers the truth") == {"first": 1.0, "second": 0.0, "only": 1.0}
    table = score.table(
        [*results, {"group": "none", "decoy": "", "false_alarm": True, "alarm": 0.6, "wrong_sure": False, "hidden": []}]
    )
    assert (
        table["  named alone at 0.5 or more, easy"]["value"] == 0.8
        and table["  named alone at 0.8 or more, easy"]["value"] == 0.4
    )
    assert table["  a name of 0.5 or more"]["value"] == 1.0 and table["  a name of 0.8 or more"]["value"] == 0.0
    assert "second law" in score.show(table, results)
    # truths of before laws were drawn follow the first
    assert score.law_of({"kind": "lag"}) == "first" and score.law_of({"kind": "offset"}) == "only"


def test_hand_cases_hold_effects_at_one_joint_and_at_two():
    plan = generate.plan({"hand": 12}, 5)
    counts = sorted(len(p["kinds"]) for p in plan)
    assert counts == [0] * 4 + [1] * 6 + [2] * 2 and all(p["shape"] == "hand" for p in plan)
    assert all(len({effects.KINDS[k].effect for k in p["kinds"]}) == len(p["kinds"]) for p in plan)
    assert generate.MIX["hand"] >= 6
