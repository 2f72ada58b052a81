"""The solver's host side: which models it serves, its launches, and its place in MuJoCo-Warp's step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import mujoco_warp as mjw
import warp as wp
from mujoco_warp._src import smooth
from mujoco_warp._src import solver as theirs
from mujoco_warp._src.warp_util import event_scope

from dexsim.sim.launches import taken
from dexsim.sim.solver.kernel import Problem, Solution, solve_kernel
from dexsim.sim.solver.source import LANES, shared_bytes

VERSION = "4.0.0"
"""The MuJoCo-Warp whose stage this replaces; with another one the setting is refused (see `unsupported`)."""
_SHARED = 48 * 1024  # bytes a CUDA block has without asking for more


def unsupported(model: mujoco.MjModel, device: str, njmax: int) -> str | None:
    """Return the why `sim.solver=hand` cannot serve this model on this device, or None if it can."""
    opt, bit = model.opt, mujoco.mjtDisableBit
    if mjw.__version__ != VERSION:
        return f"it is written for MuJoCo-Warp {VERSION}, and {mjw.__version__} is installed"
    if not device.startswith("cuda") and not wp.config.enable_cpu_blocks:
        return "it needs a CUDA device"
    if opt.solver != mujoco.mjtSolver.mjSOL_NEWTON:
        return "it is a Newton solver, and the model asks for another"
    if opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
        return "it is for elliptic cones of friction, and the model asks for pyramids"
    if opt.jacobian != mujoco.mjtJacobian.mjJAC_SPARSE:
        return "it reads a sparse Jacobian, and the model asks for another"
    if model.nv > LANES:
        return f"the model has {model.nv} dofs, and {LANES} is the most it takes"
    if model.nflex:
        return "it knows no flexible bodies, and the model has some"
    if model.ntendon and (model.tendon_frictionloss > 0).any():
        return "it knows dry friction of joints only, and a tendon of the model has some"
    if opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        return "it does not let bodies sleep, and the model asks for that"
    if opt.integrator not in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
                              mujoco.mjtIntegrator.mjINT_IMPLICIT):  # fmt: skip
        return "the model's integrator wants forces that it does not leave behind"
    if opt.disableflags & bit.mjDSBL_CONSTRAINT or opt.iterations < 1 or not model.nv:
        return "the model has nothing for it to solve"
    if shared_bytes(model.nv, _whole(njmax), 1) > _SHARED:
        return f"sim.njmax={njmax} rows do not fit into its memory"
    return None


def _whole(rows: int) -> int:
    return -(-rows // 16) * 16


class NewtonSolver:
    """Constraint forces and accelerations of N worlds of `m`, one warp a world.

    Worlds with at most `rows` rows (those of dry friction not counted) are solved by a kernel that needs little shared
    memory, so that many run at a time; the few with more by one with room for all of `njmax`.

    Attributes:
      rows, fast_math: launch choices, see `solve_kernel`; change them before a recording.
    """

    def __init__(self, m: mjw.Model, d: mjw.Data, rows: int = 64):
        self.m, self.d = m, d
        self.most = _whole(d.njmax)
        self.rows = min(_whole(rows), self.most)
        # Approximate roots and quotients (2 units in the last place) on a GPU, as MuJoCo-Warp's line search has them. A
        # CPU's compiler takes more liberties: not to know what is not finite, for one
        self.fast_math = d.qacc.device.is_cuda
        problem, self._solution = taken(Problem, m.opt, d, d.efc), taken(Solution, d, d.efc)
        problem.M_rowind, problem.M_colind, self._solution.niter = m.M_hinit_i, m.M_colind, d.solver_niter
        for name in ("friction", "dim", "efc_address"):
            setattr(problem, f"contact_{name}", getattr(d.contact, name))
        self._problem = problem

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Let `mujoco_warp.step`, within this, solve here."""
        original = theirs.solve

        @event_scope
        def solve(m: mjw.Model, d: mjw.Data) -> None:
            self.launch()
            if m.opt.noslip_iterations > 0:
                theirs.noslip(m, d)

        theirs.solve = solve
        try:
            yield
        finally:
            theirs.solve = original

    def launch(self) -> None:
        m, d = self.m, self.d
        if smooth.skip_qacc_smooth(m, d):
            warm = 2
        else:
            warm = 0 if m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART else 1
        above = -1
        for rows in (self.rows, self.most) if self.rows < self.most else (self.most,):
            wp.launch(
                solve_kernel(m.nv, rows, self.fast_math), dim=d.nworld * LANES,
                inputs=[above, m.opt.iterations, m.opt.ls_iterations, warm, d.njmax, self._problem, self._solution],
                block_dim=LANES,
            )  # fmt: skip
            above = rows
