"""What stands between motor and joint, and what joints do to each other, against solutions of their own: an explicit
two-body integration at 10 us, momentum, statics. The kernel's lines themselves are compared with NumPy's in
test_servo.py."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from dexsim.actuator import FIELDS, Servo, ServoTable
from dexsim.actuator.kernel import STOP_GAIN, STOP_RATE
from dexsim.errors import UserError
from dexsim.sim import make_engine

G, MASS, ARM = 9.81, 0.1, 0.05  # of the link: kg, m
LINK, ROTOR = 1e-3, 5e-4  # kg.m2
PERIOD = 0.002  # s between targets


def target(t: float) -> float:
    return -0.3 + 0.4 * math.sin(2 * math.pi * 1.5 * t)


def rig(
    columns: dict,
    dt: float,
    loop: str = "joint",
    gravity: float = G,
    engine: str = "mujoco",
    position: str = "joint",
    joints: int = 1,
    **table,
):
    """Return an engine with hinges side by side (each a link on an arm, along x at q = 0) and their servo."""
    own = LINK - MASS * ARM**2
    bodies = "".join(
        f"""<body pos="0 {k} 0"><joint name="j{k}" type="hinge" axis="0 -1 0" armature="{ROTOR}"
 solimpfriction="0.9999 0.9999 0.001 0.5 2"/>
        <inertial pos="{ARM} 0 0" mass="{MASS}" diaginertia="{own} {own} {own}"/></body>"""
        for k in range(joints)
    )
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{dt}" integrator="implicitfast" gravity="0 0 '
        f'{-gravity}"/><worldbody>{bodies}</worldbody></mujoco>'
    )
    e = make_engine(spec, 1, "cpu", engine, fields=FIELDS, threads=1)
    raw = {
        "joints": columns if "j0" in columns else {"*": columns},
        "loop_encoder": loop,
        "position_encoder": position,
    } | table
    servo = Servo(e, [f"j{k}" for k in range(joints)], ServoTable.from_dict(raw), control_period=PERIOD)
    return e, servo


def begin(e, servo, q: float) -> None:
    e.set_state(torch.ones(1, dtype=torch.bool), torch.full_like(e.t.qpos, q), torch.zeros_like(e.t.qvel))
    servo.reset(None, torch.full_like(servo.torque, q))


def moved(columns: dict, dt: float, loop: str, seconds: float = 2.0, engine: str = "mujoco") -> np.ndarray:
    """[steps] positions under `target`."""
    e, servo = rig(columns, dt, loop, engine=engine)
    begin(e, servo, -0.3)
    out, k = [], 0
    for i in range(round(seconds / dt)):
        while k * PERIOD < (i + 1) * dt - 1e-12:
            servo.send(torch.full_like(servo.torque, target(k * PERIOD)), stamp=k * PERIOD)
            k += 1
        e.step(1, servo.before_each)
        out.append(e.t.qpos[0, 0].item())
    return np.array(out)


def explicit(
    kp: float,
    kd: float,
    loop: str,
    backlash: float = 0.0,
    softness: float = 0.0,
    friction: float = 0.0,
    seconds: float = 2.0,
    dt: float = 1e-5,
) -> np.ndarray:
    """Return the same two bodies by small explicit steps: rotor with dry friction, spring with a gap, link under
    gravity."""
    total = LINK + ROTOR
    stiff = 1 / softness if softness else STOP_GAIN * kp + STOP_RATE**2 * total
    damp = 0.1 * math.sqrt(stiff * LINK) if softness else 2 * 0.1 * math.sqrt(stiff * ROTOR * LINK / total)
    q = rotor = -0.3
    v = w = 0.0
    out = []
    for i in range(round(seconds / dt)):
        e = target(math.floor(i * dt / PERIOD + 1e-9) * PERIOD) - (rotor if loop == "motor" else q)
        motor = kp * e - kd * (w if loop == "motor" else v)
        twist, pull = rotor - q, 0.0
        if abs(twist) > 0.5 * backlash or not backlash:
            pull = stiff * (twist - math.copysign(0.5 * backlash, twist)) + damp * (w - v)
            if backlash and pull * twist < 0:
                pull = 0.0
        w += dt * (motor - pull) / ROTOR
        w = math.copysign(max(abs(w) - dt * friction / ROTOR, 0.0), w)
        v += dt * (pull - MASS * G * ARM * math.cos(q)) / LINK
        q, rotor = q + dt * v, rotor + dt * w
        out.append(q)
    return np.array(out)


@pytest.mark.parametrize(("columns", "loop"), [
    pytest.param({"backlash": 0.04, "coulomb_friction": 0.01}, "motor", marks=pytest.mark.slow),
    pytest.param({"softness": 0.15}, "motor", marks=pytest.mark.slow),
    ({"softness": 0.05}, "joint"),
    ({"softness": 0.05, "backlash": 0.03, "coulomb_friction": 0.02}, "motor"),
])  # fmt: skip
def test_two_bodies_as_integrated_apart(columns, loop):
    """First order in the step: half the step, half the error; and far nearer than a rigid joint."""
    true = explicit(
        2.0,
        0.05,
        loop,
        columns.get("backlash", 0.0),
        columns.get("softness", 0.0),
        columns.get("coulomb_friction", 0.0),
    )

    def error(c: dict, dt: float) -> float:
        q = moved({"kp": 2.0, "kd": 0.05} | c, dt, loop, 1.995)
        return float(np.sqrt(np.mean((q - true[np.round(dt * np.arange(1, len(q) + 1) / 1e-5).astype(int) - 1]) ** 2)))

    fine, coarse = error(columns, 2.5e-4), error(columns, 1e-3)
    assert fine < 0.6e-3 and coarse < 4.8 * fine
    rigid = error({"coulomb_friction": columns.get("coulomb_friction", 0.0)}, 2.5e-4)
    assert rigid > (1.1 if loop == "joint" else 15) * fine  # a loop on the joint makes up for most of it
    if "backlash" in columns and "softness" not in columns:
        assert error(columns, 0.007) < 0.7 * rigid  # at the tasks' step too


def test_both_engines_carry_a_rotor_alike():
    columns = {"kp": 2.0, "kd": 0.05, "softness": 0.05, "backlash": 0.03, "coulomb_friction": 0.02}
    assert np.abs(moved(columns, 1e-3, "motor", 0.4) - moved(columns, 1e-3, "motor", 0.4, engine="warp")).max() < 2e-5


def test_what_the_rotor_loses_the_link_receives():
    """No motor, no friction, no gravity: a rotor that flies through its play. Momentum stays, energy falls at the
    impact only."""
    dt = 5e-4
    e, servo = rig({"kp": 0.0, "backlash": 0.1}, dt, gravity=0.0)
    begin(e, servo, 0.0)
    servo.state[0, 0, servo.slots["fresh"]], servo.state[0, 0, servo.slots["line_a"]] = 0.0, 2.0
    e.t.qvel[0, 0] = 0.0
    rotor, link = [], []
    for _ in range(200):
        e.step(1, servo.before_each)
        a, b = (servo.state[0, 0, servo.slots[n]].item() for n in ("line_a", "line_b"))
        link.append(e.t.qvel[0, 0].item())
        rotor.append(a + b * link[-1])
    rotor, link = np.array(rotor), np.array(link)
    assert (link[:40] == 0).all() and (link != 0).any()  # 0.05 rad at 2 rad/s: 25 ms until it hits
    np.testing.assert_allclose(ROTOR * rotor + LINK * link, ROTOR * 2.0, rtol=1e-9)
    energy = ROTOR * rotor**2 + LINK * link**2
    assert (
        energy.max() <= ROTOR * 2.0**2 + 1e-12 and (ROTOR * 2.0) ** 2 / (ROTOR + LINK) <= energy[-1] < 0.9 * energy[0]
    )


@pytest.mark.parametrize(
    ("columns", "sag"),
    [({"backlash": 0.04}, lambda load, stop: 0.02 + load / stop), ({"softness": 0.2}, lambda load, stop: 0.2 * load)],
)
def test_a_held_link_hangs_by_its_play_and_its_softness(columns, sag):
    """Loop on the motor: the rotor stands where the PD holds the load, the link hangs below; the reported side is the
    table's."""
    for position in ("joint", "motor"):
        e, servo = rig({"kp": 2.0, "kd": 0.05} | columns, 1e-3, "motor", position=position)
        begin(e, servo, 0.0)
        e.step(3000, servo.before_each)
        q = e.t.qpos[0, 0].item()
        load = MASS * G * ARM * math.cos(q)
        stop = STOP_GAIN * 2.0 + STOP_RATE**2 * (LINK + ROTOR)
        rotor = -load / 2.0
        assert q == pytest.approx(rotor - sag(load, stop), abs=2e-5)
        assert servo.position()[0, 0].item() == pytest.approx(q if position == "joint" else rotor, abs=2e-5)
        assert servo.torque[0, 0].item() == pytest.approx(load, rel=1e-3)


