"""The final hypotheses in the engine that trains: the same motion as a replay, said where it leaves more, handed on as
it was confirmed."""

from __future__ import annotations

import json
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import yaml
from test_gap import SERVO, demo, mechanism_of, motion, plant_run

from dexsim.actuator.table import ServoTable
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.judge import full_model
from dexsim.gap.judge.full_model import Hypothesis, World, free_runs
from dexsim.gap.plant.case import build
from dexsim.gap.read import conditions
from dexsim.gap.search.search import JointSearch, Member
from dexsim.paths import CONFIGS
from dexsim.recording import read
from dexsim.recording.mechanism import drive, mechanism, replay
from dexsim.recording.schema import COMMANDS, Series


def world(table: ServoTable, t: np.ndarray, cmd: np.ndarray, duration: float, q: float, v: float = 0.0) -> World:
    one = lambda x: np.array([float(x)])  # noqa: E731
    return World(
        table.nominal(["joint"]), table, np.array([0, 0, -9.81]), duration, one(q), one(v), one(cmd[0]), t, cmd[:, None]
    )


def test_worlds_of_a_batch_move_as_a_replay_of_each_does():
    table = ServoTable.from_dict({"joints": {"*": SERVO | {"delay": 0.013}}})
    m = mechanism_of(table)
    given = [motion(k, 2.0, k) for k in (0, 1)]
    together = free_runs(m.spec, ["joint"], [world(table, t, c, 2.0, c[0]) for t, c in given], timestep=1e-3)
    for q, (t, c) in zip(together, given, strict=True):
        alone = drive(m, Series(t, c[:, None], COMMANDS, t), ["joint"], 2.0, np.array([c[0]]), timestep=1e-3)
        assert np.abs(q[:2000, 0] - alone.position[:, 0]).max() < 1e-9


def test_a_run_begun_in_its_middle_goes_on_as_it_did():
    """Position, speed, and the commands that were sent shortly before and still act."""
    table = ServoTable.from_dict({"joints": {"*": SERVO | {"delay": 0.05}}})
    m = mechanism_of(table)
    t, c = motion(0, 3.0)
    whole = drive(m, Series(t, c[:, None], COMMANDS, t), ["joint"], 3.0, np.array([c[0]]), timestep=1e-3)
    late = world(table, t[t > 0.9] - 1.5, c[t > 0.9], 1.4, whole.position[1500, 0], whole.velocity[1500, 0])
    q = free_runs(m.spec, ["joint"], [late], timestep=1e-3)[0][:1400, 0]
    assert np.abs(q - whole.position[1500:2900, 0]).max() < 1e-6
    still = world(table, t[t > 1.5] - 1.5, c[t > 1.5], 1.4, whole.position[1500, 0], whole.velocity[1500, 0])
    # those commands matter
    assert np.abs(free_runs(m.spec, ["joint"], [still], timestep=1e-3)[0][:1400, 0] - q).max() > 1e-4


def test_a_freed_joint_swings():
    table = ServoTable.from_dict({"joints": {"*": SERVO | {"coulomb_friction": 0.0}}})
    t, c = motion(0, 1.0)
    w = world(table, t, np.full_like(c, 1.0), 1.0, 1.0)
    w.enabled = (np.array([0.0, 0.3]), np.array([[1.0], [0.0]]))
    q = free_runs(mechanism_of(table).spec, ["joint"], [w], timestep=1e-3)[0][:, 0]
    assert np.ptp(q[100:300]) < 0.08 and q[600] < q[299] - 0.3


@pytest.fixture(scope="module")
def answer(tmp_path_factory):
    """Return a diagnosis of dry friction in a simulated pendulum, and what it wrote."""
    folder = tmp_path_factory.mktemp("confirm")
    paths, model, servo, _ = demo.make(folder, "coulomb_friction", seconds=4.0)
    allowed = {"coulomb_friction", "stribeck_friction", "viscous_friction"}
    d = diagnose(
        Settings(paths, folder / "out", None, str(model), str(servo), next_recording=False, allowed=allowed),
        say=lambda _: None,
    )
    save(d, folder / "out")
    return d, folder, model


