"""What is written of each joint, chosen by replay in the engine that trains: the same motion as `play replay=`, and its
number."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from test_gap import SERVO, demo, mechanism_of, motion, plant_run

from dexsim import guard, system
from dexsim.actuator.columns import INDEX as SERVO_INDEX
from dexsim.actuator.table import ServoTable
from dexsim.cli import recorded
from dexsim.errors import UserError
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.judge import full_model
from dexsim.gap.judge.full_model import World, free_runs
from dexsim.gap.judge.handed_on import missing_of, model_changes, servo_changes, values_of
from dexsim.gap.plant.case import build
from dexsim.gap.plant.free_run import free_run
from dexsim.gap.read import conditions
from dexsim.gap.search.search import JointSearch, Member
from dexsim.paths import CONFIGS
from dexsim.recording.mechanism import drive, mechanism, of_recording
from dexsim.recording.schema import COMMANDS, Series, States


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
    # with the armature, damping and dry friction of its own model each
    t, c = given[0]
    for k, (armature, damping, friction) in enumerate(((0.0, 0.0, 0.01), (0.02, 0.05, 0.0))):
        other = mechanism_of(table)
        joint = other.spec.joint("joint")
        joint.armature, joint.damping, joint.frictionloss = armature, [damping, 0.0, 0.0], friction
        assert full_model.frame_of(m, other.spec) == full_model.frame_of(m, m.spec)
        own = world(table, t, c, 2.0, c[0])
        own.figures = np.array([[damping], [friction], [armature]])
        q = free_runs(m.spec, ["joint"], [world(table, t, c, 2.0, c[0]), own], timestep=1e-3)[1]
        alone = drive(other, Series(t, c[:, None], COMMANDS, t), ["joint"], 2.0, np.array([c[0]]), timestep=1e-3)
        assert np.abs(q[:2000, 0] - alone.position[:, 0]).max() < 1e-9 < np.abs(q - together[0]).max(), k


def test_a_link_that_meets_a_wall_in_a_replay_is_stopped_as_in_play():
    m = mechanism_of(ServoTable.from_dict({"joints": {"*": SERVO}}))
    m.spec.geom("bob").contype = m.spec.geom("bob").conaffinity = 1
    t, c = motion(1, 2.0, 0)
    run = lambda: drive(m, Series(t, c[:, None], COMMANDS, t), ["joint"], 2.0, np.array([c[0]]), timestep=1e-3)  # noqa: E731
    free = run().position[:, 0]
    at = 0.5 * (free.max() + free[0])  # the wall is met on the way
    m.spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.012, 0, 0], pos=[-0.1 * np.sin(at), 0, -0.1 * np.cos(at)]
    )
    stopped = run().position[:, 0]
    q = free_runs(m.spec, ["joint"], [world(m.table, t, c, 2.0, c[0])], timestep=1e-3)[0][:2000, 0]
    assert np.abs(q - stopped).max() < 1e-9 < 1e-2 < np.abs(free - stopped).max()
    # of worlds side by side each has its own contacts
    away = world(m.table, t, c - 0.3, 2.0, c[0] - 0.3)
    alone, (q, beside) = free_runs(m.spec, ["joint"], [away], timestep=1e-3)[0], (
        free_runs(m.spec, ["joint"], [world(m.table, t, c, 2.0, c[0]), away], timestep=1e-3)
    )
    assert np.abs(q[:2000, 0] - stopped).max() < 1e-9 and np.array_equal(beside, alone)


@pytest.mark.parametrize("far", [0.5, 1.6])
def test_fingers_that_rest_are_left_out_of_a_replay_until_something_touches(far, monkeypatch):
    """The hand's middle finger moves, its others are told nothing; bent by 1.6 rad it meets what is fixed."""
    m, t, k = mechanism(), np.arange(0.0, 1.5, 0.01), 6
    assert m.joints[k] == "mid_joint1"
    targets = np.full((len(t), len(m.joints)), np.nan)
    targets[:, k] = far * np.sin(np.pi * t / 1.5)
    rest = np.zeros(len(m.joints))
    w = World(m.table.nominal(m.joints), m.table, np.array([0, 0, -9.81]), 1.5, rest, rest, rest, t, targets)
    if far > 1:
        palm = m.spec.body("right_hand_mid_link1").parent
        model = m.spec.compile()
        data, tip = mujoco.MjData(model), model.body("right_hand_mid_link2").id
        data.qpos[k] = 0.6 * far
        mujoco.mj_forward(model, data)
        at = data.xmat[palm.id].reshape(3, 3).T @ (data.xipos[tip] - data.xpos[palm.id])
        palm.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.004, 0, 0], pos=at)
    sizes, engine = [], full_model.make_engine
    made = lambda spec, *a, **o: sizes.append(spec.compile().nv) or engine(spec, *a, **o)  # noqa: E731
    monkeypatch.setattr(full_model, "make_engine", made)
    light = free_runs(m.spec, m.joints, [w], engine="mujoco")[0]
    monkeypatch.setattr(full_model, "_moving", lambda model, joints, worlds: [])
    whole = free_runs(m.spec, m.joints, [w], engine="mujoco")[0]
    assert sizes == ([2, 12] if far < 1 else [2, 12, 12])
    assert np.abs(light - whole)[:, k].max() < 1e-9 and np.ptp(whole[:, k]) > 0.3
    assert np.abs(light - whole).max() < 0.02  # they rest, but for what gravity bends


