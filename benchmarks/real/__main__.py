"""Diagnose real recordings: python -m benchmarks.real bam|emps|sage DATA_DIR [out=DIR]. One JSON line at the end."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from dexsim.cli.ending import guard
from dexsim.errors import UserError

USAGE = """usage: python -m benchmarks.real bam|emps|sage DATA_DIR [out=out/real]

DATA_DIR is where you put the downloaded recordings (BAM's raw/*.json; EMPS' *.mat; SAGE's motions as npz with so101.xml).
"""


def bam(data: Path, out: Path) -> dict:
    """Leave one gain out: each of the 16 recordings run free in closed loop, with everything chosen on the other three gains."""
    from benchmarks.real.convert_bam import convert
    from dexsim.gap.diagnosis import Settings, diagnose, save

    made = convert(data, out / "recordings")
    errors, found, seconds = {}, {}, []
    for gain in sorted(set(made.gains.values())):
        held = [p for p in made.recordings if made.gains[p.name] == gain]
        rest = [p for p in made.recordings if p not in held]
        start = time.perf_counter()
        d = diagnose(Settings(rest, out / f"gain_{gain}", held, str(made.model), str(made.servo), next_recording=False), say=lambda _: None)
        seconds.append(time.perf_counter() - start)
        save(d, out / f"gain_{gain}")
        found[gain] = [f"{f['effect']} {f['confidence']:.2f}" for f in d.data["findings"]]
        for (_, recording), (before, after) in d.mae.items():
            errors[recording] = (before, after)
        print(f"gain {gain} left out: {d.data['verdict']}, {', '.join(found[gain]) or 'nothing'}; position MAE "
              f"{1e3 * np.mean([errors[p.name][1] for p in held]):.1f} mrad ({seconds[-1]:.0f} s)", flush=True)  # fmt: skip
    table = {p.name: round(1e3 * errors[p.name][1], 1) for p in made.recordings}
    return {"benchmark": "bam", "mae_mrad": float(1e3 * np.mean([e[1] for e in errors.values()])),
            "mae_before_mrad": float(1e3 * np.mean([e[0] for e in errors.values()])), "to_beat_mrad": 52.3, "coulomb_viscous_mrad": 64.1,
            "found": found, "by_recording": table, "seconds": round(sum(seconds), 1)}  # fmt: skip


def emps(data: Path, out: Path) -> dict:
    """Fitted on the estimation data, judged on the pulses."""
    from benchmarks.real.convert_emps import REFERENCE, convert
    from dexsim.gap.diagnosis import Settings, diagnose, save

    made = convert(data, out / "recordings")
    start = time.perf_counter()
    d = diagnose(Settings([made.estimation], out, [made.pulses], str(made.model), str(made.servo), next_recording=False), say=lambda _: None)
    save(d, out)
    return {"benchmark": "emps", "verdict": d.data["verdict"], "found": {f["effect"]: f["parameters"] for f in d.data["findings"]},
            "nuisance": d.data["nuisance"], "reference": REFERENCE, "held_out": d.data["held_out"], "joints": d.joints,
            "seconds": round(time.perf_counter() - start, 1)}  # fmt: skip


def sage(data: Path, out: Path) -> dict:
    """Twenty motions to fit, ten held out; by joint."""
    from benchmarks.real.convert_sage import convert
    from dexsim.gap.diagnosis import Settings, diagnose, save

    made = convert(data, out / "recordings")
    start = time.perf_counter()
    d = diagnose(Settings(made.recordings, out, made.held_out, str(made.model), str(made.servo), next_recording=False), say=lambda _: None)
    save(d, out)
    found: dict[str, list[str]] = {}
    for f in d.data["findings"]:
        for j in f["where"]["joints"]:
            found.setdefault(j, []).append(f"{f['effect']} {f['confidence']:.2f}")
    rows = {j: {"before_mrad": round(1e3 * v["before"], 2), "after_mrad": round(1e3 * v["after"], 2), "found": found.get(j, [])} for j, v in d.joints.items()}
    return {"benchmark": "sage", "verdict": d.data["verdict"], "joints": rows, "seconds": round(time.perf_counter() - start, 1)}


JOBS = {"bam": bam, "emps": emps, "sage": sage}


def main(argv: list[str]) -> int:
    """Runs one benchmark; returns the exit status."""
    plain = [a for a in argv if "=" not in a]
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    if len(plain) != 2 or plain[0] not in JOBS or set(given) - {"out"}:
        print(USAGE, end="")
        return 0 if plain[:1] in (["-h"], ["--help"]) else 2
    data = Path(plain[1]).expanduser()
    if not data.is_dir():
        raise UserError(f"{data} is not a folder; download the recordings first (see benchmarks/real/convert_{plain[0]}.py for where from)")
    from dexsim.cli.build import quiet_warp

    quiet_warp("cpu")
    print(json.dumps(JOBS[plain[0]](data, Path(given.get("out", f"out/real/{plain[0]}")))))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
