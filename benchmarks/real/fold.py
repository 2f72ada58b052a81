"""One diagnosis of a part of a data set."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.real.common import Converted


def diagnosed(out: Path, name: str, fit: Sequence[Path], held: Sequence[Path], made: Any, **more: Any) -> tuple:
    """Diagnose recordings with the model and servo of converted files. Return the diagnosis and what all summaries
    keep of it.

    It is saved to out/name, its progress to out/name.log. held: recordings kept out (none: the tool's own choice);
    more: further settings.
    """
    from dexsim.gap.diagnosis import Settings, diagnose, save
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    chosen = Settings(list(fit), out / name, list(held) or None, str(made.model), str(made.servo), next_recording=False,
                     **more)  # fmt: skip
    with (out / f"{name}.log").open("w", encoding="utf-8", buffering=1) as log:
        d = diagnose(chosen, say=lambda text: print(f"{time.perf_counter() - start:6.0f} s  {text}", file=log))
    save(d, out / name)
    return d, {
        "verdict": d.data["verdict"],
        "sentence": d.sentence,
        "findings": [brief(f) for f in d.data["findings"]],
        "nuisance": d.data["nuisance"],
        "held_out": d.data["held_out"],
        "floor_mrad": milli(d.data["noise_floor"]["position_rad"]),
        "recordings": {r: [before, after] for (_, r), (before, after) in d.mae.items()},
        "stages": d.stages,
        "depends_on": d.data["unexplained"]["depends_on"],
        "notes": d.notes,
        "shares": d.shares,
        "seconds": round(time.perf_counter() - start, 1),
    }


def one(job: tuple[Converted, Path]) -> dict:
    """Diagnose one part of a data set: fitted on its recordings, judged on those held out. Written to out/NAME.json."""
    part, out = job
    joints = None if part.judged is None else set(part.judged)
    d, said = diagnosed(out, part.name, part.recordings, part.held_out, part, joints=joints)
    errors = {j: {f"{k}_mrad": milli(v.get(k)) for k in ("before", "after")} for j, v in d.joints.items()}
    result = {"name": part.name, "joints": errors, "plain": d.data["baseline"], **said}
    (out / f"{part.name}.json").write_text(json.dumps(result, default=float), encoding="utf-8")
    return result


def milli(x: float | None) -> float | None:
    """Return thousandths, to two digits; None for what is not known."""
    return None if x is None or x != x else round(1e3 * x, 2)


def brief(f: dict) -> dict:
    """Return a finding without its stretches of time."""
    keys = ("effect", "confidence", "indistinguishable", "alternatives", "regime", "parameters", "held_out",
            "separating_experiment")  # fmt: skip
    return {k: f.get(k) for k in keys} | {"joints": f["where"]["joints"]}