def test_of_what_is_replayed_whole_only_what_is_far_behind_on_every_joint_is_left_out():
    kinds = [dict.fromkeys("ab", k) for k in ("found", "refitted", "believed", "plain")]
    noise = {"a": 1.0, "b": 0.01}
    # a: all but what is believed are within the noise; b: the plain model is half of what was found
    missed = [{"a": 1.0, "b": 4.0}, {"a": 1.1, "b": 3.9}, {"a": 9.0, "b": 8.1}, {"a": 1.2, "b": 2.0}]
    assert full_model.behind(kinds, missed, noise) == {2}
    missed[3]["b"] = 1.9
    assert full_model.behind(kinds, missed, noise) == {1, 2}


@pytest.mark.limits
def test_on_several_cores_worlds_move_as_on_one(monkeypatch):
    """In processes of their own, to the last bit; a process that breaks is made up for."""
    table = ServoTable.from_dict({"joints": {"*": SERVO | {"delay": 0.013}}})
    m = mechanism_of(table)
    worlds = [world(table, *motion(k % 2, 1.0, k), 1.0 - 0.2 * k, 0.0) for k in range(4)]
    for w, armature in zip(worlds, (1.0, 2.0, 2.0, 1.0), strict=True):
        w.spec = m.spec.copy()
        w.spec.joint("joint").armature *= armature
    forked, real = [], guard.turns

    def turns(work, **rest):
        forked.append(work)
        if len(forked) % 3 == 0:
            raise UserError("broken")
        return (yield from real(work, **rest))

    monkeypatch.setattr(guard, "turns", turns)
    moved = []
    for cores in ("1", "2", "16"):
        monkeypatch.setenv("OMP_NUM_THREADS", cores)
        moved.append(free_runs(m.spec, ["joint"], worlds, timestep=1e-3))
    assert all(np.array_equal(a, b) for x in moved[1:] for a, b in zip(moved[0], x, strict=True))
    assert len(forked) >= 6 or system.start_method() != "fork"
    assert np.abs(moved[0][0][:300] - moved[0][2][:300]).max() > 1e-4  # another motion, another model


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


def test_a_joint_that_sticks_does_not_creep(tmp_path):
    """Of a model from a file that says nothing of how hard friction holds: 5 s under 0.8 of it."""
    file = tmp_path / "rig.xml"
    file.write_text(re.sub("solimpfriction.*solreffriction=.*1\"", "", demo.MODEL))
    m = mechanism(file, {"joints": {"*": SERVO | {"kp": 2.0, "coulomb_friction": 0.1, "stribeck_peak": 0.0}}})
    t = np.array([0.0])
    run = drive(m, Series(t, np.full((1, 1), 0.04), COMMANDS, t), ["joint"], 5.0, np.zeros(1))
    assert np.abs(run.position).max() < 1e-4
    assert np.ptp(drive(m, Series(t, np.full((1, 1), 0.2), COMMANDS, t), ["joint"], 1.0, np.zeros(1)).position) > 0.05


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


