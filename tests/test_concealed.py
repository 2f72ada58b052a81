"""The concealed benchmark itself: its plant against the pendulum's own formulas, and that nothing but the motion
tells."""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from benchmarks import answers
from benchmarks.concealed import __main__ as command
from benchmarks.concealed import effects, generate, plant, rigs, score, touch
from dexsim.hand import load_hand
from dexsim.recording import read
from tests.made_hand import made_hand

SMOOTH = {"coulomb": 0.0, "viscous": 0.0, "kp": 0.0, "kd": 0.0}
BOB = plant.pendulum(0.1)


def run(
    rows: int, steps: int, command: float | np.ndarray = 0.0, rig=BOB, q0=0.0, driven: bool = True, **values
) -> dict[str, np.ndarray]:
    """Return one-joint rows of the plant; outputs [rows, steps]."""
    c = np.broadcast_to(np.asarray(command, float), (rows, 1, steps))
    p = plant.rows(rows, len(rig.names), **values)
    return {
        k: v[:, 0]
        for k, v in plant.simulate(
            rig, p, np.repeat(c, len(rig.names), 1), q0=np.asarray(q0, float).reshape(-1, 1), driven=driven
        ).items()
    }


def crossings(x: np.ndarray) -> np.ndarray:
    """Times [s] at which a millisecond-sampled signal rises through zero."""
    i = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    return 1e-3 * (i - x[i] / (x[i + 1] - x[i]))


def test_plant_imports_nothing_of_the_simulator():
    for module in (plant, effects, touch):
        tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
        names = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names |= {a.name.split(".")[0] for a in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add((node.module or "").split(".")[0])
        assert names <= {"__future__", "numpy", "dataclasses", "collections"}, names


@pytest.mark.slow
def test_pendulum_swings_at_its_own_frequency():
    """Both inertias count, and the period grows with the amplitude: T = T0 (1 + a^2/16 + 11 a^4/3072)."""
    amplitude = np.array([0.05, 0.9])
    q = run(2, 2400, q0=amplitude, driven=False, **SMOOTH)["position"]
    expected = (
        2
        * np.pi
        * np.sqrt((0.15 * 0.1**2 + 4e-4) / (0.15 * 9.81 * 0.1))
        * (1 + amplitude**2 / 16 + 11 * amplitude**4 / 3072)
    )
    for row in range(2):
        assert np.diff(crossings(q[row])).mean() == pytest.approx(expected[row], rel=0.003)
    assert np.abs(q[:, -800:]).max(1) == pytest.approx(amplitude, rel=0.02)  # the step itself takes no energy


def test_links_of_an_arm_move_as_lagrange_says():
    """Two-link planar arm: mass matrix, gravity and Coriolis torques against the formulas of a textbook (point
    masses)."""
    l1, c1, c2, m1, m2 = 0.1, 0.07, 0.06, 0.2, 0.12
    rig = plant.Rig(
        ("a", "b"),
        np.array([[0, 0], [0, 1]]),
        np.tile(np.eye(3), (1, 2, 1, 1)),
        np.array([[[0, 0, 0], [0, 0, -l1]]]),
        np.array([[[0, 1.0, 0]] * 2]),
        np.array([[[0, 0, -c1], [0, 0, -c2]]]),
        np.zeros((1, 2, 3, 3)),
        np.array([0, 0, -9.81]),
    )
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-1, 1, (5, 1, 2)), rng.uniform(-4, 4, (5, 1, 2))
    mass = np.tile([m1, m2], (5, 1, 1))
    M, h = plant.dynamics(rig, mass, 0 * mass, 0 * mass + 1, q, v, np.tile(rig.gravity, (5, 1)))
    a, b, va, vb = q[:, 0, 0], q[:, 0, 1], v[:, 0, 0], v[:, 0, 1]
    s = m2 * l1 * c2 * np.sin(b)
    assert M[:, 0, 0, 0] == pytest.approx(m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * np.cos(b)))
    assert M[:, 0, 0, 1] == pytest.approx(m2 * (c2**2 + l1 * c2 * np.cos(b))) and M[:, 0, 1, 1] == pytest.approx(
        m2 * c2**2
    )
    lower = m2 * 9.81 * c2 * np.sin(a + b)
    assert h[:, 0, 0] == pytest.approx(-s * (2 * va * vb + vb**2) + (m1 * c1 + m2 * l1) * 9.81 * np.sin(a) + lower)
    assert h[:, 0, 1] == pytest.approx(s * va**2 + lower)


