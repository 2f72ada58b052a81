"""Both engines behind one interface: state, fields, contact forces, flags, determinism."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from rig import pendulum_spec

from dexsim.errors import UserError
from dexsim.sim import ContactPair, make_engine
from dexsim.sim.engine import FLAG_NAN

ENGINES = ("mujoco", "warp")
G = 9.81
SLAB, BALL = 0.4, 0.15  # kg
N = 4
PAIRS = (
    ContactPair("slab_floor", ("body", "slab"), ("geom", "floor")),
    ContactPair("floor_slab", ("geom", "floor"), ("body", "slab")),
    ContactPair("ball_slab", ("geom", "ball"), ("subtree", "slab")),
    ContactPair("slab_ball", ("subtree", "slab"), ("geom", "ball")),
    ContactPair("ball_floor", ("geom", "ball"), ("geom", "floor")),
)
FIELDS = ("opt.gravity", "body_mass", "body_inertia", "geom_friction", "geom_size", "geom_rbound",
          "geom_aabb", "geom_dataid", "body_subtreemass", "body_invweight0", "dof_invweight0")


def stack_spec(cone: str = "elliptic", meshes: bool = False) -> mujoco.MjSpec:
    """Return a slab (60 x 60 x 20 mm) on a floor, a ball (10 mm radius) on the slab, both free."""
    mesh = '<mesh name="low" vertex="{0}"/><mesh name="high" vertex="{1}"/>'.format(
        *(
            " ".join(f"{x} {y} {z}" for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (-h, h))
            for h in (0.010, 0.016)
        )
    )
    slab = (
        '<geom name="slab" type="mesh" mesh="low" mass="0.4"/>'
        if meshes
        else '<geom name="slab" type="box" size=".03 .03 .01" mass="0.4" condim="4"/>'
    )
    return mujoco.MjSpec.from_string(f"""
<mujoco>
  <option timestep="0.002" integrator="implicitfast" cone="{cone}" impratio="10" iterations="20" ls_iterations="30"/>
  <asset>{mesh if meshes else ""}</asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="slab" pos="0 0 .01"><freejoint name="slab_free"/>{slab}</body>
    <body name="ball" pos="0 0 .03"><freejoint name="ball_free"/>
 <geom name="ball" type="sphere" size=".01" mass="{BALL}" condim="4"/></body>
  </worldbody>
