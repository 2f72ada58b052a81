"""Values that no run can work with, refused before anything heavy starts.

Only what every task shares; a task, the servo and the randomization check their own settings where they use them.
"""

from __future__ import annotations

import math
from typing import Any

from dexsim import typed
from dexsim.errors import UserError
from dexsim.learning import names

INF = math.inf
# setting: (lowest, highest, whole number?); a missing or null setting is not checked
LIMITS: dict[str, tuple[float, float, bool]] = {
    "worlds": (1, 1 << 20, True), "iterations": (1, 10**9, True), "episodes": (1, 10**7, True),
    "view_port": (1, 65535, True), "view_seconds": (1, 1e9, False), "seed": (0, 2**31 - 1, True),
    "noise": (0, 2, False), "save_interval": (1, 10**9, True), "average": (0, 10**6, True),
    "final_episodes": (0, 10**7, True), "sim.timestep": (1e-5, 0.02, False), "sim.control_period": (1e-4, 1.0, False),
    "sim.iterations": (1, 10**4, True), "sim.iterations_mujoco": (1, 10**4, True), "sim.nconmax": (1, 10**6, True),
    "sim.njmax": (1, 10**6, True), "agent.num_steps_per_env": (1, 10**5, True),
    "agent.algorithm.learning_rate": (1e-12, 1.0, False), "agent.algorithm.desired_kl": (1e-9, 10.0, False),
    "agent.algorithm.num_learning_epochs": (1, 1000, True), "agent.algorithm.num_mini_batches": (1, 10**6, True),
    "agent.algorithm.clip_param": (1e-6, 10.0, False), "agent.algorithm.gamma": (0.0, 1.0, False),
    "agent.algorithm.lam": (0.0, 1.0, False), "agent.algorithm.entropy_coef": (0.0, INF, False),
    "agent.algorithm.value_loss_coef": (0.0, INF, False), "agent.algorithm.max_grad_norm": (1e-9, INF, False),
    "agent.actor.distribution_cfg.init_std": (1e-6, 100.0, False),
}  # fmt: skip


def check(cfg: dict[str, Any]) -> None:
    """Raise UserError for a setting outside its limits, naming it, its value and the range."""
    for key, (low, high, whole) in LIMITS.items():
        value = get(cfg, key)
        if value is not None:
            if isinstance(value, str):
                raise UserError(f"{key}={value}: must be a number, not text")
            typed.number(key, value, low, high, exact=whole)
    if cfg.get("save_worlds") not in (None, True, False):
        raise UserError(f"save_worlds={cfg['save_worlds']}: must be true, false or null")
    step, period = get(cfg, "sim.timestep"), get(cfg, "sim.control_period")
    if step and period and (period < step or abs(period / step - round(period / step)) > 1e-6):
        raise UserError(
            f"sim.control_period={period}: must be a multiple of sim.timestep={step}, e.g."
            f" {max(round(period / step), 1) * step:g}"
        )
    if isinstance(agent := cfg.get("agent"), dict):
        names.check_sizes(agent)
    worlds, steps = cfg.get("worlds"), get(cfg, "agent.num_steps_per_env")
    batches = get(cfg, "agent.algorithm.num_mini_batches")
    if worlds and steps and batches and worlds * steps < 2 * batches:
        raise UserError(
            f"agent.algorithm.num_mini_batches={batches}: {worlds} worlds x {steps} steps are too few samples;"
            " raise worlds or agent.num_steps_per_env"
        )


def get(cfg: dict[str, Any], key: str) -> Any:
    """Return the value at a dotted key, None where the path breaks off."""
    node: Any = cfg
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            return None
        node = node[part]
    return node
