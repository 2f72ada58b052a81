"""An effect is one entry: everything that the diagnosis knows of it stands in its class."""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import test_gap
from test_gap import SERVO, model, plant_run

import dexsim.gap
from dexsim.actuator.table import ServoTable
from dexsim.gap.effects import FittedEffect, Variant, drive
from dexsim.gap.effects.catalogue import CATALOGUE, EFFECTS, TOUCH_CATALOGUE, TOUCH_EFFECTS
from dexsim.gap.inquiry import TouchResult
from dexsim.gap.judge import conclude
from dexsim.gap.plant.case import Case, build
from dexsim.gap.plant.columns import NAMES, SERIES
from dexsim.gap.plant.free_run import free_run
from dexsim.gap.read import Run, conditions
from dexsim.gap.search.fit import intervals
from dexsim.gap.search.search import JointSearch, search_joint, widened

ROOM = Path(dexsim.gap.__file__).parent
IDS = {*EFFECTS, *TOUCH_EFFECTS}
COLUMNS = {*NAMES, *SERIES}  # some effects are called as the column that they write


def asked_by_name(source: str) -> list[str]:
    """Return the ids of effects that a source names: any that is no column's name, and those in comparisons with a
    finding's or a member's effect, by a constant that stands for one too. A signal that is wrong is no effect."""
    out = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in IDS - COLUMNS:
            out.append(f"{node.lineno}: {node.value}")
        if isinstance(node, ast.Compare) and re.search(r"\.effects?\b", ast.unparse(node)):
            # by a name that stands for one
            constant = r"\b(?:[A-Z]\w+\.id|(?!EFFECTS|WRONG_SIGNAL)[A-Z][A-Z_]+)\b"
            out += [f"{node.lineno}: {x}" for x in re.findall(constant, ast.unparse(node))]
        if isinstance(node, ast.Compare) and re.search(r"\.ids?\b|\beffects?\b", ast.unparse(node)):
            named = (
                {x.value for x in ast.walk(node) if isinstance(x, ast.Constant) and isinstance(x.value, str)}
                & IDS
                & COLUMNS
            )
            out += [f"{node.lineno}: {x}" for x in sorted(named)]
    return out


@pytest.mark.parametrize(("source", "found"), [
    ('f["effect"] == '
     '"supply_sag"', 1), ('m.id in ("payload", '
                          '"lag")', 2), ('FAST = ("command_delay", "lag")', 1), ('row[INDEX["payload"]]', 0),
    ('name in ("kp", "torque_limit")', 0), ('n.effect == LAG', 1),
    ('n.effect in (STRIBECK, LoadFriction.id)', 2)])  # fmt: skip
def test_the_search_for_names_finds_them(source, found):
    assert len(asked_by_name(source)) == found


def test_no_effect_is_asked_for_by_name_outside_its_class():
    files = [p for p in ROOM.rglob("*.py") if p.parent.name != "effects"]
    assert len(files) > 20
    assert {
        str(p.relative_to(ROOM)): said for p in files if (said := asked_by_name(p.read_text(encoding="utf-8")))
    } == {}


def test_every_effect_is_one_class_of_one_file_and_says_what_it_is():
    """Each class stands once in the files of `effects/`, and each class that stands there is an entry."""
    classes = [
        (path.stem, name)
        for path in (ROOM / "effects").glob("*.py")
        for name in re.findall(r"^class (\w+)\(.*Effect.*\)", path.read_text(encoding="utf-8"), re.M)
    ]
    entries = [(type(e).__module__.rpartition(".")[2], type(e).__name__) for e in (*CATALOGUE, *TOUCH_CATALOGUE)]
    assert sorted(classes) == sorted(entries)
    for e in (*CATALOGUE, *TOUCH_CATALOGUE):
        assert e.words and e.shows and e.experiment and type(e).__doc__
    assert len(EFFECTS) == len(CATALOGUE) and len(TOUCH_EFFECTS) == len(TOUCH_CATALOGUE)


