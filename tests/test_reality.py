"""Another world to be judged in: drawn once, never trained in, and different where it says so."""

from __future__ import annotations

import math

import pytest
import torch
import yaml

from dexsim.cli import start
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tactile.config import COLUMNS
from dexsim.tasks import make_env, reality
from tools.assets import xhand


def world(*overrides: str) -> dict:
    """Return the resolved config of `play.py policy=zero reality=bench`."""
    return start.for_play(["policy=zero", "reality=bench", "episodes=4", *overrides], CONFIGS).cfg


@pytest.fixture(scope="module")
def env():
    cfg = world("task=rotate")
    return make_env(cfg, 4, "cpu", 0, cfg["sim"]["engine"])


def test_the_committed_world_is_the_drawn_one():
    servo = yaml.safe_load((CONFIGS / "servo" / "xhand.yaml").read_text())
    path = CONFIGS / "reality" / "bench.yaml"
    seed = yaml.safe_load(path.read_text())["seed"]
    assert path.read_text() == reality.text(reality.draw(seed, servo))
    assert reality.draw(seed + 1, servo) != reality.draw(seed, servo)


def test_no_training_config_uses_it():
    for path in CONFIGS.rglob("*.yaml"):
        if path.parent.name != "reality":
            assert "bench" not in path.read_text(), path
    for task in ("rotate", "grasp"):
        assert start.for_train([f"task={task}", "device=cpu"], CONFIGS).cfg["reality"] == {"name": "none"}
        with pytest.raises(UserError, match="reality=bench: .*not to train in"):
            start.for_train([f"task={task}", "reality=bench", "device=cpu"], CONFIGS)


def test_its_drives_have_effects_that_no_training_randomizes():
    cfg = start.for_train(["task=rotate", "device=cpu"], CONFIGS).cfg
    nominal = {k for columns in cfg["servo"]["joints"].values() for k in columns}
    seen = nominal | set(cfg["randomize"]["servo"])
    for columns in world("task=rotate")["servo"]["joints"].values():
        assert {
            "stribeck_peak",
            "friction_asymmetry",
            "load_friction",
            "lag",
            "position_offset",
            "position_scale",
        } <= set(columns) - seen
        assert all(columns[k] != 0 for k in columns)


@pytest.mark.parametrize("task", ["rotate", "grasp"])
def test_what_it_draws_are_ranges_that_the_task_has(task):
    known = start.for_train([f"task={task}", "device=cpu"], CONFIGS).cfg
    drawn = yaml.safe_load((CONFIGS / "reality" / "bench.yaml").read_text())["tasks"][task]
    for name in drawn["randomize"]:
        group, _, key = name.partition(".")
        assert key in known["randomize"][group], name
    assert set(drawn["sensors"]) <= set(known["task"]["sensors"])


def test_physics_and_drives_are_its_own(env):
    table = env.cfg["reality"]
    m = env.engine.mjm
    assert (
        env.engine.kind == "mujoco"
        and m.opt.timestep == table["sim"]["timestep"]
        and m.opt.solver == reality.SOLVERS["cg"]
    )
    tip = m.geom("tip_index")
    assert m.geom_condim[tip.id] == 6 and tuple(m.geom_solimp[tip.id]) == tuple(table["contact"]["tip_solimp"])
    kp = [table["servo"]["joints"][j]["kp"] for j in xhand.JOINTS]
    # one hand, the same in every trial
    assert torch.allclose(env.servo.column("kp"), torch.tensor(kp).double().expand(4, 12))
    mu = env.engine.field("geom_friction")[:, tip.id, 0]
    world_mu = table["tasks"]["rotate"]["randomize"]["object.friction"]
    assert torch.allclose(
        mu, torch.full((4,), world_mu * table["contact"]["friction_by_finger"][1]).double(), atol=1e-6
    )


def test_touch_is_its_own(env):
    """Every imperfection that the world names is what its taxels have, in each task, and differs from what training
    believes, but for counts and other fingers, which a rotation's training knows."""
    own = yaml.safe_load((CONFIGS / "reality" / "bench.yaml").read_text())["tactile"]
    assert {"threshold", "noise", "gain_spread", "dead", "delay", "hysteresis", "stiffness_scale"} <= set(own)
    for task in ("rotate", "grasp"):
        believed = start.for_train([f"task={task}", "device=cpu"], CONFIGS).cfg["tactile"]
        there = world(f"task={task}")["tactile"]
        for name, value in own.items():
            assert there[name] == value, (task, name)
            assert value != believed[name] or (task == "rotate" and name in ("feel_others", "lsb")), (task, name)
    for name, value in own.items():
        c = env.touch.cfg
        assert (c.range(name) == (value, value)) if name in COLUMNS else (getattr(c, name) == value), name


def test_sensors_report_counts(env):
    for _ in range(3):
        env.step(0.5 * torch.ones(4, 12))
    step = 2 * math.pi / 4096
    counts = env.q / step
    assert torch.allclose(counts, counts.round(), atol=1e-3)
    assert torch.allclose(env.q.double(), env.servo.position(), atol=step)
    offset = (
        env.servo.column("position_offset")
        + (env.servo.column("position_scale") - 1) * env.engine.t.qpos[:, env.joint_q]
    )
    assert torch.allclose(env.servo.position() - env.engine.t.qpos[:, env.joint_q], offset)
    assert offset.abs().max() > 5 * step
    amps = env.torque / 0.01
    assert torch.allclose(amps, amps.round(), atol=1e-3) and env.torque.abs().max() > 0


def test_the_force_scale_stays_what_training_believed():
    """F_max scales what the grasp policy sees and is asked; the other world does not tell its drives."""
    believed = start.for_train(["task=grasp", "device=cpu"], CONFIGS).cfg
    there = world("task=grasp")
    assert there["belief"]["servo"] == believed["servo"] != there["servo"]
    a, b = (make_env(c, 1, "cpu", 0, "mujoco") for c in (believed, there))
    assert a.f_max == b.f_max


def test_timing_varies_about_the_nominal():
    cfg = yaml.safe_load((CONFIGS / "reality" / "bench.yaml").read_text())
    w = reality.Reality(cfg, torch.Generator().manual_seed(0), load_hand())
    steps = torch.tensor([w.substeps(14) for _ in range(2000)]).double()
    assert steps.min() == 12 and steps.max() == 16 and abs(steps.mean() - 14) < 0.1
    late, arrives = w.late(20000)
    assert 0 <= late.min() and late.max() <= cfg["timing"]["late"] and late.max() > 0.9 * cfg["timing"]["late"]
    assert abs((~arrives).float().mean() - cfg["timing"]["lost"]) < 0.004


def test_a_lost_target_leaves_the_last_in_force(env):
    env.reset_all()
    before = env.servo.state.clone()
    env.reality.late = lambda n: (torch.zeros(n), torch.tensor([False, True, True, True]))
    try:
        env.act(0.5 * torch.ones(4, 12))
    finally:
        del env.reality.late
    assert torch.equal(env.servo.state[0], before[0]) and not torch.equal(env.servo.state[1], before[1])


def test_errors_name_what_is_wrong():
    with pytest.raises(UserError, match="reality=elsewhere: no such option"):
        start.for_play(["policy=zero", "task=rotate", "reality=elsewhere"], CONFIGS)
    with pytest.raises(UserError, match="reality.solver.cone=round"):
        cfg = world("task=rotate", "reality.solver.cone=round")
        make_env(cfg, 1, "cpu", 0)
