"""One diagnosis of a data set, in a process of its own: a fold of BAM, a joint of SAGE, runs of an ergoCub finger."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any


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


def fold(job: tuple[Path, Path, int]) -> dict:
    """Return one gain of BAM left out: fitted on the other three, judged on its four recordings."""
    from benchmarks.real.convert_bam import convert

    data, out, gain = job
    made = convert(data, out / f"recordings_{gain}")
    held = [p for p in made.recordings if made.gains[p.name] == gain]
    rest = [p for p in made.recordings if p not in held]
    name = f"gain_{gain}"
    return _keep(out, name, {"gain": gain, **diagnosed(out, name, rest, held, made)[1]})


def joint(job: tuple[Any, Path, str]) -> dict:
    """Return one joint of SAGE: fitted on the motions to fit, judged on those held out."""
    made, out, name = job
    d, said = diagnosed(out, name, made.recordings, made.held_out, made, joints={name})
    v = d.joints[name]
    errors = {f"{k}_mrad": milli(v[k]) for k in ("before", "after")}
    return _keep(out, name, {"joint": name, **errors, **said})


def finger(job: tuple[Path, Path, str, str, tuple[str, ...], tuple[str, ...]]) -> dict:
    """Return runs of one ergoCub finger: fitted on the first names, judged on the second (none: on every fourth clip of
    the first)."""
    from benchmarks.real.convert_ergocub import KEPT, convert, repeat_noise

    data, out, name, which, fitted, held = job
    made = convert(data, out / f"recordings_{name}")
    clips, judged = [p for n in fitted for p in made.runs[n]], [p for n in held for p in made.runs[n]]
    if not held:
        judged = clips[KEPT - 1 :: KEPT]
        clips = [p for p in clips if p not in judged]
    d, said = diagnosed(out, name, clips, judged, made)
    v, plain = d.joints.get("joint", {}), d.data["baseline"]
    named = [f["effect"] for f in d.data["findings"] if f["effect"] != "bad_channel"]
    return _keep(
        out,
        name,
        {
            "name": name,
            "finger": which,
            "fitted": fitted,
            "kept_out": held,
            "clips": [len(clips), len(judged)],
            "first_name": named[0] if named else None,
            "before_mrad": milli(v.get("before")),
            "after_mrad": milli(v.get("after")),
            "plain_mrad": milli(plain.get("error")),
            "plain": plain.get("joints", {}).get("joint", {}).get("parameters"),
            "less_than_plain": round(1 - v["after"] / plain["error"], 3) if v and plain else None,
            "repeat_noise_mrad": {n: milli(repeat_noise(data, n)) for n in (*fitted, *held)},
            **said,
        },
    )


def milli(x: float | None) -> float | None:
    """Return thousandths, to two digits; None for what is not known."""
    return None if x is None or x != x else round(1e3 * x, 2)


def _keep(out: Path, name: str, result: dict) -> dict:
    """Return the result, written to out/NAME.json as well."""
    (out / f"{name}.json").write_text(json.dumps(result, default=float), encoding="utf-8")
    return result


def brief(f: dict) -> dict:
    """Return a finding without its stretches of time."""
    keys = ("effect", "confidence", "indistinguishable", "alternatives", "regime", "parameters", "held_out",
            "separating_experiment")  # fmt: skip
    return {k: f.get(k) for k in keys} | {"joints": f["where"]["joints"]}