@pytest.mark.slow
def test_friction_holds_below_its_level_and_play_is_as_wide_as_said():
    # the weight asks for 0.115 N.m
    q = run(2, 2000, q0=[0.9, 0.9], driven=False, **(SMOOTH | {"coulomb": np.array([0.05, 0.2])}))["position"]
    assert abs(q[0, -1]) < 0.6 and abs(q[1, -1] - 0.9) < 0.02
    # a motor held in place: the link hangs on one flank, and pulled up by a spring on the other
    play = np.array([0.02, 0.06])
    o = run(2, 1500, 0.5, q0=[0.5, 0.5], kp=8.0, kd=0.2, torque_limit=5.0, play=play, motor_side=1.0, coulomb=0.0)
    hangs = 0.15 * 9.81 * 0.1 * np.sin(o["position"][:, -1])
    assert o["position"][:, -1] == pytest.approx(0.5 - hangs / 8.0 - play / 2, abs=1.5e-3)
    assert (o["free"].sum(1) > 0).all()


def test_delay_is_felt_after_its_time():
    delay = np.array([0.0, 0.0125, 0.04])
    q = run(3, 400, np.where(np.arange(400) >= 100, 0.4, 0.0), delay=delay)["position"]
    at = [np.interp(0.1, row[100:], np.arange(300) * 1e-3) for row in q]
    assert np.diff(at) == pytest.approx(np.diff(delay), abs=6e-4)


@pytest.mark.slow
def test_other_joints_matter_where_they_should():
    """Coupling moves a joint by its share of another's motion; a sagging supply takes torque only while the other one
    works."""
    rig = plant.pendulum(names=("a", "b"), lengths=(0.1, 0.1))
    p = plant.rows(2, 2, kp=8.0, kd=0.2, torque_limit=5.0, couple=np.array([[0.0, 0.0], [0.0, 0.1]]), motor_side=1.0)
    c = np.zeros((2, 2, 1500))
    c[:, 0] = 0.5
    q = plant.simulate(rig, p, c)["position"]
    assert q[0, 1, -1] == pytest.approx(0.0, abs=2e-3) and q[1, 1, -1] == pytest.approx(0.1 * q[1, 0, -1], rel=0.15)
    p = plant.rows(
        2,
        2,
        voltage=1.0,
        kp=2.0,
        kd=0.0,
        torque_limit=1.0,
        no_load_speed=10.0,
        coulomb=1e-3,
        sag=np.array([[0.0, 3.0]]),
    )
    hold = np.zeros((2, 2, 1200))
    hold[:, 1], hold[1, 0] = 0.6, 1.2
    alone, together = plant.simulate(rig, p, hold, q0=np.array([[0.0, 0.5]] * 2))["position"][:, 1, -1]
    assert together < alone - 0.01


