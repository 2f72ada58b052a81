"""Touch in the diagnosis: its own plant against the taxel kernels, effects planted on a press rig, sets, what is not
known."""

from __future__ import annotations

import json

import numpy as np
import press_rig
import pytest

from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.effects.catalogue import TOUCH_CATALOGUE, touch_confusable
from dexsim.gap.finding import Finding
from dexsim.gap.judge import confidence
from dexsim.gap.read import Run, inputs
from dexsim.gap.rules import JUDGE
from dexsim.gap.touch import plant as touch_plant
from dexsim.gap.touch import read as touch_read
from dexsim.gap.touch import search as touch_search
from dexsim.recording import read, write
from dexsim.recording.mechanism import mechanism
from dexsim.tactile import reference as ref
from tests.tactile_fixtures import touch_result


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return press_rig.record(tmp_path_factory.mktemp("plain"), 3, 6.0, seed=1)


def collected(paths, model, servo):
    m = mechanism(model, servo)
    recordings = [read(p, joints=m.joints, audit=False) for p in paths]
    return touch_read.collect(recordings, m, m.sensors), recordings, m


def found(folder, seconds=4.0, allowed=None, count=3, **planted):
    """Return the touch of some rig recordings with what was planted."""
    paths, model, servo = press_rig.record(folder, count, seconds, seed=4, **planted)
    m = mechanism(model, servo)
    return touch_result([read(p, joints=m.joints, audit=False) for p in paths], m, set(), allowed=allowed)


def test_catalogue_of_touch_is_that_of_the_specification():
    assert {e.id for e in TOUCH_CATALOGUE} == {
        "tactile_gain",
        "tactile_stiffening",
        "tactile_hysteresis",
        "tactile_crosstalk",
        "tactile_delay",
        "contact_friction",
        "contact_stiffness",
        "thermal",
    }
    assert (
        touch_confusable("tactile_gain", "contact_stiffness")
        and touch_confusable("thermal", "tactile_hysteresis")
        and not touch_confusable("tactile_gain", "tactile_delay")
    )
    for e in TOUCH_CATALOGUE:
        assert all(len(s) == len(e.fits) for s in e.starts) and {k for k, _ in e.report} <= set(e.fits)


@pytest.mark.slow
def test_the_plant_reads_what_the_rig_reads(plain):
    """The rig's contact is MuJoCo's and its taxels are the kernels': readings agree to the counts, with and without the
    load cell."""
    data, _, _ = collected(*plain)
    assert len(data.runs) == 3 and not data.blind and data.scale_known
    for run in data.runs:
        on = run.z.max(1) > 0
        for load in (run.load, None):
            run.load, run.memory = load, {}
            error = touch_plant.readings(run, touch_plant.neutral())[on] - run.z[on]
            loaded = run.z.max(0) > 0.3
            assert np.sqrt(np.mean(error[:, loaded] ** 2)) < (0.05 if load is not None else 0.12)


def test_rubber_relaxes_as_the_standard_linear_solid():
    x = np.r_[np.zeros(10), np.ones(400)][:, None]
    y = touch_plant.relaxed(x, 0.01, 0.4, 0.5)[:, 0]
    t = np.arange(400) * 0.01
    assert np.allclose(y[10:], 1 + 0.4 * np.exp(-(t + 0.01) / 0.5), atol=2e-3)
    assert touch_plant.relaxed(1 - x, 0.01, 0.4, 0.5).min() == 0.0  # rubber does not pull


def test_foundation_and_neighbours_keep_their_sums(plain):
    run = collected(*plain)[0].runs[0]
    run.load = None
    v = touch_plant.neutral() | {"c10": 8e4, "c01": 1e4}
    force, share = touch_plant.contact(run, v)
    g = int(np.argmax(run.depth))
    expected = ref.mooney_rivlin_force(np.maximum(-run.dist[g], 0), run.area, touch_plant.THICKNESS, 8e4, 1e4)
    assert force[g] == pytest.approx(expected.sum(), rel=1e-9) and share[g].sum() == pytest.approx(1.0)
    assert np.allclose(run.mixing.sum(0), 1.0)  # what a taxel gives its neighbours is what it loses


def test_a_slipping_bristle_stops_at_friction_times_force(plain):
    run = collected(*plain)[0].runs[0]
    run.slide = np.stack([np.linspace(0, 30e-3, len(run.grid)), np.zeros(len(run.grid))], 1)
    run.z = np.zeros_like(run.z)
    run.z[:, [60, 61]] = 1.0, 2.0
    run.pressed = run.z > 0
    out = touch_plant.shear(run, touch_plant.neutral() | {"mu": 0.5})
    assert out[-1, 0] == pytest.approx(0.5 * touch_read.FRICTION * 3.0) and out[-1, 1] == 0
    early = 5  # before anything slips: stiffness times area times path
    k = touch_plant.SHEAR_STIFFNESS * run.area[[60, 61]].sum()
    assert out[early, 0] == pytest.approx(
        k * (np.interp(run.t[early], run.grid, run.slide[:, 0]) - np.interp(run.t[0], run.grid, run.slide[:, 0])),
        rel=1e-6,
    )


