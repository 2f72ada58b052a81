"""One fold of BAM: a process of its own; and a finding as the summaries keep it."""

from __future__ import annotations

import time
from pathlib import Path


def fold(job: tuple[Path, Path, int]) -> dict:
    """One gain of BAM left out: fitted on the other three, judged on its four recordings."""
    from benchmarks.real.convert_bam import convert
    from dexsim.cli.build import quiet_warp
    from dexsim.gap.diagnosis import Settings, diagnose, save

    data, out, gain = job
    quiet_warp("cpu")
    made = convert(data, out / f"recordings_{gain}")
    held = [p for p in made.recordings if made.gains[p.name] == gain]
    rest = [p for p in made.recordings if p not in held]
    start = time.perf_counter()
    d = diagnose(Settings(rest, out / f"gain_{gain}", held, str(made.model), str(made.servo), next_recording=False), say=lambda _: None)
    save(d, out / f"gain_{gain}")
    return {"gain": gain, "verdict": d.data["verdict"], "floor_rad": d.data["noise_floor"]["position_rad"], "findings": [brief(f) for f in d.data["findings"]],
            "recordings": {name: [before, after] for (_, name), (before, after) in d.mae.items()}, "notes": d.notes, "stages": d.stages,
            "depends_on": d.data["unexplained"]["depends_on"], "seconds": round(time.perf_counter() - start, 1)}  # fmt: skip


def brief(f: dict) -> dict:
    """A finding without its stretches of time."""
    return {k: f.get(k) for k in ("effect", "confidence", "indistinguishable", "alternatives", "regime", "parameters", "held_out", "separating_experiment")} | {
        "joints": f["where"]["joints"]}  # fmt: skip