def test_ball_on_a_flat_pad():
    """A ball pressed on a square of two triangles: depth by hand, force by its law, all of it on the taxels, read late
    and with its gain."""
    square = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]]) * 0.02
    xy = np.stack(np.meshgrid(np.arange(-6, 7) * 2e-3, np.arange(-6, 7) * 2e-3), -1).reshape(-1, 2)
    points = np.c_[xy, np.zeros(len(xy))]
    pad = touch.Pad(
        square,
        1e-4,
        points,
        np.tile([0, 0, 1.0], (len(xy), 1)),
        np.full(len(xy), 4e-6),
        np.array([0, 0, 0.0141]),
        np.array([0, 0, -1.0]),
        np.array([1.0, 0, 0]),
        0.012,
        np.zeros(3),
    )
    assert pad.depth(np.array([0.0, 3e-3]), np.array([0.0, 1e-3])) == pytest.approx([-2e-3, 1e-3], abs=2e-5)
    command = np.zeros((2, 400))
    command[1] = np.where(np.arange(400) > 100, 4e-3, 0.0)
    p = touch.DEFAULTS | {"gain": 0.5, "delay": 0.05}
    q, force = touch.move(pad, p, command)
    assert force[-1] == pytest.approx(7000 * (q[1, -1] - 2e-3), rel=0.01) and force[-1] == pytest.approx(
        4000 * (4e-3 - q[1, -1]), rel=0.01
    )
    z = touch.readings(pad, p, q, force)
    assert z[-1].sum() == pytest.approx(0.5 * force[-1], rel=1e-3) and points[z[-1].argmax()] == pytest.approx(
        [0, 0, 0]
    )
    first = [int(np.flatnonzero(x > 0.05 * x.max())[0]) for x in (force, z.sum(1))]
    assert first[1] - first[0] == 50
    held = touch.readings(pad, p | {"delay": 0.0, "fraction": 0.4, "time_constant": 0.02}, q, force).sum(1)
    # stiffer while fast, then relaxed
    assert held.max() > 1.1 * 0.5 * force.max() and held[-1] == pytest.approx(0.5 * force[-1], rel=0.01)
    spread = touch.readings(pad, p | {"delay": 0.0, "crosstalk": 0.3}, q, force)[-1]
    assert (spread > 0.01).sum() > (z[-1] > 0.01).sum() and spread.sum() == pytest.approx(z[-1].sum(), rel=0.02)


def entries(*kinds: str, shape: str = "one", tier: str = "easy") -> list[dict]:
    """Plan entries of given kinds ("none": nothing missing)."""
    return [
        {
            "group": "none" if k == "none" else "outside" if k in effects.OUTSIDE else "effect",
            "kinds": [] if k == "none" else [k],
            "tier": tier,
            "shape": shape,
            "joints": [],
        }
        for k in kinds
    ]


@pytest.fixture
def quick(monkeypatch):
    """Short recordings, few sizes."""
    monkeypatch.setattr(generate, "SECONDS", 0.6)
    monkeypatch.setattr(generate, "SIZES", 2)


@pytest.fixture(scope="module")
def some(tmp_path_factory):
    """Return one case of several kinds from one seed, with the fast settings of a test."""
    root = tmp_path_factory.mktemp("cases")
    seconds, generate.SECONDS = generate.SECONDS, 0.6
    sizes, generate.SIZES = generate.SIZES, 2
    try:
        plan = entries("none", "backlash", "coulomb", "cable_spring", "torque_limit")
        made = [generate.build(e, n, 3, root / "cases", root / "truth") for n, e in enumerate(plan)]
    finally:
        generate.SECONDS, generate.SIZES = seconds, sizes
    return root, made, plan


@pytest.mark.slow
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
    assert len(facts) == 1


@pytest.mark.slow
def test_metadata_classifier_is_at_chance(quick, tmp_path):
    """Everything that is not motion, of thirty cases in two classes, through a leave-one-out nearest-neighbour
    classifier."""
    features, labels = [], []
    for n in range(30):
        kind = ("none", "stribeck")[n % 2]
        made = generate.build(entries(kind)[0], n, 4, tmp_path / "cases", tmp_path / "truth")
        folder = tmp_path / "cases" / made["name"]
        r = read(folder / "a.mcap")
        servo = yaml.safe_load((folder / "servo.yaml").read_text(encoding="utf-8"))
        row = [
            int(made["name"], 16) / 2**32,
            servo["drive"] == "voltage",
            servo["loop_encoder"] == "motor",
            r.meta["effort_is"] == "none",
            (folder / "rig.xml").stat().st_size,
            len(r.states.position),
            float(r.states.position.t[0]),
            len(r.temperature),
        ]
        features.append(np.array(row + list(servo["joints"]["joint0"].values()), float))
        labels.append(n % 2)
    x, y = np.array(features), np.array(labels)
    x = (x - x.mean(0)) / (x.std(0) + 1e-12)
    distance = ((x[:, None] - x[None]) ** 2).sum(-1) + 1e9 * np.eye(len(x))
    hits = int((y[distance.argmin(1)] == y).sum())
    assert hits <= 21, hits  # chance is 15; more than 21 of 30 has probability 0.8 %


