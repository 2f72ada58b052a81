"""An effect is one entry: everything that the diagnosis knows of it stands in its class."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest
import test_gap
from test_gap import model, plant_run

import dexsim.gap
from dexsim.gap.effects.catalogue import CATALOGUE, EFFECTS, TOUCH_CATALOGUE, TOUCH_EFFECTS
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import NAMES, SERIES
from dexsim.gap.read.runs import conditions
from dexsim.gap.search.fit import intervals
from dexsim.gap.search.search import JointSearch

ROOM = Path(dexsim.gap.__file__).parent
IDS = {*EFFECTS, *TOUCH_EFFECTS}
COLUMNS = {*NAMES, *SERIES}  # some effects are called as the column that they write


def asked_by_name(source: str) -> list[str]:
    """Ids of effects that a source names: any that is no column's name, and those in comparisons with a finding's or a member's effect."""
    out = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in IDS - COLUMNS:
            out.append(f"{node.lineno}: {node.value}")
        if isinstance(node, ast.Compare) and re.search(r"\.ids?\b|\beffects?\b", ast.unparse(node)):
            named = {x.value for x in ast.walk(node) if isinstance(x, ast.Constant) and isinstance(x.value, str)} & IDS & COLUMNS
            out += [f"{node.lineno}: {x}" for x in sorted(named)]
    return out


@pytest.mark.parametrize(("source", "found"), [
    ('f["effect"] == "supply_sag"', 1), ('m.id in ("payload", "lag")', 2), ('FAST = ("command_delay", "lag")', 1), ('row[INDEX["payload"]]', 0),
    ('name in ("kp", "torque_limit")', 0)])  # fmt: skip
def test_the_search_for_names_finds_them(source, found):
    assert len(asked_by_name(source)) == found


def test_no_effect_is_asked_for_by_name_outside_its_class():
    files = [p for p in ROOM.rglob("*.py") if p.parent.name != "effects"]
    assert len(files) > 20
    assert {str(p.relative_to(ROOM)): said for p in files if (said := asked_by_name(p.read_text(encoding="utf-8")))} == {}


def test_every_effect_has_a_file_of_its_own_and_says_what_it_is():
    for e in (*CATALOGUE, *TOUCH_CATALOGUE):
        text = (ROOM / "effects" / f"{type(e).__module__.rpartition('.')[2]}.py").read_text(encoding="utf-8")
        assert len(re.findall(r"^class \w+\((?:Touch)?Effect\)", text, re.M)) == 1, e.id
        assert e.words and e.shows and e.experiment and type(e).__doc__
    assert len(EFFECTS) == len(CATALOGUE) and len(TOUCH_EFFECTS) == len(TOUCH_CATALOGUE)


def found(changes: dict[str, float], servo: dict | None = None, allowed: set[str] | None = None, seconds: float = 5.0):
    """The search's outcome on three runs of our own plant whose other figures are a few percent off."""
    off = {"*kp": 1.03, "*inertia_scale": 0.97, "*viscous_friction": 0.96}
    runs = [plant_run(f"run{k}", k, seconds, off | changes, seed=k, servo=servo) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    return JointSearch(build(model(), runs)[0], [0, 1, 2], None, conditions(runs), allowed=allowed).run()


def steps(kind: int, seconds: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Times and targets that jump every 0.6 s."""
    t = np.arange(0.0, seconds, 0.01)
    levels = np.random.default_rng([seed, kind]).uniform(-1.4, 1.4, int(seconds / 0.6) + 1)
    return t, levels[(t / 0.6).astype(int)]


FAST = {"torque_limit": 0.3, "no_load_speed": 14.0, "braking_slope": 1.0}


BRAKING = ({"braking_slope": 0.0}, FAST, {"braking_limit", "torque_limit", "torque_speed_limit"})
LEADING = ({"speed_feedforward": 0.04}, None, {"controller_term"})
CREEPING = ({"integral_gain": 3.0}, None, {"controller_term", "payload"})
GIVING = ({"presliding": 0.02, "coulomb_friction": 0.06}, {"coulomb_friction": 0.06}, {"presliding", "backlash", "stribeck_friction"})


@pytest.mark.parametrize(("planted", "effect", "key", "value", "jumps"), [
    (LEADING, "controller_term", "gain", 0.04, False),
    pytest.param(BRAKING, "braking_limit", "slope", 0.0, True, marks=pytest.mark.slow),
    pytest.param(CREEPING, "controller_term", "gain", 3.0, False, marks=pytest.mark.slow),
    pytest.param(GIVING, "presliding", "distance", 0.02, False, marks=pytest.mark.slow)],
    ids=["feed-forward", "braking", "integral", "presliding"])  # fmt: skip
def test_a_law_that_is_not_believed_is_named_and_sized(monkeypatch, planted, effect, key, value, jumps):
    monkeypatch.setattr(test_gap, "motion", steps if jumps else test_gap.motion)
    best = found(*planted).best
    assert best.ids == (effect,) and best.fit.value(f"{effect}.{key}") == pytest.approx(value, rel=0.1, abs=0.05 if jumps else 0)


def test_what_is_not_stated_of_braking_is_no_effect(monkeypatch):
    """Nothing is believed of how an unknown drive brakes: it is refitted, and no name is given to it."""
    monkeypatch.setattr(test_gap, "motion", steps)
    unsaid = {k: v for k, v in FAST.items() if k != "braking_slope"}
    outcome = found({"braking_slope": 0.0}, unsaid, {"braking_limit"})
    assert outcome.best.ids == () and outcome.best.fit.value("braking_slope") == pytest.approx(0.0, abs=0.1)


@pytest.mark.slow
def test_an_interval_holds_the_size_by_another_law():
    """Breakaway friction that falls with the speed itself and not with its square: the law is tried too, and the interval holds the truth."""
    off = {"*kp": 1.02, "*inertia_scale": 0.98, "stribeck_peak": 0.06, "stribeck_speed": 0.25, "stribeck_exponent": 1.0}
    runs = [plant_run(f"run{k}", k, 5.0, off, seed=k) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    search = JointSearch(build(model(), runs)[0], [0, 1, 2], None, conditions(runs), allowed={"stribeck_friction"})
    best = search.run().best
    assert best.ids == ("stribeck_friction",) and len(search.by_law["stribeck_friction"]) == 2
    low, high = search.widen(best, intervals(best.fit, search.blocks, knee=search.r.knee))[0]
    assert low < 0.06 < high < 0.1
    assert best.members[0].variant.label == "exponential in speed"
