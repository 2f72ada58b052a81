"""A diagnosis as files: diagnosis.json, details.json, report.html, servo.yaml and the rest."""

from __future__ import annotations

import copy
import html
import json
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim import outputs
from dexsim.gap.judge import residual_fit
from dexsim.gap.judge.findings import MODEL_FILES, save_model
from dexsim.gap.result import Diagnosis
from dexsim.gap.touch import handed_on as touch_handed


def save(d: Diagnosis, out: Path) -> list[Path]:
    """Writes diagnosis.json, details.json, report.html, servo.yaml and, where there is something in them, model.xml and
    tactile.yaml, all of them or none; returns what was written. Raises UserError where one would go over a file that is
    not ours."""
    d.notes = grouped(d.notes)
    names = []
    with outputs.staged(out) as stage:
        if d.servo is not None:
            d.servo.save(stage / "servo.yaml")
            names.append("servo.yaml")
        if d.touch is not None and touch_handed.save(
            touch_handed.handed(d.touch.findings, d.touch.facts, d.touch.names), stage / "tactile.yaml"
        ):
            names.append("tactile.yaml")
        if d.standins and d.servo is not None:
            residual_fit.write(d.servo, d.standins, stage / "servo_standin.yaml")
            names.append("servo_standin.yaml")
        if d.model_spec is not None:
            try:
                d.model_spec.compile()
                save_model(d.model_spec, stage / "model.xml")
                names.append("model.xml")
            except (ValueError, mujoco.FatalError) as error:
                d.notes.append(f"model.xml could not be written: {error}")
        asked, more = specified(d.data)
        more |= {"notes": d.notes, "seconds": d.shares}
        data = {"diagnosis.json": asked, "details.json": more} | (
            {"evidence.json": [e.plain() for e in d.evidence]} if d.evidence else {}
        )
        for name, value in data.items():
            (stage / name).write_text(json.dumps(plain(value), indent=1, allow_nan=False), encoding="utf-8")
        (stage / "report.html").write_text(_page(d), encoding="utf-8")
        names = [*data, *names]
    if (d.data["next_recording"] or {}).get("commands"):
        names.append(d.data["next_recording"]["commands"])
    return [out / name for name in (*names, "report.html")]


def _page(d: Diagnosis) -> str:
    """The page. It is drawn from an answer that may have taken an hour: a fault in the drawing must not lose that."""
    from dexsim.gap.report.sections import page

    try:
        return page(d)
    except Exception:
        print("report.html could not be drawn and holds the reason (please report it); the answer is in diagnosis.json")
        return f"<!doctype html><title>no report</title><pre>{html.escape(traceback.format_exc())}</pre>\n"


RESULTS = (
    "diagnosis.json",
    "details.json",
    "evidence.json",
    "servo.yaml",
    "tactile.yaml",
    "servo_standin.yaml",
    "model.xml",
    MODEL_FILES,
    "next_recording.mcap",
    "report.html",
)
"""Everything that `save` and the plan of the next recording may write."""
BEYOND = (("reason",), ("held_out", "how"), ("held_out", "confirmed"), ("unexplained", "not_considered"))


def specified(data: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(what diagnosis.json holds, and nothing else: programs rely on its keys; what is known beyond that, for
    details.json)."""
    asked = copy.deepcopy(data)
    more: dict[str, Any] = {}
    for *parents, key in BEYOND:
        there = asked[parents[0]] if parents else asked
        if key in there:
            (more.setdefault(parents[0], {}) if parents else more)[key] = there.pop(key)
    return asked, more


def grouped(notes: Sequence[str]) -> list[str]:
    """Notes that several recordings share, said once: "a.mcap, b.mcap: ..." with at most three names."""
    out: dict[str, list[str]] = {}
    for note in notes:
        name, colon, text = note.partition(": ")
        if colon and name.endswith((".mcap", ".bag", ".csv", ".tsv", ".npz")) and " " not in name:
            out.setdefault(text, []).append(name)
        else:
            out.setdefault(note, [])
    join = lambda names: ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")  # noqa: E731
    return [f"{join(list(dict.fromkeys(names)))}: {text}" if names else text for text, names in out.items()]


def plain(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(k): plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain(v) for v in x]
    if isinstance(x, (np.floating, float)):
        return float(x) if np.isfinite(x) else None
    if isinstance(x, np.integer):
        return int(x)
    return x
