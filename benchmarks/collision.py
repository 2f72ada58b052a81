"""sim.collision=hand beside sim.collision=mujoco, in one process on one device: start, physics, full step, profile,
play.

    python -m benchmarks.collision [out=out/collision.json] [worlds=8192] [steps=40] [rounds=3] [episodes=512]
    [limit_s=330]
                                   [parts=measure,variants,play,exact] [any setting of train.py]

The grasp of benchmarks.step is made once, with `hand`, and handed to the other setting, so that both step the same
worlds.
  start     seconds until the first control steps are done, and the modules compiled until then (with an empty kernel
  cache: a
            cold start); what the other setting compiles in addition is listed beside it
  measure   for both settings: times as benchmarks.step, stages as benchmarks.trace, microseconds of each kernel of one
  physics
            step launched one by one, Newton iterations, contacts, pairs tested and overlapping
  variants  bare physics under other launch sizes and solver options, one at a time, with `hand`
  play      metrics of checkpoints/grasp.pt and rotate.pt under both
  exact     contacts of random poses against C MuJoCo (benchmarks.narrow_phase) on this device
What no longer fits into `limit_s` is left out and named. The file is written after every part.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp
from warp._src import context

from benchmarks import narrow_phase, tools, trace
from benchmarks import step as step_benchmark
from benchmarks.physics import edited
from benchmarks.tape import Tape
from dexsim.cli import start as start_up
from dexsim.learning.ppo import load_policy
from dexsim.paths import CONFIGS
from dexsim.sim import warp_engine
from dexsim.tasks import make_env

SETTINGS = ("hand", "mujoco")
PARTS = ("measure", "variants", "play", "exact")


@contextmanager
def compiled() -> Iterator[list[tuple[str, float]]]:
    """(module, seconds) of each that Warp compiles meanwhile; in parallel, so their sum is no wall time."""
    built: list[tuple[str, float]] = []
    compile_module = context.Module._compile

    def timed(self, *args, **kwargs):
        begin = time.perf_counter()
        done = compile_module(self, *args, **kwargs)
        if done:
            built.append((self.name.partition("__locals__")[0], round(time.perf_counter() - begin, 2)))
        return done

    context.Module._compile = timed
    try:
        yield built
    finally:
        context.Module._compile = compile_module


class Run:
    def __init__(self, argv: list[str]):
        own, rest = tools.split(
            argv,
            {
                "out": "out/collision.json",
                "steps": "40",
                "rounds": "3",
                "episodes": "512",
                "limit_s": "330",
                "parts": ",".join(PARTS),
                "poses": "20000",
            },
        )
        self.begin, self.limit = time.perf_counter(), float(own["limit_s"])
        self.steps, self.rounds, self.episodes, self.poses = (
            tools.numbers(own[k], k)[0] for k in ("steps", "rounds", "episodes", "poses")
        )
        self.parts = own["parts"].split(",")
        self.path = Path(own["out"])
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.cfg = tools.config([*rest, "sim.engine=warp"])
        self.device = self.cfg["device"]
        self.out: dict[str, Any] = {
            "benchmark": "collision",
            **tools.about(self.device),
            "worlds": self.cfg["worlds"],
            "left_out": [],
        }
        self.envs: dict[str, Any] = {}

    def part(self, name: str, call: Callable[[], Any], need_s: float = 0.0) -> None:
        """Run a part, keep its result or its error, and write the file."""
        spent = time.perf_counter() - self.begin
        if spent + need_s > self.limit:
            self.out["left_out"].append(name)
        else:
            try:
                self.out[name] = call()
            except Exception as error:  # one part's trouble must not cost the others' figures
                self.out[name] = {"error": f"{type(error).__name__}: {error}"}
            print(
                f"  {name:24s}{time.perf_counter() - self.begin - spent:7.1f} s  {json.dumps(self.out[name])[:160]}",
                flush=True,
            )
        self.out["total_s"] = round(time.perf_counter() - self.begin, 1)
        self.path.write_text(json.dumps(self.out, indent=1) + "\n")

    def make(self, setting: str) -> dict:
        """Build the environment and do three control steps."""
        begin = time.perf_counter()
        cfg = {**self.cfg, "sim": {**self.cfg["sim"], "collision": setting}}
        with compiled() as built:
            try:
                env = make_env(cfg, cfg["worlds"], self.device, 0, "warp")
            except Exception as error:  # the other figures do not need it
                self.out["compile_together"] = f"{type(error).__name__}: {error}"
                warp_engine.compile_together = lambda program, device: 0
                env = make_env(cfg, cfg["worlds"], self.device, 0, "warp")
            self.envs[setting] = env
            made = time.perf_counter()
            for _ in range(3):
                env.step(torch.zeros(env.num_envs, env.num_actions, device=self.device))
            tools.wait(self.device)
        return {"make_s": made - begin, "steps_s": time.perf_counter() - made, "modules": len(built),
                "compile_s": sum(s for _, s in built),
                "longest": sorted(built, key=lambda x: -x[1])[:12]}  # fmt: skip

    def grasp(self) -> dict:
        tools.close_hand(self.envs["hand"])
        self.state = tools.Snapshot(self.envs["hand"])
        return {name: value for name, value in self.envs["hand"].engine.peaks().items()}

    def back(self, setting: str) -> Any:
        env = self.envs[setting]
        self.state.restore(env, fields=True)
        return env

    def measure(self, setting: str) -> dict:
        env = self.back(setting)
        times = step_benchmark.measure(env, self.steps, self.rounds)
        bare, driven, touched, full = (1e3 * statistics.median(t) for t in times.values())
        return {"bare_ms": bare, "servo_ms": driven, "touch_ms": touched, "full_ms": full, "overhead": full / bare - 1,
                "env_steps_per_s": 1e3 * env.num_envs / full,
                "physics_steps_per_s": 1e3 * env.num_envs * env.decimation / bare,
                "rounds_ms": {k: [round(1e3 * x, 3) for x in t] for k, t in times.items()}}  # fmt: skip

    def stages(self, setting: str) -> dict:
        env = self.back(setting)
        for _ in range(3):
            env.engine.step(env.decimation, env.servo.before_each)
        found = trace.stages(env.engine, 20) if self.device.startswith("cuda") else {}
        d = env.engine.d
        n = int(d.nacon.numpy()[0])
        types = env.engine.mjm.geom_type[d.contact.geom.numpy()[:n]]
        pairs, counts = np.unique(np.sort(types, axis=1), axis=0, return_counts=True)
        narrow = env.engine.narrow
        return {"us": found, "contacts": n / env.num_envs, "pairs": int(d.ncollision.numpy()[0]) / env.num_envs,
                "overlapping": int(narrow.deep_number.numpy()[0]) / env.num_envs if narrow is not None else None,
                "rows_mean_p99_max": trace._spread(d.nefc.numpy()),
                "newton_mean_p99_max": trace._spread(d.solver_niter.numpy()),
                "newton_histogram": np.bincount(d.solver_niter.numpy()).tolist(),
                "by_types": {f"{a}-{b}": round(int(c) / env.num_envs, 3) for (a, b),
                             c in zip(pairs, counts, strict=True)}}  # fmt: skip

    def kernels(self, setting: str) -> dict:
        """Microseconds of each kernel of a physics step, and how often it is launched; means of five steps."""
        env = self.back(setting)
        if not self.device.startswith("cuda"):
            env.engine.physics_step()
            return {}
        for _ in range(3):
            env.engine.step(env.decimation, env.servo.before_each)
        with wp.ScopedDevice(self.device):
            env.engine.physics_step()
            wp.timing_begin(cuda_filter=wp.TIMING_ALL)
            for _ in range(5):
                env.engine.physics_step()
            results = wp.timing_end()
        sums: dict[str, list[float]] = {}
        for r in results:
            name = r.name.partition("__locals__")[0].replace("forward kernel ", "")
            entry = sums.setdefault(name, [0.0, 0])
            entry[0] += 1e3 * r.elapsed / 5
            entry[1] += 1
        rows = sorted(((k, round(us, 1), n / 5) for k, (us, n) in sums.items()), key=lambda row: -row[1])
        return {
            "total_us": round(sum(us for _, us, _ in rows), 1),
            "launches": sum(n for *_, n in rows),
            "kernels": rows[:45],
        }

    def bare(self, env: Any, steps: int = 20) -> float:
        """Milliseconds a control step of bare physics from the grasp, recorded anew."""
        e, k = env.engine, env.decimation
        self.state.restore(env, fields=True)
        tape = Tape(e, env.servo, (steps + 2) * k)
        for _ in range(steps + 2):
            e.step(k, tape.record)
        times = []
        for _ in range(3):
            self.state.restore(env)
            tape.rewind()
            times.append(tools.seconds(self.device, lambda: e.step(k, tape.play), steps))
        return 1e3 * statistics.median(times)

    def variants(self) -> dict:
        env = self.envs["hand"]
        m, narrow = env.engine.m, env.engine.narrow
        dims = m.block_dim
        out = {"as it is": self.bare(env)}
        trials = [(narrow, "block_dim", x) for x in (32, 64, 256)] if narrow is not None else []
        trials += [
            (dims, name, x)
            for name, values in (
                ("update_gradient_JTDAJ_dense", (32, 64, 256)),
                ("update_gradient_cholesky", (32, 128)),
                ("linesearch_iterative", (64,)),
                ("contact_jac_tiled", (64,)),
            )
            for x in values
        ]
        trials += [(m.opt, "iterations", x) for x in (4, 6)] + [(m.opt, "ls_iterations", 10)]
        for owner, name, value in trials:
            if time.perf_counter() - self.begin > self.limit:
                self.out["left_out"].append(f"variants: {name}={value}")
                continue
            kept = getattr(owner, name)
            setattr(owner, name, value)
            try:
                out[f"{name}={value}"] = self.bare(env)
            except Exception as error:
                out[f"{name}={value}"] = f"{type(error).__name__}: {error}"
            setattr(owner, name, kept)
        return out

    def sparse(self) -> dict:
        """Bare physics with a sparse Jacobian, whose solver adds all of a Newton iteration's Hessian in one kernel."""

        def edit(spec: mujoco.MjSpec) -> None:
            spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE

        with edited(edit), compiled() as built:
            env = make_env(
                {**self.cfg, "sim": {**self.cfg["sim"], "collision": "hand"}},
                self.cfg["worlds"],
                self.device,
                0,
                "warp",
            )
            out = {"bare_ms": self.bare(env)}
        self.envs["sparse"] = env
        return out | {"compile_s": sum(s for _, s in built), "kernels": self.kernels("sparse")}

    def play(self, task: str, setting: str) -> dict:
        worlds = min(self.episodes, 2048)
        argv = [
            f"checkpoint={tools.ROOT / 'checkpoints' / task}.pt",
            f"device={self.device}",
            f"episodes={self.episodes}",
            f"worlds={worlds}",
            "sim.engine=warp",
            *(["task.evaluation.cap_s=30"] if task == "rotate" else []),
        ]
        begun = start_up.for_play(argv, CONFIGS)
        cfg = {**begun.cfg, "sim": {**begun.cfg["sim"], "collision": setting}}
        env = make_env(cfg, cfg["worlds"], self.device, cfg["seed"], "warp")
        policy = load_policy(begun.data, env, str(begun.source), begun.typed)
        with torch.no_grad():
            metrics = env.evaluate(policy, episodes=self.episodes, seed=begun.play["seed"])["metrics"]
        env.check()
        return {k: v for k, v in metrics.items() if isinstance(v, (int, float))}