@pytest.mark.slow
def test_what_is_believed_does_not_depend_on_the_effect(quick, tmp_path):
    """The same case number with another effect: rig, servo, metadata and commands are the same to the byte."""
    texts = set()
    for kind in ("lag", "payload", "dwell_stiction", "none"):
        made = generate.build(entries(kind, tier="hard")[0], 5, 3, tmp_path / kind, tmp_path / "truth" / kind)
        folder = tmp_path / kind / made["name"]
        r = read(folder / "a.mcap")
        texts.add(
            (
                (folder / "rig.xml").read_text(),
                (folder / "servo.yaml").read_text(),
                json.dumps(r.meta, sort_keys=True),
                made["name"],
                r.commands.value.tobytes(),
                r.states.position.t.tobytes(),
            )
        )
    assert len(texts) == 1


def test_hash_binds_the_truth_and_the_salt_hides_it(some, tmp_path):
    root, made, plan = some
    path = root / "truth" / f"{made[1]['name']}.json"
    truth = generate.reveal(path, made[1]["digest"])
    assert truth["effects"][0]["kind"] == plan[1]["kinds"][0] and truth["effects"][0]["parameters"]["gap"] > 0
    # the same truth again: another salt, another hash, so a guess cannot be checked against it
    assert generate.commit(truth, tmp_path) != made[1]["digest"]
    bare = hashlib.sha256(json.dumps(truth, sort_keys=True).encode()).hexdigest()
    assert bare != made[1]["digest"]
    forged = tmp_path / path.name
    forged.write_text(path.read_text(encoding="utf-8").replace("backlash", "lag"), encoding="utf-8")
    with pytest.raises(ValueError, match="not the truth"):
        generate.reveal(forged, made[1]["digest"])


def test_plan_is_fixed_by_its_seed_and_takes_every_effect_in_turn():
    mix = {
        "effect": 3 * len(effects.BY_EFFECT),
        "none": 4,
        "noise": 2,
        "pair": 3,
        "outside": 2,
        "decoy": 5,
        "hand": 3,
        "touch": 4,
    }
    assert generate.plan(mix, 7) == generate.plan(mix, 7) != generate.plan(mix, 8)
    plan = generate.plan(mix, 7)
    hidden = [(effects.KINDS[p["kinds"][0]].effect, p["tier"]) for p in plan if p["group"] == "effect"]
    assert sorted(hidden) == sorted((e, t) for e in effects.BY_EFFECT for t in ("easy", "medium", "hard"))
    assert {g: sum(p["group"] == g for p in plan) for g in mix} == mix
    for p in plan:
        assert p["group"] == "touch" or not any(effects.ALL[k].joints > 1 for k in p["kinds"]) or p["shape"] != "one"
    assert all(p["shape"] == "one" for p in generate.plan({"effect": 60}, 7, one_joint=True))
    with pytest.raises(ValueError, match="no group"):
        generate.plan({"nothing": 1}, 7)