def found(changes: dict[str, float], servo: dict | None = None, allowed: set[str] | None = None, seconds: float = 5.0):
    """Return the search's outcome on three runs of our own plant whose other figures are a few percent off."""
    off = {"*kp": 1.03, "*inertia_scale": 0.97, "*viscous_friction": 0.96}
    runs = [plant_run(f"run{k}", k, seconds, off | changes, seed=k, servo=servo) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    return search_joint(JointSearch(build(model(), runs)[0], [0, 1, 2], None, conditions(runs), allowed=allowed))


def steps(kind: int, seconds: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Times and targets that jump every 0.6 s."""
    t = np.arange(0.0, seconds, 0.01)
    levels = np.random.default_rng([seed, kind]).uniform(-1.4, 1.4, int(seconds / 0.6) + 1)
    return t, levels[(t / 0.6).astype(int)]


TWO = """<mujoco><worldbody>
<body><joint name="a" axis="0 1 0" armature="5e-4"/><geom type="sphere" size="1e-3" mass="0.15" pos="0 0 -0.1"/></body>
<body pos="1 0 0"><joint name="b" axis="0 1 0" armature="5e-4"/>
 <geom type="sphere" size="1e-3" mass="0.15" pos="0 0 -0.1"/></body>
</worldbody></mujoco>"""


def moving(**servo: float) -> Case:
    """Return the joint a of two that jump and swing at their limits while they grow warm, torques logged, as the plant
    itself moves them. servo: columns other than SERVO's."""
    t = np.arange(0.0, 3.0, 0.01)
    jumps = np.stack([steps(k, 3.0)[1] for k in (0, 1)], 1)
    command = jumps + 0.3 * np.sin(2 * np.pi * 2 * t)[:, None]
    table = ServoTable.from_dict({"joints": {"*": SERVO | servo}, "loop_rate": 1000})
    run = Run("moving", ("a", "b"), t, command, t, 0.8 * command, table, np.array([0, 0, -9.81]))
    run.temperature = np.repeat((20.0 + 10.0 * t)[:, None], 2, 1)
    for _ in range(2):  # the series are those of the motion itself
        run.qs = None
        run.smooth()
        cases = build(mujoco.MjModel.from_xml_string(TWO), [run])
        moved = [c.plant.simulate(c.plant.base()[None], c.plant.windows(None)) for c in cases]
        run.q, run.torque = (np.stack([m[k][0] for m in moved], 1) for k in (0, 1))
    run.qs = None
    run.smooth()
    return build(mujoco.MjModel.from_xml_string(TWO), [run])[0]


@pytest.fixture(scope="module")
def drives() -> tuple[Case, Case]:
    """Return a drive at its limits, and a loop so soft that a spring can work against it."""
    return moving(torque_limit=0.4, braking_slope=0.5), moving(kp=0.02, kd=0.004)


def simulated(case: Case, variant: Variant | None = None, x: Sequence[float] = ()) -> np.ndarray:
    """Return [2, n] motion (rad) and the effort shown (N.m) with a variant of these sizes, or with what is believed."""
    params, fixed = (list(variant.params), variant.fixed) if variant else ([], ())
    return np.stack(free_run(case, params, np.array(x, float), case.plant.windows(None), fixed))


@pytest.mark.parametrize("effect", [e for e in CATALOGUE if e.simulated], ids=lambda e: e.id)
def test_the_plant_has_a_law_of_every_effect_that_is_simulated(drives, effect):
    """One of the sizes that the search begins from moves the joint by a milliradian (of an effect of the effort's
    sensor alone: what that shows, and the joint not at all), and each size by itself does something."""
    case = next(c for c in drives if effect.variants(c.scales))
    believed, of = simulated(case), 1 if effect.effort_only else 0
    for variant in effect.variants(case.scales):
        by_start = np.stack([simulated(case, variant, x) for x in variant.starts])
        change = np.sqrt(np.mean((by_start - believed) ** 2, -1))
        best = int(change[:, of].argmax())
        assert change[best, of] > 1e-3, variant.label
        assert not effect.effort_only or change[:, 0].max() == 0.0
        for i, p in enumerate(variant.params):
            nudged = 0.0
            for start, there in zip(variant.starts, by_start, strict=True):
                x = list(start)
                x[i] += (0.1 if x[i] + 0.1 * p.span < p.high else -0.1) * p.span
                nudged = max(nudged, np.sqrt(np.mean((simulated(case, variant, x) - there)[of] ** 2)))
                if nudged > 1e-6:
                    break
            assert nudged > 1e-6, (variant.label, p.key)


FAST = {"torque_limit": 0.3, "no_load_speed": 14.0, "braking_slope": 1.0}


BRAKING = ({"braking_slope": 0.0}, FAST, {"braking_limit", "torque_limit", "torque_speed_limit"})
LEADING = ({"speed_feedforward": 0.04}, None, {"controller_term"})
CREEPING = ({"integral_gain": 3.0}, None, {"controller_term", "payload"})
HEAVY = ({"armature": 0.015}, None, {"inertia", "payload"})  # a rotor behind a gear: eight times the model's inertia
GIVING = (
    {"presliding": 0.02, "coulomb_friction": 0.06},
    {"coulomb_friction": 0.06},
    {"presliding", "backlash", "stribeck_friction"},
)


@pytest.mark.slow
@pytest.mark.parametrize(("planted", "effect", "key", "value", "jumps"), [
    (LEADING, "controller_term", "gain", 0.04, False),
    (HEAVY, "inertia", "armature", 0.015, False),
    pytest.param(BRAKING, "braking_limit", "slope", 0.0, True, marks=pytest.mark.slow),
    pytest.param(CREEPING, "controller_term", "gain", 3.0, False, marks=pytest.mark.slow),
    pytest.param(GIVING, "presliding", "distance", 0.02, False, marks=pytest.mark.slow)],
    ids=["feed-forward", "heavy", "braking", "integral", "presliding"])  # fmt: skip
def test_a_law_that_is_not_believed_is_named_and_sized(monkeypatch, planted, effect, key, value, jumps):
    monkeypatch.setattr(test_gap, "motion", steps if jumps else test_gap.motion)
    best = found(*planted).best
    assert best.ids == (effect,) and best.fit.value(f"{effect}.{key}") == pytest.approx(
        value, rel=0.1, abs=0.05 if jumps else 0
    )


@pytest.mark.slow
def test_what_is_not_stated_of_braking_is_no_effect(monkeypatch):
    """Nothing is believed of how an unknown drive brakes: it is refitted, and no name is given to it."""
    monkeypatch.setattr(test_gap, "motion", steps)
    unsaid = {k: v for k, v in FAST.items() if k != "braking_slope"}
    outcome = found({"braking_slope": 0.0}, unsaid, {"braking_limit"})
    assert outcome.best.ids == () and outcome.best.fit.value("braking_slope") == pytest.approx(0.0, abs=0.1)


@pytest.mark.slow
def test_an_interval_holds_the_size_by_another_law():
    """Breakaway friction that falls with the speed itself and not with its square: the law is tried too, and the
    interval holds the truth."""
    off = {"*kp": 1.02, "*inertia_scale": 0.98, "stribeck_peak": 0.06, "stribeck_speed": 0.25, "stribeck_exponent": 1.0}
    runs = [plant_run(f"run{k}", k, 5.0, off, seed=k) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    search = JointSearch(build(model(), runs)[0], [0, 1, 2], None, conditions(runs), allowed={"stribeck_friction"})
    best = search_joint(search).best
    assert best.ids == ("stribeck_friction",) and len(search.by_law["stribeck_friction"]) == 2
    low, high = widened(search, best, intervals(best.fit, search.blocks, huber=search.r.huber))[0]
    assert low < 0.06 < high < 0.1
    assert best.members[0].variant.label == "exponential in speed"


@pytest.mark.slow
def test_a_law_is_tried_before_what_it_gets_wrong_is_named():
    """By the other law a breakaway friction leaves so much that a second friction would be found beside it."""
    off = {"stribeck_peak": 0.12, "stribeck_speed": 0.15, "stribeck_exponent": 1.0}
    runs = [plant_run(f"run{k}", k, 4.0, off, seed=k) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    allowed = {"stribeck_friction", "load_friction", "torque_ripple"}
    search = JointSearch(build(model(), runs)[0], [0, 1, 2], None, conditions(runs), allowed=allowed)
    best = search_joint(search).best
    assert best.ids == ("stribeck_friction",) and best.members[0].variant.label == "exponential in speed"


def test_a_grease_that_thins_is_told_by_the_line_that_takes_as_much_energy_too():
    """At one speed that is the friction there; a jump from one recording to the next is no motion."""
    t, q = np.array([0.0, 0.1, 0.2, 9.0, 9.1]), np.array([0.0, 0.3, 0.6, -5.0, -5.3])
    plant = SimpleNamespace(q=q, t=t, run_of=np.array([0, 0, 0, 1, 1]))
    scales = SimpleNamespace(base_damping=0.001, nominal={"viscous_friction": 0.01}, slide=False)
    case = SimpleNamespace(plant=plant, scales=scales)
    value = {"at_rest": 0.02, "half_speed": 3.0}
    fit = FittedEffect(None, value, {"at_rest": (0.018, 0.022), "half_speed": (2.0, 4.0)}, case, None)
    parameters = EFFECTS["viscous_friction"].parameters(fit)
    assert (parameters["coefficient"]["value"], parameters["at_rest"]["value"]) == pytest.approx((0.021, 0.031))
    assert (parameters["coefficient"]["low"], parameters["coefficient"]["high"]) == pytest.approx((0.02, 0.022))
    line = FittedEffect(None, {"coefficient": 0.02}, {"coefficient": (0.01, 0.03)}, case, None)
    assert set(EFFECTS["viscous_friction"].parameters(line)) == {"coefficient"}


def test_a_ripple_is_looked_for_up_to_what_the_drive_can_work_against():
    """A light joint loads its drive with little, and a ripple of its gear may be several times that."""
    runs = [plant_run("a", 0, 2.0, {})]
    runs[0].smooth()
    scales = replace(build(model(), runs)[0].scales, tau=0.013, demand=0.4)
    for variant in EFFECTS["torque_ripple"].variants(scales):
        amplitude = next(p for p in variant.params if p.key == "amplitude")
        assert 0.4 < amplitude.high < 0.6
        assert all(0 < start[0] < 0.013 for start in variant.starts)


@pytest.mark.parametrize("believed", [*({n: 0.1} for n in drive.WARMED), {"unknown": ("coulomb_friction",)}])
def test_friction_that_drifts_with_heat_is_looked_for_where_there_may_be_friction(believed):
    """Any column of friction that is there, or of which nothing is believed."""
    thermal, unknown = EFFECTS["thermal"], believed.get("unknown", ())
    s = SimpleNamespace(warm=20.0, voltage=False, nominal=believed, unknown=unknown, base_friction=0.0)
    assert "friction" in [v.label for v in thermal.variants(s)] and thermal.without(s) == {}


def test_friction_that_cannot_drift_with_heat_is_said_not_to_be_looked_for():
    runs = [plant_run(f"r{k}", k, 3.0, {}, temperature=1.0 + 40.0 * k) for k in (0, 1)]
    for r in runs:
        r.smooth()
    case = build(model(), runs)[0]
    nominal = case.scales.nominal | dict.fromkeys(drive.WARMED, 0.0)
    for model_has, said in ((0.0, "no friction is believed of the drive"), (0.2, "frictionloss has no temperature")):
        case.scales = replace(case.scales, nominal=nominal, base_friction=model_has)
        absent = conclude.not_considered([case], TouchResult(), None)
        assert said in absent["thermal of friction"] and "thermal" not in absent
        assert [v.label for v in EFFECTS["thermal"].variants(case.scales)] == ["torque_constant"]
