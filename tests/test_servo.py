"""The servo: kernel against reference, analytic solutions of its law, its integration at tiny inertia, its state."""

from __future__ import annotations

import math
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from servo_reference import servo as servo_reference
from servo_reference import target_in_force, target_rates

from dexsim.actuator import COLUMNS, FIELDS, Servo, ServoTable
from dexsim.actuator.columns import FEATURES, INDEX, MEMORY, column
from dexsim.actuator.kernel import EXTENDED, EXTRA_SLOTS
from dexsim.actuator.reference import Step, command_delay
from dexsim.errors import UserError
from dexsim.sim import make_engine

G = 9.81


class StubEngine:
    """Arrays only, no physics: N worlds of a model whose joints come after a free body, so that indices are shifted."""

    kind = "mujoco"  # no graph records its launches

    def __init__(self, n: int, joints: int, real, dt: float = 0.005):
        links = "".join(
            f'<body pos="{i} 0 0"><joint name="j{i}" type="hinge" axis="0 1 0" damping="0.0{i + 1}"/>'
            f'<geom size=".01" mass="0.1" pos="0 0 .1"/></body>'
            for i in range(joints)
        )
        self.mjm = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody><body><freejoint/><geom size='.01'/></body>{links}</worldbody></mujoco>"
        )
        self.n, self.device, self.real, self.dt = n, "cpu", real, dt
        nq, nv = self.mjm.nq, self.mjm.nv
        self.wp = SimpleNamespace(time=wp.zeros(n, dtype=real, device="cpu"))
        for name, width in (("qpos", nq), ("qvel", nv), ("qfrc_applied", nv)):
            setattr(self.wp, name, wp.zeros((n, width), dtype=real, device="cpu"))
        self._fields = {name: wp.zeros((n, nv), dtype=real, device="cpu") for name in FIELDS}
        self.t = SimpleNamespace(**{name: wp.to_torch(a) for name, a in vars(self.wp).items()})

    def keep_outside(self):
        self.wp.outside = wp.zeros(self.t.qvel.shape, dtype=self.real, device="cpu")
        self.t.outside = wp.to_torch(self.wp.outside)

    def wp_field(self, name):
        return self._fields[name]

    def field(self, name):
        return wp.to_torch(self._fields[name])


def link_spec(inertia: float, dt: float, gravity: float = 0.0, friction: str = "") -> mujoco.MjSpec:
    """Return one hinge `joint` with the given inertia about it [kg.m2]; with gravity, 0.1 kg at 8 mm (along x at q =
    0)."""
    offset, mass = (0.008, 0.1) if gravity else (0.0, 0.001)
    own = inertia - mass * offset**2
    return mujoco.MjSpec.from_string(f"""
<mujoco><option timestep="{dt}" integrator="implicitfast" gravity="0 0 {-gravity}"/>
  <worldbody><body name="link"><joint name="joint" type="hinge" axis="0 -1 0" {friction}/>
    <inertial pos="{offset} 0 0" mass="{mass}" diaginertia="{own} {own} {own}"/></body></worldbody>
</mujoco>""")


STICKS = 'solimpfriction="0.9999 0.9999 0.001 0.5 2"'  # a stuck joint holds instead of creeping


def drive(columns: dict, inertia=1e-4, dt=0.005, n=1, voltage=False, gravity=0.0, control_rate=None, friction=STICKS):
    """Return a C MuJoCo engine with one link, and its servo."""
    spec = link_spec(inertia, dt, gravity, friction)
    engine = make_engine(spec, n, engine="mujoco", fields=FIELDS, threads=1)
    raw = {"drive": "voltage" if voltage else "torque", "joints": {"joint": columns}, "control_rate": control_rate}
    return engine, Servo(engine, ["joint"], ServoTable.from_dict(raw), control_period=0.005)


def run(engine, servo, seconds: float, each=None) -> np.ndarray:
    """Steps; returns q, v, torque [steps, 3] of world 0 after each step."""
    out = []
    for i in range(round(seconds / engine.dt)):
        if each:
            each(i * engine.dt)
        engine.step(1, servo.before_each)
        out.append((engine.t.qpos[0, 0].item(), engine.t.qvel[0, 0].item(), servo.torque[0, 0].item()))
    return np.array(out)


WHOLE = ("deadband_kind", "coupling_from")  # numbers of a kind, and of a joint


