"""Environment steps a second with PPO included, where the time goes, and the distance to bare physics with PPO.

    python -m benchmarks.learning [worlds=4096,8192,16384,32768] [iterations=6] [policy=checkpoints/grasp.pt]
                                  [settle=120] [any other setting of train.py]

For each number of worlds, in one run:
  full   the environment and rsl-rl's PPO as train.py runs them, with the actor of a trained policy, so that the worlds
         hold what trained hands hold (`settle` control steps first);
  bare   the same PPO on a stand-in that returns the same observations, rewards and ends, and in whose step only physics
         happens: the physics steps of the last rollout, from the same states, driven by the recorded torques.
Seconds an iteration are medians, from device clocks: physics, rest of the environment's step, inference (actor, critic,
storage, statistics), update. ratio: steps a second of full over bare. Other settings of learning are timed by setting
them: graphed_update=false (rsl-rl's own update), tf32=false, agent.algorithm.use_mixed_precision=true.
"""

from __future__ import annotations

import gc
import json
import statistics
import time
from typing import Any

import torch

from benchmarks import tools
from benchmarks.options import options
from benchmarks.tape import Tape
from dexsim.cli import machine
from dexsim.learning import checkpoint
from dexsim.learning.runner import Runner
from dexsim.tasks import make_env


class Bare:
    """An environment of the same spaces that steps only physics (rsl-rl's VecEnv, as far as Runner uses it)."""

    def __init__(self, env: Any, length: int):
        self.env = env
        for name in ("num_envs", "num_actions", "device", "cfg", "action_names", "max_episode_length"):
            setattr(self, name, getattr(env, name))
        self.episode_length_buf = env.episode_length_buf
        self._tape = Tape(env.engine, env.servo, length * env.decimation)
        self._length, self._at = length, 0

    def record(self, runner: Runner) -> None:
        """Play one rollout of the real environment and keep its first states, its torques and what it returns."""
        env, e = self.env, self.env.engine
        obs = env.get_observations()
        self._qpos, self._qvel = e.t.qpos.clone(), e.t.qvel.clone()
        env.servo.before_each = self._tape.record
        try:
            with torch.no_grad():
                for _ in range(self._length):
                    self._last = env.step(runner.alg.actor(obs, stochastic_output=True))
                    obs = self._last[0]
        finally:
            del env.servo.before_each
        self._everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)

    def get_observations(self):
        return self.env.get_observations()

    def step(self, actions: torch.Tensor):
        e = self.env.engine
        if self._at == 0:
            e.set_state(self._everyone, self._qpos, self._qvel)
            self._tape.rewind()
        self._at = (self._at + 1) % self._length
        e.step(self.env.decimation, self._tape.play)
        return self._last

    def describe(self) -> dict:
        return self.env.describe()

    def check(self) -> None:
        pass


class Clock:
    """Seconds between marks, by the device's own clock; nothing waits until `read`."""

    def __init__(self, device: str):
        self._cuda = device.startswith("cuda")
        self._device = device
        self._spans: list[tuple[str, Any, Any]] = []

    def mark(self) -> Any:
        if not self._cuda:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def span(self, name: str, begin: Any) -> None:
        self._spans.append((name, begin, self.mark()))

    def read(self) -> dict[str, float]:
        tools.wait(self._device)
        sums: dict[str, float] = {}
        for name, a, b in self._spans:
            sums[name] = sums.get(name, 0.0) + (1e-3 * a.elapsed_time(b) if self._cuda else b - a)
        self._spans.clear()
        return sums


