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

WORLDS = 4
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def fibers():
    """The solver's lanes on a CPU."""
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


def bouncing() -> mujoco.MjModel:
    """A hull of the object library above a box, a contact that gives back most of its energy, no friction."""
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
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull", friction=[0.1, 0.01, 0.001], **spring)
    return spec.compile()


def test_what_bounces_keeps_as_much_energy(fibers):
    """Up to three bounces of a tumbling hull, from six orientations: energy after 0.3 s as with MuJoCo-Warp's own, and
    as C MuJoCo's."""
    model = bouncing()
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
