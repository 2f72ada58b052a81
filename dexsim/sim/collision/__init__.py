"""A narrow phase for hands, between MuJoCo-Warp's broad phase and its constraints.

`NarrowPhase` takes over the pairs of a convex hull with a sphere, a capsule, a box or another hull, which in a grasp
cost more than everything else of a physics step, and those of a cylinder with a capsule, a box or a hull, which are not
exact in MuJoCo-Warp. All other pairs, closed forms mostly, stay with MuJoCo-Warp.
"""

from __future__ import annotations

from dexsim.sim.collision.narrow import NarrowPhase, unsupported

__all__ = ["NarrowPhase", "unsupported"]
