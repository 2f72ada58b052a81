"""The solver of contact forces for hands: against MuJoCo-Warp's on the same constraints, and what it refuses.

Its lanes are CUDA's; on a CPU they are fibers (`wp.config.enable_cpu_blocks`), which run the same text.
"""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from mujoco_warp._src import solver as theirs
from rig import pendulum_spec
from worlds import grasp_env

from dexsim.errors import UserError
from dexsim.sim import make_engine
from dexsim.sim.solver import NewtonSolver, newton, unsupported
from dexsim.sim.solver.kernel import solve_kernel

WORLDS = 6
OPTION = 'integrator="implicitfast" cone="elliptic" jacobian="sparse" iterations="30" ls_iterations="30" impratio="5"'
KINDS = f"""<mujoco><option timestep="0.005" {OPTION}/>
<worldbody><geom name="floor" type="plane" size="1 1 0.1" condim="1"/>
<body pos="0 0 0.5"><joint name="swing" type="hinge" axis="0 1 0" range="-0.2 0.2" limited="true" frictionloss="0.05"/>
  <geom type="capsule" size="0.02 0.1" fromto="0 0 0 0.2 0 0"/></body>
<body pos="0.4 0 0.049"><freejoint/><geom type="box" size="0.05 0.05 0.05" condim="1"/></body>
<body pos="-0.4 0 0.049"><freejoint/><geom type="box" size="0.05 0.05 0.05" condim="3" friction="0.4"/></body>
<body pos="0 0.4 0.049"><freejoint/><geom type="sphere" size="0.05" condim="4" friction="1 0.01"/></body>
<body pos="0 -0.4 0.049"><freejoint/><geom type="sphere" size="0.05" condim="6" friction="1 0.01 0.001"/></body>
<body pos="0 0 1"><joint name="lead" axis="0 1 0" frictionloss="0.02"/><geom size="0.02" pos=".1 0 0"/>
  <body pos="0.1 0 0"><joint name="follow" axis="0 1 0"/><geom size="0.02" pos=".1 0 0"/></body></body>
</worldbody><equality><joint joint1="follow" joint2="lead" polycoef="0.1 0.5 0.1 0 0"/></equality></mujoco>"""
"""An equality, a limit, dry friction, and contacts of every number of directions; 27 dofs."""


@pytest.fixture(scope="module", autouse=True)
def fibers():
    """Yield the blocks of 32 lanes on the CPU."""
    before, wp.config.enable_cpu_blocks = wp.config.enable_cpu_blocks, True
    yield
    wp.config.enable_cpu_blocks = before