def random_params(rng, shape) -> np.ndarray:
    """Return the params that exercise every column in every regime, to each side of neutral that its limits leave; some
    neutral."""
    out = np.empty((*shape, len(COLUMNS)))
    for i, c in enumerate(COLUMNS):
        centre = c.neutral if math.isfinite(c.neutral) else 0.0
        sides = [side for side in (-1.0, 1.0) if c.low <= centre + side * c.usual <= c.high]
        value = centre + rng.choice(sides, shape) * rng.uniform(0.05, 1.0, shape) * c.usual
        out[..., i] = np.where(
            rng.random(shape) < (0.4 if c.name in ("backlash", "softness") else 0.15), c.neutral, value
        )
        if c.name in WHOLE:
            out[..., i] = np.round(out[..., i])
    return out


def test_every_column_says_how_large_a_usual_one_is():
    """Neither nothing, nor more than its limits leave on at least one side; `random_params` goes by it."""
    for c in COLUMNS:
        centre = c.neutral if math.isfinite(c.neutral) else 0.0
        assert c.usual > 0 and (c.low <= centre - c.usual or centre + c.usual <= c.high), c.name
        assert c.feature or not c.remembers, f"{c.name}: a servo has room for memory where a feature asks for it"
    assert sum(len(c.remembers) for c in COLUMNS) == len(MEMORY)  # none has another's place