def test_the_answer_is_confirmed_and_the_page_says_so(answer):
    d, folder, _ = answer
    h = json.loads((folder / "out" / "diagnosis.json").read_text())["held_out"]
    c = json.loads((folder / "out" / "details.json").read_text())["held_out"]["confirmed"]
    assert (
        c["agrees"] is True
        and c["engine"] == "C MuJoCo"
        and c["not_handed_on"] == []
        and c["recordings"] == h["recordings"]
    )
    assert (
        c["found"]["plant"] == pytest.approx(h["after"], rel=0.02)
        and c["found"]["engine"] < 2.5 * d.data["noise_floor"]["position_rad"]
    )
    assert h["after"] < 1.3 * d.data["noise_floor"]["position_rad"]
    assert c["believed"]["engine"] > 10 * c["found"]["engine"]  # it tells right from wrong
    assert "confirmed" in d.sentence and f"{1e3 * c['found']['engine']:.3g} mrad" in d.sentence
    page = (folder / "out" / "report.html").read_text()
    assert "In the engine that trains" in page and "C MuJoCo" in page


def test_what_is_handed_on_replays_as_it_was_confirmed(answer):
    """servo.yaml, loaded and replayed by `play.py replay=`'s own function: the error that was confirmed."""
    d, folder, model = answer
    m = mechanism(str(model), str(folder / "out" / "servo.yaml"))
    c = d.confirmation
    recording = read(next(p for p in folder.glob("*.mcap") if p.name == c.recordings[0]), joints=m.joints)
    recording.meta["servo"] = ""
    run = replay(recording, m, timestep=c.step_s)
    t, q = recording.states.position.t, recording.states.position.value[:, 0]
    error = float(np.sqrt(np.mean((np.interp(t, run.t, run.position[:, 0]) - q) ** 2)))
    assert error == pytest.approx(c.errors["found"][0], rel=0.15)