def both(m, d, ours: NewtonSolver, warm: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """Return what each solver leaves behind, from the constraints in `d` and the start `warm` [N, nv]."""
    found = {}
    for name, call in (("theirs", lambda: theirs.solve(m, d)), ("ours", ours.launch)):
        d.qacc_warmstart.assign(warm.astype(np.float32))
        d.overflow.zero_()
        for array in (d.qacc, d.efc.Ma, d.qfrc_constraint, d.efc.force):
            array.fill_(float("nan"))  # whatever is not written shows
        with wp.ScopedDevice("cpu"):
            call()
        found[name] = {
            "qacc": d.qacc.numpy()[:, : m.nv], "Ma": d.efc.Ma.numpy()[:, : m.nv],
            "constraint": d.qfrc_constraint.numpy()[:, : m.nv],
            "force": d.efc.force.numpy(), "state": d.efc.state.numpy(), "iterations": d.solver_niter.numpy(),
            "overflow": d.overflow.numpy(),
        }  # fmt: skip
        found[name] = {k: v.copy() for k, v in found[name].items()}
    return found


def assert_same(found: dict, nefc: np.ndarray, tolerance: float) -> None:
    """Compare accelerations and forces to `tolerance` of their largest; rows in the same state but for a few at an
    edge."""
    a, b = found["theirs"], found["ours"]
    for name in ("qacc", "Ma", "constraint"):
        assert np.isfinite(b[name]).all(), name
        assert np.abs(a[name] - b[name]).max() < tolerance * np.abs(a[name]).max(), name
    rows = np.arange(a["force"].shape[1]) < nefc[:, None]
    assert np.isfinite(b["force"][rows]).all()
    assert np.abs(a["force"] - b["force"])[rows].max() < tolerance * np.abs(a["force"][rows]).max()
    assert (a["state"] != b["state"])[rows].mean() < 0.005
    assert (np.abs(a["iterations"] - b["iterations"]) <= 1).mean() > 0.9
    assert (a["overflow"] == b["overflow"]).mean() > 0.8  # an iteration more or less reaches the limit or does not


@pytest.fixture(scope="module")
def catching(fibers):
    """Return a hand environment with MuJoCo-Warp's solver, its contact constraints those of a catch."""
    env = grasp_env("sim.solver=mujoco", worlds=WORLDS, engine="warp")
    close = torch.zeros(WORLDS, env.num_actions)
    close[:, :3], close[:, 4:] = 0.4, 0.5
    for k in range(40):
        env.step(close if k > 16 else 0 * close)
    return env


@pytest.mark.slow
def test_forces_of_a_catch_are_those_of_mujoco_warp(catching):
    """Six worlds over five control steps, from the warm start of physics and from starts that are far off."""
    e, rng = catching.engine, np.random.default_rng(0)
    ours, contacts, limit, off = NewtonSolver(e.m, e.d), 0, e.m.opt.iterations, []
    for _ in range(5):
        catching.step(torch.as_tensor(rng.uniform(-1, 1, (WORLDS, catching.num_actions)), dtype=torch.float32))
        e.physics_step()
        nefc, warm = e.d.nefc.numpy(), e.d.qacc_warmstart.numpy().copy()
        contacts += int(e.d.nacon.numpy()[0])
        for spoilt, tolerance in ((0.0, 3e-4), (10.0, 1e-4), (100.0, 1e-3)):
            e.m.opt.iterations = 100 if spoilt else limit  # cut off before it converges, a solve amplifies rounding
            found = both(e.m, e.d, ours, warm + spoilt * rng.normal(size=warm.shape))
            e.m.opt.iterations = limit
            assert_same(found, nefc, tolerance)  # (of the warm start: as near as the solver's own tolerance brings it)
            if not spoilt:
                off.append(
                    np.abs(found["theirs"]["qacc"] - found["ours"]["qacc"]) / np.abs(found["theirs"]["qacc"]).max()
                )
    assert np.percentile(off, 90) < 1e-6  # where all went the same way: rounding
    assert contacts > 5 * 4 * WORLDS  # there was something to solve


@pytest.mark.slow
def test_worlds_of_many_rows_are_solved_by_the_kernel_with_room_for_them(catching):
    """The limit between the two kernels decides nothing but where a world is solved: to the bit."""
    e = catching.engine
    nefc, nf = e.d.nefc.numpy(), e.d.nf.numpy()
    rows = int(np.median(nefc - nf)) // 16 * 16
    assert ((nefc - nf) > rows).any() and rows > 0
    out = []
    for limit in (rows, 160):
        solver = NewtonSolver(e.m, e.d, rows=limit)
        e.d.qacc.fill_(float("nan"))
        solver.launch()
        out.append((e.d.qacc.numpy().copy(), e.d.efc.force.numpy().copy()))
    assert np.isfinite(out[0][0]).all()
    np.testing.assert_array_equal(out[0][0], out[1][0])
    np.testing.assert_array_equal(out[0][1], out[1][1])


def test_a_world_that_is_not_finite_ends_and_leaves_the_others_alone(catching):
    e = catching.engine
    warm = e.d.qacc_warmstart.numpy().copy()
    clean = both(e.m, e.d, NewtonSolver(e.m, e.d), warm)["ours"]["qacc"]
    warm[2] = np.nan
    spoilt = both(e.m, e.d, NewtonSolver(e.m, e.d), warm)["ours"]["qacc"]
    assert np.isnan(spoilt[2]).any()
    np.testing.assert_array_equal(np.delete(clean, 2, 0), np.delete(spoilt, 2, 0))


@pytest.fixture(scope="module")
def kinds(fibers):
    """Return (C model, model, data) of the scene with every kind of row; worlds at random places and speeds."""
    mjm = mujoco.MjModel.from_xml_string(KINDS)
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mujoco.MjData(mjm), nworld=WORLDS, nconmax=40, njmax=160)
    rng = np.random.default_rng(1)
    d.qpos.assign(
        (d.qpos.numpy() + np.where(np.arange(mjm.nq) < 1, rng.uniform(-0.3, 0.3, (WORLDS, 1)), 0)).astype(np.float32)
    )
    d.qvel.assign(rng.normal(size=(WORLDS, mjm.nv)).astype(np.float32))
    mjw.step(m, d)
    return mjm, m, d


@pytest.mark.slow
def test_every_kind_of_row(kinds):
    """An equality, a limit, dry friction, contacts of 1, 3, 4 and 6 directions; 27 dofs (not a multiple of what a lane
    reads at once)."""
    mjm, m, d = kinds
    assert unsupported(mjm, "cpu", d.njmax) is None
    rng, seen = np.random.default_rng(2), set()
    ours = NewtonSolver(m, d)
    for _ in range(8):
        mjw.forward(m, d)
        nefc = d.nefc.numpy()
        assert_same(both(m, d, ours, d.qacc_warmstart.numpy() + rng.normal(size=(WORLDS, mjm.nv))), nefc, 1e-4)
        rows = np.arange(d.njmax) < nefc[:, None]
        seen |= set(zip(d.efc.type.numpy()[rows].tolist(), d.efc.state.numpy()[rows].tolist(), strict=True))
        mjw.step(m, d)
    state, row = mujoco.mjtConstraintState, mujoco.mjtConstraint
    for kind, how in (
        (row.mjCNSTR_EQUALITY, state.mjCNSTRSTATE_QUADRATIC),
        (row.mjCNSTR_FRICTION_DOF, state.mjCNSTRSTATE_LINEARNEG),
        (row.mjCNSTR_FRICTION_DOF, state.mjCNSTRSTATE_LINEARPOS),
        (row.mjCNSTR_LIMIT_JOINT, state.mjCNSTRSTATE_QUADRATIC),
        (row.mjCNSTR_CONTACT_FRICTIONLESS, state.mjCNSTRSTATE_QUADRATIC),
        (row.mjCNSTR_CONTACT_ELLIPTIC, state.mjCNSTRSTATE_CONE),
        (row.mjCNSTR_CONTACT_ELLIPTIC, state.mjCNSTRSTATE_QUADRATIC),
    ):
        assert (int(kind), int(how)) in seen, (kind, how)