</mujoco>""")


def stack(kind: str, n: int = N, **kw):
    spec = kw.pop("spec", None)
    return make_engine(
        stack_spec() if spec is None else spec,
        n,
        "cpu",
        kind,
        fields=FIELDS,
        pairs=PAIRS,
        **{"nconmax": 20, "njmax": 64, **kw},
    )


def run(engine, seconds: float, chunk: int = 25) -> None:
    for _ in range(round(seconds / engine.dt / chunk)):
        engine.step(chunk)


@pytest.fixture(scope="module", params=ENGINES)
def engine(request):
    """Return one engine a module; a test gets it at rest with nominal fields."""
    e = stack(request.param)
    e.nominal = {f: e.field(f).clone() for f in FIELDS}
    return e


@pytest.fixture
def fresh(engine):
    for f, v in engine.nominal.items():
        engine.field(f).copy_(v)
    engine.set_const()
    engine.t.overflow.zero_()
    engine.reset(torch.ones(engine.n, dtype=torch.bool))
    engine.refresh()
    return engine


# -- names
# ---------------------------------------------------------------------------------------------------------------


def test_names_are_resolved_and_unknown_ones_answered(fresh):
    e = fresh
    assert e.mjm.body("ball").id == e.body("ball") and e.pair("ball_slab") == 2
    for call, known in (
        (lambda: e.body("bal"), "ball"),
        (lambda: e.geom("x"), "floor"),
        (lambda: e.joint("x"), "slab_free"),
        (lambda: e.pair("x"), "slab_floor"),
    ):
        with pytest.raises(UserError, match=known):
            call()


@pytest.mark.parametrize("kind", ENGINES)
@pytest.mark.parametrize("bad", [("geom", "nothing"), ("body", "nothing"), ("subtree", "nothing"), ("site", "ball")])
def test_a_pair_of_unknown_geoms_is_a_user_error_on_both_engines(kind, bad):
    with pytest.raises(UserError, match="contact pair"):
        make_engine(stack_spec(), 1, "cpu", kind, pairs=[ContactPair("p", ("geom", "ball"), bad)])


def test_bad_engine_settings():
    for kw, word in (
        (dict(engine="bullet"), "bullet"),
        (dict(worlds=0), "worlds"),
        (dict(engine="mujoco", device="cuda:0"), "CPU"),
    ):
        with pytest.raises(UserError, match=word):
            make_engine(**{"spec": pendulum_spec(), "worlds": 1, **kw})
    assert make_engine(pendulum_spec(), 1, "cpu", "auto").kind == "mujoco"


# -- state
# ---------------------------------------------------------------------------------------------------------------


def test_set_state_and_reset_touch_masked_worlds_only(fresh):
    e = fresh
    e.t.xfrc_applied[:, 1, 0] = 0.3
    e.t.qfrc_applied[:, 2] = 0.1
    run(e, 0.1)
    names = ("qpos", "qvel", "time", "xfrc_applied", "qfrc_applied", "pair_normal", "pair_force", "flags")
    before = {k: getattr(e.t, k).clone() for k in names}
    mask = torch.tensor([True, False, True, False])
    q, v = torch.rand(N, 14, dtype=torch.float64), torch.rand(N, 12, dtype=torch.float64)
    q[1], v[1] = float("nan"), float("nan")  # what is not selected must not leak, not even through 0 * nan
    e.set_state(mask, q, v)
    assert torch.equal(e.t.qpos[mask], q[mask].to(e.t.qpos.dtype)) and torch.equal(
        e.t.qvel[mask], v[mask].to(e.t.qvel.dtype)
    )
    for k in names:
        now = getattr(e.t, k)
        assert torch.equal(now[~mask], before[k][~mask]), k
        if k not in ("qpos", "qvel"):
            assert not now[mask].any(), k
    e.reset(mask)
    e.refresh()
    assert np.allclose(e.t.qpos[0].numpy(), e.mjm.qpos0) and not e.t.qvel[0].any()
    assert np.allclose(e.t.xpos[0, 2].numpy(), [0, 0, 0.03], atol=1e-7)
    assert torch.equal(e.t.qpos[~mask], before["qpos"][~mask])


def test_a_world_goes_on_the_same_after_others_are_reset(fresh):
    e = fresh
    e.t.qvel[:, 6] = 0.2
    start = (e.t.qpos.clone(), e.t.qvel.clone())
    everyone = torch.ones(N, dtype=torch.bool)
    e.set_state(everyone, *start)
    run(e, 0.1)
    free = e.t.qpos.clone()
    e.set_state(everyone, *start)
    run(e, 0.05)
    e.reset(torch.tensor([False, True, False, True]))
    run(e, 0.05)
    assert torch.equal(e.t.qpos[[0, 2]], free[[0, 2]])
    assert not torch.equal(e.t.qpos[[1, 3]], free[[1, 3]])


def test_poses_belong_to_the_present_state(fresh):
    """After a step, xpos is that of qpos now, not of the step's start (0.4 mm apart at 0.2 m/s)."""
    e = fresh
    q, v = e.t.qpos.clone(), torch.zeros_like(e.t.qvel)
    q[:, 9], v[:, 6] = 0.2, 0.2
    e.set_state(torch.ones(N, dtype=torch.bool), q, v)
    e.step(3)
    assert torch.allclose(e.t.xpos[:, 2].double(), e.t.qpos[:, 7:10].double(), atol=1e-7)
    assert e.t.qpos[0, 7] > 0.001


# -- fields
# --------------------------------------------------------------------------------------------------------------


