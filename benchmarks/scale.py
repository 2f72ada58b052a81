"""Memory and time by number of worlds, up to what the device holds.

    python -m benchmarks.scale [counts=1,64,1024,8192] [seconds=400] [limit=true] [modes=simulate,train] [out=FOLDER]
    [any setting of train.py]

Each count runs in a process of its own (a full device leaves nothing behind): the environment of train.py is built, its
hands close for a second and then hold, a few control steps are timed, then PPO learns one iteration. Memory is what the
process adds to the device beyond its empty context (CUDA: of the driver's count; CPU: anonymous resident memory); bytes
a world are the slope of a straight line through all counts of 1,024 and more. `limit=true` (the default on CUDA) then
looks for the largest count that can be simulated and the largest that can be trained (`modes`), in steps of 7 %: a
count fits when it runs and all worlds are finite. `prior=scale.json` goes on from an earlier run.
Written after each process: scale.json; at the end scale.png and, as one line, the JSON. It stops after `seconds`, with
what it has.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.paths import CONFIGS

COUNTS = {"cuda": (1, 16, 256, 1024, 4096, 8192, 16384, 32768, 65536, 131072), "cpu": (1, 4, 16, 64, 256)}
OWN = ("counts", "seconds", "limit", "modes", "out", "mode", "prior")
TIMED_S = 3.0  # how long control steps are timed, about
CLOSING = 48  # control steps in which the hands close, one second
STEEP = 1024  # counts from which memory grows in proportion


# -- one count, in a process of its own
# -------------------------------------------------------------------------------------
def used(device: str) -> int:
    """Bytes in use: of the whole CUDA device, or this process's anonymous memory on a CPU."""
    import torch

    if device.startswith("cuda"):
        torch.cuda.synchronize(device)
        free, total = torch.cuda.mem_get_info(device)
        return total - free
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["RssAnon"].split()[0]) * 1024


def measure(cfg: dict, mode: str) -> dict:
    """Memory and times of one count. mode: "cost" (closed hands, timed, one iteration), "simulate" (three steps) or
    "train" (one iteration)."""
    import torch

    from dexsim.cli import build, machine
    from dexsim.learning.ranks import seed_all
    from dexsim.learning.runner import Runner
    from dexsim.tasks import make_env

    device, worlds = cfg["device"], cfg["worlds"]
    machine.set_threads(device)
    seed_all(cfg["seed"])
    build.quiet_warp(device)
    torch.zeros(1, device=device)
    empty = used(device)
    start = time.perf_counter()
    env = make_env(cfg, worlds, device, cfg["seed"], cfg["sim"]["engine"])
    action = torch.zeros(worlds, env.num_actions, device=device)
    close = torch.zeros_like(action)
    close[:, 4:], close[:, :3] = 0.5, 0.4
    for _ in range(3):  # compiled, recorded, replayed
        env.step(action)
    found = {"worlds": worlds, "mode": mode, "simulate_bytes": used(device) - empty,
             "ready_s": time.perf_counter() - start}
    _check(env)

    def clock(repeats: int) -> float:
        before = time.perf_counter()
        for _ in range(repeats):
            env.step(action)
        used(device)  # waits for the device
        return (time.perf_counter() - before) / repeats

    if mode == "cost":
        for k in range(CLOSING):
            env.step(torch.where((env.torque / env.effort).abs() > 0.4, action, close) if k > 12 else action)
        one = clock(2)
        found["step_s"] = clock(int(np.clip(TIMED_S / one, 3, 200)))
        found |= {f"peak_{k}": v for k, v in env.engine.peaks().items()}
    elif mode == "simulate":
        found["step_s"] = clock(2)
    if mode in ("cost", "train"):
        runner, rows = Runner(env, cfg, machine.versions()), []
        runner.learn(1, rows.append)
        runner.learn(2, rows.append) if mode == "cost" else None
        found |= {"train_bytes": used(device) - empty, "collect_s": rows[-1]["collect_s"],
                  "learn_s": rows[-1]["learn_s"],
                  "iteration_steps": runner.cfg["num_steps_per_env"]}
    _check(env)
    return found


def _check(env) -> None:
    env.check()
    if not all(bool(x.isfinite().all()) for x in (env.q, env.object_pose, *env.obs.values())):
        raise RuntimeError("a state is not finite")
    if int(env.nan_count) > env.num_envs // 1000:
        raise RuntimeError(f"{int(env.nan_count)} of {env.num_envs} worlds were not finite")