QUICK = [
    (
        "tactile_hysteresis",
        {"sensor": {"hysteresis": 0.3, "hysteresis_time": 0.4}},
        {"fraction": 0.3, "time_constant": 0.4},
    ),
]
MORE = [
    ("contact_stiffness", {"stiffness": 4500.0}, {"stiffness": 4500.0}),
    ("tactile_gain", {"gains": dict.fromkeys(range(120), 0.7)}, {"gain": 0.7}),
    ("tactile_crosstalk", {"crosstalk": 0.25}, {"fraction": 0.25}),
    # the sensor reports its last reading that is older than the delay: four periods of 11 ms
    ("tactile_delay", {"sensor": {"delay": 0.04}}, {"delay": 4 / 90}),
    ("tactile_stiffening", {"rubber": (1e5, 2e4)}, {"c10": 1e5}),
    ("thermal", {"drift": -0.01}, {"per_degree": -0.01}),
    ("contact_friction", {"slides": True, "friction": 0.4}, {"mu": 0.4}),
]


def check(folder, effect, planted, values, allowed=None):
    # a drift with temperature needs time to show
    out = found(folder, 7.0 if effect == "thermal" else 4.0, allowed, **planted)
    assert [f.effect for f in out.findings] == [effect], out.findings
    f = out.findings[0]
    assert f.confidence > 0.8 and not f.indistinguishable and f.taxels and f.when
    for key, value in values.items():
        p = f.parameters[key]
        assert p["value"] == pytest.approx(value, rel=0.15) and p["low"] < p["value"] < p["high"]
    # a wider contact, which is refitted with and without it, follows most of what a crosstalk makes
    assert f.held_out["after"] < (0.9 if effect == "tactile_crosstalk" else 0.6) * f.held_out["before"]


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "planted", "values"), QUICK, ids=[q[0] for q in QUICK])
def test_planted_touch_effect_is_named_and_sized(tmp_path, effect, planted, values):
    check(tmp_path, effect, planted, values, {effect, "tactile_delay", "contact_stiffness"})


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "planted", "values"), QUICK + MORE, ids=[q[0] for q in QUICK + MORE])
def test_more_planted_touch_effects(tmp_path, effect, planted, values):
    check(tmp_path, effect, planted, values)


@pytest.mark.slow
def test_nothing_planted_nothing_found(plain):
    paths, model, servo = plain
    m = mechanism(model, servo)
    out = touch_result([read(p, joints=m.joints, audit=False) for p in paths], m, set())
    assert not out.findings and not out.structured and out.before[0] < 1.3 * out.floor


@pytest.mark.slow
def test_two_effects_at_once(tmp_path):
    out = found(tmp_path, sensor={"hysteresis": 0.3, "hysteresis_time": 0.4, "delay": 0.03})
    assert {f.effect for f in out.findings} == {"tactile_delay", "tactile_hysteresis"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "allowed",
    [
        pytest.param({"tactile_gain", "tactile_crosstalk"}, id="few"),
        pytest.param(None, id="all", marks=pytest.mark.slow),
    ],
)
def test_gains_dead_stuck_and_exchanged_taxels(allowed, tmp_path):
    # long enough for presses on every one of them
    out = found(tmp_path, 7.0, allowed, gains={54: 0.5, 66: 1.5, 67: 0.0}, stuck={80: 2.0}, swapped=[(55, 65)])
    (f,) = out.findings
    assert f.effect == "tactile_gain" and {"1:54", "1:55", "1:65", "1:66", "1:67", "1:80"} == set(
        f.taxels
    )
    gain = dict(zip(f.taxels, f.parameters["gain"]["value"], strict=True))
    assert (
        gain["1:54"] == pytest.approx(0.5, abs=0.1)
        and gain["1:66"] == pytest.approx(1.5, abs=0.2)
        and gain["1:67"] < 0.05
        and gain["1:80"] == 0
    )
    assert f.parameters["taxels"]["swapped"] == [["1:55", "1:65"]]


@pytest.mark.slow
def test_without_a_load_cell_gain_and_stiffness_are_a_set(tmp_path):
    (f,) = found(tmp_path, load_cell=False, stiffness=4500.0).findings
    assert (
        set(f.indistinguishable) == {"tactile_gain", "contact_stiffness"}
        and "load cell" in f.separating_experiment
        and f.confidence < 0.8
    )


