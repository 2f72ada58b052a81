"""The physics of a drive, one small Warp function a law, in SI units: what the training's servo (`kernel.py`) and the search's
plant (`dexsim.gap.plant.kernel`) have in common. Each works in float32 and in float64; `reference.py` has the same laws in
NumPy, written apart, as their check."""

# No `from __future__ import annotations`: Warp resolves these annotations from the module.

from typing import Any

import warp as wp


@wp.func
def torque_limit(tau0: Any, x: Any, slope: Any):
    """Largest torque [N.m] of a motor: tau0 * max(0, 1 - slope * x), x = |speed| / no-load speed at the supply's voltage.

    tau0: stall torque [N.m]. slope: 1 while the motor drives (the torque-speed line of a DC motor at its full voltage), the
    column `braking_slope` while it brakes: 1 the driving line mirrored (the paper's limit), 0 a current limit (tau0 at any
    speed), -1 the driving line gone on beyond zero speed (back-EMF and full voltage add up: a voltage limit).
    """
    limit = type(tau0)(0.0)
    if slope * x < type(x)(1.0):
        limit = tau0 * (type(x)(1.0) - slope * x)
    return limit