# -- the loop over counts
# -----------------------------------------------------------------------------------------------------
class Bench:
    """Runs counts in child processes and keeps what they found in `rows`, saved to out/scale.json after each."""

    def __init__(self, settings: list[str], out: Path, seconds: float, about: dict) -> None:
        self.settings, self.out, self.about, self.rows = settings, out, about, []
        self._end = time.perf_counter() + seconds

    def left(self) -> float:
        return self._end - time.perf_counter()

    def run(self, worlds: int, mode: str) -> dict:
        """One count; a row with "error" where it did not run."""
        print(f"  {worlds:>9,} worlds, {mode:8s} ", end="", flush=True)
        command = [sys.executable, "-m", "benchmarks.scale", f"mode={mode}", *self.settings, f"worlds={worlds}"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=max(self.left(), 1.0))
        except subprocess.TimeoutExpired:
            print("out of time")
            return {"worlds": worlds, "mode": mode, "error": "out of time"}
        lines = [x for x in done.stdout.splitlines() if x.startswith("{")]
        if done.returncode == 0 and lines:
            row = json.loads(lines[-1])
            print("  ".join(f"{k} {v:.4g}" for k, v in row.items() if k.endswith(("_s", "_bytes"))), flush=True)
        else:
            row = {"worlds": worlds, "mode": mode, "error": reason(done.stderr, done.returncode)}
            print(row["error"], flush=True)
        self.rows.append(row)
        self.save({})
        return row

    def save(self, summary: dict) -> None:
        text = json.dumps({"benchmark": "scale", **self.about, **summary, "rows": self.rows}, indent=1)
        (self.out / "scale.json").write_text(text)


def reason(stderr: str, status: int) -> str:
    """Why a child failed, in a few words."""
    lower = stderr.lower()
    if "out of memory" in lower or "failed to allocate" in lower or "memoryerror" in lower or status == -9:
        return "out of memory"
    lines = [x.strip() for x in stderr.splitlines() if x.strip()]
    return f"status {status}: {lines[-1][:160] if lines else 'no message'}"