def test_another_hand_is_believed_as_its_own_model_has_it(tmp_path):
    """The written rig.xml weighs and throws its joints about as the hand's model does."""
    hand = load_hand(made_hand(tmp_path / "made"), mirror=True)
    d = rigs.draw(np.random.default_rng(0), "hand", hand.identity)
    rigs.files(tmp_path, d)
    one, other = mujoco.MjModel.from_xml_path(str(tmp_path / "rig.xml")), hand.spec().compile()
    q = np.random.default_rng(1).uniform(*hand.limits.T)
    bias = []
    for model in (one, other):
        data = mujoco.MjData(model)
        for name, angle in zip(hand.joints, q, strict=True):
            data.joint(name).qpos, data.joint(name).qvel = angle, 2.0 * np.cos(9 * angle)
        mujoco.mj_forward(model, data)
        bias.append([data.joint(name).qfrc_bias[0] for name in hand.joints])
    np.testing.assert_allclose(bias[0], bias[1], rtol=1e-3, atol=1e-4 * np.abs(bias[1]).max())
    assert set(yaml.safe_load((tmp_path / "servo.yaml").read_text())["joints"]) == set(hand.joints)
    assert d.hand == hand.robot != "xhand_right"
    large = generate.plan({"large": 5}, 3)
    assert [(e["shape"], e["tier"], len(e["kinds"])) for e in large] == [("hand", "easy", 1)] * 5


@pytest.mark.slow
def test_size_is_what_was_asked(tmp_path, monkeypatch):
    """An easy case is ten floors large by the generator's own measure, a hard one one and a half."""
    monkeypatch.setattr(generate, "SECONDS", 2.0)
    for tier, ratio in (("easy", 10.0), ("hard", 1.5)):
        made = generate.build(entries("viscous", tier=tier)[0], 8, 3, tmp_path / tier, tmp_path / tier)
        truth = generate.reveal(tmp_path / tier / f"{made['name']}.json", made["digest"])
        assert truth["effects"][0]["facts"]["ratio"] == pytest.approx(ratio, rel=0.4) and truth["tier"] == tier


def test_a_drive_whose_encoder_is_off_begins_where_it_reads_its_target(monkeypatch):
    """Else it jumps, and the jump is counted as the effect although a replay from the first reading has it too."""
    rng = np.random.default_rng(4)
    off = [rng.uniform(*x, 200) for x in ((0.7, 1.3), (-0.5, 0.5), (0.0, 0.2), (-3, 3), (0.0, 0.5))]
    angle = rng.uniform(-2, 2, 200)
    np.testing.assert_allclose(plant.angle_read_as(plant.encoded(angle, *off), *off), angle, atol=1e-12)
    monkeypatch.setattr(generate, "SECONDS", 0.3)
    d = rigs.draw(np.random.default_rng(1), "one")
    jumps = []
    for settled in (True, False):
        bench = generate.Bench(d, np.full((4, 1, 300), 0.1), np.full(4, 30.0), 5e-4, 0, settled)
        q = bench.run([bench.changed(0, {"offset": 0.2, "scale": 1.1})])["position"]
        jumps.append(float(np.abs(q - q[..., :1]).max()))
        assert settled == (abs(q[0, 0, 0, 0] - 0.1) < 1e-9)
    assert jumps[0] < 0.25 * jumps[1]  # what is left is the weight that it sinks under


def test_a_large_effect_is_planted_where_it_shows():
    bench, reached = object.__new__(generate.Bench), {4: 1.1, 2: 2.5, 0: 8.0, 1: 11.0}
    tried = []

    def sized(kind, joint, ratio, seed, law):
        tried.append((joint, law))
        return 0.1 * joint, {"ratio": reached[joint]}, {}

    bench.sized = sized
    kind = effects.KINDS["offset"]
    assert bench.largest(kind, [4, 2, 0, 1], 10.0, 1, str)[0] == 0 and tried == [(4, "4"), (2, "2"), (0, "0")]
    assert bench.largest(kind, [4, 2], 10.0, 1, str) == (2, (0.2, {"ratio": 2.5}, {}))


