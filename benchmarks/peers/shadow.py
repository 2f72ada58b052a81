"""dexsim on one CPU thread beside Gymnasium-Robotics' Shadow hand: environment steps and simulated seconds per CPU
second.

Two hands, two tasks: Shadow (30 degrees of freedom with the block, 92 touch sites, a scalar each) turns a block,
dexsim's xHand (18, 600 taxels) catches one. So only the order of the ratio means something. CPU time, because the
machine may do other work.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from benchmarks.peers.__main__ import HERE, ROOT, child, interpreter
from dexsim.errors import UserError

CODE = """
import json, sys, time, torch
from dexsim.cli import build, start
from dexsim.paths import CONFIGS
from dexsim.tasks import make_env
worlds, seconds = int(sys.argv[1]), float(sys.argv[2])
torch.set_num_threads(1)
build.quiet_warp("cpu")
settings = ["task=grasp", "device=cpu", f"worlds={worlds}", "sim.threads=1", "task.objects.train=[box]"]
cfg = start.for_train(settings, CONFIGS).cfg
env = make_env(cfg, worlds, "cpu", 0, "auto")
random = lambda: 2 * torch.rand(worlds, 12) - 1
for _ in range(20):
    env.step(random())
steps, begin = 0, time.process_time()
while time.process_time() - begin < seconds:
    env.step(random())
    steps += worlds
spent = time.process_time() - begin
print(json.dumps({"peer": f"dexsim, {worlds} worlds", "steps_per_cpu_s": steps / spent,
                  "physics_per_step": env.decimation, "timestep": env.engine.dt, "control_s": env.dt,
                  "dofs": int(env.engine.mjm.nv), "sensors": 600, "observation": int(env.obs["actor"].shape[1])}))
"""


def main(own: dict[str, str], out: Path) -> int:
    """Both, in turns, twice; the better turn counts."""
    if "shadow" not in own:
        raise UserError(
            "shadow=: an interpreter that has gymnasium-robotics (pip install gymnasium-robotics in a"
            " virtual environment of its own)"
        )
    python, environment = interpreter(own["shadow"])
    seconds, best = own.get("seconds", "20"), {}
    one = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    plan = [
        ("shadow", [*python, str(HERE / "shadow_loop.py"), seconds], environment | {"OMP_NUM_THREADS": "1"}),
        ("dexsim_1", [sys.executable, "-c", CODE, "1", seconds], one),
        ("dexsim_64", [sys.executable, "-c", CODE, "64", seconds], one),
    ]
    for _ in range(2):
        for name, command, env in plan:
            row = child(command, env)
            if "error" in row:
                raise UserError(f"{name}: {row['error']}")
            print(
                f"  {name:10s} {row['steps_per_cpu_s']:8.0f} steps, {row['steps_per_cpu_s'] * row['control_s']:6.1f}"
                " simulated s, per CPU second",
                flush=True,
            )
            if row["steps_per_cpu_s"] > best.get(name, {"steps_per_cpu_s": 0.0})["steps_per_cpu_s"]:
                best[name] = row
    base = best["shadow"]
    for name, row in best.items():
        row["steps_over_shadow"] = row["steps_per_cpu_s"] / base["steps_per_cpu_s"]
        row["physics_steps_over_shadow"] = row["steps_over_shadow"] * row["physics_per_step"] / base["physics_per_step"]
        row["simulated_time_over_shadow"] = row["steps_over_shadow"] * row["control_s"] / base["control_s"]
        print(
            f"  {name:10s} environment steps {row['steps_over_shadow']:.2f}, physics steps"
            f" {row['physics_steps_over_shadow']:.2f},"
            f" simulated time {row['simulated_time_over_shadow']:.2f} of Shadow's"
        )
    (out / "peers_cpu.json").write_text(json.dumps({"benchmark": "peers cpu", "rows": best}, indent=1))
    print(json.dumps({"benchmark": "peers cpu", "rows": best}), flush=True)
    return 0