def test_gravity_and_mass_act_by_world(fresh):
    e = fresh
    g = e.field("opt.gravity")
    for w in range(N):
        g[w] = torch.tensor([0.5 * w, 0.0, -w], dtype=g.dtype)
    e.field("body_mass")[:, 2] = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=g.dtype)
    e.set_const()  # a changed mass recomputes what depends on it
    q, v = e.t.qpos.clone(), torch.zeros_like(e.t.qvel)
    q[:, 9] = 5.0
    e.set_state(torch.ones(N, dtype=torch.bool), q, v)
    e.t.xfrc_applied[:, 2, 1] = 0.06
    e.step(10)
    t = 10 * e.dt
    ball = e.t.qvel[:, 6:9].double().numpy()
    assert np.allclose(ball[:, 2], -np.arange(N) * t, atol=1e-5)
    assert np.allclose(ball[:, 0], 0.5 * np.arange(N) * t, atol=1e-5)
    assert np.allclose(ball[:, 1], 0.06 / np.array([0.1, 0.2, 0.3, 0.4]) * t, rtol=1e-4)


@pytest.mark.parametrize("kind", ENGINES)
def test_armature_acts_by_world_on_a_centred_link(kind):
    """A disc about its own axis: a = tau / (I + armature), written between steps, also after its inertia was changed.
    C MuJoCo keeps the inertia of such a link as compiled."""
    spec = mujoco.MjSpec.from_string(
        """<mujoco><option timestep="0.001"/><worldbody><body><joint name="axis" axis="0 0 1" armature="0.0005"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.001 0.001 0.001"/></body></worldbody></mujoco>"""
    )
    e = make_engine(spec, 2, "cpu", kind, fields=("dof_armature", "body_inertia", "body_subtreemass",
                                                  "body_invweight0", "dof_invweight0"))  # fmt: skip
    expected = np.zeros(2)
    for inertia in (1e-3, 4e-3):
        e.field("body_inertia")[:, 1] = inertia
        e.set_const()
        for armature in ([-2e-4, 5e-4], [0.0, 3e-3]):
            e.field("dof_armature")[:, 0] = torch.tensor(armature, dtype=e.field("dof_armature").dtype)
            e.t.qfrc_applied[:] = 0.01
            e.step(5)
            expected += 5e-3 * 0.01 / (inertia + np.array(armature))
            assert np.allclose(e.t.qvel[:, 0].double().numpy(), expected, rtol=1e-5)


def test_friction_acts_by_world(fresh):
    """A floor tilted by 0.3 rad (through gravity): held at mu = 0.6, sliding with g (sin - mu cos) at mu = 0.1."""
    e = fresh
    mu = torch.tensor([0.6, 0.1, 0.6, 0.2], dtype=e.t.qpos.dtype)
    e.field("geom_friction")[:, :2, 0] = mu[:, None]
    run(e, 0.1)
    g = e.field("opt.gravity")
    a = 0.3
    g[:] = torch.tensor([G * math.sin(a), 0, -G * math.cos(a)], dtype=g.dtype)
    q, v = e.t.qpos.clone(), torch.zeros_like(e.t.qvel)
    q[:, 7:10] = torch.tensor([0.5, 0.5, 5.0], dtype=q.dtype)  # the ball out of the way
    e.set_state(torch.ones(N, dtype=torch.bool), q, v)
    run(e, 0.1)
    expect = np.where(mu > math.tan(a), 0, G * (math.sin(a) - mu.double().numpy() * math.cos(a)) * 0.1)
    assert np.allclose(e.t.qvel[:, 0].double().numpy(), expect, atol=0.012)


def test_geom_size_acts_by_world(fresh):
    e = fresh
    r = torch.tensor([0.008, 0.010, 0.014, 0.020], dtype=e.t.qpos.dtype)
    e.field("geom_size")[:, 2, 0] = r
    e.field("geom_rbound")[:, 2] = r  # bounding volumes follow the size, or broad phases miss contacts
    e.field("geom_aabb").view(N, 3, 6)[:, 2, 3:] = r[:, None]
    q = e.t.qpos.clone()
    q[:, 9] = 0.02 + r
    e.set_state(torch.ones(N, dtype=torch.bool), q, torch.zeros_like(e.t.qvel))
    run(e, 0.3)
    assert np.allclose(e.t.qpos[:, 9].double(), 0.02 + r.double(), atol=1e-3)  # MuJoCo's own soft contact: 0.6 mm deep