def test_scores_by_hand():
    def finding(effect, confidence=0.9, group=(), joint="joint0", **parameters):
        return {
            "effect": effect,
            "confidence": confidence,
            "indistinguishable": list(group),
            "where": {"joints": [joint], "taxels": [], "topics": []},
            "when": [{"recording": "a.mcap", "start": 1.0, "end": 2.0}],
            "held_out": {"before": 11.0, "after": 3.0},
            "parameters": {k: dict(zip(("value", "low", "high"), v, strict=True)) for k, v in parameters.items()},
        }

    hidden = {
        "effect": "backlash",
        "kind": "backlash",
        "joint": "joint0",
        "parameters": {"gap": 0.02},
        "facts": {"floor": 1.0, "before": 11.0, "ratio": 11.0},
        "when": [["a", 1.0, 2.5]],
        "also": [],
    }
    truth = {
        "name": "x",
        "group": "effect",
        "decoy": "",
        "tier": "easy",
        "shape": "one",
        "joints": 1,
        "effects": [hidden],
    }
    held = {"before": 11.0, "after": 3.0}
    right = {"verdict": "explained", "held_out": held, "findings": [finding("backlash", gap=(0.022, 0.019, 0.025))]}
    r = score.one(truth, right)
    assert (
        r["right"]
        and r["alone"]
        and not r["wrong_sure"]
        and r["parameter_errors"] == pytest.approx([0.1])
        and r["covered"] == [True]
    )
    assert r["removed"] == pytest.approx(0.8) and r["overlap"] == pytest.approx(2 / 3, abs=0.01)
    named = {"verdict": "explained", "held_out": held, "findings": [finding("coulomb_friction")]}
    assert not score.one(truth, named)["right"] and score.one(truth, named)["wrong_sure"]
    elsewhere = {"verdict": "explained", "held_out": held, "findings": [finding("backlash", joint="joint1")]}
    assert score.one(truth, elsewhere)["wrong_sure"]  # the right name on the wrong joint
    as_set = {
        "verdict": "explained",
        "held_out": held,
        "findings": [finding("coulomb_friction", group=("backlash", "coulomb_friction"))],
    }
    assert (
        score.one(truth, as_set)["right"]
        and not score.one(truth, as_set)["alone"]
        and not score.one(truth, as_set)["wrong_sure"]
    )
    foreign = {"verdict": "explained", "held_out": held, "findings": [finding("lag", group=("backlash", "lag"))]}
    assert not score.one(truth, foreign)["right"]  # a set of no class is no answer
    pair = {
        **truth,
        "group": "pair",
        "joints": 2,
        "effects": [hidden, {**hidden, "effect": "lag", "kind": "lag", "joint": "joint1"}],
    }
    p = score.one(pair, {**right, "findings": [finding("backlash"), finding("lag")]})
    assert p["f1"] == [1, 2, 2] and p["joint_f1"] == [1, 1, 2]  # lag is named on the wrong joint
    linked = {**truth, "joints": 2, "effects": [{**hidden, "effect": "joint_coupling", "also": ["joint1"]}]}
    other_end = score.one(linked, {**right, "findings": [finding("joint_coupling", joint="joint1")]})
    # a linkage has two ends
    assert other_end["right"] and not other_end["wrong_sure"] and other_end["joint_f1"] == [1, 1, 1]
    nothing = {**truth, "group": "none", "effects": []}
    assert (
        score.one(nothing, right)["false_alarm"]
        and not score.one(nothing, {**right, "findings": [], "verdict": "none"})["false_alarm"]
    )
    outside = {**truth, "group": "outside", "effects": [{**hidden, "effect": "", "kind": "cable_spring"}]}
    assert (
        not score.one(outside, right)["humble"]
        and score.one(outside, {**right, "verdict": "unknown", "findings": []})["humble"]
    )
    bad = {**nothing, "group": "decoy", "decoy": "bad_channel"}
    assert (
        score.one(bad, {**right, "findings": [finding("bad_channel")]})["caught"]
        and not score.one(bad, right)["caught"]
    )
    lines = score.table([r, score.one(nothing, right)])
    assert lines["right effect first, easy"]["value"] == 1.0 and lines["confident and wrong, all cases"]["value"] == 0.5


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_three_cases_end_to_end_and_resumed(tmp_path, capsys, monkeypatch):
    """An effect, nothing missing, a decoy: diagnosed by the command; then again from the disk."""
    cases = ["mix=effect:1,none:1,decoy:1", "one_joint=true", "seed=2", f"out={tmp_path}"]
    line = command.main([*cases, "jobs=2", "limit=240"])
    assert line["cases"] == 3 and line["failed"] == line["left_out"] == 0
    assert line["lines"]["confident and wrong, all cases"]["value"] <= 0.2
    assert line["lines"]["false alarm, nothing missing"]["value"] <= 0.5
    assert json.loads(capsys.readouterr().out.strip().splitlines()[-1])["benchmark"] == "concealed"
    hashes = (tmp_path / "seed_2" / "hashes.txt").read_text(encoding="utf-8").split()
    assert len(hashes) == 6 and all(len(h) == 64 for h in hashes[::2])
    monkeypatch.setattr(sys, "executable", "no such program")  # a finished case is not made or diagnosed again
    assert command.main(cases)["lines"] == line["lines"]