def main(argv: list[str]) -> dict:
    run = Run(argv)
    run.part("start hand", lambda: run.make("hand"))
    run.part("grasp", run.grasp)
    if "measure" in run.parts:
        run.part("measure hand", lambda: run.measure("hand"))
        run.part("stages hand", lambda: run.stages("hand"))
        run.part("kernels hand", lambda: run.kernels("hand"))
    run.part("start mujoco", lambda: run.make("mujoco"))
    if "measure" in run.parts:
        run.part("measure mujoco", lambda: run.measure("mujoco"))
        run.part("stages mujoco", lambda: run.stages("mujoco"))
        run.part("kernels mujoco", lambda: run.kernels("mujoco"))
    if "play" in run.parts:
        for task in ("grasp", "rotate"):
            for setting in SETTINGS:
                run.part(f"play {task} {setting}", lambda task=task, setting=setting: run.play(task, setting), 15)
    if "exact" in run.parts:
        for kind in narrow_phase.KINDS:
            run.part(
                f"exact {kind}",
                lambda kind=kind: narrow_phase.kind_of_pair(kind, run.poses, run.device, min(run.poses, 8192)),
                8,
            )
    if "variants" in run.parts:
        run.part("variants", run.variants, 10)
        run.part("sparse", run.sparse, 30)
    if {f"measure {s}" for s in SETTINGS} <= set(run.out):
        hand, theirs = (run.out[f"measure {s}"] for s in SETTINGS)
        if "error" not in hand | theirs:
            run.out["physics_speedup"] = theirs["bare_ms"] / hand["bare_ms"]
            run.out["full_speedup"] = theirs["full_ms"] / hand["full_ms"]
    run.path.write_text(json.dumps(run.out, indent=1) + "\n")
    print(json.dumps({k: v for k, v in run.out.items() if isinstance(v, (int, float, str, list))}), flush=True)
    return run.out


if __name__ == "__main__":
    tools.command(main, __doc__)