def test_the_files_are_replayed_and_that_is_the_number_of_the_report(answer):
    d, folder, model = answer
    h = json.loads((folder / "out" / "diagnosis.json").read_text())["held_out"]
    r = h["replayed"]
    assert r["engine"] == "C MuJoCo" and list(r["recordings"]) == h["recordings"] and r["joints"]["joint"] == r["error"]
    assert d.written.chosen["joint"] in (*full_model.ORDER[:2], "plain")
    assert h["after"] < 1.3 * d.data["noise_floor"]["position_rad"]
    assert d.written.errors["joint"]["believed"] > 10 * r["error"]  # it tells right from wrong
    # what the choice went by is that number
    assert r["error"] == pytest.approx(d.written.errors["joint"][d.written.chosen["joint"]], rel=1e-6)
    assert r["error"] == pytest.approx(h["after"], rel=0.5)
    # the one number of the sentence, and so of the page's first lines
    assert f"the files as written, replayed in the engine that trains, leave {1e3 * r['error']:.3g} on" in d.sentence
    assert d.sentence.count("leave") == 1 and "with it, by" not in d.sentence
    page = (folder / "out" / "report.html").read_text()
    assert "What is written of each joint" in page and "as written, replayed" in page


def test_play_prints_the_number_of_the_report(answer, tmp_path, capsys):
    """`play.py replay=` of each recording that was held out, with the files that were written."""
    d, folder, model = answer
    r = json.loads((folder / "out" / "diagnosis.json").read_text())["held_out"]["replayed"]
    assert r["parts"]
    for part in r["parts"]:
        path = next(p for p in folder.rglob(part["recording"]) if p.suffix == ".mcap")
        argv = [f"replay={path}", f"model={model}", f"servo={folder / 'out' / 'servo.yaml'}", "video=false"]
        argv += [f"out={tmp_path / 'play'}", f"start={part['start']}", f"end={part['end']}"]
        recorded.run(recorded.settings(argv, CONFIGS))
        said = json.loads((tmp_path / "play" / "metrics.json").read_text())
        number = r["recordings"][part["recording"]]["joint"]
        assert said["position_rmse_rad"]["joint"] == pytest.approx(number, rel=1e-3)
        assert f"{1e3 * number:.2f}" in capsys.readouterr().out


