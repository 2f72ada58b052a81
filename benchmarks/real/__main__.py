"""Diagnose real recordings: python -m benchmarks.real bam|emps|sage|panda|ergocub data=PATH [out=DIR] [jobs=1]. One
JSON line at the end."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.real.fold import diagnosed, finger, fold, joint
from dexsim import intervals
from dexsim.console.ending import guard
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


def bam(data: Path, out: Path, jobs: int) -> dict:
    """Leave one gain out: each of the 16 recordings run free in closed loop, with everything chosen on the other three
    gains."""
    from benchmarks.real.convert_bam import convert

    gains = sorted(set(convert(data, out / "recordings").gains.values()))
    folds = []
    for done in _parts(fold, [(data, out, g) for g in gains], jobs):
        folds.append(done)
        print(
            f"gain {done['gain']} left out: {done['verdict']}, "
            f"{', '.join(_named(f) for f in done['findings']) or 'nothing'}; position MAE "
            f"{1e3 * np.mean([e[1] for e in done['recordings'].values()]):.1f} mrad ({done['seconds']:.0f} s)",
            flush=True,
        )
    folds.sort(key=lambda f: f["gain"])
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


def _parts(work: Callable, given: Sequence[tuple], jobs: int):
    """Yield the results of work(x) for each x as they come, `jobs` at a time in processes of their own."""
    with ProcessPoolExecutor(max(jobs, 1), mp_context=get_context("spawn")) as pool:
        for done in as_completed([pool.submit(work, x) for x in given]):
            yield done.result()


def _named(f: dict) -> str:
    return f"{f['effect']} {f['confidence']:.2f}"


def emps(data: Path, out: Path, jobs: int) -> dict:
    """Return what was fitted to the estimation data and judged on the pulses: by the search in closed loop, and by the
    tool's own stage for a logged motor torque."""
    from benchmarks.real.convert_emps import FILES, REFERENCE, convert, load

    made = convert(data, out / "recordings")
    d, said = diagnosed(out, "found", [made.estimation], [made.pulses], made)
    result = {"benchmark": "emps", "reference": REFERENCE, "joints": d.joints, **said}
    found = _emps_parameters(d)
    result["found"] = found
    result["off_percent"] = {k: round(100 * (found[k] / REFERENCE[k] - 1), 2) for k in REFERENCE}
    # the tool's own stage for a logged motor torque, as its report has it
    from dexsim.gap.search.inverse_dynamics import identify

    given = {n: load(data, n)[:3] for n in FILES}
    tool = identify(*given["estimation"], test=given["pulses"])
    names = {"mass": "inertia", "viscous": "viscous_friction", "coulomb": "coulomb_friction", "offset": "offset"}
    by = {k: tool.value[n] for k, n in names.items()}
    result["inverse"] = {
        "value": by,
        "low": {k: tool.low[n] for k, n in names.items()},
        "high": {k: tool.high[n] for k, n in names.items()},
        "off_percent": {k: round(100 * (by[k] / REFERENCE[k] - 1), 3) for k in by},
        "extra": tool.extra[:3],
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


def sage(data: Path, out: Path, jobs: int, fit: int = 0) -> dict:
    """Return the twenty motions to fit (or `fit` of them, evenly), ten held out; joint by joint, the others' motion
    prescribed."""
    from benchmarks.real.convert_sage import JOINTS, convert

    made = convert(data, out / "recordings")
    if fit:
        made.recordings = made.recordings[:: max(len(made.recordings) // fit, 1)][:fit]
    start = time.perf_counter()
    rows = {}
    for done in _parts(joint, [(made, out, j) for j in sorted(JOINTS, key=HARD.index)], jobs):
        rows[done["joint"]] = done
        print(
            f"{done['joint']:<12} {done['before_mrad']:>7} -> {done['after_mrad']:>6} mrad  "
            f"{', '.join(_named(f) for f in done['findings']) or '-'} "
            f"({done['seconds']:.0f} s)",
            flush=True,
        )
    return {
        "benchmark": "sage",
        "fitted_motions": len(made.recordings),
        "commands_logged_late": made.late,
        "joints": {j: rows[j] for j in JOINTS},
        "seconds": round(time.perf_counter() - start, 1),
    }


def panda(data: Path, out: Path, jobs: int) -> dict:
    """Dry friction of seven joints under gravity, from their torque sensors; the last quarter of the one trajectory is
    kept out."""
    from benchmarks.real.convert_panda import JOINTS, convert, plain
    from dexsim.gap.rules import JUDGE

    made = convert(data, out / "recordings")
    d, said = diagnosed(out, "found", [made.recording], [], made)
    rows, plainly = {}, plain(data, 1 - JUDGE.kept_end)
    for j in JOINTS:
        v = d.servo.value(j, "coulomb_friction")
        x = plainly[j]
        rows[j] = {"handed_on": None if v.unknown else v.value, "low": v.low, "high": v.high, "plain": x,
                   "inside": bool(not v.unknown and x["low"] <= v.value <= x["high"]), "sigma": d.joints.get(j)}
    inside = sum(r["inside"] for r in rows.values())
    return {"benchmark": "panda", "inside": inside, "of": len(JOINTS), "joints": rows, **said}


def ergocub(data: Path, out: Path, jobs: int) -> dict:
    """Return each run of a finger alone, every fourth clip kept out; and each finger's runs together, every third
    kept out."""
    from benchmarks.real.convert_ergocub import FINGERS, held_out

    work = [(data, out, run, which, (run,), ()) for which, runs in FINGERS.items() for run in runs]
    for which, runs in FINGERS.items():
        held = held_out(which)
        work += [(data, out, f"all_{which}", which, tuple(r for r in runs if r not in held), held)] if held else []
    start, rows = time.perf_counter(), {}
    for done in _parts(finger, work, jobs):
        rows[done["name"]] = done
        print(f"{done['name']:<16} {done['verdict']:<16} plain {done['plain_mrad']} -> {done['after_mrad']} mrad  "
              f"{', '.join(_named(f) for f in done['findings']) or '-'} ({done['seconds']:.0f} s)", flush=True)
    rows = {x[2]: rows[x[2]] for x in work}
    first = {which: {r: rows[r]["first_name"] for r in runs} for which, runs in FINGERS.items()}
    return {
        "benchmark": "ergocub",
        "first_name_by_run": first,
        "dead_encoder_named": any(f["effect"] == "bad_channel" for f in rows["thumb1"]["findings"]),
        "runs": rows,
        "seconds": round(time.perf_counter() - start, 1),
    }


HARD = ("Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Rotation", "Jaw")  # the longest to search first
JOBS = {"bam": bam, "emps": emps, "sage": sage, "panda": panda, "ergocub": ergocub}


def folder(name: str, given: str | None) -> Path | None:
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
    plain = [a for a in argv if "=" not in a]
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    if (
        not plain
        or len(plain) > 2
        or plain[0] not in JOBS
        or set(given) - {"data", "out", "jobs", "fit"}
        or not given.get("jobs", "1").isdigit()
    ):
        print(USAGE, end="")
        return 0 if plain[:1] in (["-h"], ["--help"]) else 2
    data = folder(plain[0], plain[1] if len(plain) == 2 else given.get("data"))
    if data is None:
        print(
            json.dumps(
                {
                    "benchmark": plain[0],
                    "skipped": f"../shared/realdata/{FOLDERS[plain[0]]} is absent; data=PATH names the recordings "
                    f"(benchmarks/real/convert_{plain[0]}.py says where from)",
                }
            )
        )
        return 0
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    out = Path(given.get("out", f"out/real/{plain[0]}"))
    more = {"fit": int(given["fit"])} if "fit" in given and plain[0] == "sage" else {}
    result = JOBS[plain[0]](data, out, int(given.get("jobs", 1)), **more)
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(result, default=float)
    (out / f"{plain[0]}.json").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
