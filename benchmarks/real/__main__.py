"""Diagnose real recordings: python -m benchmarks.real bam|emps|sage|panda|ergocub data=PATH [out=DIR] [jobs=1]. One
JSON line at the end."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import answers
from benchmarks.real import parts
from benchmarks.real.common import Converted
from benchmarks.real.fold import diagnosed, milli, one
from dexsim import intervals
from dexsim.console.ending import guard
from dexsim.console.jobs import Engine
from dexsim.errors import UserError

USAGE = """\
usage: python -m benchmarks.real bam|emps|sage|panda|ergocub [data=PATH] [out=out/real/NAME] [jobs=1] [fit=20]

data: where you put the downloaded recordings (BAM's raw/*.json; EMPS' *.mat; SAGE's motions as npz with so101.xml;
the Panda's trajectory; the ergoCub fingers' runs), or the folder of all of them with one folder each; without it
../shared/realdata is looked for. Where the data is absent a line says so and nothing is run. jobs: of BAM's four
gains left out in turn, SAGE's six joints or ergoCub's fingers, how many at a time, each in a process of its own; fit:
of SAGE's twenty motions, how many to fit. Each part's result is written to out/ as it is done; the whole to
out/NAME.json.
"""
FOLDERS = {"bam": "bam_xl330", "emps": "emps", "sage": "sage_so101", "panda": "panda", "ergocub": "ergocub_fingers"}


def bam(data: Path, out: Path, engine: Engine) -> dict:
    """Leave one gain out: each of the 16 recordings run free in closed loop, with everything chosen on the other three
    gains."""
    folds = _each(parts.bam(data, out, "bam"), out, engine)
    for done in folds:
        print(
            f"{done['name']} left out: {done['verdict']}, "
            f"{', '.join(_named(f) for f in done['findings']) or 'nothing'}; position MAE "
            f"{1e3 * np.mean([e[1] for e in done['recordings'].values()]):.1f} mrad ({done['seconds']:.0f} s)",
            flush=True,
        )
    errors = {k: v for f in folds for k, v in f["recordings"].items()}
    x = np.array(list(errors.values()))
    low, high = intervals.bootstrap((x[:, 1],), np.mean, 0, 2000)
    return {
        "benchmark": "bam",
        "mae_mrad": float(1e3 * x[:, 1].mean()),
        "mae_low_mrad": float(1e3 * low),
        "mae_high_mrad": float(1e3 * high),
        "mae_before_mrad": float(1e3 * x[:, 0].mean()),
        "to_beat_mrad": 52.3,
        "coulomb_viscous_mrad": 64.1,
        "by_recording_mrad": {k: [round(1e3 * a, 1), round(1e3 * b, 1)] for k, (a, b) in sorted(errors.items())},
        "folds": folds,
    }


def _each(given: Sequence[Converted], out: Path, engine: Engine) -> list[dict]:
    """Return what a diagnosis says of each part, each a job of its own."""
    return list(answers.at_once(one, {p.name: (p, out) for p in given}, out, engine))


def _named(f: dict) -> str:
    return f"{f['effect']} {f['confidence']:.2f}"


def emps(data: Path, out: Path, engine: Engine) -> dict:
    """Return what was fitted to the estimation data and judged on the pulses: by the search in closed loop, and by the
    tool's own stage for a logged motor torque."""
    from benchmarks.real.convert_emps import REFERENCE, convert, load, stretch

    made = convert(data, out / "recordings")
    d, said = diagnosed(out, "found", made.recordings, made.held_out, made)
    result = {"benchmark": "emps", "reference": REFERENCE, "joints": d.joints, **said}
    found = _emps_parameters(d)
    result["found"] = found
    result["off_percent"] = {k: round(100 * (found[k] / REFERENCE[k] - 1), 2) for k in REFERENCE}
    # the tool's own stage for a logged motor torque, as its report has it
    from dexsim.gap.search.inverse_dynamics import columns_of, highest, solve

    given = [load(data, n)[:3] for n in ("estimation", "pulses")]
    at = lambda cutoff: tuple(columns_of([stretch(*x, cutoff)], 0) for x in given)  # noqa: E731
    tool = solve(at, highest(given[0][0]))
    names = {"mass": "inertia", "viscous": "viscous_friction", "coulomb": "coulomb_friction", "offset": "offset"}
    by = {k: tool.value[n] for k, n in names.items()}
    result["inverse"] = {
        "value": by,
        "low": {k: tool.low[n] for k, n in names.items()},
        "high": {k: tool.high[n] for k, n in names.items()},
        "off_percent": {k: round(100 * (by[k] / REFERENCE[k] - 1), 3) for k in by},
        "residual": tool.residual,
        "named": [
            {k: getattr(n, k) for k in ("text", "effect", "value", "low", "high", "share")}
            | {"before_N": n.before, "after_N": n.after}
            for n in tool.named
        ],
    }
    return result


def _emps_parameters(d) -> dict[str, float]:
    """Return the mass, viscous and dry friction, offset of the fitted drive as servo.yaml and the nuisances have them,
    in the literature's terms."""
    from dexsim.actuator.columns import INDEX

    row = d.servo.nominal(("carriage",))[0]
    get = lambda n: float(row[INDEX[n]])  # noqa: E731
    mass = 95.0 * float(d.data["nuisance"].get("inertia_factor@carriage", 1.0))
    return {
        "mass": mass,
        "viscous": get("viscous_friction"),
        "coulomb": get("coulomb_friction"),
        "offset": 0.5 * get("friction_asymmetry") * get("coulomb_friction"),
    }