def _timed(runner: Runner, env: Any, iterations: int) -> dict[str, float]:
    """Return medians over iterations: seconds of an iteration, of env.step, of the update; the rest is inference."""
    clock = Clock(str(env.device))
    step, update = env.step, runner._updater.update

    def around(name, call):
        def run(*args):
            begin = clock.mark()
            out = call(*args)
            clock.span(name, begin)
            return out

        return run

    env.step, runner._updater.update = around("step", step), around("update", update)
    rows: list[dict[str, float]] = []
    last = [0.0]

    def on_iteration(row: dict[str, float]) -> None:
        found = clock.read()
        now = time.perf_counter()
        rows.append({"all": now - last[0], **found})
        last[0] = time.perf_counter()

    tools.wait(str(env.device))
    last[0] = time.perf_counter()
    try:
        runner.learn(runner.iteration + iterations + 1, on_iteration)
    finally:
        env.step, runner._updater.update = step, update
    rows = rows[1:]  # the first one compiles, allocates and records
    return {k: statistics.median(r[k] for r in rows) for k in rows[0]}


def _runner(env: Any, cfg: dict, actor: dict) -> Runner:
    runner = Runner(env, cfg, machine.versions())
    runner.alg._raw_actor.load_state_dict(actor)
    return runner


def measure(cfg: dict, worlds: int, iterations: int, settle: int, actor: dict) -> dict:
    """Return one row of the table: seconds, rates and the ratio at `worlds` worlds."""
    cfg = {**cfg, "worlds": worlds}
    device, length = cfg["device"], cfg["agent"]["num_steps_per_env"]
    torch.manual_seed(0)
    env = make_env(cfg, worlds, device, 0, cfg["sim"]["engine"])
    runner = _runner(env, cfg, actor)
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=env.max_episode_length - 100)
    with torch.no_grad():
        for _ in range(settle):
            env.step(runner.alg.actor(env.get_observations(), stochastic_output=True))
    full = _timed(runner, env, iterations)
    bare_env = Bare(env, length)
    runner.alg._raw_actor.load_state_dict(actor)
    bare_env.record(runner)
    bare = _timed(_runner(bare_env, cfg, actor), bare_env, iterations)
    steps = worlds * length
    row = {
        "worlds": worlds, "steps_per_s": steps / full["all"], "bare_steps_per_s": steps / bare["all"],
        "ratio": bare["all"] / full["all"],
        "iteration_s": full["all"], "physics_s": bare["step"], "rest_of_step_s": full["step"] - bare["step"],
        "inference_s": full["all"] - full["step"] - full["update"], "update_s": full["update"],
        "env_steps_per_s": steps / full["step"],
        "contacts": env.engine.peaks()["contacts"], "bare": bare,
    }  # fmt: skip
    return {k: float(f"{v:.5g}") if isinstance(v, float) else v for k, v in row.items()}


def main(argv: list[str]) -> dict:
    cuda = torch.cuda.is_available() and "device=cpu" not in argv
    rest: list[str] = []
    own = options(argv, {"worlds": "4096,8192,16384,32768" if cuda else "64,128", "iterations": 6 if cuda else 3,
                         "policy": str(tools.ROOT / "checkpoints" / "grasp.pt"), "settle": 120 if cuda else 40},
                  rest)  # fmt: skip
    cfg = tools.config(rest)
    data = checkpoint.load(own["policy"], cfg["device"])
    if "command" in cfg["task"]:  # what the policy sees
        cfg["task"]["command"] |= {"thumb": None} | data["config"]["task"]["command"]
    out: dict = {"benchmark": "learning", **tools.about(cfg["device"]), "rows": []}
    for worlds in tools.numbers(own["worlds"], "worlds"):
        row = measure(cfg, worlds, own["iterations"], own["settle"], data["actor"])
        out["rows"].append(row)
        share = {k: row[f"{k}_s"] / row["iteration_s"] for k in ("physics", "rest_of_step", "inference", "update")}
        print(
            f"  {worlds:6d} worlds  {row['steps_per_s']:9.0f} steps/s with PPO, {row['ratio']:.3f} of bare physics +"
            " PPO "
            f"({row['bare_steps_per_s']:.0f}); " + ", ".join(f"{k} {100 * v:.1f} %" for k, v in share.items()),
            flush=True,
        )
        gc.collect()
        if cfg["device"].startswith("cuda"):
            torch.cuda.empty_cache()
    print(json.dumps(out), flush=True)
    return out


if __name__ == "__main__":
    tools.command(main, __doc__)