def test_a_run_ends_when_it_must_and_leaves_out_what_was_under_way(tmp_path, monkeypatch):
    """A diagnosis that the run's end stops is left out, one that took too long by itself is a wrong
    answer."""
    (tmp_path / "diagnose.py").write_text("import time\nprint('begun', flush=True)\ntime.sleep(60)\n")
    ask, begun = answers.ask, command.time.time()
    monkeypatch.setattr(answers, "ask", lambda *a: ask(*a, code=tmp_path))
    for name, limit, until in (("late", 100, 0.5), ("slow", 0.4, 0)):
        s = {"budget": 0, "until": until, "limit": limit, "braking": "unsaid"}
        command.diagnose((name, s, tmp_path, begun))
    assert not (tmp_path / "diagnoses" / "late" / "seconds").exists()
    slow = tmp_path / "diagnoses" / "slow"
    assert json.loads((slow / "diagnosis.json").read_text())["verdict"] == "failed"
    assert "begun" in (slow / "log.txt").read_text()


def test_the_first_cases_of_a_set_are_those_of_the_whole(monkeypatch, tmp_path):
    """`first=` cuts the drawn order and changes no case."""
    built = []

    class Ended(Exception):
        pass

    def at_once(work, given, out, engine):
        built.append(list(given.values()))
        raise Ended

    monkeypatch.setattr(answers, "at_once", at_once)
    for more in ([], ["first=5"]):
        with pytest.raises(Ended):
            command.main(["mix=effect:8,none:4", "seed=3", f"out={tmp_path}", *more])
    whole, first = built
    assert len(whole) == 12 and first == whole[:5]


def test_spatial_rigs_are_a_little_off_what_their_files_say(tmp_path):
    for k, shape in enumerate(rigs.SPATIAL):
        d = rigs.draw(np.random.default_rng(k), shape)
        rigs.files(tmp_path, d)
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "rig.xml"))
        assert model.njnt == d.joints == k + 2 and len(d.believed_rig.place) == d.joints
        body = model.jnt_bodyid[model.joint("joint1").id]
        at = tuple(d.rig.place[1])
        np.testing.assert_allclose(model.body_pos[body], d.believed_rig.offset[at], atol=1e-5)
        away = np.abs(d.rig.com - d.believed_rig.com).max()
        assert 0 < away < 0.03 * np.abs(d.believed_rig.com).max() and (d.rig.axis != d.believed_rig.axis).any()
        tilt = np.degrees(np.arccos(-d.gravity[:, 2] / np.linalg.norm(d.gravity, axis=1)))
        assert (0 < tilt).all() and (tilt < 1.0).all() and np.ptp(tilt) > 0
        np.testing.assert_allclose(np.linalg.norm(d.gravity, axis=1), 9.81, rtol=1e-3)
    plan = generate.plan({"spatial": 12}, 1)
    assert sum(not p["kinds"] for p in plan) == 8 and {p["shape"] for p in plan} == set(rigs.SPATIAL)