def sage(data: Path, out: Path, engine: Engine, fit: int = 0) -> dict:
    """Return the twenty motions to fit (or `fit` of them, evenly), ten held out; joint by joint, the others' motion
    prescribed."""
    from benchmarks.real.convert_sage import JOINTS

    given = {p.judged[0]: p for p in parts.sage(data, out, "sage")}
    if fit:
        for p in given.values():
            p.recordings = p.recordings[:: max(len(p.recordings) // fit, 1)][:fit]
    start = time.perf_counter()
    done = _each([given[j] for j in HARD], out, engine)
    rows = {r["name"].removeprefix("sage_"): r | r["joints"][r["name"].removeprefix("sage_")] for r in done}
    for joint, row in rows.items():
        print(
            f"{joint:<12} {row['before_mrad']:>7} -> {row['after_mrad']:>6} mrad  "
            f"{', '.join(_named(f) for f in row['findings']) or '-'} "
            f"({row['seconds']:.0f} s)",
            flush=True,
        )
    return {
        "benchmark": "sage",
        "fitted_motions": len(given["Jaw"].recordings),
        "commands_logged_late": given["Jaw"].late,
        "joints": {j: rows[j] for j in JOINTS},
        "seconds": round(time.perf_counter() - start, 1),
    }


def panda(data: Path, out: Path, engine: Engine) -> dict:
    """Dry friction of seven joints under gravity, from their torque sensors; the last quarter of the one trajectory is
    kept out."""
    from benchmarks.real.convert_panda import JOINTS, convert, plain
    from dexsim.gap.rules import JUDGE

    made = convert(data, out / "recordings")
    d, said = diagnosed(out, "found", made.recordings, [], made)
    rows, plainly = {}, plain(data, 1 - JUDGE.kept_end)
    for j in JOINTS:
        v = d.servo.value(j, "coulomb_friction")
        x = plainly[j]
        rows[j] = {"handed_on": None if v.unknown else v.value, "low": v.low, "high": v.high, "plain": x,
                   "inside": bool(not v.unknown and x["low"] <= v.value <= x["high"]), "sigma": d.joints.get(j)}
    inside = sum(r["inside"] for r in rows.values())
    return {"benchmark": "panda", "inside": inside, "of": len(JOINTS), "joints": rows, **said}


def ergocub(data: Path, out: Path, engine: Engine) -> dict:
    """Return each run of a finger alone, every fourth clip kept out; and each finger's runs together, every third
    kept out."""
    from benchmarks.real.convert_ergocub import FINGERS, repeat_noise

    start, rows = time.perf_counter(), {}
    for r in _each(parts.ergocub(data, out, "runs"), out, engine):
        v, plain = r["joints"].get("joint", {}), milli(r["plain"].get("error"))
        if v and plain:
            r |= {**v, "plain_mrad": plain, "less_than_plain": round(1 - v["after_mrad"] / plain, 3)}
        r["first_name"] = next((f["effect"] for f in r["findings"] if f["effect"] != "bad_channel"), None)
        rows[r["name"]] = r
        print(f"{r['name']:<20} {r['verdict']:<16} plain {plain} -> {v.get('after_mrad')} mrad  "
              f"{', '.join(_named(f) for f in r['findings']) or '-'} ({r['seconds']:.0f} s)", flush=True)
    runs = [run for runs in FINGERS.values() for run in runs]
    return {
        "benchmark": "ergocub",
        "first_name_by_run": {which: {r: rows[r]["first_name"] for r in runs} for which, runs in FINGERS.items()},
        "dead_encoder_named": any(f["effect"] == "bad_channel" for f in rows["thumb1"]["findings"]),
        "repeat_noise_mrad": {run: milli(repeat_noise(data, run)) for run in runs},
        "runs": rows,
        "seconds": round(time.perf_counter() - start, 1),
    }


HARD = ("Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Rotation", "Jaw")  # the longest to search first
JOBS = {"bam": bam, "emps": emps, "sage": sage, "panda": panda, "ergocub": ergocub}


def folder(name: str, given: str) -> Path | None:
    """Return the folder of a data set; None where none was given and none lies beside the project. UserError where
    the given one is not there."""
    root = Path(given).expanduser() if given else Path("../shared/realdata")
    inner = root / FOLDERS[name]
    if inner.is_dir():
        return inner
    if given and not root.is_dir():
        raise UserError(
            f"data={given} is not a folder; download the recordings first (benchmarks/real/convert_{name}.py says "
            "where from)"
        )
    return root if given else None


def main(argv: list[str]) -> int:
    """Runs one benchmark; returns the exit status."""
    name = argv[0] if argv else ""
    if name not in JOBS:
        print(USAGE, end="")
        return 2
    s, engine = answers.settings(argv[1:], {"data": "", "out": f"out/real/{name}", "jobs": 1, "fit": 0})
    data = folder(name, s["data"])
    if data is None:
        skipped = (f"../shared/realdata/{FOLDERS[name]} is absent; data=PATH names the recordings "
                   f"(benchmarks/real/convert_{name}.py says where from)")  # fmt: skip
        print(json.dumps({"benchmark": name, "skipped": skipped}))
        return 0
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    out = Path(s["out"])
    result = JOBS[name](data, out, engine, *[s["fit"]] * (name == "sage"))
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(result, default=float)
    (out / f"{name}.json").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], USAGE))