@pytest.mark.parametrize("voltage", [False, True])
@pytest.mark.parametrize(
    "features",
    [
        (),
        ("braking",),
        ("controller",),
        ("load",),
        ("presliding", "shape"),
        ("play",),
        ("play", "presliding"),
        pytest.param(tuple(FEATURES), id="all_features"),
    ],
)
@pytest.mark.parametrize(
    "real, tolerance", [pytest.param(wp.float32, 1e-5, marks=pytest.mark.slow), (wp.float64, 1e-12)]
)
def test_kernel_agrees_with_reference(real, tolerance, features, voltage):
    """Also that a kernel built without a feature does not see its columns."""
    rng = np.random.default_rng(2)
    n, j = 400, 3
    engine = StubEngine(n, j, real)
    raw = {
        "drive": "voltage" if voltage else "torque",
        "joints": {"*": {"kp": 1.0, "torque_limit": 1.0}},
        "loop_encoder": {"j0": "motor"},
    }
    servo = Servo(engine, ["j2", "j0", "j1"], ServoTable.from_dict(raw), varied=[FEATURES[f][0] for f in features])
    assert servo.features == set(features)
    qi, vi = [7 + 2, 7 + 0, 7 + 1], [6 + 2, 6 + 0, 6 + 1]

    params = random_params(rng, (n, j))
    if voltage:
        params[..., INDEX["torque_limit"]] = rng.uniform(0.1, 1.0, (n, j))
    servo.params[:] = torch.as_tensor(params)
    state = np.zeros(servo.state.shape)
    slots, queue = servo.slots, servo.queue
    state[..., slots["motor"]] = rng.normal(0, 0.3, (n, j))
    state[..., slots["enabled"]] = rng.random((n, j)) < 0.9
    state[..., slots["stamp0"] : slots["stamp0"] + queue] = 0.5 * np.sort(
        rng.uniform(0.9, 1.0, (n, j, queue))
    ) + 0.5 * np.linspace(0.9, 1.0, queue)
    state[..., slots["target0"] : slots["target0"] + queue] = rng.normal(0, 0.3, (n, j, queue))
    servo.base_armature[:] = torch.as_tensor(rng.uniform(0, 2e-3, (n, j)))
    servo.home[:] = torch.as_tensor(rng.normal(0, 0.1, (n, j)))
    extra = bool(EXTENDED & set(features))
    if extra:
        state[..., slots["fresh"]] = rng.random((n, j)) < 0.1
        state[..., slots["filtered"]], state[..., slots["line_a"]] = rng.normal(0, 6.0, (2, n, j))
        for name in set(MEMORY) - {"filtered"}:
            state[..., slots[name]] = np.random.default_rng(MEMORY[name]).normal(0, 0.3, (n, j))
        state[..., slots["line_b"]] = rng.uniform(-0.2, 0.9, (n, j))
        state[..., slots["taken"]] = rng.uniform(-1.0, 1.0, (n, j))
        state[..., slots["integral"]] = rng.normal(0, 0.3, (n, j))
    servo.set_state(torch.as_tensor(state, dtype=servo.state.dtype))
    q, v = rng.normal(0, 0.1, (n, j)), rng.normal(0, 6.0, (n, j)) * (rng.random((n, j)) < 0.8)
    if extra:
        state[..., slots["rotor"]] = q + rng.normal(0, 0.02, (n, j))
        servo.set_state(torch.as_tensor(state, dtype=servo.state.dtype))
    given = rng.normal(0, 0.3, (n, j))
    servo.torque[:] = torch.as_tensor(given)
    engine.t.qpos[:, qi] = torch.as_tensor(q).to(servo.params)
    engine.t.qvel[:, vi] = torch.as_tensor(v).to(servo.params)
    engine.t.time.fill_(1.0)
    outside = np.zeros((n, j))
    if "load" in features:
        engine.t.outside[:, vi] = torch.as_tensor(rng.normal(0, 0.3, (n, j))).to(servo.params)
        outside = engine.t.outside[:, vi].numpy().astype(float)
    # what the kernel sees is rounded to `real`: the reference starts from the same numbers
    params, state, v = (x.numpy().astype(float) for x in (servo.params, servo.state, engine.t.qvel[:, vi]))
    q = engine.t.qpos[:, qi].numpy().astype(float)
    given, armature, home = (x.numpy().astype(float) for x in (servo.torque, servo.base_armature, servo.home))

    servo.before_each()

    stamps, targets = np.split(state[..., slots["stamp0"] : slots["stamp0"] + 2 * queue], 2, axis=-1)
    by_name = {name: params[..., i] for name, i in INDEX.items()}
    retained = {name for c in COLUMNS if c.feature in features for name in c.remembers}
    step = Step(engine.dt, state[..., slots["fresh"]] != 0 if extra else True)
    step.memory |= {name: state[..., slots[name]] for name in retained}
    delay = command_delay(by_name, 1.0, features, step)
    target = target_in_force(1.0, stamps, targets, delay, engine.dt)
    known = {name: state[..., slots[name]] for name in EXTRA_SLOTS if name not in MEMORY} if extra else {}
    source = np.clip(params[..., INDEX["coupling_from"]].astype(int), 0, j - 1)
    expected = servo_reference(
        params,
        target,
        q,
        v,
        dt=engine.dt,
        voltage=voltage,
        features=features,
        base_armature=armature,
        **known,
        memory={name: step.memory[name] for name in retained},
        dragging=np.take_along_axis(q - home, source, 1),
        others=np.abs(given).sum(1, keepdims=True) - np.abs(given),
        loop_motor=np.array([False, True, False]),
        rates=target_rates(1.0, stamps, targets, delay, engine.dt),
        outside=outside,
        last=state[..., slots["motor"]],
        enabled=state[..., slots["enabled"]],
        inertia=servo.inertia.numpy(),
        base_damping=servo.base_damping.numpy(),
    )
    got = {
        "torque": servo.torque.numpy(),
        "qfrc_applied": engine.t.qfrc_applied[:, vi].numpy(),
        "dof_damping": engine.field("dof_damping")[:, vi].numpy(),
        "dof_frictionloss": engine.field("dof_frictionloss")[:, vi].numpy(),
    }
    if extra:
        got |= {name: servo.state[..., slots[name]].numpy() for name in ("line_a", "line_b") if "play" in features}
        got |= {"taken": servo.state[..., slots["taken"]].numpy()} if "presliding" in features else {}
        got |= {"integral": servo.state[..., slots["integral"]].numpy()} if "controller" in features else {}
        got |= {name: servo.state[..., slots[name]].numpy() for name in retained}
    if "play" in features:
        got |= {
            "rotor": servo.state[..., slots["rotor"]].numpy(),
            "dof_armature": engine.field("dof_armature")[:, vi].numpy(),
        }
    # a jump of the law (deadband, back-driven) might fall on either side in the other precision: by the seed none does
    for name, value in got.items():
        size = np.abs(expected[name]) + 1.0  # limits are of order one
        assert np.abs(value - expected[name]).max() < tolerance * size.max(), name
        assert (np.abs(value - expected[name]) < 30 * tolerance * size).all(), name
    limited = np.abs(expected["torque"]).max()
    assert limited > 0.3 and not engine.t.qfrc_applied[:, :6].any()  # the free body was left alone
    np.testing.assert_array_equal(servo.state[..., slots["motor"]].numpy(), servo.torque.numpy())


