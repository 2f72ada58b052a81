"""The concealed benchmark itself: its plant against the pendulum's own formulas, and that nothing but the motion tells."""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.concealed import generate, plant, score
from benchmarks.concealed import __main__ as command
from dexsim.recording import read

SMOOTH = {"coulomb": 0.0, "viscous": 0.0, "kp": 0.0, "kd": 0.0}


def crossings(x: np.ndarray) -> np.ndarray:
    """Times [s] at which a millisecond-sampled signal rises through zero."""
    i = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    return 1e-3 * (i - x[i] / (x[i + 1] - x[i]))


def test_plant_imports_nothing_of_the_simulator():
    tree = ast.parse(Path(plant.__file__).read_text(encoding="utf-8"))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {a.name.split(".")[0] for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add((node.module or "").split(".")[0])
    assert names <= {"__future__", "numpy"}, names


def test_pendulum_swings_at_its_own_frequency():
    """Both inertias count, and the period grows with the amplitude: T = T0 (1 + a^2/16 + 11 a^4/3072)."""
    amplitude = np.array([0.05, 0.9])
    p = plant.rows(2, **SMOOTH)
    q = plant.simulate(p, np.zeros((2, 4000)), q0=amplitude, driven=False)["position"]
    inertia = p["mass"] * p["length"] ** 2 + p["rotor"]
    expected = 2 * np.pi * np.sqrt(inertia / (p["mass"] * 9.81 * p["length"])) * (1 + amplitude**2 / 16 + 11 * amplitude**4 / 3072)
    for row in range(2):
        assert np.diff(crossings(q[row])).mean() == pytest.approx(expected[row], rel=0.003)
    assert np.abs(q[:, -800:]).max(1) == pytest.approx(amplitude, rel=0.02)  # the step itself takes no energy


def test_friction_holds_below_its_level_and_play_is_as_wide_as_said():
    p = plant.rows(2, **(SMOOTH | {"coulomb": np.array([0.05, 0.2])}))
    q = plant.simulate(p, np.zeros((2, 3000)), q0=0.9, driven=False)["position"]  # the weight asks for 0.115 N.m
    assert abs(q[0, -1]) < 0.6 and abs(q[1, -1] - 0.9) < 0.02
    # turned over, the link falls from one flank to the other: a motor held in place shows the whole play
    for play in (0.02, 0.06):
        p = plant.rows(2, kp=8.0, kd=0.2, torque_limit=5.0, play=play, motor_side=1.0, coulomb=0.0, mass=np.array([0.15, 1e-2]), cable=np.array([0.0, 0.2]),
                       cable_rest=np.array([0.0, 1.0]))  # fmt: skip
        q = plant.simulate(p, np.tile(0.5, (2, 2500)), q0=0.5)["position"][:, -1]
        static = [0.15 * 9.81 * 0.1 * np.sin(q[0]) / 8.0, -(0.2 * (1.0 - q[1]) - 1e-2 * 9.81 * 0.1 * np.sin(q[1])) / 8.0]
        assert q[0] == pytest.approx(0.5 - static[0] - play / 2, abs=1.5e-3)
        assert q[1] == pytest.approx(0.5 - static[1] + play / 2, abs=1.5e-3)


def test_delay_is_felt_after_its_time():
    delay = np.array([0.0, 0.0125, 0.04])
    p = plant.rows(3, delay=delay)
    step = np.tile(np.where(np.arange(400) >= 100, 0.4, 0.0), (3, 1))
    q = plant.simulate(p, step)["position"]
    at = [np.interp(0.1, row[100:], np.arange(300) * 1e-3) for row in q]
    assert np.diff(at) == pytest.approx(np.diff(delay), abs=6e-4)


@pytest.fixture(scope="module")
def some(tmp_path_factory):
    """One case of several kinds from one seed, with the fast settings of a test."""
    root = tmp_path_factory.mktemp("cases")
    seconds, generate.SECONDS = generate.SECONDS, 1.2
    sizes, generate.SIZES = generate.SIZES, 3
    try:
        kinds = ("none", "backlash", "coulomb_friction", "cable_spring", "torque_limit")
        entries = [{"group": "effect" if k in generate.INSIDE else "outside" if k in generate.KINDS else "none", "kind": k, "tier": "easy"} for k in kinds]
        made = [generate.build(e, n, 3, root / "cases", root / "truth") for n, e in enumerate(entries)]
    finally:
        generate.SECONDS, generate.SIZES = seconds, sizes
    return root, made, entries


def test_names_and_metadata_tell_nothing(some):
    """A classifier on everything but the motion has nothing to split on: the same keys and values, the same names."""
    root, made, _ = some
    facts = set()
    for m in made:
        folder = root / "cases" / m["name"]
        seen = []
        for letter in generate.RECORDINGS:
            r = read(folder / f"{letter}.mcap")
            meta = {k: v for k, v in r.meta.items() if k != "effort_is"}  # drawn by a coin of its own, below
            seen.append((letter, tuple(sorted(meta.items())), r.start_ns, r.joints))
        facts.add((tuple(sorted(p.name for p in folder.iterdir())), tuple(seen)))
        for name in (*generate.KINDS, "easy", "medium", "hard"):
            for file in ("rig.xml", "servo.yaml"):
                text = (folder / file).read_text(encoding="utf-8")
                # the belief names ordinary columns of every servo, whatever is hidden
                assert name not in text or name in ("coulomb_friction", "viscous_friction", "torque_limit")
    assert len(facts) == 1
    assert len({tuple((root / "cases" / m["name"] / "servo.yaml").read_text().count(k) for k in ("kp", ":")) for m in made}) == 1


def test_what_is_believed_does_not_depend_on_the_effect(tmp_path):
    """The same case number with another effect: rig, servo, metadata and commands are the same to the byte."""
    seconds, generate.SECONDS = generate.SECONDS, 0.6
    sizes, generate.SIZES = generate.SIZES, 2
    try:
        texts = set()
        for kind in ("lag", "payload", "dwell_stiction", "none"):
            made = generate.build({"group": "effect", "kind": kind, "tier": "hard"}, 5, 3, tmp_path / kind, tmp_path / "truth" / kind)
            folder = tmp_path / kind / made["name"]
            r = read(folder / "a.mcap")
            texts.add(((folder / "rig.xml").read_text(), (folder / "servo.yaml").read_text(), json.dumps(r.meta, sort_keys=True), made["name"],
                       r.commands.value.tobytes(), r.states.position.t.tobytes()))  # fmt: skip
        assert len(texts) == 1
    finally:
        generate.SECONDS, generate.SIZES = seconds, sizes


def test_hash_binds_the_truth_and_the_salt_hides_it(some, tmp_path):
    root, made, entries = some
    path = root / "truth" / f"{made[1]['name']}.json"
    truth = generate.reveal(path, made[1]["digest"])
    assert truth["kind"] == entries[1]["kind"] and truth["parameters"]["gap"] > 0
    # the same truth again: another salt, another hash, so a guess cannot be checked against it
    assert generate.commit(truth, tmp_path) != made[1]["digest"]
    bare = hashlib.sha256(json.dumps(truth, sort_keys=True).encode()).hexdigest()
    assert bare != made[1]["digest"]
    forged = tmp_path / path.name
    forged.write_text(path.read_text(encoding="utf-8").replace("backlash", "lag"), encoding="utf-8")
    with pytest.raises(ValueError, match="not the truth"):
        generate.reveal(forged, made[1]["digest"])


def test_plan_is_fixed_by_its_seed():
    mix = {"effect": len(generate.INSIDE), "none": 4, "noise": 2, "outside": 2, "decoy": 2}
    assert generate.plan(mix, 7) == generate.plan(mix, 7) != generate.plan(mix, 8)
    plan = generate.plan(mix, 7)
    assert {p["kind"] for p in plan if p["group"] == "effect"} == set(generate.INSIDE)
    assert {g: sum(p["group"] == g for p in plan) for g in mix} == mix


def test_scores_by_hand():
    def finding(effect, confidence=0.9, group=(), **parameters):
        return {"effect": effect, "confidence": confidence, "indistinguishable": list(group),
                "parameters": {k: dict(zip(("value", "low", "high"), v, strict=True)) for k, v in parameters.items()}}  # fmt: skip

    truth = {"name": "x", "group": "effect", "kind": "backlash", "tier": "easy", "effect": "backlash", "floor": 1.0, "parameters": {"gap": 0.02}}
    right = {"verdict": "explained", "held_out": {"before": 11.0, "after": 3.0}, "findings": [finding("backlash", gap=(0.022, 0.019, 0.025))]}
    r = score.one(truth, right)
    assert r["right"] and not r["wrong_sure"] and r["parameter_errors"] == pytest.approx([0.1]) and r["covered"] == [True] and r["removed"] == pytest.approx(0.8)
    named = {"verdict": "explained", "held_out": None, "findings": [finding("coulomb_friction")]}
    assert not score.one(truth, named)["right"] and score.one(truth, named)["wrong_sure"]
    as_set = {"verdict": "explained", "held_out": None, "findings": [finding("coulomb_friction", group=("backlash", "coulomb_friction"))]}
    assert score.one(truth, as_set)["right"] and not score.one(truth, as_set)["wrong_sure"]
    foreign = {"verdict": "explained", "held_out": None, "findings": [finding("lag", group=("backlash", "lag"))]}
    assert not score.one(truth, foreign)["right"]  # a set of no class is no answer
    nothing = {**truth, "group": "none", "kind": "none", "effect": "none", "parameters": {}}
    assert score.one(nothing, right)["false_alarm"] and not score.one(nothing, {**right, "findings": [], "verdict": "none"})["false_alarm"]
    outside = {**nothing, "group": "outside"}
    assert not score.one(outside, right)["humble"] and score.one(outside, {**right, "verdict": "unknown", "findings": []})["humble"]
    assert score.wilson(0, 100)[1] == pytest.approx(0.037, abs=1e-3) and score.wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    lines = score.table([r, score.one(nothing, right)])
    assert lines["right effect first, easy"]["value"] == 1.0 and lines["confident and wrong, all cases"]["value"] == 0.5


@pytest.mark.slow
def test_end_to_end_and_resumed(tmp_path, capsys, monkeypatch):
    line = command.main(["mix=effect:1", "seed=2", f"out={tmp_path}"])
    assert line["cases"] == 1 and line["failed"] == 0 and line["lines"]
    assert json.loads(capsys.readouterr().out.strip().splitlines()[-1])["benchmark"] == "concealed"
    monkeypatch.setattr(sys, "executable", "no such program")  # a finished case is not diagnosed again
    assert command.main(["mix=effect:1", "seed=2", f"out={tmp_path}"])["lines"] == line["lines"]
