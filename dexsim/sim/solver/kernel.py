"""The kernel around the text of `source`: one warp a world."""

from __future__ import annotations

from functools import cache

import warp as wp
from mujoco_warp._src.types import vec5

from dexsim.sim.solver.source import LANES, text


@cache
def solve_kernel(nv: int, rows: int, registers: int = 0, fast_math: bool = False) -> wp.Kernel:
    """The kernel for models of `nv` dofs (at most 32); [N * 32] threads, in blocks of whole warps.

    It solves the worlds that have more than `above` and at most `rows` rows beside those of dry friction. registers:
    CUDA, at most so many a thread (0: as the compiler likes).
    """
    if not 0 < nv <= LANES or rows % 4:
        raise ValueError(f"solve_kernel: nv {nv} must be 1 to {LANES}, rows {rows} a multiple of 4")

    def solve_world(
        world: int,
        above: int,
        iterations: int,
        ls_iterations: int,
        warm: int,
        njmax: int,
        tolerance_in: wp.array(dtype=float),
        ls_tolerance_in: wp.array(dtype=float),
        impratio_invsqrt_in: wp.array(dtype=float),
        M_rowind: wp.array(dtype=int),
        M_colind: wp.array(dtype=int),
        M_in: wp.array2d(dtype=float),
        qacc_warmstart_in: wp.array2d(dtype=float),
        qacc_smooth_in: wp.array2d(dtype=float),
        qfrc_smooth_in: wp.array2d(dtype=float),
        dof_frictionadr_in: wp.array2d(dtype=int),
        nf_in: wp.array(dtype=int),
        nefc_in: wp.array(dtype=int),
        nacon_in: wp.array(dtype=int),
        contact_friction: wp.array(dtype=vec5),
        contact_dim: wp.array(dtype=int),
        contact_efc_address: wp.array2d(dtype=int),
        type_in: wp.array2d(dtype=int),
        id_in: wp.array2d(dtype=int),
        J_rownnz: wp.array2d(dtype=int),
        J_rowadr: wp.array2d(dtype=int),
        J_colind: wp.array3d(dtype=int),
        J_in: wp.array3d(dtype=float),
        D_in: wp.array2d(dtype=float),
        aref_in: wp.array2d(dtype=float),
        frictionloss_in: wp.array2d(dtype=float),
        qacc_out: wp.array2d(dtype=float),
        Ma_out: wp.array2d(dtype=float),
        qfrc_constraint_out: wp.array2d(dtype=float),
        force_out: wp.array2d(dtype=float),
        state_out: wp.array2d(dtype=int),
        niter_out: wp.array(dtype=int),
        overflow_out: wp.array(dtype=int),
    ): ...

    solve_world.__name__ = solve_world.__qualname__ = f"solve_world_{nv}_{rows}"
    call = wp.func_native(text(nv, rows))(solve_world)

    def solve(
        above: int,
        iterations: int,
        ls_iterations: int,
        warm: int,
        njmax: int,
        tolerance_in: wp.array(dtype=float),
        ls_tolerance_in: wp.array(dtype=float),
        impratio_invsqrt_in: wp.array(dtype=float),
        M_rowind: wp.array(dtype=int),
        M_colind: wp.array(dtype=int),
        M_in: wp.array2d(dtype=float),
        qacc_warmstart_in: wp.array2d(dtype=float),
        qacc_smooth_in: wp.array2d(dtype=float),
        qfrc_smooth_in: wp.array2d(dtype=float),
        dof_frictionadr_in: wp.array2d(dtype=int),
        nf_in: wp.array(dtype=int),
        nefc_in: wp.array(dtype=int),
        nacon_in: wp.array(dtype=int),
        contact_friction: wp.array(dtype=vec5),
        contact_dim: wp.array(dtype=int),
        contact_efc_address: wp.array2d(dtype=int),
        type_in: wp.array2d(dtype=int),
        id_in: wp.array2d(dtype=int),
        J_rownnz: wp.array2d(dtype=int),
        J_rowadr: wp.array2d(dtype=int),
        J_colind: wp.array3d(dtype=int),
        J_in: wp.array3d(dtype=float),
        D_in: wp.array2d(dtype=float),
        aref_in: wp.array2d(dtype=float),
        frictionloss_in: wp.array2d(dtype=float),
        qacc_out: wp.array2d(dtype=float),
        Ma_out: wp.array2d(dtype=float),
        qfrc_constraint_out: wp.array2d(dtype=float),
        force_out: wp.array2d(dtype=float),
        state_out: wp.array2d(dtype=int),
        niter_out: wp.array(dtype=int),
        overflow_out: wp.array(dtype=int),
    ):
        call(
            wp.tid() // wp.static(LANES), above, iterations, ls_iterations, warm, njmax, tolerance_in, ls_tolerance_in,
            impratio_invsqrt_in, M_rowind, M_colind, M_in, qacc_warmstart_in, qacc_smooth_in, qfrc_smooth_in,
            dof_frictionadr_in, nf_in, nefc_in, nacon_in, contact_friction, contact_dim, contact_efc_address, type_in,
            id_in, J_rownnz, J_rowadr, J_colind, J_in, D_in, aref_in, frictionloss_in, qacc_out, Ma_out,
            qfrc_constraint_out, force_out, state_out, niter_out, overflow_out,
        )  # fmt: skip

    return wp.kernel(
        solve,
        enable_backward=False,
        module="unique",
        grid_stride=False,
        cuda_max_registers=registers or None,
        module_options={"fast_math": fast_math},
    )