def test_neutral_table_is_an_ideal_pd():
    e = np.linspace(-1, 1, 21)
    params = np.tile([c.neutral for c in COLUMNS], (21, 1))
    params[:, INDEX["kp"]], params[:, INDEX["kd"]] = 3.0, 0.2
    v, dt = 0.7, 1e-3
    out = servo_reference(params, e, 0.0, v, dt=dt)
    np.testing.assert_allclose(out["torque"], 3.0 * e - 0.2 * v, atol=1e-14)
    np.testing.assert_allclose(out["dof_damping"], 0.2 + 3.0 * dt, atol=1e-14)
    np.testing.assert_allclose(out["qfrc_applied"] - out["dof_damping"] * v, 3.0 * (e - dt * v) - 0.2 * v, atol=1e-14)
    assert not np.any(out["dof_frictionloss"])


@pytest.mark.parametrize("dt", [0.005, 0.001])
def test_ideal_pd_matches_the_analytic_oscillator(dt):
    """I q'' = kp (target - q) - kd q', underdamped: backward Euler converges at first order to the closed form."""
    inertia, kp, kd, target = 1e-2, 1.0, 0.05, 0.3
    engine, servo = drive({"kp": kp, "kd": kd}, inertia=inertia, dt=dt)
    servo.send(torch.full((1, 1), target))
    q = run(engine, servo, 0.6)[:, 0]
    w, s = math.sqrt(kp / inertia - (kd / 2 / inertia) ** 2), kd / 2 / inertia
    t = dt * np.arange(1, len(q) + 1)
    exact = target * (1 - np.exp(-s * t) * (np.cos(w * t) + s / w * np.sin(w * t)))
    assert np.abs(q - exact).max() < 8 * dt * target


def test_static_droop_is_load_over_gain():
    engine, servo = drive({"kp": 1.5, "kd": 0.03, "torque_limit": 1.1, "no_load_speed": 8.63}, gravity=G)
    servo.send(torch.zeros(1, 1))
    q, v, torque = run(engine, servo, 3.0)[-1]
    load = 0.1 * G * 0.008 * math.cos(q)  # gravity about the hinge
    assert abs(v) < 1e-9
    assert q == pytest.approx(-load / 1.5, rel=1e-8)
    assert torque == pytest.approx(load, rel=1e-8)


