"""From physics to a trained policy in one run: dexsim's own kernels beside MuJoCo-Warp's, and what a task then takes.

    python -m benchmarks.speedup [worlds=8192,32768] [parts=physics,learning,grasp,rotate] [limit_s=1200]
                                 [grasp_s=150] [rotate_s=205] [episodes=2048] [mjlab=PYTHON] [out=out/speedup]
                                 [any setting of train.py]

One device, one part after the other, each in a process of its own:
  physics   bare physics, full environment step and taxels a second of the first of `worlds`, under both (and peers on
            the same scene, with `mjlab=`): benchmarks.collision
  learning  environment steps a second with PPO included at each of `worlds`, under both: benchmarks.learning
  grasp     trained for `grasp_s` seconds of wall time and judged beside the included policy: benchmarks.minutes
  rotate    likewise, for `rotate_s`
What no longer fits into `limit_s` is left out and named. out/ gets each part's printout and speedup.json, renewed after
every part.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import tools
from dexsim.errors import UserError

THEIRS = ["sim.collision=mujoco", "sim.solver=mujoco"]
"""MuJoCo-Warp's own narrow phase and solver."""
PARTS = ("physics", "learning", "grasp", "rotate")


def last_json(text: str) -> dict[str, Any]:
    """The JSON object that a benchmark prints as its last line; raises UserError where there is none."""
    for line in reversed(text.splitlines()):
        if line.startswith("{"):
            return json.loads(line)
    raise UserError(f"a benchmark printed no JSON line; its end: {text[-400:].strip()}")


class Run:
    def __init__(self, argv: list[str]):
        own, self.settings = tools.split(
            argv,
            {
                "worlds": "8192,32768",
                "parts": ",".join(PARTS),
                "limit_s": "1200",
                "grasp_s": "150",
                "rotate_s": "205",
                "episodes": "2048",
                "mjlab": "",
                "out": "out/speedup",
            },
        )
        self.begin = time.perf_counter()
        self.worlds = tools.numbers(own["worlds"], "worlds")
        self.limit, self.episodes = (tools.numbers(own[k], k)[0] for k in ("limit_s", "episodes"))
        self.seconds = {task: tools.numbers(own[f"{task}_s"], f"{task}_s")[0] for task in ("grasp", "rotate")}
        self.parts, self.mjlab = own["parts"].split(","), own["mjlab"]
        if unknown := [p for p in self.parts if p not in PARTS]:
            raise UserError(f"parts={unknown[0]}: must be of {', '.join(PARTS)}")
        self.out = Path(own["out"]).resolve()
        self.out.mkdir(parents=True, exist_ok=True)
        cfg = tools.config(self.settings)
        self.found: dict[str, Any] = {"benchmark": "speedup", **tools.about(cfg["device"]), "left_out": []}

    def of(self, name: str, module: str, *arguments: str) -> dict[str, Any] | None:
        """What `python -m benchmarks.MODULE` found, in what is left of the time; None if it found nothing."""
        left = self.limit - (time.perf_counter() - self.begin)
        if left < 20:
            self.found["left_out"].append(name)
            return None
        log = self.out / f"{name}.log"
        command = [sys.executable, "-m", f"benchmarks.{module}", *arguments, *self.settings]
        try:
            with open(log, "w") as file:
                status = subprocess.run(
                    command, stdout=file, stderr=subprocess.STDOUT, cwd=tools.ROOT, timeout=left
                ).returncode
        except subprocess.TimeoutExpired:
            self.found["left_out"].append(name)
            return None
        text = log.read_text(encoding="utf-8", errors="replace")
        if status:
            raise UserError(f"{name} ended with status {status}; {log} ends: {text[-600:].strip()}")
        return last_json(text)

    def keep(self, name: str, value: Any) -> None:
        self.found[name] = value
        self.found["total_s"] = round(time.perf_counter() - self.begin, 1)
        (self.out / "speedup.json").write_text(json.dumps(self.found, indent=1) + "\n")

    def physics(self) -> None:
        parts = "measure,peers" if self.mjlab else "measure"
        path = self.out / "collision.json"
        found = self.of("physics", "collision", f"worlds={self.worlds[0]}", f"parts={parts}", f"mjlab={self.mjlab}",
                        f"out={path}")  # fmt: skip
        if found is None:
            return
        full = json.loads(path.read_text())
        row: dict[str, Any] = {s: full[f"measure {s}"] for s in ("hand", "narrow", "mujoco")}
        for name, measured in row.items():
            if "error" in measured:
                raise UserError(f"physics under {name}: {measured['error']}; {self.out / 'physics.log'} says more")
        row |= {"physics_speedup": full["physics_speedup"], "full_speedup": full["full_speedup"]}
        self.keep("physics", row | ({"peers": full["peers"]} if "peers" in full else {}))
        ours, theirs = row["hand"], row["mujoco"]
        print(
            f"{self.worlds[0]} worlds: bare physics {theirs['bare_ms']:.2f} -> {ours['bare_ms']:.2f} ms a control step"
            f" ({row['physics_speedup']:.2f}x), full step {theirs['full_ms']:.2f} -> {ours['full_ms']:.2f} ms,"
            f" {theirs['env_steps_per_s']:,.0f} -> {ours['env_steps_per_s']:,.0f} environment steps a second,"
            f" {100 * ours['overhead']:.0f} % over bare physics",
            flush=True,
        )

    def learning(self) -> None:
        rows: dict[str, Any] = {}
        for worlds in self.worlds:
            for name, settings in (("hand", []), ("mujoco", THEIRS)):
                found = self.of(f"learning_{worlds}_{name}", "learning", f"worlds={worlds}", *settings)
                if found is not None:
                    rows.setdefault(str(worlds), {})[name] = found["rows"][0]
                    self.keep("learning", rows)
            both = rows.get(str(worlds), {})
            if len(both) == 2:
                a, b = both["mujoco"]["steps_per_s"], both["hand"]["steps_per_s"]
                print(f"{worlds} worlds: training {a:,.0f} -> {b:,.0f} steps a second ({b / a:.2f}x)", flush=True)

    def task(self, task: str) -> None:
        more = ["judge=task.evaluation.cap_s=30"] if task == "rotate" else []
        found = self.of(task, "minutes", f"task={task}", f"seconds={self.seconds[task]}", f"episodes={self.episodes}",
                        f"out={self.out / task}", *more)  # fmt: skip
        if found is not None:
            self.keep(task, found)
            text = (self.out / f"{task}.log").read_text(encoding="utf-8", errors="replace")
            print("\n".join(x for x in text.splitlines() if not x.startswith("{")), flush=True)


def main(argv: list[str]) -> dict[str, Any]:
    run = Run(argv)
    failed = {}
    for part in run.parts:
        try:
            run.task(part) if part in ("grasp", "rotate") else getattr(run, part)()
        except UserError as error:  # one part's trouble must not cost the others' figures
            failed[part] = str(error)
            print(f"{part} failed: {error}", flush=True)
    run.keep("failed", failed)
    if run.found["left_out"]:
        print(f"left out, the {run.limit} s of limit_s= being over: {', '.join(run.found['left_out'])}", flush=True)
    print(json.dumps({k: run.found[k] for k in ("device", "left_out", "failed", "total_s")}), flush=True)
    if failed:
        raise UserError(f"{', '.join(failed)} failed: see above; {run.out / 'speedup.json'} holds the rest")
    return run.found


if __name__ == "__main__":
    tools.command(main, __doc__)