@pytest.mark.parametrize("kind", ENGINES)
def test_dataid_swaps_the_mesh_by_world(kind):
    e = stack(kind, spec=stack_spec(meshes=True))
    low, high = e.mjm.mesh("low").id, e.mjm.mesh("high").id
    e.field("geom_dataid")[:, 1] = torch.tensor([low, high, low, high], dtype=torch.int32)
    e.field("geom_rbound")[:, 1] = 0.06
    q = e.t.qpos.clone()
    q[:, 2], q[:, 7] = 0.02, 1.0
    e.set_state(torch.ones(N, dtype=torch.bool), q, torch.zeros_like(e.t.qvel))
    run(e, 0.5)
    assert np.allclose(e.t.qpos[:, 2].double(), [0.010, 0.016, 0.010, 0.016], atol=3e-4)


def test_fields_written_are_seen_by_a_recorded_step(fresh):
    """A view of a field keeps acting after the step sequence was recorded."""
    e = fresh
    for k in (1.0, 2.0, 3.0):  # eager, recorded, replayed
        e.field("opt.gravity")[:] = torch.tensor([k, 0.0, 0.0], dtype=e.t.qpos.dtype)
        q = torch.as_tensor(e.mjm.qpos0, dtype=e.t.qpos.dtype).repeat(N, 1)
        q[:, 9] = 5.0
        e.set_state(torch.ones(N, dtype=torch.bool), q, torch.zeros_like(e.t.qvel))
        e.step(7)
        assert np.allclose(e.t.qvel[:, 6].double(), 7 * e.dt * k, rtol=1e-4)


# -- contact forces
# -------------------------------------------------------------------------------------------------------


def _rest(e) -> None:
    run(e, 0.6)
    assert float(e.t.qvel.abs().max()) < 5e-3


def _check_stack(e, g: np.ndarray) -> None:
    """Check static forces under gravity g [3]: the sum carries the weight, whatever the number of contacts."""
    tol = dict(rtol=3e-3, atol=3e-3)
    normal, force = e.t.pair_normal.double().numpy(), e.t.pair_force.double().numpy()
    both, ball = -(SLAB + BALL) * g, -BALL * g
    for w in range(e.n):
        np.testing.assert_allclose(force[w], [both, -both, ball, -ball, 0 * g], **tol)
        np.testing.assert_allclose(normal[w], [both[2], both[2], ball[2], ball[2], 0], **tol)


def test_pair_forces_carry_the_weight_with_sign_and_frame(fresh):
    """On the first member, world frame: the floor lifts the slab, the slab lifts the ball, and the reverse pairs."""
    _rest(fresh)
    _check_stack(fresh, np.array([0, 0, -G]))


def test_pair_forces_hold_friction(fresh):
    """Gravity tilted within the cone (rolling held by torsion-free slab alone): tangential forces are in the sum."""
    e = fresh
    q = e.t.qpos.clone()
    q[:, 7:10] = torch.tensor([5.0, 0, 5.0], dtype=q.dtype)  # no ball: it would roll
    e.set_state(torch.ones(N, dtype=torch.bool), q, torch.zeros_like(e.t.qvel))
    g = np.array([1.5, -2.0, -G])
    e.field("opt.gravity")[:] = torch.as_tensor(g).to(e.t.qpos.dtype)
    run(e, 0.3)
    force = e.t.pair_force.double().numpy()
    np.testing.assert_allclose(force[:, 0], np.tile(-SLAB * g, (N, 1)), rtol=2e-3, atol=4e-3)
    np.testing.assert_allclose(force[:, 1], -force[:, 0], atol=1e-4)


