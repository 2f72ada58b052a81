"""What `diagnose` writes on real machines, replayed, beside what is believed and plain least squares.

    python -m benchmarks.real.written [sets=igris,igris_other,igris_pair,sage,ergocub,bam,panda] [data=PATH]
                                      [out=out/real/written] [jobs=1] [limit=0] [hand=300] [only=NAME]

Of each set (a part of one: a gain, a finger, a joint) `diagnose` is run, then `play replay=` on every recording that
was held out with the files that it wrote, and a least squares of our own (`baseline.py`) is fitted to the same
recordings. By joint: rms of what was held out as believed, by our own least squares (written and replayed likewise,
all joints together), by the tool's plain fit (likewise), as reported (`held_out.replayed`) and as `play` prints it.
Passed where the last is within a tenth of what was reported, and at most 1.05 x the better of belief and plain. limit:
seconds a diagnosis may take (0: none); hand: those of our own fit of a joint. Results of each part in out/NAME.json,
all in out/written.json.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import answers
from benchmarks.real import fold
from benchmarks.real.common import Converted
from benchmarks.real.parts import MAKE
from dexsim.console.ending import guard
from dexsim.console.tables import table
from dexsim.errors import UserError

SETS = ("igris", "igris_other", "igris_pair", "sage", "ergocub", "bam", "panda")
FOLDERS = {"sage": "sage_so101", "ergocub": "ergocub_fingers", "bam": "bam_xl330", "panda": "panda"}
SETTINGS = {"sets": ",".join(SETS), "data": "../shared/realdata", "out": "out/real/written", "jobs": 1, "limit": 0,
            "hand": 300, "only": ""}  # fmt: skip
AGREE, WORSE = 0.10, 1.05  # the two criteria
SPLIT = 4  # processes that replay one part's recordings


def diagnosed(job: tuple[Converted, Path, float | None]) -> dict[str, Any]:
    """Diagnose one part and write its files."""
    part, out, limit = job
    judged = None if part.judged is None else set(part.judged)
    d, said = fold.diagnosed(out, part.name, part.recordings, part.held_out, part, joints=judged, limit=limit)
    reported = said["held_out"].get("replayed")
    rows, parts = {}, [] if reported is None else reported["parts"]
    for joint, v in d.joints.items():
        w = d.written
        errors_of = {} if w is None else w.errors[joint]
        rows[joint] = {
            "believed": errors_of.get("believed"),
            "plain": errors_of.get("plain"),
            "candidates": errors_of,
            "written": None if w is None else w.chosen[joint],
            "by_search": {"before": v["before"], "after": v["after"]},
            "reported": None if reported is None else reported["joints"].get(joint),
        }
    result = {
        "part": part.name,
        **said,
        "joints": rows,
        "parts": parts,
        "reported": None if reported is None else reported["error"],
        "floor": d.data["noise_floor"],
        "baseline": d.data["baseline"],
    }
    (out / f"{part.name}.json").write_text(json.dumps(result, default=float), encoding="utf-8")
    return result


def play(job: tuple[Converted, Path, dict[int, dict[str, Any]]]) -> dict[str, list[float]]:
    """Return by joint (sum of squares, number) of what `play.py replay=` misses with the files in a folder, by the rms
    [rad or m] that it prints, of parts of recordings by their number."""
    from dexsim.cli import recorded
    from dexsim.gap.read.channels import own_readings
    from dexsim.paths import CONFIGS
    from dexsim.recording import read
    from dexsim.sim.quiet import quiet_warp

    part, folder, parts = job
    quiet_warp("cpu")
    files, missed = {p.name: p for p in (*part.recordings, *part.held_out)}, {}
    model = folder / "model.xml" if (folder / "model.xml").is_file() else part.model
    for k, x in parts.items():
        out = folder / "play" / str(k)
        argv = [f"replay={files[x['recording']]}", f"model={model}", f"servo={folder / 'servo.yaml'}", "video=false",
                f"out={out}", f"start={x['start']}", f"end={x['end']}"]  # fmt: skip
        with contextlib.redirect_stdout(io.StringIO()):
            recorded.run(recorded.settings(argv, CONFIGS))
        said, recording = json.loads((out / "metrics.json").read_text(encoding="utf-8")), read(files[x["recording"]])
        state = recording.states.position
        on = (state.t >= x["start"] - 1e-9) & (state.t <= x["end"] + 1e-3)
        for joint, error in said["position_rmse_rad"].items():
            if error is not None and joint not in said["follow_their_recording"]:
                seen = np.asarray(state.value[:, recording.joints.index(joint)], float)
                count = (on & own_readings(state.t, seen)).sum()  # one sent again tells nothing
                missed[joint] = missed.get(joint, np.zeros(2)) + np.array([error**2 * count, count])
    return {j: x.tolist() for j, x in missed.items()}


def played(given: dict[str, tuple[Converted, Path, Sequence[dict[str, Any]]]], out: Path, engine: Any) -> dict:
    """Return by name and joint the rms [rad or m] that `play.py replay=` prints over all parts with the files in a
    folder. given: by name of the set's part: it, the folder, what was held out."""
    jobs = {f"{n}.{k}": (p, f, dict(list(enumerate(parts))[k::SPLIT]))
            for n, (p, f, parts) in given.items() for k in range(min(SPLIT, len(parts)))}  # fmt: skip
    total: dict[str, dict[str, np.ndarray]] = {n: {} for n in given}
    for name, missed in zip(jobs, answers.at_once(play, jobs, out, engine), strict=True):
        for joint, x in missed.items():
            mine = total[name.rpartition(".")[0]]
            mine[joint] = mine.get(joint, np.zeros(2)) + x
    return {n: {j: float(np.sqrt(a / b)) for j, (a, b) in x.items()} for n, x in total.items()}