def search(bench: Bench, mode: str, start: int, guess: int) -> dict:
    """The limit of one mode: `start` fits, `guess` is what the bytes a world promise. {"fits", "fails" (None: not
    reached), "why"}."""

    def fits(n: int) -> bool | None:
        if bench.left() < 20:
            return None
        row = bench.run(n, mode)
        return None if row.get("error") == "out of time" else "error" not in row

    low, high, n = start, None, max(int(0.97 * guess) // 256 * 256, start)
    answer: bool | None = True
    if n > low and not (answer := fits(n)):
        while answer is not None and not answer:  # downwards in small steps: the guess is near
            high, n = n, max(int(0.93 * n) // 256 * 256, start)
            if n == start:
                break
            answer = fits(n)
        low = n if answer else low
    elif n > low:
        while answer:
            low, n = n, int(1.07 * n) // 256 * 256
            answer = fits(n)
        high = n if answer is not None else None
    return {"fits": low, "fails": high,
            "why": next((r["error"] for r in bench.rows if r["worlds"] == high and "error" in r), None)}


def line(rows: list[dict], key: str) -> dict | None:
    """Straight line through bytes over worlds for the counts of STEEP and more (all, if those are fewer than two)."""
    points = [(r["worlds"], r[key]) for r in rows if key in r]
    large = [p for p in points if p[0] >= STEEP]
    points = large if len(large) > 1 else points
    if len({p[0] for p in points}) < 2:
        return None
    x, y = np.array(points, dtype=float).T
    slope, fixed = np.polyfit(x, y, 1, w=1 / x)  # relative errors alike
    return {"bytes_per_world": float(slope), "fixed_bytes": float(fixed),
            "worst_error": float(np.abs(slope * x + fixed - y).max() / y.max())}


def draw(rows: list[dict], lines: dict, limits: dict, path: Path) -> Path:
    """Microseconds a world and step, and memory, over worlds."""
    from matplotlib.figure import Figure

    from dexsim.view.plots import BLUE

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    time_axes, rate_axes, memory_axes = figure.subplots(1, 3)
    cost = sorted((r for r in rows if r.get("step_s") and r["mode"] == "cost"), key=lambda r: r["worlds"])
    train = [r for r in cost if "learn_s" in r]
    x = [r["worlds"] for r in cost]
    time_axes.loglog(x, [1e6 * r["step_s"] / r["worlds"] for r in cost], "o-", color=BLUE, label="environment step")
    iteration = [(r["collect_s"] + r["learn_s"]) / (r["iteration_steps"] * r["worlds"]) for r in train]
    time_axes.loglog([r["worlds"] for r in train], [1e6 * t for t in iteration], "s--", color="#c2571a",
                     label="with PPO")
    time_axes.set_ylabel("time of a world and control step (us)")
    rate_axes.loglog(x, [r["worlds"] / r["step_s"] for r in cost], "o-", color=BLUE)
    rate_axes.loglog([r["worlds"] for r in train], [1 / t for t in iteration], "s--", color="#c2571a")
    rate_axes.set_ylabel("environment steps a second")
    for key, style, colour in (("simulate_bytes", "o", BLUE), ("train_bytes", "s", "#c2571a")):
        points = sorted((r["worlds"], r[key]) for r in rows if key in r)
        memory_axes.loglog([p[0] for p in points], [p[1] / 2**30 for p in points], style, color=colour)
        if fit := lines.get(key):
            grid = np.geomspace(points[0][0], points[-1][0], 60)
            memory_axes.loglog(grid, (fit["bytes_per_world"] * grid + max(fit["fixed_bytes"], 0)) / 2**30,
                               color=colour, linewidth=1,
                               label=f"{key.partition('_')[0]}: {fit['bytes_per_world'] / 1024:.1f} KiB a world")
    for mode, limit in limits.items():
        memory_axes.axvline(limit["fits"], color={"simulate": BLUE, "train": "#c2571a"}[mode], linestyle=":")
    memory_axes.set_ylabel("memory (GiB)")
    for axes in figure.axes:
        axes.set_xlabel("worlds")
        axes.grid(alpha=0.25)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    return path


def main(argv: list[str]) -> int:
    """Parent (no mode=) or child (mode=)."""
    from dexsim.cli import folder, machine
    from dexsim.cli import start as start_up

    own = {a.partition("=")[0]: a.partition("=")[2] for a in argv if a.partition("=")[0] in OWN}
    rest = [a for a in argv if a.partition("=")[0] not in OWN]
    cfg = start_up.for_train(rest, CONFIGS).cfg
    if "mode" in own:
        print(json.dumps(measure(cfg, own["mode"])))
        return 0
    device = cfg["device"]
    kind = device.partition(":")[0]
    try:
        counts = [int(float(x)) for x in own["counts"].split(",")] if "counts" in own else list(COUNTS[kind])
    except ValueError:
        raise UserError(f"counts={own['counts']}: must be whole numbers, e.g. counts=1,1024,8192") from None
    modes = own.get("modes", "simulate,train").split(",")
    if not set(modes) <= {"simulate", "train"}:
        raise UserError(f"modes={own['modes']}: must be simulate, train or both, e.g. modes=train")
    out = folder.make(Path(own.get("out", "out/scale")), "out=")
    about = {"device": machine.describe(device), "memory": machine.memory(device), "versions": machine.versions()}
    bench = Bench(rest, out, float(own.get("seconds", 400)), about)
    print(f"{about['device']}, {about['memory']}")
    if "prior" in own:
        bench.rows = [r for r in json.loads(Path(own["prior"]).read_text())["rows"] if r.get("error") != "out of time"]
        counts = [n for n in counts if n not in [r["worlds"] for r in bench.rows]]
    for n in sorted(counts):
        if bench.left() > 20 and "error" in bench.run(n, "cost"):
            break
    keys = ("simulate_bytes", "train_bytes")
    limits: dict[str, dict] = {}
    if own.get("limit", str(kind == "cuda")).lower() == "true":
        import torch

        total = torch.cuda.mem_get_info(device)[1] if kind == "cuda" else 0
        if not total:
            raise UserError("limit=true: the limit is looked for on a CUDA device only; a CPU would swap")
        for mode in modes:
            key = f"{mode}_bytes"
            good = [r["worlds"] for r in bench.rows if "error" not in r and key in r]
            if good and (fit := line(bench.rows, key)):
                limits[mode] = search(bench, mode, max(good),
                                      int((total - fit["fixed_bytes"]) / fit["bytes_per_world"]))
                bench.save({"limits": limits})
    lines = {k: fit for k in keys if (fit := line(bench.rows, k))}
    bench.save({"lines": lines, "limits": limits})
    for key, fit in lines.items():
        print(f"  {key.partition('_')[0]:9s} {fit['bytes_per_world'] / 1024:8.2f} KiB a world +"
              f" {fit['fixed_bytes'] / 2**20:.0f} MiB")
    for mode, limit in limits.items():
        print(f"  {mode:9s} largest count that ran {limit['fits']:,}; did not: {limit['fails']} ({limit.get('why')})")
    print(f"  figure   {draw(bench.rows, lines, limits, out / 'scale.png')}\n  data     {out / 'scale.json'}")
    print(json.dumps({"benchmark": "scale", **about, "lines": lines, "limits": limits, "rows": bench.rows}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