@pytest.mark.parametrize("kind", ENGINES)
def test_pair_forces_with_a_pyramidal_cone(kind):
    e = stack(kind, n=1, spec=stack_spec("pyramidal"), njmax=96)
    _rest(e)
    _check_stack(e, np.array([0, 0, -G]))
    q = e.t.qpos.clone()
    q[:, 7:10] = torch.tensor([5.0, 0, 5.0], dtype=q.dtype)
    e.set_state(torch.ones(1, dtype=torch.bool), q, torch.zeros_like(e.t.qvel))
    g = np.array([1.5, -2.0, -G])
    e.field("opt.gravity")[:] = torch.as_tensor(g).to(e.t.qpos.dtype)
    run(e, 0.3)
    np.testing.assert_allclose(e.t.pair_force[0, 0].double(), -SLAB * g, rtol=2e-3, atol=4e-3)


def centipede(kind: str, feet: int):
    """Return a body of 0.2 kg on so many spherical feet."""
    foot = "".join(
        f'<geom type="sphere" size=".004" pos="{0.01 * (i - feet / 2 + 0.5)} {0.02 * (-1) ** i} 0" '
        f'mass="{0.2 / feet}"/>'
        for i in range(feet)
    )
    spec = mujoco.MjSpec.from_string(f"""
<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
<worldbody><geom name="floor" type="plane" size="1 1 .1"/>
<body name="centipede" pos="0 0 .004"><freejoint/>{foot}</body></worldbody></mujoco>""")
    return make_engine(
        spec,
        2,
        "cpu",
        kind,
        pairs=[ContactPair("feet", ("body", "centipede"), ("geom", "floor"))],
        nconmax=20,
        njmax=64,
    )


@pytest.mark.parametrize("kind", ENGINES)
def test_a_pair_sums_any_number_of_contacts(kind):
    """Ten feet on the floor in one pair: more contacts than a sensor slot or two."""
    e = centipede(kind, 10)
    run(e, 0.4)
    np.testing.assert_allclose(e.t.pair_normal[:, 0], 0.2 * G, rtol=5e-3)
    np.testing.assert_allclose(e.t.pair_force[:, 0, 2], 0.2 * G, rtol=5e-3)
    e.check_overflow()


def test_a_pair_with_more_contacts_than_can_be_summed_fails():
    e = centipede("mujoco", 14)
    e.step(5)
    with pytest.raises(UserError, match="14 contacts"):
        e.check_overflow()


# -- flags
# ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["qpos", "qvel", "fast"])
def test_a_nan_world_is_flagged_others_go_on_and_it_recovers(fresh, where):
    e = fresh
    run(e, 0.05)
    everyone = torch.ones(N, dtype=torch.bool)
    q0, v0 = e.t.qpos.clone(), e.t.qvel.clone()
    e.set_state(everyone, q0, v0)
    run(e, 0.1)
    clean, force = e.t.qpos.clone(), e.t.pair_force.clone()
    e.set_state(everyone, q0, v0)
    if where == "fast":
        e.t.qvel[2, 6] = 1e6
    else:
        getattr(e.t, where)[2, 8] = float("nan")
    run(e, 0.1)
    bad = (e.t.flags & FLAG_NAN) != 0
    assert bad.tolist() == [False, False, True, False]
    others = [0, 1, 3]
    assert torch.equal(e.t.qpos[others], clean[others]) and torch.equal(e.t.pair_force[others], force[others])
    e.set_state(bad, q0, v0)
    assert not e.t.flags.any()
    run(e, 0.1)
    assert not e.t.flags.any()
    assert torch.equal(e.t.qpos[2], clean[2]) and torch.equal(e.t.pair_force[2], force[2])  # no trace of it


@pytest.mark.parametrize("nconmax, njmax", [(40, 16), (2, 64)])
def test_overflow_fails_with_the_setting_to_raise(nconmax, njmax):
    e = stack("warp", nconmax=nconmax, njmax=njmax)
    run(e, 0.1)
    full = "sim.njmax" if njmax == 16 else "sim.nconmax"
    with pytest.raises(UserError, match=full) as err:
        e.check_overflow()
    assert f"{full}={nconmax if full == 'sim.nconmax' else njmax}" in str(err.value)
    p = e.peaks()
    assert (p["rows"] > 16) if njmax == 16 else (p["contacts"] > 2)  # what was needed, not what there was room for


