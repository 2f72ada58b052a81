"""The kernel around the text of `source`: one warp a world."""

from __future__ import annotations

from functools import cache

import warp as wp
from mujoco_warp._src.types import vec5

from dexsim.sim.solver.source import LANES, text


@wp.struct
class Problem:
    """The problem to solve, in MuJoCo-Warp's arrays: N worlds of V dofs and up to R rows, C contacts in all; M has E
    entries, a Jacobian up to Z. Units are those of a slide; a hinge has N.m, kg.m2 and rad/s2. [N or 1]: 1 where all
    worlds have the same."""

    tolerance: wp.array(dtype=float)  # [N or 1]
    ls_tolerance: wp.array(dtype=float)  # [N or 1]
    impratio_invsqrt: wp.array(dtype=float)  # [N or 1]
    M_rowind: wp.array(dtype=int)  # [E]
    M_colind: wp.array(dtype=int)  # [E]
    M: wp.array2d(dtype=float)  # [N, E] kg
    qacc_warmstart: wp.array2d(dtype=float)  # [N, V] m/s2
    qacc_smooth: wp.array2d(dtype=float)  # [N, V] m/s2
    qfrc_smooth: wp.array2d(dtype=float)  # [N, V] N
    dof_frictionadr: wp.array2d(dtype=int)  # [N, V] row of the dof's dry friction
    ne: wp.array(dtype=int)  # [N] rows of equalities, which come first,
    nf: wp.array(dtype=int)  # [N] of dry friction, which come next, and
    nefc: wp.array(dtype=int)  # [N] all that there are
    nacon: wp.array(dtype=int)  # [1] contacts of all worlds
    contact_friction: wp.array(dtype=vec5)  # [C]
    contact_dim: wp.array(dtype=int)  # [C]
    contact_efc_address: wp.array2d(dtype=int)  # [C, P] its rows; -1: none
    type: wp.array2d(dtype=int)  # [N, R] `ConstraintType`
    id: wp.array2d(dtype=int)  # [N, R] of the row's contact
    J_rownnz: wp.array2d(dtype=int)  # [N, R]
    J_rowadr: wp.array2d(dtype=int)  # [N, R]
    J_colind: wp.array3d(dtype=int)  # [N, 1, Z]
    J: wp.array3d(dtype=float)  # [N, 1, Z]
    D: wp.array2d(dtype=float)  # [N, R] kg
    aref: wp.array2d(dtype=float)  # [N, R] m/s2
    frictionloss: wp.array2d(dtype=float)  # [N, R] N


@wp.struct
class Solution:
    """Results of a solve (out), in the same."""

    qacc: wp.array2d(dtype=float)  # [N, V] m/s2
    Ma: wp.array2d(dtype=float)  # [N, V] N
    qfrc_constraint: wp.array2d(dtype=float)  # [N, V] N
    force: wp.array2d(dtype=float)  # [N, R] N
    state: wp.array2d(dtype=int)  # [N, R] `ConstraintState`
    niter: wp.array(dtype=int)  # [N] iterations
    overflow: wp.array(dtype=int)  # [N] bits: what ended before it had converged


@cache
def solve_kernel(nv: int, rows: int, fast_math: bool = False) -> wp.Kernel:
    """Return the kernel for models of `nv` dofs (at most 32); [N * 32] threads, in blocks of whole warps.

    It solves the worlds that have more than `above` and at most `rows` rows beside those of dry friction.
    """
    if not 0 < nv <= LANES or rows % 4:
        raise ValueError(f"solve_kernel: nv {nv} must be 1 to {LANES}, rows {rows} a multiple of 4")

    def solve_world(
        world: int, above: int, iterations: int, ls_iterations: int, warm: int, njmax: int, problem: Problem,
        solution: Solution,
    ): ...  # fmt: skip

    solve_world.__name__ = solve_world.__qualname__ = f"solve_world_{nv}_{rows}"
    call = wp.func_native(text(nv, rows))(solve_world)

    def solve(
        above: int, iterations: int, ls_iterations: int, warm: int, njmax: int, problem: Problem, solution: Solution
    ):  # fmt: skip
        call(wp.tid() // wp.static(LANES), above, iterations, ls_iterations, warm, njmax, problem, solution)

    return wp.kernel(
        solve, enable_backward=False, module="unique", grid_stride=False, module_options={"fast_math": fast_math},
    )  # fmt: skip
