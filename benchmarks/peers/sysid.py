"""`mujoco.sysid` beside `diagnose` on one joint: time, and error of the hidden parameter.

Concealed cases (an independent plant, see `benchmarks/concealed`) of one joint whose hidden effect is a parameter that
both know. Both get the same recordings and the same believed model. `diagnose` has to find which effect it is among its
whole catalogue; `mujoco.sysid` has no such step: once all nine of its parameters are free and the one that is meant is
read off, once it is told which one to fit and believes the rest, which but for the law of friction is right here.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

from benchmarks.concealed.baselines import KINDS
from dexsim.errors import UserError

WHO = ("diagnose", "sysid", "sysid_told")
SEED = 8


def make(number: int, kind: str, root: Path) -> tuple[str, dict]:
    """One case: (its folder's name, its truth)."""
    from benchmarks.concealed import generate

    entry = {"group": "effect", "kinds": [kind], "tier": ("easy", "medium")[number % 2], "shape": "one", "joints": []}
    made = generate.build(entry, number, SEED, root / "cases", root / "truth")
    return made["name"], generate.reveal(root / "truth" / f"{made['name']}.json", made["digest"])


def ours(name: str, truth: dict, root: Path, limit: float) -> dict:
    """diagnose.py on a case as a user would run it."""
    from benchmarks.concealed import __main__ as concealed
    from benchmarks.concealed import score

    concealed._diagnose({"name": name}, {"limit": limit, "budget": 0}, root, time.perf_counter())
    out = root / "diagnoses" / name
    found = json.loads((out / "diagnosis.json").read_text())
    meant = truth["effects"][0]
    finding = next((f for f in found.get("findings", []) if score.named_right(f, meant["effect"])), None)
    errors, _ = score._parameters(
        finding, {"parameters": {KINDS[meant["kind"]][0]: meant["parameters"][KINDS[meant["kind"]][0]]}}
    )
    return {
        "seconds": float((out / "seconds").read_text()),
        "error": errors[0] if errors else None,
        "named": finding is not None,
    }


def theirs(name: str, truth: dict, root: Path, told: bool) -> dict:
    """mujoco.sysid on the same recordings; told: which parameter to fit."""
    from benchmarks.concealed import baselines

    rig = baselines.Rig(root / "cases" / name)
    key, parameter, read = KINDS[truth["effects"][0]["kind"]]
    start = time.perf_counter()
    answer = baselines.identify(rig, free=(parameter,) if told else ())
    seconds = time.perf_counter() - start
    value = truth["effects"][0]["parameters"][key]
    got = read(answer[0][parameter], rig.meant)
    return {"seconds": seconds, "error": abs(got - value) / abs(value), "value": got, "held_out_rad": answer[1]}


def main(own: dict[str, str], out: Path) -> int:
    """All cases, a table, sysid.json."""
    try:
        from mujoco.sysid import ParameterDict  # noqa: F401  (without its dependencies the package is there, but empty)
    except ImportError:
        raise UserError('mujoco.sysid is not installed: pip install "mujoco[sysid]"') from None
    count, rows = int(own.get("cases", 8)), []
    root = out / f"sysid_{SEED}"
    names = list(KINDS)
    for k in range(count):
        kind = names[k % len(names)]
        name, truth = make(k, kind, root)
        row = {
            "case": name,
            "kind": kind,
            "tier": truth["tier"],
            "diagnose": ours(name, truth, root, 600.0),
            "sysid": theirs(name, truth, root, False),
            "sysid_told": theirs(name, truth, root, True),
        }
        rows.append(row)
        text = [
            f"{who} {r['seconds']:.0f} s, error {_percent(r['error'])}" for who, r in ((who, row[who]) for who in WHO)
        ]
        print(f"  {k + 1}/{count} {kind:8s} ({truth['tier']})  " + "   ".join(text), flush=True)
        (out / "sysid.json").write_text(
            json.dumps({"benchmark": "peers sysid", "rows": rows, "summary": summary(rows)}, indent=1)
        )
    for who, s in summary(rows).items():
        print(f"  {who:10s} median error {100 * s['error']:.0f} % of {s['n']}, median time {s['seconds']:.0f} s")
    print(json.dumps({"benchmark": "peers sysid", "summary": summary(rows), "rows": rows}), flush=True)
    return 0


def summary(rows: list[dict]) -> dict[str, dict]:
    """Median error (an effect that is not named counts as 100 %) and time of both."""
    found = {}
    for who in WHO:
        errors = [1.0 if r[who]["error"] is None else min(r[who]["error"], 10.0) for r in rows]
        found[who] = {
            "error": float(np.median(errors)),
            "seconds": float(np.median([r[who]["seconds"] for r in rows])),
            "n": len(rows),
        }
    return found


def _percent(error: float | None) -> str:
    return "not named" if error is None else f"{100 * error:.0f} %"