def test_room_enough_is_no_overflow(fresh):
    run(fresh, 0.1)
    fresh.check_overflow()
    p = fresh.peaks()
    assert 5 <= p["contacts"] <= 9 and p["rows"] >= 15


def test_one_world_out_of_rows_is_seen_among_others(fresh):
    """Flags of worlds are joined, not compared: a harmless larger bit elsewhere hides nothing."""
    e = fresh
    lost = 1 if e.kind == "warp" else 1 << 6
    e.t.overflow[1], e.t.overflow[2] = lost, 1 << 9
    with pytest.raises(UserError):
        e.check_overflow()
    if e.kind == "warp":
        e.t.overflow[1] = 1 << 2
        with pytest.raises(UserError, match="pairs that come near, which count against sim.nconmax"):
            e.check_overflow()
    e.t.overflow[1] = 0
    e.check_overflow()
    assert not e.t.overflow.any()


# -- the same again
# -------------------------------------------------------------------------------------------------------


def _tumble(e, steps: int = 12) -> torch.Tensor:
    everyone = torch.ones(e.n, dtype=torch.bool)
    q, v = e.t.qpos.clone(), torch.zeros_like(e.t.qvel)
    q[:] = torch.as_tensor(e.mjm.qpos0).to(q.dtype)
    gen = torch.Generator().manual_seed(3)
    q[:, 9] += 0.01
    v[:] = torch.randn(v.shape, generator=gen).to(v.dtype) * 0.5
    e.set_state(everyone, q, v)
    for _ in range(steps):
        e.step(10)
    return torch.cat([e.t.qpos, e.t.qvel, e.t.pair_normal.to(q.dtype)], 1)


def test_a_recorded_step_is_the_eager_step(monkeypatch):
    from dexsim.sim.warp_engine import WarpEngine

    recorded = _tumble(stack("warp"))

    def eager(self, key, program):
        with wp.ScopedDevice(self.device):
            program()

    monkeypatch.setattr(WarpEngine, "_run", eager)
    assert torch.equal(recorded, _tumble(stack("warp")))


def test_deterministic_runs_are_bitwise_equal():
    a, b = stack("warp", deterministic=True), stack("warp", deterministic=True)
    first = _tumble(a)
    assert torch.equal(first, _tumble(b)) and torch.equal(first, _tumble(a))


def test_threads_do_not_change_results():
    first = _tumble(stack("mujoco", n=7, threads=1))
    assert torch.equal(first, _tumble(stack("mujoco", n=7, threads=2)))
    assert torch.equal(first[:3], _tumble_first(7, 3))


def _tumble_first(n: int, m: int) -> torch.Tensor:
    return _tumble(stack("mujoco", n=n, threads=0))[:m]


# -- the smallest mechanism
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ENGINES)
def test_pendulum_swings_as_computed(kind):
    m, length, armature = 0.1, 0.1, 1e-4
    e = make_engine(
        pendulum_spec(m, length, armature, timestep=0.001), 3, "cpu", kind, fields=("dof_damping", "dof_armature")
    )
    e.field("dof_armature")[1] = 4e-4
    e.field("dof_damping")[2] = 2e-3
    q = torch.full((3, 1), 0.05, dtype=e.t.qpos.dtype)
    e.set_state(torch.ones(3, dtype=torch.bool), q, torch.zeros_like(q))
    angles = []
    for _ in range(150):
        e.step(10)
        angles.append(e.t.qpos[:, 0].double().clone())
    t, angle = 0.01 * np.arange(1, 151), torch.stack(angles).numpy()
    inertia = m * length**2 + 0.4 * m * 0.005**2 + np.array([armature, 4e-4, armature])
    damping = np.array([0, 0, 2e-3])
    w0, rate = np.sqrt(m * G * length / inertia), damping / (2 * inertia)
    w = np.sqrt(w0**2 - rate**2)
    for k in range(3):  # damped oscillation from rest
        exact = 0.05 * np.exp(-rate[k] * t) * (np.cos(w[k] * t) + rate[k] / w[k] * np.sin(w[k] * t))
        assert np.abs(angle[:, k] - exact).max() < 0.0012, k
    assert np.allclose(e.t.time.double(), 1.5, atol=1e-5)


