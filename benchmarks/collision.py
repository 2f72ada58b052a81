"""dexsim's own kernels (sim.collision=hand, sim.solver=hand) beside MuJoCo-Warp's (both mujoco), in one process on one
device: start, physics, full step, profile, peers, play.

    python -m benchmarks.collision [out=out/collision.json] [worlds=8192] [steps=40] [rounds=3] [episodes=512]
                                   [limit_s=330] [parts=measure,solve,variants,peers,play,exact] [mjlab=PYTHON]
                                   [any setting of train.py]

The grasp of benchmarks.step is made once, with dexsim's kernels, and handed to the other settings (`narrow`: dexsim's
contacts, MuJoCo-Warp's solver; `mujoco`: MuJoCo-Warp's of both), so that all step the same worlds.
  start     seconds until the first control steps are done, and the modules compiled until then (with an empty kernel
            cache: a cold start); what each other setting compiles in addition is listed beside it
  measure   for each: times as benchmarks.step, stages as benchmarks.trace, microseconds of each kernel of one physics
            step launched one by one and of the recorded parts of the environment's step, Newton iterations, contacts,
            pairs tested and overlapping
  variants  bare physics with dexsim's kernels under other launch sizes and solver options, one at a time
  peers     bare MuJoCo-Warp, and with `mjlab=` its environment loop, on the same scene (benchmarks.peers gpu)
  solve     accelerations and forces of both solvers from the same constraints
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

import numpy as np
import torch
import warp as wp
from mujoco_warp._src import solver
from warp._src import context

from benchmarks import narrow_phase, tools, trace
from benchmarks import step as step_benchmark
from benchmarks.peers import __main__ as peers
from benchmarks.tape import Tape
from dexsim.cli import start as start_up
from dexsim.console import folders
from dexsim.learning.ppo import load_policy
from dexsim.paths import CONFIGS
from dexsim.sim import warp_engine
from dexsim.tasks import make_env

SETTINGS = {
    "hand": {"collision": "hand", "solver": "hand"},
    "narrow": {"collision": "hand", "solver": "mujoco"},
    "mujoco": {"collision": "mujoco", "solver": "mujoco"},
}
"""Whose kernels: dexsim's; dexsim's for contacts only; MuJoCo-Warp's."""
PARTS = ("measure", "solve", "variants", "peers", "play", "exact")
SOLVERS: list[dict[str, Any]] = [
    *({"rows": rows} for rows in (32, 48, 96, 160)),
    *({"worlds_per_block": worlds} for worlds in (2, 4)),
    *({"registers": registers} for registers in (64, 80, 96)),
    {"fast_math": True},
    {"fast_math": True, "registers": 80},
    {"fast_math": True, "rows": 48, "registers": 80},
]
"""Launch choices of dexsim's solver that `variants` times, each from the defaults."""


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


def _differences(theirs: list[torch.Tensor], ours: list[torch.Tensor], rows: torch.Tensor) -> dict[str, Any]:
    """Of two solves: [acceleration, force, iterations, state] by world; rows [N, R]: which rows there are."""
    (a, fa, na, sa), (b, fb, nb, sb) = theirs, ours
    off, force = (a - b).abs().amax(1), torch.where(rows, (fa - fb).abs(), 0).amax(1)
    return {
        "acceleration_median_99_worst": [float(x) for x in _percentiles(off)],
        "acceleration_largest": float(a.abs().max()),
        "force_median_99_worst": [float(x) for x in _percentiles(force)],
        "force_largest": float(fa[rows].abs().max()),
        "same_iterations": float((na == nb).float().mean()),
        "iterations": [float(na.float().mean()), float(nb.float().mean())],
        "same_states": float(((sa == sb) | ~rows).all(1).float().mean()),
    }


