"""Benchmarks replay the torques that they recorded, refuse bad settings, and run on a CPU."""

from __future__ import annotations

import importlib
import json

import forked
import pytest
import torch
from worlds import grasp_env

from benchmarks import machines, tools
from benchmarks.learning import Bare
from benchmarks.options import options
from benchmarks.tape import Tape
from dexsim.errors import UserError


@pytest.fixture(scope="module")
def env():
    env = grasp_env("task.objects.train=[box,sphere]", "task.objects.emphasis={}", worlds=4)
    tools.close_hand(env, 40)
    return env


def test_bare_physics_repeats_the_driven_run_to_the_bit(env):
    e, k, steps = env.engine, env.decimation, 5
    grasp, tape = tools.Snapshot(env), Tape(e, env.servo, steps * k)

    def run(before) -> torch.Tensor:
        grasp.restore(env)
        tape.rewind()
        states = []
        for _ in range(steps):
            e.step(k, before)
            states.append(torch.cat([e.t.qpos, e.t.qvel], 1).clone())
        return torch.stack(states)

    driven = run(tape.record)
    assert torch.equal(run(tape.play), driven)
    assert torch.equal(run(env.servo.before_each), driven)
    assert not torch.equal(run(None), driven), "without the servo it must go elsewhere, or this compares nothing"


def test_a_snapshot_puts_another_environment_there(env):
    grasp = tools.Snapshot(env)
    other = grasp_env("task.objects.train=[box,sphere]", "task.objects.emphasis={}", worlds=4, seed=5)
    assert not torch.equal(other.engine.field("body_mass"), env.engine.field("body_mass"))
    grasp.restore(other, fields=True)
    grasp.restore(env)
    for e in (env, other):
        e.engine.step(e.decimation, e.servo.before_each)
    assert torch.equal(env.engine.t.qpos, other.engine.t.qpos)


def test_bare_environment_steps_the_physics_of_the_last_rollout(env):
    class Agent:
        class alg:  # noqa: N801
            actor = staticmethod(lambda obs, stochastic_output: torch.zeros(4, 12))

    bare = Bare(env, 3)
    env.pushes = False  # the torques are replayed, a push is not
    tools.Snapshot(env).restore(env)
    bare.record(Agent)
    end = env.engine.t.qpos.clone()
    for _ in range(2):  # it begins anew by itself
        for _ in range(3):
            bare.step(torch.ones(4, 12))
        assert torch.equal(env.engine.t.qpos, end)


@pytest.mark.parametrize(
    "name, setting",
    [
        ("step", "steps=none"),
        ("learning", "worlds=0"),
    ],
)
def test_bad_settings_are_one_clear_line(name, setting):
    with pytest.raises(UserError) as error:
        importlib.import_module(f"benchmarks.{name}").main(
            [setting] + (["device=cpu"] if name == "learning" else [])
        )
    assert setting.split("=")[0] in str(error.value) and "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize("command, keys", [
    (("benchmarks.learning", "device=cpu", "worlds=8", "iterations=1", "settle=2"), ("rows",)),
])  # fmt: skip
def test_they_run_on_a_cpu_and_end_in_one_json_line(command, keys):
    done = forked.run(*command)
    assert done.returncode == 0, done.stderr[-2000:]
    out = json.loads(done.stdout.splitlines()[-1])
    assert out["benchmark"] == command[0].split(".")[1] and "versions" in out and "device" in out
    for key in keys:
        assert out[key], key


def test_numbers_and_settings_are_split():
    assert tools.numbers("8, 16", "worlds") == [8, 16]
    with pytest.raises(UserError, match="worlds=8,x"):
        tools.numbers("8,x", "worlds")
    assert options(["a=1", "b=2", "c"], {"a": 0}, rest := []) == {"a": 1} and rest == ["b=2", "c"]


def test_what_a_cable_costs_by_hand():
    """125 MB need 0.1 s at 10 Gbit/s: 1.6 s an iteration after one node's 1.5 s, 1.85 s after a free cable's 1.75."""
    one, free = {"collect_s": 1.0, "learn_s": 0.5}, {"collect_s": 1.0, "learn_s": 0.75}
    found = machines.computed(one, free | {"bytes_sent": [1.25e8, 1e8], "steps": 3000}, 10.0)
    assert found["wire_s"] == pytest.approx(0.1) and found["seconds"] == pytest.approx([1.6, 1.85])
    assert found["rate"] == pytest.approx([3000 / 1.6, 3000 / 1.85])
