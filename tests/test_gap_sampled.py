"""What a digital drive does to a motion: its loop acts on samples, shows the torque in force, reads speeds through its
own encoder."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from test_gap import SERVO, model, motion

from dexsim.actuator.table import ServoTable
from dexsim.gap.plant.case import build, true_motion
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.read import Run
from dexsim.gap.search.search import JointSearch

FREE = SERVO | {"coulomb_friction": 0.0, "torque_limit": 1e3, "no_load_speed": 1e6}


def sampled(eccentric: tuple[float, float] = (0.0, 0.0), seconds: float = 4.0) -> tuple[Run, np.ndarray]:
    """(run, torque [n] in force) of the demo's pendulum under a loop of 1 kHz that holds its torque between samples and
    takes its speed from two of them; the joint in between in steps of 0.05 ms, in NumPy. eccentric: sin and cos of the
    encoder's error."""
    m = model()
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    full = np.zeros((1, 1))
    mujoco.mj_fullM(m, d, full)
    inertia = float(full[0, 0])

    def weight(q: float) -> float:
        d.qpos[0], d.qvel[0] = q, 0.0
        mujoco.mj_forward(m, d)
        return float(d.qfrc_bias[0])

    poses = np.linspace(-np.pi, np.pi, 721)
    bias = np.array([weight(q) for q in poses])
    shows = lambda q: q + eccentric[0] * np.sin(q) + eccentric[1] * (np.cos(q) - 1)  # noqa: E731
    t_cmd, cmd = motion(0, seconds, 3)
    steps = int(seconds * 1000)
    q, v, last = float(cmd[0]), 0.0, None
    out, torque = np.empty(steps), np.empty(steps)
    damping = float(m.dof_damping[0]) + FREE["viscous_friction"]
    for k in range(steps):
        seen = shows(q)
        speed = 0.0 if last is None else (seen - last) / 1e-3
        last = seen
        tau = FREE["kp"] * (cmd[np.searchsorted(t_cmd, k * 1e-3 + 1e-9, side="right") - 1] - seen) - FREE["kd"] * speed
        out[k], torque[k] = seen, tau
        for _ in range(20):
            v += 5e-5 * (tau - np.interp(q, poses, bias) - damping * v) / inertia
            q += 5e-5 * v
    t = np.arange(2, steps - 20, 10) * 1e-3 + np.random.default_rng(0).uniform(0, 9e-3, len(range(2, steps - 20, 10)))
    table = ServoTable.from_dict({"joints": {"*": FREE}, "loop_rate": 1000})
    run = Run(
        "a",
        ("joint",),
        t_cmd,
        cmd[:, None],
        t,
        np.interp(t, np.arange(steps) * 1e-3, out)[:, None],
        table,
        np.array([0, 0, -9.81]),
    )
    run.smooth()
    return run, torque[(t * 1000).astype(int)]


def simulated_error(run: Run, **columns: float) -> tuple[float, np.ndarray]:
    """Return (rms of the position error, simulated torque) of the plant run free with these columns."""
    plant = build(model(), [run])[0].plant
    params = plant.base()[None].copy()
    for name, value in columns.items():
        params[..., INDEX[name]] = value
    q, torque = plant.simulate(params, plant.windows(None))
    return float(np.sqrt(np.mean((run.q[:, 0] - q[0])[20:] ** 2))), torque[0]


def test_a_sampled_loop_is_followed_by_the_age_of_what_it_acts_on():
    run, torque = sampled()
    at_once = simulated_error(run)[0]
    aged, simulated = simulated_error(run, feedback_delay=0.5e-3, speed_lag=1e-3)
    assert at_once > 5e-4 and aged < 0.2 * at_once
    size = np.abs(np.quantile(torque, 0.9))
    # the torque in force, and not that of a step before
    assert np.sqrt(np.median((simulated - torque) ** 2)) < 0.02 * size
    assert float(np.polyfit(simulated, torque, 1)[0]) == pytest.approx(1.0, abs=0.01)


def test_an_eccentric_encoder_shows_other_speeds_too():
    run, _ = sampled((-0.09, 0.04))
    error, _ = simulated_error(run, feedback_delay=0.5e-3, speed_lag=1e-3, eccentric_sin=-0.09, eccentric_cos=0.04)
    assert error < 4e-4 and simulated_error(run, feedback_delay=0.5e-3, speed_lag=1e-3)[0] > 10 * error


def test_a_motion_as_it_is_from_what_an_encoder_shows():
    t = np.linspace(0.0, 1.0, 2001)
    q = 0.7 * np.sin(5 * t)
    row = np.zeros(len(INDEX))
    (
        row[INDEX["position_scale"]],
        row[INDEX["position_offset"]],
        row[INDEX["eccentric_sin"]],
        row[INDEX["eccentric_cos"]],
    ) = 1.1, 0.03, 0.08, -0.05
    reading = 1.1 * q + 0.03 + 0.08 * np.sin(q) - 0.05 * (np.cos(q) - 1)
    speed = np.gradient(reading, t)
    x, v, a = true_motion((t, reading, speed, np.gradient(speed, t)), row)[1:]
    assert (
        np.abs(x - q).max() < 1e-4
        and np.abs(v - 3.5 * np.cos(5 * t))[5:-5].max() < 2e-3
        and np.abs(a + 17.5 * np.sin(5 * t))[5:-5].max() < 0.02
    )


def test_the_search_finds_the_age_and_nothing_else_is_missing():
    run, _ = sampled()
    case = build(model(), [run])[0]
    search = JointSearch(case, [0], None, [0])
    x = {p.key: v for p, v in zip(*(lambda f: (f.params, f.x))(search.start().fit), strict=True)}
    assert x["feedback_delay"] == pytest.approx(0.5e-3, abs=0.25e-3) and x["kd"] == pytest.approx(1.0, abs=0.015)


@pytest.mark.parametrize(
    ("believed", "low", "high"),
    [(0.0, 0.0, 0.003), (0.02, 0.017, 0.023), ({"value": 0.02, "low": 0.01, "high": 0.04}, 0.01, 0.04)],
)
def test_a_speed_filter_that_is_believed_is_refitted_about_its_belief(believed, low, high):
    """A servo.yaml of an earlier diagnosis states it: it is kept, once, and not replaced by what any drive may have."""
    from test_gap import conditions, plant_run

    value = believed["value"] if isinstance(believed, dict) else believed
    runs = [plant_run(f"r{k}", k, 2.0, {}, seed=k, servo={"speed_lag": believed} if value else None) for k in (0, 1)]
    for r in runs:
        r.smooth()
    search = JointSearch(build(model(), runs)[0], [0, 1], None, conditions(runs))
    mine = [p for p in search.all_nuisances if p.columns == ("speed_lag",)]
    assert len(mine) == 1 and (mine[0].low, mine[0].high) == (pytest.approx(low), pytest.approx(high))
    assert search.case.plant.base()[0, INDEX["speed_lag"]] == value