def _percentiles(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return x.median(), x.quantile(0.99), x.max()


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
                "mjlab": "",
            },
        )
        self.begin, self.limit = time.perf_counter(), float(own["limit_s"])
        self.steps, self.rounds, self.episodes, self.poses = (
            tools.numbers(own[k], k)[0] for k in ("steps", "rounds", "episodes", "poses")
        )
        self.parts, self.mjlab = own["parts"].split(","), own["mjlab"]
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
        cfg = {**self.cfg, "sim": {**self.cfg["sim"], **SETTINGS[setting]}}
        with compiled() as built:
            try:
                env = make_env(cfg, cfg["worlds"], self.device, 0, "warp")
            except Exception as error:  # the other figures do not need it
                self.out["compile_side_by_side"] = f"{type(error).__name__}: {error}"
                warp_engine.compile_side_by_side = lambda program, device: 0
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
                "rounds_ms": {k: [round(1e3 * x, 3) for x in t] for k, t in times.items()},
                "recorded_us": self.recorded(env)}  # fmt: skip

    def recorded(self, env: Any) -> dict[str, float]:
        """Microseconds of each recorded part of the environment's step outside physics."""
        out = {}
        for name, graph in env._recorded.items():
            out[name] = round(1e6 * tools.seconds(self.device, graph.replay, 50), 1)
        out["observations"] = round(1e6 * tools.seconds(self.device, env.get_observations, 50), 1)
        return out

    def solve(self) -> dict:
        """dexsim's solver against MuJoCo-Warp's on the same constraints: the grasp's, warm started as in a step and
        from spoilt starts. Differences of accelerations [rad/s^2 or m/s^2] and of forces [N]; and whether two runs are
        equal."""
        env = self.back("hand")
        e = env.engine
        m, d, ours = e.m, e.d, e.newton
        for _ in range(3):
            e.step(env.decimation, env.servo.before_each)
        with wp.ScopedDevice(self.device):
            e.physics_step()
        warm, kept, kept_math = wp.to_torch(d.qacc_warmstart), wp.to_torch(d.qacc_warmstart).clone(), ours.fast_math
        rows = torch.arange(d.njmax, device=self.device) < wp.to_torch(d.nefc)[:, None]
        generator = torch.Generator(device=self.device).manual_seed(0)
        out: dict[str, Any] = {}
        for spoilt in (0.0, 10.0, 100.0):
            warm.copy_(kept + spoilt * torch.randn(kept.shape, generator=generator, device=self.device))
            found = {}
            for name in ("mujoco", "exact", "again", "fast"):
                ours.fast_math = name == "fast"
                with wp.ScopedDevice(self.device):
                    solver.solve(m, d) if name == "mujoco" else ours.launch()
                found[name] = [wp.to_torch(x).clone() for x in (d.qacc, d.efc.force, d.solver_niter, d.efc.state)]
            ours.fast_math = kept_math
            for name in ("exact", "fast"):
                out[f"{name}, spoilt {spoilt:g}"] = _differences(found["mujoco"], found[name], rows)
            again = bool((found["again"][0] == found["exact"][0]).all())
            out[f"exact, spoilt {spoilt:g}"]["bitwise_equal_again"] = again
        warm.copy_(kept)
        return out

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
        m, narrow, newton = env.engine.m, env.engine.narrow, env.engine.newton
        out = {"as it is": self.bare(env)}
        trials = [(narrow, {"block_dim": x}) for x in (32, 64, 256)] if narrow is not None else []
        trials += [(newton, changes) for changes in SOLVERS] if newton is not None else []
        trials += [(m.opt, {"iterations": 4}), (m.opt, {"ls_iterations": 10})]
        if newton is not None:
            self.compile_solvers(newton)
        for owner, changes in trials:
            name = ", ".join(f"{k}={v}" for k, v in changes.items())
            if time.perf_counter() - self.begin > self.limit:
                self.out["left_out"].append(f"variants: {name}")
                continue
            kept = {k: getattr(owner, k) for k in changes}
            for k, v in changes.items():
                setattr(owner, k, v)
            try:
                out[name] = self.bare(env)
            except Exception as error:
                out[name] = f"{type(error).__name__}: {error}"
            for k, v in kept.items():
                setattr(owner, k, v)
        return out

    def compile_solvers(self, newton: Any) -> None:
        """Compile all variants of the solver at once."""
        def launch_all() -> None:
            for changes in SOLVERS:
                kept = {k: getattr(newton, k) for k in changes}
                for k, v in changes.items():
                    setattr(newton, k, v)
                newton.launch()
                for k, v in kept.items():
                    setattr(newton, k, v)

        warp_engine.compile_side_by_side(launch_all, self.device)

    def peers(self) -> dict:
        """Milliseconds of a control step of each (the best of two turns), and over dexsim's full step."""
        own = {"worlds": str(self.cfg["worlds"]), "device": self.device} | ({"mjlab": self.mjlab} if self.mjlab else {})
        rows = peers.gpu(own, folders.make((self.path.parent / "peers").resolve(), "out="))
        failed = {r["name"]: r["error"] for r in rows if "error" in r}
        best: dict[str, float] = {}
        for r in rows:
            if "ms" in r:
                best[r["name"]] = min(r["ms"], best.get(r["name"], r["ms"]))
        return {"ms": best, "over_dexsim": peers.ratios(rows), "failed": failed}

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
        cfg = {**begun.cfg, "sim": {**begun.cfg["sim"], **SETTINGS[setting]}}
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
    if "variants" in run.parts:
        run.part("variants", run.variants, 10)
    for setting in ("narrow", "mujoco") if "measure" in run.parts else ():
        run.part(f"start {setting}", lambda setting=setting: run.make(setting))
        run.part(f"measure {setting}", lambda setting=setting: run.measure(setting))
        run.part(f"stages {setting}", lambda setting=setting: run.stages(setting))
        run.part(f"kernels {setting}", lambda setting=setting: run.kernels(setting))
    if "solve" in run.parts:
        run.part("solve", run.solve)
    if "peers" in run.parts:
        run.part("peers", run.peers, 30)
    if "play" in run.parts:
        for task in ("grasp", "rotate"):
            for setting in ("hand", "mujoco"):
                run.part(f"play {task} {setting}", lambda task=task, setting=setting: run.play(task, setting), 15)
    if "exact" in run.parts:
        for kind in narrow_phase.KINDS:
            run.part(
                f"exact {kind}",
                lambda kind=kind: narrow_phase.kind_of_pair(kind, run.poses, run.device, min(run.poses, 8192)),
                8,
            )
    if {"measure hand", "measure mujoco"} <= set(run.out):
        hand, theirs = (run.out[f"measure {s}"] for s in ("hand", "mujoco"))
        if "error" not in hand | theirs:
            run.out["physics_speedup"] = theirs["bare_ms"] / hand["bare_ms"]
            run.out["full_speedup"] = theirs["full_ms"] / hand["full_ms"]
    run.path.write_text(json.dumps(run.out, indent=1) + "\n")
    print(json.dumps({k: v for k, v in run.out.items() if isinstance(v, (int, float, str, list))}), flush=True)
    return run.out


if __name__ == "__main__":
    tools.command(main, __doc__)
