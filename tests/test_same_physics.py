"""dexsim's narrow phase and solver in place of MuJoCo-Warp's change no physics: a held grasp creeps alike, and what
bounces keeps as much energy."""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from worlds import grasp_env

from benchmarks import tools
from dexsim.assets.objects import library
from dexsim.sim.collision import NarrowPhase
from dexsim.sim.solver import NewtonSolver
from tests.narrow_phase import tip_vertices

WORLDS = 4
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def fibers():
    """Yield the solver's lanes on a CPU."""
    before, wp.config.enable_cpu_blocks = wp.config.enable_cpu_blocks, True
    yield
    wp.config.enable_cpu_blocks = before


def test_a_held_grasp_creeps_alike(fibers):
    """The same grasp, held for a second with the palm turned down: objects stay, and drift by as much (float32 chaos
    aside)."""
    envs = {}
    for whose in ("mujoco", "hand"):
        both = (f"sim.collision={whose}", f"sim.solver={whose}")
        envs[whose] = grasp_env(*both, "task.objects.baked_scales=[1.25]", worlds=WORLDS, engine="warp", seed=3)
    assert envs["hand"].engine.narrow is not None and envs["hand"].engine.newton is not None
    assert envs["mujoco"].engine.narrow is None and envs["mujoco"].engine.newton is None
    tools.close_hand(envs["mujoco"], 60)
    grasp = tools.Snapshot(envs["mujoco"])
    place, drift = {}, {}
    for whose, env in envs.items():
        grasp.restore(env, fields=True)
        e = env.engine
        e.field("opt.gravity")[:] = torch.tensor([0.0, 0.0, 9.81])  # the palm looks down
        path = []
        for _ in range(48):
            e.step(env.decimation, env.servo.before_each)
            path.append(e.t.qpos[:, env.object_q[:3]].clone())
        place[whose] = torch.stack(path)
        drift[whose] = (path[-1] - path[23]).norm(dim=1) / (24 * env.dt)
    held = (place["mujoco"][-1] - place["mujoco"][0]).norm(dim=1) < 0.03
    assert held.sum() >= WORLDS - 1
    assert ((place["hand"][-1] - place["hand"][0]).norm(dim=1) < 0.03).equal(held)
    assert (place["hand"] - place["mujoco"])[:, held].norm(dim=2).max() < 2e-5  # m, over a second
    torch.testing.assert_close(drift["hand"][held], drift["mujoco"][held], rtol=0.02, atol=1e-5)  # m/s