def replayed(
    effect: str,
    label: str,
    hidden: dict[str, float],
    x: list[float],
    servo: dict | None = None,
    temperature: bool = False,
):
    """Return the recordings of the gap's own plant with an effect, and the confirmation of the very same hypothesis."""
    runs = [plant_run(f"r{k}", k, 4.0, hidden, seed=k, servo=servo, temperature=temperature) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    m = mechanism_of(runs[0].servo)
    case = build(mujoco.MjModel.from_xml_string(demo.MODEL), runs)[0]
    search = JointSearch(case, [0, 2], None, conditions(runs))
    none = search.start()
    variant = next(v for v in EFFECTS[effect].variants(case.scales) if v.label == label)
    found = search.fit((Member(EFFECTS[effect], variant),), np.array(x), none)
    return full_model.confirm(
        m,
        runs,
        [case],
        [Hypothesis("believed", {"joint": none}), Hypothesis("found", {"joint": found})],
        [1],
        None,
        4e-4,
    )


@pytest.mark.parametrize(
    ("effect", "label", "hidden", "x", "servo", "temperature"),
    [
        ("backlash", "", {"backlash": 0.05}, [0.05, 0.1], {"loop_encoder": "motor"}, False),
        (
            "backlash",
            "",
            {"backlash": 0.05},
            [0.05, 0.1],
            {"loop_encoder": "motor", "position_encoder": "motor"},
            False,
        ),
        ("compliance", "", {"softness": 0.4}, [0.4, 0.1], {"loop_encoder": "motor"}, False),
        ("lag", "velocity filter", {"speed_lag": 0.03}, [0.03], None, False),
        (
            "position_scale",
            "eccentricity",
            {"eccentric_sin": 0.15, "eccentric_cos": 0.15},
            [0.15, 0.15],
            {"kp": 0.8, "kd": 0.02},
            False,
        ),
        ("deadband", "counted from its edge", {"deadband": 0.03, "deadband_kind": 2.0}, [0.03], None, False),
        (
            "thermal",
            "friction",
            {"coulomb_friction": 0.06, "thermal_friction": 0.05},
            [0.05],
            {"coulomb_friction": 0.06},
            True,
        ),
    ],
)
def test_what_the_search_found_the_engine_does_too(effect, label, hidden, x, servo, temperature):
    """The plant of the search and the servo of training are two programs: what one simulates, the other replays."""
    c = replayed(effect, label, hidden, x, servo, temperature)
    engine, plant = c.errors["found"]
    assert c.missing == [] and "Not confirmed" not in c.text()
    # half the encoder's quantum
    assert c.errors["believed"][0] > 3 * engine and engine < max(1.7 * plant, 0.8e-3), c.errors


def test_no_more_is_replayed_than_is_worth_its_time(monkeypatch):
    """Of a long recording its begin, however much time there is."""
    whole = replayed("lag", "velocity filter", {"speed_lag": 0.03}, [0.03], None, False)
    monkeypatch.setattr(full_model, "MOST", 1.0)
    part = replayed("lag", "velocity filter", {"speed_lag": 0.03}, [0.03], None, False)
    long, short = whole.simulated["joint"], part.simulated["joint"]
    assert 95 <= len(short) <= 105 < len(long)
    np.testing.assert_allclose(short, long[: len(short)], atol=1e-9)


def test_what_training_cannot_be_given_is_not_confirmed():
    """The motor's servo has no linkage: the search's plant follows what it names, the engine does not, and both are
    said."""
    member = Member(
        EFFECTS["joint_coupling"], EFFECTS["joint_coupling"].variants(SimpleNamespace(others=("other",)))[1]
    )
    trial = SimpleNamespace(members=(member,), fit=SimpleNamespace(params=member.variant.params, x=np.array([0.3])))
    assert full_model.missing_of(Hypothesis("found", {"joint": trial})) == ["joint_coupling (linkage with other)@joint"]
    c = full_model.Confirmation(
        "C MuJoCo",
        5e-4,
        {"believed": (6e-3, 6e-3), "found": (5e-3, 1e-3)},
        {},
        full_model.missing_of(Hypothesis("found", {"joint": trial})),
        [],
        full_model.agree(5e-3, 1e-3, 1e-3, 6e-3),
        1e-3,
    )
    assert not c.agrees and "Not confirmed" in c.text() and "joint_coupling (linkage with other)@joint" in c.text()


@pytest.mark.parametrize(("engine", "word"), [(1.2e-3, True), (1.5e-3, True), (2.6e-3, False)])
def test_confirmed_is_what_leaves_little_of_the_error_before(engine, word):
    """Floor 1 mrad, the plant leaves as much, 20 mrad before: within 1.3 x of it, or a tenth of the error before in
    squares."""
    assert full_model.agree(engine, 1e-3, 1e-3, 20e-3) is word
    assert full_model.agree(engine, 1e-3, 1e-3, 1.5e-3) is (engine < 1.3e-3)


def test_what_the_engine_follows_in_the_main_is_said_so():
    one = {"joint": (1e-3, 5e-4)}
    c = full_model.Confirmation(
        "C MuJoCo", 5e-4, {"believed": (6e-3, 6e-3), "found": (1e-3, 5e-4)}, one, [], ["a.mcap"], False, 4e-4
    )
    assert c.text() == "Replayed in the engine that trains, 1 mrad of 6 are left, more than in the search's own plant."
    c.errors["found"] = (5e-3, 5e-4)
    assert c.text().startswith("Not confirmed by the engine that trains: it leaves 5 mrad")


def test_the_tasks_step_is_that_of_the_configuration():
    configured = yaml.safe_load((CONFIGS / "config.yaml").read_text())
    assert full_model.TASKS == configured["sim"]["timestep"]