def replayed(
    effect: str,
    label: str,
    hidden: dict[str, float],
    x: list[float],
    servo: dict | None = None,
    temperature: bool = False,
):
    """Return what is written of recordings of the gap's own plant with an effect, by the very same hypothesis."""
    runs = [plant_run(f"r{k}", k, 4.0, hidden, seed=k, servo=servo, temperature=temperature) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    m = mechanism_of(runs[0].servo)
    case = build(mujoco.MjModel.from_xml_string(demo.MODEL), runs)[0]
    search = JointSearch(case, [0, 2], None, conditions(runs))
    none = search.start()
    variant = next(v for v in EFFECTS[effect].variants(case.scales) if v.label == label)
    found = search.fit((Member(EFFECTS[effect], variant),), np.array(x), none)
    return best_of(m, runs, case, {"refitted": none, "found": found})


def best_of(m, runs, case, trials, **more):
    """Return what is written of the only joint, of fitted hypotheses by name; run 1 is held out. more: of
    `write_best`."""
    windows = case.plant.windows(None, [1])
    states = lambda r: States(Series(r.t, r.q), None, None)  # noqa: E731
    recordings = {r.name: SimpleNamespace(joints=r.joints, states=states(r)) for r in runs}

    def candidate(name, trial):
        fixed = [f for x in trial.members for f in x.variant.fixed]
        q = free_run(case, trial.fit.params, trial.fit.x, windows, fixed)[0]
        plant = float(np.sqrt(np.mean((case.plant.q[windows.sample_row] - q) ** 2)))
        bounds = np.stack([trial.fit.x, trial.fit.x], 1)

        def write(table, spec):
            servo_changes(table, case, trial, bounds, m.joints)
            return model_changes(spec, case, trial, values_of(trial))

        return full_model.Candidate(name, plant, write, missing_of(case, trial))

    given = {case.joint: [candidate(name, trial) for name, trial in trials.items()]}
    return full_model.write_best(m, runs, recordings, [case], given, {case.joint: 4e-4}, [1], None, **more)


@pytest.mark.parametrize(
    ("effect", "label", "hidden", "x", "servo", "temperature"),
    [
        ("backlash", "", {"backlash": 0.05}, [0.05, 0.1], {"loop_encoder": "motor"}, False),
        pytest.param(
            "backlash",
            "",
            {"backlash": 0.05},
            [0.05, 0.1],
            {"loop_encoder": "motor", "position_encoder": "motor"},
            False,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "compliance", "", {"softness": 0.4}, [0.4, 0.1], {"loop_encoder": "motor"}, False, marks=pytest.mark.slow
        ),
        ("lag", "velocity filter", {"speed_lag": 0.03}, [0.03], None, False),
        pytest.param(
            "position_scale",
            "eccentricity",
            {"eccentric_sin": 0.15, "eccentric_cos": 0.15},
            [0.15, 0.15],
            {"kp": 0.8, "kd": 0.02},
            False,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "deadband",
            "counted from its edge",
            {"deadband": 0.03, "deadband_kind": 2.0},
            [0.03],
            None,
            False,
            marks=pytest.mark.slow,
        ),
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
    engine, plant = c.errors["joint"]["found"], c.candidates["joint"][1].plant
    assert c.candidates["joint"][1].missing == () and c.chosen == {"joint": "found"} and c.by_replay
    # half the encoder's quantum
    assert c.errors["joint"]["refitted"] > 3 * engine and engine < max(1.7 * plant, 0.8e-3), c.errors


def test_what_training_cannot_be_given_is_said():
    """The motor's servo has no linkage: the search's plant follows what it names, the engine does not, and both are
    said."""
    member = Member(
        EFFECTS["joint_coupling"], EFFECTS["joint_coupling"].variants(SimpleNamespace(others=("other",)))[1]
    )
    trial = SimpleNamespace(members=(member,), fit=SimpleNamespace(params=member.variant.params, x=np.array([0.3])))
    missing = missing_of(SimpleNamespace(joint="joint"), trial)
    assert missing[0] == "joint_coupling (linkage with other)@joint"
    found = full_model.Candidate("found", 1e-3, lambda table, spec: [], missing)
    w = full_model.Written({"joint": [found]}, {"joint": {"found": 5e-3}}, {"joint": "found"}, True)
    w.replayed = full_model.Replayed(5e-3, {"joint": 5e-3}, {}, [])
    (said,) = w.differences({"joint": {"sigma": 1e-4}})
    assert "leaves 5 mrad in the engine that trains and 1 in the search's own plant" in said and missing[0] in said
    w.replayed.joints["joint"] = 1.05e-3
    assert w.differences({"joint": {"sigma": 1e-4}}) == []


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ({"found": 1.0, "refitted": 2.0, "believed": 3.0, "plain": 0.96}, "found"),  # alike
        ({"found": 1.0, "refitted": 2.0, "believed": 3.0, "plain": 0.9}, "plain"),
        ({"found": 4.0, "refitted": 2.0, "believed": 3.0, "plain": 5.0}, "refitted"),  # a name that only harms
        ({"found": 2.02, "refitted": 2.0, "believed": 3.0}, "refitted"),
        ({"found": 4.0, "refitted": 3.5, "believed": 3.0, "plain": np.inf}, "believed"),
        ({"found": 0.12, "refitted": 0.12, "believed": 0.1, "plain": 0.05}, "found"),  # all within the noise
        ({"refitted": np.inf, "believed": np.inf}, "refitted"),
    ],
)
def test_of_a_joint_what_follows_best_is_written(errors, chosen):
    assert full_model.choose(errors, 0.1) == chosen


def test_what_was_found_is_beaten_where_it_follows_worse_beyond_the_belief_and_the_noise():
    """The plain model is written in each; plant: what was found leaves where the plain model leaves 1."""
    for plant, noise, chosen, beaten in (
        (1.04, 0.1, "plain", False),
        (1.07, 0.1, "plain", True),
        (1.07, 0.1, "found", False),
        (1.25, 1.0, "plain", False),
        (1.35, 1.0, "plain", True),
    ):
        given = [full_model.Candidate("found", plant, None), full_model.Candidate("plain", 1.0, None)]
        written = full_model.Written({"j": given}, {}, {"j": chosen})
        assert written.beaten("j", noise) is beaten, (plant, noise, chosen)


def test_what_was_fitted_goes_before_what_a_recording_says_but_for_what_differs():
    """For a gain that each recording states itself, the fit's factor is written; of the rest its value."""
    believed = {"joints": {"*": {"kp": 5.0, "kd": 0.1, "delay": 0.01, "coulomb_friction": 0.02}}}
    m = mechanism_of(ServoTable.from_dict(believed))
    table = ServoTable.from_dict(
        {"joints": believed["joints"] | {"joint": {"kp": 5.25, "kd": 0.12}}, "fitted": {"joint": {"kp": 1.05}}}
    )
    other = {"kp": 2.0, "coulomb_friction": 0.05}
    for stated, kp, friction in (({"kp": 8.0, "kd": 0.3}, 8.4, 0.02), (other, 2.1, 0.05)):
        meta = {"servo": json.dumps({"joints": {"joint": stated}})}
        r = SimpleNamespace(path="r", joints=("joint",), gravity=np.zeros(3), meta=meta)
        own = of_recording(m, r).table  # as believed: the recording wins
        assert own.value("joint", "kp").value == stated["kp"] and own.value("joint", "delay").value == 0.01
        written = of_recording(mechanism_of(table), r).table.nominal(["joint"])
        names = ("kp", "kd", "delay", "coulomb_friction")
        got = [written[0, SERVO_INDEX[n]] for n in names]
        assert got == pytest.approx([kp, 0.12, 0.01, friction])
        run = SimpleNamespace(servo=own, supply=None)
        assert full_model.rows_of(table, run, ["joint"])[0] == pytest.approx(written[0], nan_ok=True)


@pytest.mark.parametrize("budget, share", [(1e6, 1.0), (12.0, 0.8), (3.0, 0.25)])
def test_the_choice_keeps_to_the_time_there_is(budget, share, monkeypatch):
    """A world takes a second for each second of it: two candidates over 4 s."""
    runs = [plant_run(f"r{k}", k, 4.0, {"lag": 0.02}, seed=k) for k in (0, 1)]
    for r in runs:
        r.smooth()
    case, clock, real = build(mujoco.MjModel.from_xml_string(demo.MODEL), runs)[0], [0.0], full_model.free_runs

    def slow(spec, joints, worlds, *rest, **more):
        clock[0] += sum(w.duration for w in worlds)
        return real(spec, joints, worlds, *rest, **more)

    monkeypatch.setattr(full_model, "free_runs", slow)
    monkeypatch.setattr(full_model.time, "monotonic", lambda: clock[0])
    none = JointSearch(case, [0], None, conditions(runs)).start()
    room = lambda: budget - clock[0]  # noqa: E731
    w = best_of(mechanism_of(runs[0].servo), runs, case, {"refitted": none, "believed": none}, room=room)
    assert clock[0] <= budget and w.by_replay and w.share == pytest.approx(share, abs=0.2)
    monkeypatch.setattr(full_model, "LEAST", 0.5)
    assert best_of(mechanism_of(runs[0].servo), runs, case, {"refitted": none}, room=lambda: 1e-3).by_replay is False


def test_a_joint_that_anothers_choice_harms_is_not_left_worse_than_plain():
    """b's found model throws a off unless c is as found too, which itself is worse than believed: a swap of b alone
    is fair to all, and neither a kind for all nor the best of each is."""

    def left(choice):
        a = {"believed": 3.0, "plain": 1.0, "found": 0.8}[choice["a"]]
        harmed = choice["b"] == "found" and choice["c"] != "found"
        b = {"believed": 3.0, "plain": 1.03, "found": 1.0}[choice["b"]]
        return {"a": 1.3 if harmed else a, "b": b, "c": {"believed": 1.0, "plain": 2.0, "found": 3.0}[choice["c"]]}

    by = {j: ("believed", "plain", "found") for j in "abc"}
    errors = {j: {} for j in by}
    done = [(x, left(x)) for x in full_model.kinds_of(by)]
    chosen = full_model.composed(by, errors, dict.fromkeys(by, 1e-3), done, lambda xs: [left(x) for x in xs])
    least = {j: min(errors[j]["believed"], errors[j]["plain"]) for j in by}
    assert all(left(chosen)[j] <= 1.05 * least[j] for j in by), (chosen, errors)
