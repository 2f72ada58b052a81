"""One world's Newton solve, as the text of a CUDA or C++ function: 32 lanes that work on one world until it has
converged.

The mathematics is that of `mujoco_warp._src.solver` (MuJoCo's primal Newton solver on elliptic cones, its line search
included), so that both give the same accelerations up to rounding. What differs is where it happens. MuJoCo-Warp
launches some ten kernels an iteration over all worlds, until the last one has converged. Here a world's rows lie in
shared memory and its matrices in registers (lane j holds column j), nothing is written between two iterations, and a
world that has converged ends.

On a CPU the lanes are fibers of one thread and exchange through memory (`wp.config.enable_cpu_blocks`): slow, for
tests.
"""

from __future__ import annotations

from pathlib import Path

from mujoco_warp._src import types

LANES = 32
FOLDER = Path(__file__).parent
PARTS = ("world.cuh", "newton.cuh", "line.cuh")
"""The text's files, in order: one function body, in three pieces for reading."""

ROW_FLOATS = 8
"""Floats a row needs in shared memory beside its Jacobian."""
ROW_INTS = 3


def row_stride(nv: int) -> int:
    """Return the floats between rows of the dense Jacobian: an odd multiple of 4, so that 8 lanes that read 4 floats
    each of 8 rows meet no bank twice."""
    quads = -(-nv // 4)
    return 4 * (quads + 1 - quads % 2)


def shared_bytes(nv: int, rows: int, worlds: int) -> int:
    """Return the shared memory of a block of `worlds` worlds of at most `rows` rows each."""
    words = rows * (row_stride(nv) + ROW_FLOATS + ROW_INTS) + LANES + nv * (nv | 1)
    return 16 * worlds * -(-words // 4)


def text(nv: int, rows: int) -> str:
    """Return the function's body for `nv` dofs and at most `rows` rows (a multiple of 4) beside those of the dofs' dry
    friction."""
    state, overflow = types.ConstraintState, types.OverflowType
    values = {
        "NV": nv, "STRIDE": row_stride(nv), "ROWS": rows, "SIZE": shared_bytes(nv, rows, 1) // 4,
        "MINVAL": types.MJ_MINVAL, "SATISFIED": state.SATISFIED, "QUADRATIC": state.QUADRATIC,
        "LINEARNEG": state.LINEARNEG, "LINEARPOS": state.LINEARPOS,
        "CONE": state.CONE, "CONTACT_ELLIPTIC": types.ConstraintType.CONTACT_ELLIPTIC,
        "ITERATIONS_BIT": overflow.ITERATIONS, "LS_BIT": overflow.LS_ITERATIONS,
    }  # fmt: skip
    body = "".join((FOLDER / name).read_text(encoding="utf-8") for name in PARTS)
    for name in sorted(values, key=len, reverse=True):
        number = values[name]
        body = body.replace(f"${name}", repr(number) if isinstance(number, float) else str(int(number)))
    return body
