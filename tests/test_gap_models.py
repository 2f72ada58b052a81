"""Physics that the plant and the handed-on model have beyond one number: a load off its link's centre, elasticity that
hardens."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from test_gap import demo, model, plant_run

from dexsim.actuator.table import ServoTable
from dexsim.gap.effects import FittedEffect
from dexsim.gap.effects.body import add_mass
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX, SERIES_INDEX
from dexsim.gap.plant.mechanics import leaf_of
from dexsim.gap.read import Run, conditions
from dexsim.gap.search.fit import intervals
from dexsim.gap.search.search import JointSearch, search_joint, widened
from tools.assets import xhand

OFF = {"*kp": 1.03, "*inertia_scale": 0.97, "*viscous_friction": 0.96}


def found(changes: dict[str, float], effect: str, seconds: float = 4.0) -> tuple[dict, str]:
    """Return (parameters as reported, variant's label) of the search for one effect on recordings with figures a few
    percent off."""
    runs = [plant_run(f"run{k}", k, seconds, OFF | changes, seed=k) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    case = build(model(), runs)[0]
    search = JointSearch(case, [0, 1, 2], None, conditions(runs), allowed={effect})
    best = search_joint(search).best
    assert best.ids == (effect,)
    bounds = widened(search, best, intervals(best.fit, search.blocks, huber=search.r.huber))
    keys, member = [p.key for p in best.fit.params], best.members[0]
    at = {p.key: keys.index(f"{effect}.{p.key}") for p in member.variant.params}
    raw, spread = (
        {k: float(best.fit.x[i]) for k, i in at.items()},
        {k: (float(bounds[i][0]), float(bounds[i][1])) for k, i in at.items()},
    )
    return member.effect.parameters(
        FittedEffect(member.variant, raw, spread, case, runs[0].servo)
    ), member.variant.label


def mass_matrix(m: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return (inertia, bias with gravity) at a pose and speed away from zero."""
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = m.qpos0 + 0.2, 0.5
    mujoco.mj_forward(m, d)
    full = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, full)
    return full, d.qfrc_bias.copy()


@pytest.mark.parametrize("joint", ["index_joint2", "joint"])
@pytest.mark.parametrize("mass", [0.02, -0.001])
def test_an_added_mass_is_a_point_mass_on_the_last_link(joint, mass):
    spec = mujoco.MjSpec.from_string(demo.MODEL) if joint == "joint" else xhand.hand_spec()
    plain = spec.compile()
    leaf = leaf_of(plain, int(plain.jnt_bodyid[plain.joint(joint).id]))
    place = np.array([0.01, 0.02, -0.03]) if mass > 0 else None
    changed = spec.copy()
    assert f"{abs(mass):.3g} kg" in add_mass(changed, joint, mass, place)
    if mass > 0:
        point = spec.body(plain.body(leaf).name).add_body(name="point", pos=place.tolist())
        point.mass, point.explicitinertial, point.inertia, point.ipos = mass, True, [1e-12] * 3, [0, 0, 0]
        for a, b in zip(mass_matrix(changed.compile()), mass_matrix(spec.compile()), strict=True):
            assert np.abs(a - b).max() < 1e-6 * np.abs(b).max()
    else:
        assert changed.compile().body_mass[leaf] == pytest.approx(plain.body_mass[leaf] + mass)


def test_more_mass_cannot_be_taken_away_than_there_is():
    spec = mujoco.MjSpec.from_string(demo.MODEL)
    assert "less than the model's links" in add_mass(spec, "joint", -1.0, None) and spec.compile().body_mass[
        1
    ] == pytest.approx(0.15)


def test_the_plants_load_off_centre_is_that_of_the_model():
    """Inertia and gravity torque per pose: the plant's series against MuJoCo's own mass matrix with the mass added."""
    run = plant_run("a", 0, 2.0, {}, noisy=False)
    run.smooth()
    case = build(model(), [run])[0]
    c, series = case.constants, case.plant.series[::200]
    out, across, mass = 0.02, -0.05, 0.07
    place = c.centre + out * c.places[0] + across * c.places[1]
    assert c.places @ c.places.T == pytest.approx(np.eye(2)) and c.places @ [0, 1, 0] == pytest.approx([0, 0])
    spec = mujoco.MjSpec.from_string(demo.MODEL)
    add_mass(spec, "joint", mass, place)
    heavy, plain = spec.compile(), model()
    for row in series:
        x = {n: row[i] for n, i in SERIES_INDEX.items()}
        torques = []
        for m in (heavy, plain):
            d = mujoco.MjData(m)
            d.qpos[0] = x["q"]
            mujoco.mj_forward(m, d)
            full = np.zeros((1, 1))
            mujoco.mj_fullM(m, d, full)
            torques.append((full[0, 0], d.qfrc_bias[0]))
        inertia = mass * (
            x["load_inertia"] + out * x["com_out_inertia"] + across * x["com_across_inertia"] + out**2 + across**2
        )
        gravity = mass * (x["load_cos"] + out * x["com_out_cos"] + across * x["com_across_cos"])
        assert inertia == pytest.approx(torques[0][0] - torques[1][0], rel=1e-6)
        assert gravity == pytest.approx(torques[0][1] - torques[1][1], abs=1e-5)


CHAIN = """<mujoco><worldbody><body pos="0 0 1"><joint name="a" axis="0 1 0" armature="1e-4"/>
<geom type="sphere" size="0.01" mass="0.1" pos="0 0 -0.08"/><body pos="0 0 -0.1">
 <joint name="b" axis="1 0 0" armature="1e-4"/>
<geom type="sphere" size="0.01" mass="0.1" pos="0.01 0 -0.06"/></body></body></worldbody></mujoco>"""