# -- the whole diagnosis
# ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_rig_is_diagnosed_from_end_to_end(tmp_path):
    paths, model, servo = press_rig.record(tmp_path / "rig", 3, 5.0, seed=5, sensor={"delay": 0.06})
    few = {"tactile_delay", "tactile_hysteresis", "contact_stiffness"}
    d = diagnose(
        Settings(paths, tmp_path / "out", [], str(model), str(servo), next_recording=False, allowed=few),
        say=lambda _: None,
    )
    save(d, tmp_path / "out")
    data = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert data["verdict"] == "explained" and data["findings"][0]["effect"] == "tactile_delay"
    assert (
        data["held_out"]["error"] == "tactile_rmse_N" and data["held_out"]["after"] < 0.5 * data["held_out"]["before"]
    )
    assert "index's pad" in d.sentence and any("joints are not judged" in n for n in d.notes)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "taxel 66" in page and "tactile delay" in page


def test_touch_without_the_object_says_what_it_can(plain, tmp_path):
    """The same readings with the xHand's model: no object in it, so forces cannot be predicted; a dead taxel can be
    told."""
    paths, model, servo = plain
    r = read(paths[0], audit=False)
    r.tactile.value[:, 1, 66] = 0
    write(tmp_path / "a.mcap", r)
    bare = tmp_path / "bare.xml"
    bare.write_text(
        model.read_text()
        .replace('<geom name="ball"', '<geom name="ball" group="1"')
        .replace('type="sphere" ', 'type="ellipsoid" ')
        .replace('"0.012"', '"0.012 0.012 0.012"')
    )
    m = mechanism(model, servo)
    from dexsim.gap.touch import read as td

    kinds, td.KINDS = td.KINDS, {}
    try:
        out = touch_result([read(tmp_path / "a.mcap", joints=m.joints, audit=False)], m, set())
    finally:
        td.KINDS = kinds
    assert out.before is None and any("not what was touched" in n for n in out.notes)
    assert [f.taxels for f in out.findings] == [["1:66"]]


@pytest.mark.slow
def test_unknown_counts_leave_the_common_gain_open(tmp_path):
    paths, model, servo = press_rig.record(tmp_path, 3, 4.0, seed=2, gains=dict.fromkeys(range(120), 0.6))
    m = mechanism(model, servo)
    out = touch_result(
        [read(p, meta={"tactile_lsb": "unknown"}, joints=m.joints, audit=False) for p in paths], m, set()
    )
    assert not out.findings and any("tactile_lsb is unknown" in n for n in out.notes)


def test_joints_are_judged_in_free_air_alone():
    t = np.arange(0, 12, 0.01)
    q = np.sin(t)[:, None]
    run = Run("a", ("j",), t, q, t, q, None, np.zeros(3), torque=q.copy())
    notes: list[str] = []
    pieces, held = inputs.free_air([run], [0], {"a": [(4.0, 5.0), (5.9, 6.5)]}, notes)
    assert [(round(p.t[0], 1), round(p.t[-1], 1)) for p in pieces] == [(0.0, 3.9), (6.8, 12.0)]
    assert (
        held == [0, 1] and all(len(p.torque) == len(p.t) and p.name == "a" for p in pieces) and "free air" in notes[0]
    )
    assert inputs.free_air([run], [], {"a": [(0.5, 11.5)]}, notes) == ([], []) and "not judged" in notes[1]


def test_a_little_crosstalk_may_be_the_law_of_the_contact():
    def said(low: float) -> float:
        size = {"fraction": {"value": low + 0.05, "low": low, "high": low + 0.1}}
        f = Finding("tactile_crosstalk", 0.99, "", parameters=size, held_out={"before": 0.06, "after": 0.03})
        return confidence.of_touch([f], 0.06, 0.03)[0][0].confidence

    assert said(0.08) == JUDGE.doubted and said(0.2) == 0.99


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.8, 1.25])
def test_a_force_that_spreads_otherwise_than_the_law_is_no_crosstalk(plain, spread, monkeypatch):
    """Readings of a contact whose pressure reaches further (or less far): the reach is refitted, and nothing is
    named."""
    data, _, _ = collected(*plain)
    runs = data.runs[:2]
    for run in runs:
        x = touch_plant.readings(run, touch_plant.neutral() | {"spread": spread})
        run.z = np.round(x / run.lsb) * run.lsb
    best = touch_search.PadSearch(runs, set(), data.scale_known, False).run().best
    assert best.ids == () and abs(best.values["spread"] / spread - 1) < 0.06
    if spread > 1:  # as it was: the reach believed, the neighbours taken for guilty
        believed = touch_search.PadSearch._keys
        monkeypatch.setattr(touch_search.PadSearch, "_keys", lambda *a: tuple(k for k in believed(*a) if k != "spread"))
        alone = {"tactile_crosstalk"}  # nothing else is tried: what else it could be is another test's
        assert (
            "tactile_crosstalk"
            in touch_search.PadSearch(runs, set(), data.scale_known, False, allowed=alone).run().best.ids
        )