def test_the_servo_without_play_does_not_change_by_having_the_column():
    """A table that states no play is built without it; one that does, with worlds where it is zero, moves those as
    before."""
    plain = moved(
        {"kp": 2.0, "kd": 0.05, "coulomb_friction": 0.02, "torque_ripple": 0.01, "ripple_per_turn": 9},
        1e-3,
        "joint",
        0.5,
    )
    e, servo = rig({"kp": 2.0, "kd": 0.05}, 1e-3)
    assert servo.features == frozenset()
    zero = {"backlash": {"value": 0.0, "low": 0.0, "high": 0.01}, "speed_lag": {"value": 0.0, "low": 0.0, "high": 0.01}}
    e, servo = rig({"kp": 2.0} | zero, 1e-3)
    assert servo.features == {"play", "rare"}
    again = moved(
        {"kp": 2.0, "kd": 0.05, "coulomb_friction": 0.02, "torque_ripple": 0.01, "ripple_per_turn": 9} | zero,
        1e-3,
        "joint",
        0.5,
    )
    np.testing.assert_allclose(again, plain, atol=1e-12)


def hold(columns: dict, joints: int = 1, targets: list[float] | None = None, seconds: float = 3.0, **kw):
    e, servo = rig(columns, 1e-3, joints=joints, **kw)
    begin(e, servo, 0.0)
    if targets:
        servo.send(torch.tensor([targets], dtype=servo.torque.dtype))
    e.step(round(seconds / 1e-3), servo.before_each)
    return e.t.qpos[0].numpy().copy(), servo