def by_hand(job: tuple[Converted, Path, str, Sequence[dict[str, Any]], float]) -> dict[str, Any]:
    """Fit our own least squares to one joint of a part. held: parts of recordings that were held out (none: all
    of those files); limit: seconds."""
    from benchmarks.real import baseline
    from dexsim.recording import mechanism, read
    from dexsim.sim.quiet import quiet_warp

    part, out, joint, held, limit = job
    quiet_warp("cpu")
    begun = time.perf_counter()
    m = mechanism.mechanism(str(part.model), str(part.servo))
    files = {p.name: read(p, joints=m.joints) for p in (*part.recordings, *part.held_out)}
    test = [(files[x["recording"]], x["start"], x["end"]) for x in held]
    test = test or [(files[p.name], 0.0, np.inf) for p in part.held_out]
    if part.held_out:
        train = [(files[p.name], 0.0, np.inf) for p in part.recordings]
    else:
        train = [(r, 0.0, next(x["start"] for x in held if x["recording"] == n)) for n, r in files.items()]
    found = baseline.fit(m, joint, train, test, limit=limit) | {"part": part.name, "joint": joint}
    found["seconds"] = time.perf_counter() - begun
    (out / f"{part.name}.{joint}.hand.json").write_text(json.dumps(found, default=float), encoding="utf-8")
    return found


def write_hand(part: Converted, folder: Path, hand: dict[str, dict[str, Any]]) -> None:
    """Write our own least squares of all joints of a part as `diagnose` writes its answer."""
    from dexsim.actuator.columns import INDEX
    from dexsim.gap.effects.body import add_armature
    from dexsim.gap.judge.handed_on import save_model
    from dexsim.recording import mechanism

    m = mechanism.mechanism(str(part.model), str(part.servo))
    table = m.table
    table.fitted = {}
    for joint, found in hand.items():
        x, row = found["figures"], m.table.nominal([joint])[0]
        table.fitted[joint] = {"kp": x["kp"], "torque_limit": x["limit"]}
        if row[INDEX["kd"]] > 0:
            table.fitted[joint]["kd"] = x["kd"]
        else:
            table.set(joint, "kd", x["kd"])
        for name, factor in table.fitted[joint].items():
            table.set(joint, name, factor * min(float(row[INDEX[name]]), 1e9))
        for name, column in (("coulomb", "coulomb_friction"), ("viscous", "viscous_friction"), ("delay", "delay"),
                             ("lag", "lag"), ("offset", "standin_constant")):  # fmt: skip
            table.set(joint, column, x[name])
        add_armature(m.spec, joint, x["inertia"])
    folder.mkdir(parents=True, exist_ok=True)
    table.save(folder / "servo.yaml")
    save_model(m.spec, folder / "model.xml")


