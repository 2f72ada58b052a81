"""Touch beside the joints: one verdict, one list of findings, one figure of what is left."""

from __future__ import annotations

import numpy as np

from dexsim.gap.judge import verdict
from dexsim.gap.report.sentence import sentence
from dexsim.gap.result import Diagnosis
from dexsim.gap.rules import JUDGE
from dexsim.gap.touch.result import TouchResult


def _verdict(felt: TouchResult) -> str | None:
    """The word for touch alone; None where it was not judged."""
    if felt.before is None:
        return "explained" if felt.findings else None
    for f in felt.findings:
        if f["confidence"] < JUDGE.firm:
            f["hint"] = True
    named = [{"effect": f["effect"], "held_out": True, "hint": f.get("hint", False)} for f in felt.findings]
    word = verdict.verdict(named, felt.floor, felt.before[0], felt.before[1], felt.after[0], felt.structured)
    return "partly_explained" if word == "explained" and felt.structured else word


def add(d: Diagnosis, felt: TouchResult) -> None:
    """Touch into a diagnosis: beside the joints, or by itself where none of them is judged (the verdict says so)."""
    d.touch = felt
    if d.data["verdict"] == "unusable":
        _alone(d, felt)
    else:
        _beside(d, felt)


def _alone(d: Diagnosis, felt: TouchResult) -> None:
    """Touch where no joint could be judged."""
    data = d.data
    data["verdict"] = _verdict(felt) or "unusable"
    data["noise_floor"] = {"position_rad": None, "how": "quantum", "tactile_N": felt.floor}
    data["findings"] = data["findings"] + sorted(felt.findings, key=lambda f: -f["confidence"])
    data["nuisance"] = dict(felt.nuisance)
    if felt.before is not None:
        _metric(data, felt)
    else:
        data["held_out"]["error"] = "tactile_rmse_N"
    data["unexplained"]["depends_on"] = felt.depends_on if data["verdict"] not in ("none", "explained") else []
    d.sentence = sentence(data, d, felt.floor or 0.0)


def _beside(d: Diagnosis, felt: TouchResult) -> None:
    """Findings, the verdict of both, the metric of what was found."""
    word = _verdict(felt)
    if word is None:
        return
    data = d.data
    joints = data["verdict"]
    bad = [f for f in data["findings"] if f["effect"] == "bad_channel"]
    rest = [f for f in data["findings"] if f["effect"] != "bad_channel"]
    data["findings"] = bad + rest + sorted(felt.findings, key=lambda f: -f["confidence"])
    data["nuisance"] |= felt.nuisance
    if felt.floor is not None:
        data["noise_floor"]["tactile_N"] = felt.floor
    if "none" in (joints, word):
        data["verdict"] = word if joints == "none" else joints
    elif joints != word:
        data["verdict"] = "partly_explained"
    if not rest and (felt.findings or joints == "none") and felt.before is not None and word != "none":
        _metric(data, felt)
    data["unexplained"]["depends_on"] += felt.depends_on if data["verdict"] not in ("none", "explained") else []
    d.sentence = sentence(data, d, data["noise_floor"]["position_rad"])


def _metric(data: dict, felt: TouchResult) -> None:
    (b, bl, bh), (a, al, ah) = felt.before, felt.after
    data["held_out"] = {
        "recordings": felt.recordings,
        "error": "tactile_rmse_N",
        "before": b,
        "after": a,
        "before_low": bl,
        "before_high": bh,
        "after_low": al,
        "after_high": ah,
        "how": "presses kept out of the fit",
    }
    gap = b**2 - felt.floor**2
    data["unexplained"]["fraction_of_gap"] = (
        round(float(np.clip((a**2 - felt.floor**2) / gap, 0.0, 1.0)), 4)
        if gap > 0 and b > JUDGE.within * felt.floor
        else 0.0
    )