def test_steps_with_it_are_those_of_c_mujoco(kinds):
    """Fifty steps of the scene, in place of MuJoCo-Warp's solver, against C MuJoCo's."""
    mjm, m, _ = kinds
    data = mujoco.MjData(mjm)
    data.qvel[:] = np.random.default_rng(3).normal(size=mjm.nv) * 0.3
    d = mjw.put_data(mjm, data, nworld=1, nconmax=40, njmax=160)
    ours = NewtonSolver(m, d)
    for _ in range(50):
        mujoco.mj_step(mjm, data)
        with ours.in_place():
            mjw.step(m, d)
    assert np.abs(d.qpos.numpy()[0] - data.qpos).max() < 1e-4
    assert np.abs(d.qvel.numpy()[0] - data.qvel).max() < 5e-3


def test_a_world_without_rows_takes_its_smooth_acceleration():
    spec = pendulum_spec()
    spec.option.cone, spec.option.jacobian = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtJacobian.mjJAC_SPARSE
    e = make_engine(spec, 2, "cpu", "warp", solver="hand")
    assert e.newton is not None
    e.wp.qpos.fill_(0.5)
    e.physics_step()
    assert (e.d.nefc.numpy() == 0).all() and np.abs(e.d.qacc_smooth.numpy()).min() > 1
    np.testing.assert_allclose(e.d.qacc.numpy(), e.d.qacc_smooth.numpy(), rtol=1e-6)
    assert (e.d.qfrc_constraint.numpy() == 0).all()


SWING = "<joint joint='swing' coef='1'/>"


def changed(**options) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(KINDS)
    for name, value in options.items():
        setattr(model.opt, name, value)
    return model


def model_with(end: str, more: str) -> mujoco.MjModel:
    """Return the model with more before a closing tag."""
    return mujoco.MjModel.from_xml_string(KINDS.replace(end, more + end))


@pytest.mark.parametrize(
    "model, says",
    [
        (changed(solver=mujoco.mjtSolver.mjSOL_CG), "Newton"),
        (changed(cone=mujoco.mjtCone.mjCONE_PYRAMIDAL), "pyramids"),
        (changed(jacobian=mujoco.mjtJacobian.mjJAC_DENSE), "sparse"),
        (changed(integrator=mujoco.mjtIntegrator.mjINT_RK4), "integrator"),
        (changed(enableflags=mujoco.mjtEnableBit.mjENBL_SLEEP), "sleep"),
        (changed(disableflags=mujoco.mjtDisableBit.mjDSBL_CONSTRAINT), "nothing"),
        (model_with("</worldbody>", 2 * "<body><freejoint/><geom size='.1'/></body>"), "39 dofs"),
        (model_with("</mujoco>", f"<tendon><fixed frictionloss='1'>{SWING}</fixed></tendon>"), "tendon"),
    ],
)  # fmt: skip
def test_what_it_cannot_serve_it_says(model, says):
    assert says in unsupported(model, "cuda:0", 160)


def test_where_it_is_refused(monkeypatch):
    model = changed()
    assert unsupported(model, "cuda:0", 160) is None
    assert "sim.njmax=1000" in unsupported(model, "cuda:0", 1000)
    monkeypatch.setattr(newton.mjw, "__version__", "4.1.0")
    assert "4.1.0 is installed" in unsupported(model, "cuda:0", 160)
    monkeypatch.undo()
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", False)
    assert "CUDA" in unsupported(model, "cpu", 160)
    with pytest.raises(UserError, match="sim.solver=hand: .*CUDA.*sim.solver=mujoco"):
        make_engine(pendulum_spec(), 1, "cpu", "warp", solver="hand")
    assert make_engine(pendulum_spec(), 1, "cpu", "warp").newton is None
    with pytest.raises(UserError, match="sim.solver='both'"):
        make_engine(pendulum_spec(), 1, "cpu", "mujoco", solver="both")


@pytest.mark.slow
def test_it_compiles_for_a_gpu_that_is_not_there(tmp_path):
    """The text's CUDA half, for compute capability 9.0."""
    kernel = solve_kernel(18, 64)
    kernel.module.options["block_dim"] = 32
    (built,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=False)
    assert built.stat().st_size > 50_000
