"""How long the first and every later start takes, and what is compiled in it.

    python -m benchmarks.startup [device=cuda:0] [engines=mujoco,warp] [worlds=64] [any other setting of train.py]

For each engine, two new processes build the environment and do three control steps, with a kernel cache of their own in
a temporary folder: empty for the first (cold), as the first left it for the second (warm). Seconds are of the whole
process, imports included. Counts the modules that Warp compiled (each holds a kernel or a few; one compilation each),
their seconds (the first of a process on a CPU holds LLVM's own start, about 1.5 s), and the longest of them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time

from benchmarks import tools
from dexsim.errors import UserError

LONGEST = 8


def _child(begin: float, argv: list[str]) -> dict:
    """One start, of a process that was asked for at `begin` (monotonic clock); prints one JSON line."""
    import torch
    import warp as wp
    from warp._src import context

    from dexsim.tasks import make_env

    imported = time.monotonic()
    built: list[tuple[str, float]] = []
    compile_module = context.Module._compile

    def timed(self, *args, **kwargs):
        start = time.perf_counter()
        done = compile_module(self, *args, **kwargs)
        if done:
            built.append((self.name, time.perf_counter() - start))
        return done

    context.Module._compile = timed
    wp.config.log_level = wp.LOG_WARNING
    cfg = tools.config(argv)
    device = cfg["device"]
    env = make_env(cfg, cfg["worlds"], device, 0, cfg["sim"]["engine"])
    made = time.monotonic()
    action = torch.zeros(env.num_envs, env.num_actions, device=device)
    for _ in range(3):  # plain, recorded, replayed
        env.step(action)
    tools.wait(device)
    end = time.monotonic()
    built.sort(key=lambda x: -x[1])
    found = {
        "import_s": round(imported - begin, 2), "make_s": round(made - imported, 2), "steps_s": round(end - made, 2),
        "total_s": round(end - begin, 2), "modules": len(built), "compile_s": round(sum(s for _, s in built), 2),
        "longest": [[name.partition("__locals__")[0], round(s, 2)] for name, s in built[:LONGEST]],
    }  # fmt: skip
    print(json.dumps(found), flush=True)
    return found


def main(argv: list[str]) -> dict:
    if argv[:1] == ["--child"]:
        return _child(float(argv[1]), argv[2:])
    own, rest = tools.split(argv, {"engines": ""})
    if not any(a.startswith("worlds=") for a in rest):
        rest.append("worlds=64")
    device = tools.config(rest)["device"]
    engines = (own["engines"] or ("warp" if device.startswith("cuda") else "mujoco,warp")).split(",")
    out: dict = {"benchmark": "startup", **tools.about(device)}
    for engine in engines:
        with tempfile.TemporaryDirectory() as cache:
            for state in ("cold", "warm"):
                command = [sys.executable, "-m", "benchmarks.startup", "--child", str(time.monotonic()), *rest,
                           f"sim.engine={engine}"]
                done = subprocess.run(command, cwd=tools.ROOT, capture_output=True, text=True,
                                      env=os.environ | {"WARP_CACHE_PATH": cache})
                if done.returncode:
                    raise UserError(f"benchmarks.startup: {engine} did not start:"
                                    f" {done.stderr.strip().splitlines()[-1]}")
                found = json.loads(done.stdout.splitlines()[-1])
                out[f"{engine}_{state}"] = found
                slow = ", ".join(f"{name} {s} s" for name, s in found["longest"][:4])
                print(f"  {engine:7s}{state:5s} {found['total_s']:7.1f} s, of it {found['modules']:3d} modules compiled"
                      " in "
                      f"{found['compile_s']:.1f} s" + (f": {slow}" if slow else ""), flush=True)
    print(json.dumps(out), flush=True)
    return out


if __name__ == "__main__":
    tools.command(main, __doc__)