@pytest.mark.parametrize("kind", ENGINES)
def test_callbacks_run_before_each_physics_step_and_after(kind):
    """before_each sees the time of its physics step's start; `after` sees refreshed poses; both by plain launches."""
    e = make_engine(pendulum_spec(), 2, "cpu", kind)
    log = wp.zeros((2, 8), dtype=wp.float64, device="cpu")
    count = wp.zeros(2, dtype=int, device="cpu")
    after = wp.zeros(2, dtype=int, device="cpu")
    write = _write_time(e.real)

    def before_each():
        wp.launch(write, dim=2, inputs=[e.wp.time, count, log], device="cpu")

    def done():
        wp.launch(_count, dim=2, inputs=[after], device="cpu")

    for _ in range(4):
        e.step(2, before_each, done)
    assert np.allclose(log.numpy(), np.tile(0.005 * np.arange(8), (2, 1)), atol=1e-6)
    assert after.numpy().tolist() == [4, 4] and count.numpy().tolist() == [8, 8]


ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <geom type="plane" size="1 1 .1" pos="0 0 -.25"/>
  <body><joint name="a" axis="0 1 0" frictionloss="0.02" damping="0.01" stiffness="0.1"/>
    <geom type="capsule" size=".01" fromto="0 0 0 .1 0 0" mass=".1"/>
    <body pos=".1 0 0"><joint name="b" axis="0 1 0" frictionloss="0.03" damping="0.001" limited="true" range="-1 0.3"
      solimpfriction="0.999 0.9999 0.001 0.5 2" solreffriction="0.01 1"/>
      <geom type="capsule" size=".01" fromto="0 0 0 .1 0 0" mass=".05"/>
      <body pos=".1 0 0"><joint name="c" axis="0 1 0" armature="1e-4" frictionloss="0.001" solreffriction="-100 -5"/>
        <geom type="capsule" size=".01" fromto="0 0 0 .1 0 0" mass=".05"/></body></body></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("kind, tolerance", [("mujoco", 1e-12), ("warp", 1e-3)])
def test_what_a_dof_feels_from_outside(kind, tolerance):
    """Against MuJoCo's own forces, row by row: gravity, Coriolis, spring, push, limit and contact, without what is
    applied, damping and dry friction (slipping, sticking, with each way to state solref)."""
    e = make_engine(mujoco.MjSpec.from_string(ARM), 2, "cpu", kind, fields=("dof_frictionloss",))
    assert e.wp.outside is None and "outside" not in e.memory()
    e.keep_outside()
    model = mujoco.MjModel.from_xml_string(ARM)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    data = mujoco.MjData(model)
    seen = set()
    for k in range(300):
        data.qfrc_applied[:] = 0.1 * math.sin(0.02 * k), 0.05 * math.cos(0.03 * k), 0.0
        data.xfrc_applied[2, 2] = 0.3 if k > 200 else 0.0
        for t, state in ((e.t.qpos, data.qpos), (e.t.qvel, data.qvel), (e.t.qfrc_applied, data.qfrc_applied)):
            t[:] = torch.as_tensor(state)
        e._warmstart[:] = torch.as_tensor(data.qacc_warmstart)
        e.t.xfrc_applied[:, 2, 2] = float(data.xfrc_applied[2, 2])
        e.step(1)
        mujoco.mj_step(model, data)
        rows = range(data.nefc)
        seen |= {int(data.efc_type[r]) for r in rows}
        friction = np.zeros(3)
        for r in rows:
            if data.efc_type[r] == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF:
                friction[data.efc_id[r]] = data.efc_force[r]
        pushed = np.zeros(3)
        mujoco.mj_applyFT(model, data, data.xfrc_applied[2, :3], np.zeros(3), data.xipos[2], 2, pushed)
        measured = -data.qfrc_bias + data.qfrc_spring + pushed + data.qfrc_constraint - friction
        assert np.abs(e.t.outside.double().numpy() - measured).max() < tolerance * max(1.0, np.abs(measured).max()), k
    assert len(seen) == 3, "dry friction, limit and contact"
    e.set_state(torch.tensor([True, False]), e.t.qpos.clone(), e.t.qvel.clone())
    assert not e.t.outside[0].any() and e.t.outside[1].any() and e.memory()["outside"] is e.t.outside