def chain_case(spec: mujoco.MjSpec):
    """Return the joint a's case along motions of both joints."""
    t = np.arange(0.0, 3.0, 0.01)
    q = np.stack([0.6 * np.sin(4 * t), 0.5 * np.sin(3 * t + 1)], 1)
    servo = ServoTable.from_dict(
        {"joints": {"*": {"kp": 1.0, "kd": 0.02, "torque_limit": 1.0, "coulomb_friction": 0.002}}}
    )
    return build(spec.compile(), [Run("x", ("a", "b"), t, q.copy(), t, q, servo, np.array([0, 0, -9.81]))])[0]


def test_a_mass_on_the_joints_own_link_is_that_of_the_model():
    """A plant with the mass follows the same path as the plant of a model that has it; on the last link it does not."""
    spec = mujoco.MjSpec.from_string(CHAIN)
    light = chain_case(spec)
    variants = {v.label: v for v in EFFECTS["payload"].variants(light.scales)}
    assert variants["mass on its own link"].params[0].columns == ("own_payload",)
    assert "kg" in add_mass(spec, "a", 0.05, None, own=True) and spec.compile().body_mass[1] == pytest.approx(0.15)
    paths = {}
    for name, case, column in (
        ("model", chain_case(spec), None),
        ("own", light, "own_payload"),
        ("last", light, "payload"),
        ("none", light, None),
    ):
        params = case.plant.base()[None].copy()
        if column:
            params[..., INDEX[column]] = 0.05
        paths[name] = case.plant.simulate(params, case.plant.windows(None))[0][0]
    change = np.abs(paths["none"] - paths["model"]).max()
    assert change > 0.005
    assert np.abs(paths["own"] - paths["model"]).max() < 0.03 * change
    assert np.abs(paths["last"] - paths["model"]).max() > 0.3 * change


def test_a_last_link_has_no_own_load_beside_it():
    case = build(model(), [plant_run("a", 0, 2.0, {}, noisy=False)])[0]
    assert case.scales.own_torque == 0 and "mass on its own link" not in {
        v.label for v in EFFECTS["payload"].variants(case.scales)
    }


def test_hardening_is_the_cubic_spring_it_says():
    """A held pose: the twist between motor and joint under a load torque T solves k x (1 + h (k x)^2) = T."""
    run = plant_run("hold", 1, 4.0, {"coulomb_friction": 0.0, "viscous_friction": 0.02}, noisy=False)
    run.cmd[:], run.q[:] = 1.2, 1.15
    run.qs = None
    run.servo.loop_encoder = "motor"
    plant = build(model(), [run])[0].plant
    for softness, hard in ((0.5, 0.0), (0.5, 30.0)):
        params = plant.base()[None].copy()
        params[..., INDEX["coulomb_friction"]], params[..., INDEX["viscous_friction"]] = 0.0, 0.02
        params[..., INDEX["softness"]], params[..., INDEX["hardening"]] = softness, hard
        q, tau = (x[0, -1] for x in plant.simulate(params, plant.windows(None)))
        motor = 1.2 - tau / 2.0  # kp = 2, the loop's encoder on the motor's side
        twist = motor - q
        assert tau == pytest.approx(0.15 * 9.81 * 0.1 * np.sin(q), rel=0.01)
        x = twist / softness
        assert x * (1 + hard * x * x) == pytest.approx(tau, rel=0.02)


@pytest.mark.slow
def test_a_load_off_its_links_centre_is_weighed_and_placed():
    p, label = found({"payload": 0.08, "com_across": 0.05}, "payload")
    assert label == "mass and its centre"
    assert p["mass"]["low"] <= 0.08 <= p["mass"]["high"] and p["mass"]["value"] == pytest.approx(0.08, rel=0.25)
    com = p["com"]
    assert (
        com["unit"] == "m"
        and com["value"][0] == pytest.approx(-0.05, abs=0.012)
        and com["value"][2] == pytest.approx(-0.1, abs=0.02)
    )
    assert com["low"][0] < com["value"][0] < com["high"][0] and com["value"][1] == 0.0


@pytest.mark.slow
def test_a_load_at_its_links_centre_has_no_place_fitted():
    p, label = found({"payload": 0.08}, "payload")
    assert label == "mass" and "com" not in p and p["mass"]["low"] <= 0.08 <= p["mass"]["high"]


@pytest.mark.slow
def test_elasticity_that_hardens_is_told_from_one_that_does_not():
    p, _ = found({"softness": 0.25, "hardening": 8.0}, "compliance", 6.0)
    assert p["stiffness"]["value"] == pytest.approx(4.0, rel=0.05)
    assert p["hardening"]["low"] <= 128.0 <= p["hardening"]["high"] and p["hardening"]["value"] == pytest.approx(
        128.0, rel=0.3
    )
    p, _ = found({"softness": 0.25}, "compliance", 6.0)
    assert "hardening" not in p and p["stiffness"]["value"] == pytest.approx(4.0, rel=0.05)


def test_refining_variants_follow_a_first_one():
    for effect in EFFECTS.values():
        for variant in effect.variants(_scales()):
            if variant.refines:
                first = effect.variants(_scales())[0]
                assert not first.refines and {p.key for p in first.params} < {p.key for p in variant.params}


def _scales():
    run = plant_run("a", 0, 2.0, {})
    run.smooth()
    return build(model(), [run])[0].scales