def bouncing(thing: str) -> mujoco.MjModel:
    """Return a hull of the library or a cylinder above a box, a contact that gives back most of its energy, no
    friction."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.cone = 5e-4, mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator, spec.option.jacobian = (
        mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        mujoco.mjtJacobian.mjJAC_SPARSE,
    )
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    spec.option.iterations, spec.option.ls_iterations = 30, 30
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    hull = next(s.hulls[0] for s in library().values() if s.kind == "grid")
    spec.add_mesh(name="hull", uservert=(np.asarray(hull) * 1.25).ravel())
    spring = {"solref": [-100000.0, -20.0], "solimp": [0.99, 0.99, 1e-3, 0.5, 2.0], "margin": 0.00075, "condim": 3}
    spec.worldbody.add_geom(name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.2, 0.02], **spring)
    body = spec.worldbody.add_body(name="thing", pos=[0.0, 0.0, 0.12])
    body.add_freejoint()
    body.ipos = [0.0, 0.0, 0.0]
    # explicit gyroscopic torque would add energy
    body.mass, body.inertia, body.explicitinertial = 0.1, [6e-5, 6e-5, 6e-5], True
    if thing == "hull":
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull", friction=[0.1, 0.01, 0.001], **spring)
    else:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.025, 0.03, 0], friction=[0.1, 0.01, 0.001], **spring)
    return spec.compile()


@pytest.mark.parametrize("thing", ["hull", "cylinder"])
def test_what_bounces_keeps_as_much_energy(fibers, thing):
    """Up to three bounces of a tumbling hull or cylinder, from six orientations: energy after 0.3 s as with
    MuJoCo-Warp's own, and as C MuJoCo's."""
    model = bouncing(thing)
    n, steps = 6, 600
    rng = np.random.default_rng(0)
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    start = np.concatenate([np.tile([0.0, 0.0, 0.12], (n, 1)), q], 1)
    trace = {}
    for whose in ("mujoco", "hand"):
        m, d = mjw.put_model(model), mjw.put_data(model, mujoco.MjData(model), nworld=n, nconmax=8, njmax=64)
        d.qpos.assign(start.astype(np.float32))
        narrow, newton = NarrowPhase(model, m, d), NewtonSolver(m, d)
        path = []
        for _ in range(steps):
            if whose == "hand":
                with narrow.in_place(), newton.in_place():
                    mjw.step(m, d)
            else:
                mjw.step(m, d)
            path.append(d.energy.numpy().sum(1))
        trace[whose] = np.array(path)
    path = []
    worlds = [mujoco.MjData(model) for _ in range(n)]
    for data, q0 in zip(worlds, start, strict=True):
        data.qpos[:] = q0
    for _ in range(steps):
        for data in worlds:
            mujoco.mj_step(model, data)
        path.append(np.array([data.energy.sum() for data in worlds]))
    trace["C"] = np.array(path)
    start, end = trace["C"][0].mean(), {name: path[-1] for name, path in trace.items()}
    lost = (start - end["C"]) / (0.1 * 9.81 * 0.12)
    assert (lost > 0.05).all() and (lost < 0.4).all()  # each of them has hit the box, and bounced
    for other in ("mujoco", "C"):
        # worlds that are amid a second bounce at the end differ more; before it, all agree
        assert np.abs(trace["hand"][450] - trace[other][450]).max() < 5e-3 * start, other
        assert np.abs(end["hand"] - end[other]).max() < 0.02 * start, other
    assert trace["hand"][-1].max() < start  # nothing is gained


def pinched() -> mujoco.MjModel:
    """Return a cylinder lying between a fingertip and a capsule that press it with 3 N from both sides, and nothing
    below."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.cone, spec.option.impratio = 2e-3, mujoco.mjtCone.mjCONE_ELLIPTIC, 5
    spec.option.integrator, spec.option.jacobian = (
        mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        mujoco.mjtJacobian.mjJAC_SPARSE,
    )
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    spec.option.iterations, spec.option.ls_iterations = 30, 50
    spec.add_mesh(name="tip", uservert=tip_vertices("tip_finger").ravel())
    skin = {"margin": 0.00075, "condim": 4, "friction": [1.0, 0.01, 0.001], "solref": [0.008, 1.0]}
    for name, side in (("tip", -1.0), ("capsule", 1.0)):
        body = spec.worldbody.add_body(name=name, pos=[side * 0.06, 0.002 * side, 0.0])
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[-side, 0.0, 0.0], damping=2.0)
        body.mass, body.inertia, body.explicitinertial = 0.05, [2e-5] * 3, True
        if name == "tip":
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="tip", **skin)
        else:
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.01, 0.015, 0.0], **skin)
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name, gainprm=[1.0] + 9 * [0.0])
    thing = spec.worldbody.add_body(name="thing")
    thing.add_freejoint(name="thing")
    thing.mass, thing.inertia, thing.explicitinertial = 0.06, [3e-5] * 3, True
    thing.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.02, 0.03, 0.0], **skin)
    return spec.compile()


def test_a_cylinder_held_by_a_fingertip_and_a_capsule(fibers):
    """For half a second, turned askew in three ways (along the capsule it would have no single place of contact): it
    stays in the pinch, and is where C MuJoCo has it."""
    model = pinched()
    steps, gravity = 250, lambda step: -9.81 if step > 60 else 0.0  # once it is held
    turn = np.array([[0.97, 0.2, 0.1, 0.05], [0.9, -0.1, 0.15, 0.3], [0.8, 0.1, -0.2, 0.5]])
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    k, worlds = int(model.joint("thing").qposadr[0]), [mujoco.MjData(model) for _ in turn]
    for data, q in zip(worlds, turn, strict=True):
        data.qpos[k + 3 : k + 7] = q
        data.ctrl[:] = 3.0
    m, d = mjw.put_model(model), mjw.put_data(model, worlds[0], nworld=len(turn), nconmax=8, njmax=64)
    d.qpos.assign(np.array([data.qpos for data in worlds], np.float32))
    narrow, newton = NarrowPhase(model, m, d), NewtonSolver(m, d)
    for step in range(steps):
        m.opt.gravity.assign(np.array([[0, 0, gravity(step)]], np.float32))
        with narrow.in_place(), newton.in_place():
            mjw.step(m, d)
    for step in range(steps):
        model.opt.gravity[2] = gravity(step)
        for data in worlds:
            mujoco.mj_step(model, data)
    want = np.array([data.qpos[k : k + 3] for data in worlds])
    assert int(d.nacon.numpy()[0]) == sum(data.ncon for data in worlds) == 2 * len(turn)
    assert (np.abs(want[:, 2]) < 3e-3).all()  # free, it would have fallen by 0.7 m
    assert np.abs(d.qpos.numpy()[:, k : k + 3] - want).max() < 1e-5