def _write_time(real):
    def write(time, count, log):
        w = wp.tid()
        log[w, count[w]] = wp.float64(time[w])
        count[w] = count[w] + 1

    write.__annotations__ = {
        "time": wp.array(dtype=real),
        "count": wp.array(dtype=int),
        "log": wp.array2d(dtype=wp.float64),
    }
    return wp.kernel(write, module="unique", enable_backward=False)


@wp.kernel(enable_backward=False)
def _count(n: wp.array(dtype=int)):
    w = wp.tid()
    n[w] = n[w] + 1


def test_poses_of_the_c_engine_follow_mujoco_for_every_kind_of_joint():
    """Its own kinematics against mj_kinematics: free, ball, slide and hinge joints, several on a body, offset
    anchors."""
    spec = mujoco.MjSpec.from_string("""
<mujoco>
  <worldbody>
    <body name="free" pos="0.1 0 0"><freejoint/><geom size="0.1"/>
      <body name="ball" pos="0 0.2 0.1" quat="0.9 0.1 0.3 0.2"><joint type="ball" pos="0.05 0.02 -0.03"/>
 <geom size="0.05"/>
        <body name="two" pos="0.1 0 0.3"><joint type="slide" axis="1 2 0"/>
 <joint type="hinge" axis="0 1 1" pos="0 0.03 0.01" ref="0.4"/><geom size="0.05"/></body>
      </body>
      <body name="fixed" pos="-0.1 0.2 0" euler="10 20 30"><geom size="0.05"/></body>
    </body>
  </worldbody>
</mujoco>""")
    e = make_engine(spec, 6, "cpu", "mujoco", fields=("body_pos",))
    rng = np.random.default_rng(0)
    e.field("body_pos").add_(torch.from_numpy(0.02 * rng.normal(size=e.field("body_pos").shape)))
    # quaternions of any length: MuJoCo normalizes them
    e.t.qpos.copy_(torch.from_numpy(rng.normal(size=(6, e.mjm.nq))))
    e.refresh()
    data = mujoco.MjData(e.mjm)
    for w in range(6):
        model = e.batch.get_model(w)
        data.qpos[:] = e.t.qpos[w].numpy()
        mujoco.mj_kinematics(model, data)
        assert np.abs(e.t.xpos[w].numpy() - data.xpos).max() < 1e-6
        assert np.abs(e.t.xmat[w].numpy() - data.xmat.reshape(-1, 3, 3)).max() < 1e-6


def test_the_c_engine_refuses_what_it_cannot_place():
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><body mocap="true"><geom size="0.1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(UserError, match="mocap"):
        make_engine(spec, 1, "cpu", "mujoco")


LOGS = """
import sys, mujoco, numpy as np
if sys.argv[1] == "dexsim":
    from dexsim.sim import make_engine
    from rig import pendulum_spec
    e = make_engine(pendulum_spec(), 2, "cpu", "mujoco")
    e.t.qpos[0] = float("nan")
    e.step(2)
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>")
data = mujoco.MjData(model)
data.qpos[:] = np.nan
mujoco.mj_step(model, data)
"""


@pytest.mark.parametrize("which", [pytest.param("mujoco", marks=pytest.mark.slow), "dexsim"])
def test_mujoco_leaves_no_log_in_the_users_folder(tmp_path, which):
    """Alone it does: a world that diverges writes MUJOCO_LOG.TXT where the user is."""
    here = Path(__file__).parent
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(here.parent), str(here)])}
    done = subprocess.run([sys.executable, "-c", LOGS, which], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "huge value in QPOS" in done.stderr
    assert (tmp_path / "MUJOCO_LOG.TXT").exists() == (which == "mujoco")