def judged(row: dict[str, Any]) -> dict[str, bool | None]:
    """Return the two criteria of a joint; None where neither can be said."""
    replayed, reported, plain, believed = (row.get(k) for k in ("replayed", "reported", "plain", "believed"))
    if replayed is None or reported is None:
        return {"as_reported": None, "no_worse": None}
    least = min(x for x in (plain, believed) if x is not None)
    return {"as_reported": abs(replayed - reported) <= AGREE * reported, "no_worse": replayed <= WORSE * least}


def text_of(results: Sequence[dict[str, Any]]) -> str:
    """Return the table."""
    rows, errors = [], ("believed", "by hand", "plain", "reported", "replayed")
    mrad = lambda x: "-" if x is None else f"{1e3 * x:.3g}"  # noqa: E731
    word = {True: "pass", False: "FAIL", None: "-"}
    for r in results:
        for joint, row in r["joints"].items():
            passed = judged(row)
            rows.append(
                (
                    r["part"],
                    joint,
                    *(mrad(row.get(k.replace(" ", "_"))) for k in errors),
                    row["written"] or "-",
                    word[passed["as_reported"]],
                    word[passed["no_worse"]],
                )
            )
    head = ("part", "joint", *errors, "written", "as reported", "no worse")
    return table("held out, rms, mrad", head, rows)


def main(argv: list[str]) -> int:
    """Runs the sets; returns the exit status."""
    s, engine = answers.settings(argv, SETTINGS)
    sets = s["sets"].split(",")
    if bad := [x for x in sets if x not in SETS]:
        raise UserError(f"sets={','.join(bad)}: must be of {', '.join(SETS)}")
    data, out, parts = Path(s["data"]), Path(s["out"]), []
    out.mkdir(parents=True, exist_ok=True)
    limit, hand_limit = s["limit"] or None, s["hand"]
    for name in sets:
        folder = data / FOLDERS.get(name, "igris")
        if not folder.is_dir():
            print(json.dumps({"set": name, "skipped": f"{folder} is absent"}))
            continue
        parts += MAKE[name](data if name.startswith("igris") else folder, out, name)
    parts = [p for p in parts if (s["only"] or p.name) == p.name]
    begun = {p.name: (p, out, limit) for p in parts}
    results = {r["part"]: r for r in answers.at_once(diagnosed, begun, out / "searched", engine)}
    each: dict[str, tuple] = {}
    for p in parts:
        r = results[p.name]
        print(f"{p.name}: {r['verdict']}, {r['seconds']:.0f} s: {r['sentence']}", flush=True)
        early = p.judged or () if p.held_out else ()
        joints = dict.fromkeys((*early, *(r["joints"] if r["parts"] else ())))
        each |= {f"{p.name}.{j}": (p, out, j, [] if j in early else r["parts"], hand_limit) for j in joints}
    hand: dict[str, dict[str, dict[str, Any]]] = {p.name: {} for p in parts}
    for found in answers.at_once(by_hand, each, out / "by_hand", engine):
        hand[found["part"]][found["joint"]] = found
    by = {p.name: p for p in parts}
    files = {n: (p, out / n, results[n]["parts"]) for n, p in by.items()}
    whole = {}
    for p in parts:
        r, mine = results[p.name], hand[p.name]
        if r["parts"] and set(r["joints"]) == set(mine):
            for joint, found in mine.items():
                r["joints"][joint]["by_hand_alone"] = found["error"]
            write_hand(p, out / p.name / "by_hand", mine)
            whole[p.name] = (p, out / p.name / "by_hand", r["parts"])
    for key, given, to in (("replayed", files, "play"), ("by_hand", whole, "play_by_hand")):
        for n, errors in played(given, out / to, engine).items():
            for joint, row in results[n]["joints"].items():
                row[key] = errors.get(joint)
    ordered = list(results.values())
    for r in ordered:
        for row in r["joints"].values():
            row["passed"] = judged(row)
    (out / "written.json").write_text(json.dumps(ordered, default=float), encoding="utf-8")
    print("\n" + text_of(ordered))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
