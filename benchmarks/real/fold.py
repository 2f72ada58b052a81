"""One fold of BAM, one joint of SAGE: a process of its own each; and a finding as the summaries keep it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any


def fold(job: tuple[Path, Path, int]) -> dict:
    """Return one gain of BAM left out: fitted on the other three, judged on its four recordings."""
    from benchmarks.real.convert_bam import convert
    from dexsim.gap.diagnosis import Settings, diagnose, save
    from dexsim.sim.quiet import quiet_warp

    data, out, gain = job
    quiet_warp("cpu")
    made = convert(data, out / f"recordings_{gain}")
    held = [p for p in made.recordings if made.gains[p.name] == gain]
    rest = [p for p in made.recordings if p not in held]
    start = time.perf_counter()
    name = f"gain_{gain}"
    d = diagnose(
        Settings(rest, out / name, held, str(made.model), str(made.servo), next_recording=False), say=_log(out, name)
    )
    save(d, out / name)
    return _keep(
        out,
        name,
        {
            "gain": gain,
            "verdict": d.data["verdict"],
            "floor_rad": d.data["noise_floor"]["position_rad"],
            "findings": [brief(f) for f in d.data["findings"]],
            "nuisance": d.data["nuisance"],
            "recordings": {name: [before, after] for (_, name), (before, after) in d.mae.items()},
            "notes": d.notes,
            "stages": d.stages,
            "depends_on": d.data["unexplained"]["depends_on"],
            "seconds": round(time.perf_counter() - start, 1),
        },
    )


def joint(job: tuple[Any, Path, str]) -> dict:
    """Return one joint of SAGE: fitted on the motions to fit, judged on those held out."""
    from dexsim.gap.diagnosis import Settings, diagnose, save
    from dexsim.sim.quiet import quiet_warp

    made, out, name = job
    quiet_warp("cpu")
    start = time.perf_counter()
    d = diagnose(
        Settings(
            made.recordings,
            out / name,
            made.held_out,
            str(made.model),
            str(made.servo),
            next_recording=False,
            joints={name},
        ),
        say=_log(out, name),
    )
    save(d, out / name)
    v = d.joints[name]
    return _keep(
        out,
        name,
        {
            "joint": name,
            "verdict": d.data["verdict"],
            "before_mrad": round(1e3 * v["before"], 2),
            "after_mrad": round(1e3 * v["after"], 2),
            "as_fitted_mrad": round(1e3 * v.get("as_fitted", v["after"]), 2),  # whatever the motions kept out say of it
            "findings": [brief(f) for f in d.data["findings"]],
            "nuisance": d.data["nuisance"],
            "held_out": d.data["held_out"],
            "recordings": {r: [before, after] for (_, r), (before, after) in d.mae.items()},
            "notes": d.notes,
            "scanned": [x for o in d.outcomes for x in o.scanned[:8]],
            "depends_on": d.data["unexplained"]["depends_on"],
            "seconds": round(time.perf_counter() - start, 1),
        },
    )


def finger(job: tuple[Path, Path, str, str, tuple[str, ...], tuple[str, ...]]) -> dict:
    """Runs of one ergoCub finger: fitted on the first names, judged on the second (none: on every fourth clip of the
    first)."""
    from benchmarks.real.convert_ergocub import KEPT, convert, repeat_noise
    from dexsim.gap.diagnosis import Settings, diagnose, save
    from dexsim.sim.quiet import quiet_warp

    data, out, name, which, fitted, held = job
    quiet_warp("cpu")
    made = convert(data, out / f"recordings_{name}")
    start = time.perf_counter()
    clips, judged = [p for n in fitted for p in made.runs[n]], [p for n in held for p in made.runs[n]]
    if not held:
        judged = clips[KEPT - 1 :: KEPT]
        clips = [p for p in clips if p not in judged]
    d = diagnose(
        Settings(clips, out / name, judged or None, str(made.model), str(made.servo), next_recording=False),
        say=_log(out, name),
    )
    save(d, out / name)
    v, plain = d.joints.get("joint", {}), d.data["baseline"]
    named = [f for f in d.data["findings"] if f["effect"] != "bad_channel"]
    return _keep(
        out,
        name,
        {
            "name": name,
            "finger": which,
            "fitted": fitted,
            "held_out": held,
            "verdict": d.data["verdict"],
            "sentence": d.sentence,
            "clips": [len(clips), len(judged)],
            "first_name": named[0]["effect"] if named else None,
            "findings": [brief(f) for f in d.data["findings"]],
            "before_mrad": _milli(v.get("before")),
            "after_mrad": _milli(v.get("after")),
            "plain_mrad": _milli(plain.get("error")),
            "plain": plain.get("joints", {}).get("joint", {}).get("parameters"),
            "less_than_plain": round(1 - v["after"] / plain["error"], 3) if v and plain else None,
            "repeat_noise_mrad": {n: _milli(repeat_noise(data, n)) for n in (*fitted, *held)},
            "floor_mrad": _milli(d.data["noise_floor"]["position_rad"]),
            "nuisance": d.data["nuisance"],
            "stages": d.stages,
            "depends_on": d.data["unexplained"]["depends_on"],
            "notes": d.notes,
            "seconds": round(time.perf_counter() - start, 1),
        },
    )


def _milli(x: float | None) -> float | None:
    return None if x is None or x != x else round(1e3 * x, 2)


def _log(out: Path, name: str):
    """Return the progress of a part into out/NAME.log."""
    out.mkdir(parents=True, exist_ok=True)
    path, begin = out / f"{name}.log", time.perf_counter()
    path.write_text("", encoding="utf-8")

    def say(text: str) -> None:
        with path.open("a", encoding="utf-8") as f:
            f.write(f"{time.perf_counter() - begin:6.0f} s  {text}\n")

    return say


def _keep(out: Path, name: str, result: dict) -> dict:
    """Return the result, written to out/NAME.json as well."""
    (out / f"{name}.json").write_text(json.dumps(result, default=float), encoding="utf-8")
    return result


def brief(f: dict) -> dict:
    """Return a finding without its stretches of time."""
    return {
        k: f.get(k)
        for k in (
            "effect",
            "confidence",
            "indistinguishable",
            "alternatives",
            "regime",
            "parameters",
            "held_out",
            "separating_experiment",
        )
    } | {"joints": f["where"]["joints"]}
