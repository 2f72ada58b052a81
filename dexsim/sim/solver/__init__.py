"""MuJoCo's Newton solver for hands: a warp solves a world to its end, in place of MuJoCo-Warp's kernels over all
worlds."""

from dexsim.sim.solver.newton import VERSION, NewtonSolver, unsupported

__all__ = ["VERSION", "NewtonSolver", "unsupported"]