@pytest.mark.parametrize("inertia", [1e-6, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("target", [0.05, 1.0, -2.0])
def test_stable_at_any_inertia(inertia, target):
    """dt 5 ms, kp 1.5: explicitly this needs more than 4e-5 kg.m2; here it settles, a light link without overshoot.

    (A heavy one does: near its no-load speed the paper's law has nothing left to brake with.)
    """
    engine, servo = drive({"kp": 1.5, "kd": 0.03, "torque_limit": 0.4, "no_load_speed": 14.38}, inertia=inertia)
    servo.send(torch.full((1, 1), target))
    out = run(engine, servo, 1.5)
    assert np.abs(out[:, 1]).max() <= 14.38 * 1.001
    assert np.abs(out[:, 0]).max() < abs(target) * (1.02 if inertia <= 1e-5 else 1.7)
    assert out[-1, 0] == pytest.approx(target, abs=1e-6) and abs(out[-1, 1]) < 1e-5


def trajectory(dt, columns, inertia, voltage=False):
    """Return positions at every 10 ms for targets that jump between +-0.6 rad every 150 ms, with no dry friction."""
    engine, servo = drive(columns, inertia=inertia, dt=dt, voltage=voltage)
    steps = round(0.01 / dt)
    out = []
    for i in range(90):
        if i % 15 == 0:
            servo.send(torch.full((1, 1), 0.6 * (-1) ** (i // 15)))
        engine.step(steps, servo.before_each)
        out.append(engine.t.qpos[0, 0].item())
    return np.array(out)


TORQUE = {"kp": 1.5, "kd": 0.03, "torque_limit": 0.4, "no_load_speed": 14.38}
MORE = {"lag": 0.008, "delay": 0.013, "efficiency": 0.8, "torque_ripple": 0.03, "ripple_per_turn": 9.0}
MORE |= {"viscous_friction": 1e-3}
VOLTAGE = {"kp": 5.0, "kd": 0.05, "torque_limit": 0.4, "no_load_speed": 14.38}


@pytest.mark.parametrize(
    "columns, voltage, inertia, bound",
    [
        (TORQUE, False, 1e-5, 0.003),
        (TORQUE, False, 1e-3, 0.06),  # at its no-load speed, with little to brake: the law magnifies every error
        (VOLTAGE, True, 1e-5, 0.003),
        (VOLTAGE, True, 1e-3, 0.006),
        (TORQUE | MORE, False, 1e-5, 0.015),
        (TORQUE | MORE, False, 1e-3, 0.12),
    ],
)
def test_converges_with_the_step(columns, voltage, inertia, bound):
    """Through saturation, speed limit and braking: the error [rad] against a 0.1 ms solution falls with the step."""
    reference = trajectory(1e-4, columns, inertia, voltage)
    errors = [np.sqrt(np.mean((trajectory(dt, columns, inertia, voltage) - reference) ** 2)) for dt in (0.005, 0.001)]
    assert errors[1] < 0.4 * errors[0]
    assert errors[1] < bound


def test_free_run_reaches_the_no_load_speed():
    engine, servo = drive({"kp": 100.0, "torque_limit": 0.4, "no_load_speed": 14.38}, inertia=1e-3)
    servo.send(torch.full((1, 1), 1000.0))
    v = run(engine, servo, 1.0)[:, 1]
    t = 0.005 * np.arange(1, len(v) + 1)
    tau = 1e-3 * 14.38 / 0.4  # mechanical time constant
    assert v[-1] == pytest.approx(14.38, rel=1e-6)
    # the driving line is integrated by backward Euler with its own slope: exactly this series
    np.testing.assert_allclose(v, 14.38 * (1 - (1 + 0.005 / tau) ** -np.round(t / 0.005)), rtol=1e-9)


def test_stall_torque_at_zero_speed():
    engine, servo = drive({"kp": 50.0, "torque_limit": 0.4, "no_load_speed": 14.38, "efficiency": 0.5})
    engine.field("dof_damping")
    servo.send(torch.full((1, 1), 1.0))
    servo.before_each()
    assert servo.torque[0, 0].item() == pytest.approx(0.4)  # the current shows the motor's torque,
    assert engine.t.qfrc_applied[0, 0].item() == pytest.approx(0.2)  # the joint feels eta of it


def test_voltage_drive_runs_at_duty_times_no_load_speed():
    engine, servo = drive({"kp": 0.5, "torque_limit": 0.4, "no_load_speed": 10.0}, inertia=1e-5, voltage=True)
    servo.send(torch.full((1, 1), 1000.0))  # full duty
    assert run(engine, servo, 0.5)[-1, 1] == pytest.approx(10.0, rel=1e-3)
    servo.column("supply")[:] = 0.5
    assert run(engine, servo, 0.5)[-1, 1] == pytest.approx(5.0, rel=1e-3)


@pytest.mark.parametrize("dt", [0.001, 0.002, 0.005])
def test_delay_is_in_seconds(dt):
    """The time of arrival after a jump does not depend on the physics step, nor on being a multiple of it."""
    delay = 0.0123
    engine, servo = drive({"kp": 1.0, "kd": 0.0, "delay": delay, "efficiency": 1.0}, inertia=1.0, dt=dt)
    run(engine, servo, 0.01)
    servo.send(torch.full((1, 1), 1.0))
    v = run(engine, servo, 0.05)[:, 1]  # a heavy link: v = torque integrated = time since the target acted
    assert v[-1] == pytest.approx(0.05 - delay, rel=2e-3)
    steps = math.floor(delay / dt)
    assert not v[:steps].any() and v[steps] > 0


def test_targets_act_at_ticks_of_the_bus():
    engine, servo = drive({"kp": 1.0}, inertia=1.0, dt=0.002, control_rate=100)
    run(engine, servo, 0.004)
    servo.send(torch.full((1, 1), 1.0))  # at 4 ms: acts at 10 ms
    v = run(engine, servo, 0.02)[:, 1]
    assert not v[:3].any() and v[3] > 0


def test_stamped_targets_in_one_queue():
    engine, servo = drive({"kp": 1.0}, inertia=1e6, dt=0.005)
    for stamp, target in ((0.0, 1.0), (0.010, 2.0), (0.0175, 3.0)):
        servo.send(torch.full((1, 1), target), stamp=stamp)
    torque = run(engine, servo, 0.03)[:, 2]
    np.testing.assert_allclose(torque, [1, 1, 2, 2.5, 3, 3], atol=1e-5)  # 17.5 ms: half of its step


def test_deadband_gives_no_torque_inside():
    engine, servo = drive({"kp": 1.0, "kd": 0.1, "deadband": 0.05})
    servo.send(torch.full((1, 1), 0.049))
    assert not run(engine, servo, 0.1).any()
    servo.send(torch.full((1, 1), 0.051))
    engine.step(1, servo.before_each)
    assert servo.torque[0, 0].item() == pytest.approx(0.051)


def test_dry_friction_holds_and_lets_go():
    for load, moves in ((0.9, False), (1.1, True)):
        torque = 0.1 * G * 0.008
        engine, servo = drive({"kp": 0.0, "coulomb_friction": torque / load}, gravity=G)
        q = run(engine, servo, 0.5)[-1, 0]
        assert (abs(q) > 0.1) == moves
        if not moves:
            assert abs(q) < 1e-3


def test_friction_asymmetry_shifts_both_levels():
    """Level moving positive c (1 + a/2), negative c (1 - a/2): what each side lets through."""
    for sign, torque, moves in ((1, 0.105, False), (1, 0.12, True), (-1, 0.085, False), (-1, 0.095, True)):
        engine, servo = drive({"kp": torque, "coulomb_friction": 0.1, "friction_asymmetry": 0.2}, inertia=1e-3)
        servo.send(torch.full((1, 1), float(sign)))
        v = run(engine, servo, 0.05)[:, 1]
        assert (abs(v[-1]) > 0.1) == moves, (sign, torque)


def test_stribeck_and_load_friction_levels():
    engine, servo = drive({"kp": 1.0, "coulomb_friction": 0.1, "stribeck_peak": 0.05, "stribeck_speed": 2.0,
                           "load_friction": 0.2, "load_friction_backdriven": 0.5})  # fmt: skip
    level = engine.field("dof_frictionloss")
    for v, motor, expected in (
        (0.0, 0.0, 0.15), (2.0, 0.0, 0.1 + 0.05 / math.e), (0.0, 0.3, 0.15 + 0.06), (1e3, 0.3, 0.16), (1e3, -0.3, 0.25),
    ):  # fmt: skip
        engine.t.qvel[:] = v
        servo.state[..., servo.slots["motor"]] = motor
        servo.before_each()
        assert level[0, 0].item() == pytest.approx(expected)


def test_the_gears_load_from_both_sides():
    """Levels by hand: shares weighted and then subtracted, squares only where the smaller torque is opposed, what fades
    at 1/e of itself; warmer grease on all of it; without a share from outside the old law."""
    columns = {"kp": 1.0, "coulomb_friction": 0.1, "stribeck_speed": 2.0, "load_friction": 0.2,
               "load_friction_backdriven": 0.5, "load_friction_external": 0.3, "load_stribeck": 0.1,
               "load_stribeck_external": 0.4, "load_quadratic": 2.0, "load_quadratic_external": 3.0}  # fmt: skip
    engine, servo = drive(columns)
    warm_engine, warm = drive(columns | {"thermal_friction": -0.01, "warmth": 40.0})
    e = math.exp(-1)
    for v, motor, outside, expected in (
        (0.0, 0.3, 0.0, 0.1 + 0.06 + 0.03),
        (0.0, 0.0, -0.3, 0.1 + 0.09 + 0.12),
        (1e3, 0.3, -0.2, 0.1 + 0.12),  # opposed: both shares
        (1e3, 0.3, 0.2, 0.1),  # the same way: they cancel
        (1e3, -0.3, 0.2, 0.1 + 0.06 + 0.15),  # driven back
        (0.0, 0.3, -0.2, 0.1 + 0.12 + 0.11 + 3 * 0.04),  # the motor drives the smaller torque
        (2.0, 0.3, -0.2, 0.1 + 0.12 + e * (0.11 + 3 * 0.04)),
        (0.0, 0.2, -0.3, 0.1 + 0.13 + 0.14 + 2 * 0.04),  # the larger one drives the motor
        (0.0, 0.2, 0.3, 0.1 + 0.05 + 0.1),
    ):
        for system, drives, factor in ((engine, servo, 1.0), (warm_engine, warm, 0.6)):
            system.t.qvel[:], system.t.outside[:] = v, outside
            drives.state[..., drives.slots["motor"]] = motor
            drives.before_each()
            level = system.field("dof_frictionloss")[0, 0].item()
            assert level == pytest.approx(factor * expected), (v, motor, outside)


@pytest.mark.parametrize("kind", ["mujoco", "warp"])
def test_the_gears_load_is_of_the_step_before_and_remembered(kind):
    """A weight is carried: what is felt from outside is its torque; put back, the worlds go on bit for bit."""
    spec = link_spec(1e-3, 0.002, G, STICKS)
    engine = make_engine(spec, 2, "cpu", kind, fields=FIELDS, threads=1)
    table = {"joints": {"joint": {"kp": 0.5, "kd": 0.01, "load_friction": 0.1, "load_friction_external": 0.2}}}
    servo = Servo(engine, ["joint"], ServoTable.from_dict(table), control_period=0.005)
    servo.send(torch.full((2, 1), 0.2))
    engine.step(100, servo.before_each)
    q = engine.t.qpos[0, 0].item()
    assert engine.t.outside[0, 0].item() == pytest.approx(-0.1 * G * 0.008 * math.cos(q), rel=2e-3)
    then = {k: v.clone() for part in (engine, servo) for k, v in part.memory().items() if torch.is_tensor(v)}
    engine.step(5, servo.before_each)
    after = engine.t.qpos.clone()
    engine.t.outside.fill_(7.0)
    for part in (engine, servo):
        for name, value in part.memory().items():
            if torch.is_tensor(value):
                value.copy_(then[name])
    engine.step(5, servo.before_each)
    assert torch.equal(engine.t.qpos, after)


def test_friction_never_adds_energy():
    """Free swings of a link under every kind of friction, from random speeds: kinetic energy never grows."""
    rng = np.random.default_rng(3)
    n = 32
    engine, servo = drive({"kp": 0.0}, n=n, inertia=1e-4, dt=0.002)
    most = {"coulomb_friction": 0.02, "stribeck_peak": 0.02, "viscous_friction": 1e-3, "stribeck_speed": 5.0}
    for name, high in (most | {"friction_asymmetry": 1.0, "load_friction": 0.5}).items():
        servo.column(name)[:] = torch.as_tensor(rng.uniform(0.01, 1, (n, 1)) * high)
    engine.t.qvel[:] = torch.as_tensor(rng.normal(0, 5.0, (n, 1)))
    energy = [engine.t.qvel.numpy().copy() ** 2]
    for _ in range(100):
        engine.step(1, servo.before_each)
        energy.append(engine.t.qvel.numpy().copy() ** 2)
    energy = np.array(energy)
    assert (np.diff(energy, axis=0) <= 1e-8).all()  # creep of a stuck joint: 1e-4 rad/s
    assert (energy[-1] < 1e-3 * energy[0]).any()


def test_passivity_of_the_drive_at_its_limits():
    """Braking from overspeed and reversing hard at 1e-6 kg.m2: no link is thrown past the zero of the law."""
    rng = np.random.default_rng(4)
    n = 64
    engine, servo = drive({"kp": 1.5, "kd": 0.03, "torque_limit": 0.4, "no_load_speed": 14.38}, n=n, inertia=1e-6)
    v0 = rng.uniform(-14, 14, n)
    target = rng.uniform(-1, 1, n)
    engine.t.qvel[:, 0] = torch.as_tensor(v0)
    servo.send(torch.as_tensor(target)[:, None])
    engine.step(1, servo.before_each)
    v1 = engine.t.qvel[:, 0].numpy()
    rest = np.clip(1.5 * target / (1.5 * 0.005 + 0.03), -14.38, 14.38)  # where the law is zero
    assert ((v1 - v0) * (rest - v0) >= 0).all() and (np.abs(v1 - v0) <= np.abs(rest - v0) + 1e-9).all()


def test_encoder_offset_and_scale():
    engine, servo = drive({"kp": 2.0, "position_offset": 0.1, "position_scale": 1.25}, inertia=1e-4)
    servo.column("kd")[:] = 0.05
    servo.send(torch.full((1, 1), 0.6))
    q = run(engine, servo, 2.0)[-1, 0]
    assert q == pytest.approx((0.6 - 0.1) / 1.25, abs=1e-6)
    assert servo.position()[0, 0].item() == pytest.approx(0.6, abs=1e-6)


def test_lag_is_first_order():
    engine, servo = drive({"kp": 1.0, "lag": 0.05}, inertia=1e6, dt=0.001)
    servo.send(torch.full((1, 1), 1.0))
    torque = run(engine, servo, 0.2)[:, 2]
    t = 0.001 * np.arange(1, 201)
    np.testing.assert_allclose(torque, 1 - np.exp(-t / 0.05), atol=0.012)


def test_disabled_joint_swings_free():
    engine, servo = drive({"kp": 1.0, "kd": 1.0}, inertia=1e-3)
    servo.state[..., servo.slots["enabled"]] = 0.0
    engine.t.qvel[:] = 2.0
    out = run(engine, servo, 0.1)
    np.testing.assert_allclose(out[:, 1], 2.0)
    assert not out[:, 2].any()


def test_ripple_is_periodic_in_position():
    engine, servo = drive({"kp": 0.0, "torque_ripple": 0.1, "ripple_per_turn": 4, "ripple_phase": 0.3})
    for q in (0.0, 0.4, math.pi / 2, math.pi):
        engine.t.qpos[:] = q
        servo.before_each()
        assert engine.t.qfrc_applied[0, 0].item() == pytest.approx(0.1 * math.sin(4 * q + 0.3), abs=1e-12)


def test_stand_in_is_the_torque_it_states():
    engine, servo = drive(
        {"kp": 0.0, "standin_constant": 0.02, "standin_position": 0.3, "standin_speed": -0.01, "standin_drag": -0.005}
    )
    for q, v in ((0.0, 0.0), (0.5, 2.0), (-0.4, -3.0)):
        engine.t.qpos[:], engine.t.qvel[:] = q, v
        servo.before_each()
        expected = 0.02 + 0.3 * q - 0.01 * v - 0.005 * v * abs(v)
        # before the step, v' = v
        got = engine.t.qfrc_applied[0, 0].item() - engine.field("dof_damping")[0, 0].item() * v
        assert got == pytest.approx(expected, abs=1e-9)


def test_send_and_reset_touch_masked_worlds_only():
    engine, servo = drive({"kp": 1.0}, n=4)
    mask = torch.tensor([True, False, True, False])
    servo.send(torch.ones(4, 1), mask=mask)
    engine.step(1, servo.before_each)
    np.testing.assert_array_equal(servo.torque[:, 0].numpy() != 0, mask.numpy())
    before = servo.get_state()
    servo.reset(~mask, torch.full((4, 1), 0.25))
    after = servo.get_state()
    assert torch.equal(before[mask], after[mask])
    assert (after[~mask][..., servo.slots["target7"]] == 0.25).all()
    assert (after[~mask][..., servo.slots["motor"]] == 0).all()
    servo.set_state(before, mask=~mask)
    assert torch.equal(servo.state, before)


def test_saved_state_continues_bitwise():
    columns = {"kp": 1.5, "kd": 0.03, "delay": 0.012, "lag": 0.01, "torque_limit": 0.4, "no_load_speed": 14.38}
    engine, servo = drive(columns | {"speed_lag": 0.02})  # of which the law has a memory
    servo.send(torch.full((1, 1), 1.0))
    run(engine, servo, 0.02)
    state, qpos, qvel, time = servo.get_state(), engine.t.qpos.clone(), engine.t.qvel.clone(), engine.t.time.clone()
    first = run(engine, servo, 0.05)
    engine.set_state(torch.ones(1, dtype=torch.bool), qpos, qvel)
    engine.t.time.copy_(time)
    servo.set_state(state)
    np.testing.assert_array_equal(run(engine, servo, 0.05), first)


def test_queue_outlasts_the_longest_delay():
    engine = StubEngine(1, 1, wp.float64)
    table = ServoTable.from_dict({"joints": {"j0": {"kp": 1.0, "delay": [0.0, 0.1]}}})
    assert Servo(engine, ["j0"], table, control_period=0.01).queue >= 12


def test_wrong_names_are_answered():
    engine = StubEngine(1, 2, wp.float64)
    table = ServoTable.from_dict({"joints": {"*": {"kp": 1.0}}})
    with pytest.raises(UserError, match="'j00'.*Did you mean 'j0'.*j0, j1"):
        Servo(engine, ["j00"], table)
    with pytest.raises(UserError, match="driven twice"):
        Servo(engine, ["j0", "j0"], table)
    with pytest.raises(UserError, match="Did you mean 'deadband'"):
        column("dead_band")


@pytest.mark.slow
def test_on_mujoco_warp_captured():
    """The same pendulum on MuJoCo-Warp's captured step (float32) and on C MuJoCo (float64): the same motion."""
    columns = TORQUE | {"delay": 0.01, "coulomb_friction": 0.01}
    out = []
    for kind in ("mujoco", "warp"):
        engine = make_engine(link_spec(1e-4, 0.005, G, friction=STICKS), 3, engine=kind, fields=FIELDS)
        servo = Servo(engine, ["joint"], ServoTable.from_dict({"joints": {"*": columns}}))
        path = []
        for i in range(60):
            if i % 10 == 0:
                servo.send(torch.tensor([[0.5], [-0.2], [0.0]]) * (-1) ** (i // 10))
            engine.step(4, servo.before_each)
            path.append(engine.t.qpos[:, 0].numpy().astype(float).copy())
        out.append(np.array(path))
    assert np.abs(out[0]).max() > 0.3
    np.testing.assert_allclose(out[0], out[1], atol=2e-3)