def test_an_eccentric_encoder_is_believed_by_the_loop_and_by_who_reads_it():
    q, servo = hold({"kp": 2.0, "kd": 0.05, "eccentric_sin": 0.1, "eccentric_cos": 0.05}, targets=[0.8], gravity=0.0)
    assert q[0] + 0.1 * math.sin(q[0]) + 0.05 * (math.cos(q[0]) - 1) == pytest.approx(0.8, abs=1e-6)
    assert servo.position()[0, 0].item() == pytest.approx(0.8, abs=1e-6)
    assert servo.unmeasured(servo.position())[0, 0].item() == pytest.approx(q[0], abs=1e-7)
    seen = servo.position()[0, 0].item()
    servo.engine.t.qvel[0, 0], servo.engine.t.qpos[0, 0] = 2.0, q[0] + 2e-6
    assert servo.velocity()[0, 0].item() == pytest.approx((servo.position()[0, 0].item() - seen) / 1e-6, rel=1e-4)


def test_a_joint_is_dragged_by_another():
    q, _ = hold(
        {"j0": {"kp": 2.0, "kd": 0.05}, "j1": {"kp": 2.0, "kd": 0.05, "coupling": 0.25, "coupling_from": 0}},
        2,
        [0.6, 0.1],
        gravity=0.0,
    )
    assert q[0] == pytest.approx(0.6, abs=1e-6) and q[1] == pytest.approx(0.1 + 0.25 * 0.6, abs=1e-6)
    with pytest.raises(UserError, match=r"coupling_from.*0 to 1"):
        rig({"j0": {"kp": 2.0}, "j1": {"kp": 2.0, "coupling": 0.25, "coupling_from": 2}}, 1e-3, joints=2)


def test_a_supply_sags_under_the_other_joints():
    """At stall a voltage drive gives duty * supply: j1 saturated, j0 loaded by gravity."""
    columns = {"kp": 100.0, "kd": 0.5, "torque_limit": 0.2, "no_load_speed": 20.0}
    _, servo = hold({"j0": columns, "j1": columns | {"sag": 0.8}}, 2, [0.0, 0.0], drive="voltage")
    load = servo.torque[0, 0].item()
    assert load == pytest.approx(MASS * G * ARM, rel=0.02)
    # stuck, at full duty
    _, servo = hold(
        {"j0": columns, "j1": columns | {"sag": 0.8, "coulomb_friction": 1.0}}, 2, [0.0, 3.0], drive="voltage"
    )
    assert servo.torque[0, 1].item() == pytest.approx(0.2 * (1 - 0.8 * load), rel=0.01)


def test_what_changes_with_temperature():
    warm = {"warmth": 30.0, "thermal_torque": -0.004, "thermal_friction": 0.02}
    cold, hot = (hold({"kp": 2.0, "kd": 0.05} | w)[0][0] for w in ({}, warm))
    load = lambda q: MASS * G * ARM * math.cos(q)  # noqa: E731
    assert cold == pytest.approx(-load(cold) / 2.0, rel=1e-3)
    assert hot == pytest.approx(-load(hot) / (2.0 * (1 - 0.12)), rel=1e-3)  # the same current gives 12 % less


def test_a_filtered_speed_damps_late():
    """The same PD with its speed filtered at 20 ms: an oscillator that rings on, as its third-order equation does."""
    kp, kd, lag, inertia, dt = 2.0, 0.06, 0.02, LINK + ROTOR, 2.5e-4
    e, servo = rig({"kp": kp, "kd": kd, "speed_lag": lag}, dt, gravity=0.0)
    begin(e, servo, 0.0)
    servo.send(torch.full((1, 1), 0.2, dtype=servo.torque.dtype))
    q = []
    for _ in range(1600):
        e.step(1, servo.before_each)
        q.append(e.t.qpos[0, 0].item())
    # of (q - target, v, filtered)
    system = np.array([[0, 1, 0], [-kp / inertia, 0, -kd / inertia], [0, 1 / lag, -1 / lag]])
    values, vectors = np.linalg.eig(system)
    parts = np.linalg.solve(vectors, np.array([-0.2, 0.0, 0.0]))
    t = dt * np.arange(1, 1601)
    exact = 0.2 + np.real((vectors[0] * parts) @ np.exp(values[:, None] * t))
    assert np.abs(np.array(q) - exact).max() < 0.012 and np.ptp(exact[-400:]) > 0.002
