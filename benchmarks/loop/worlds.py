"""The concealed realities of the loop: other contacts, solver, timing and touch, and drives with effects that the
belief lacks.

    python -m benchmarks.loop.worlds        # writes dexsim/configs/reality/late.yaml and stiff.yaml, drawn once

Built as `dexsim.tasks.reality` builds its own, but the drives are the believed ones, each quantity off by up to 3 %,
with two or three effects of the catalogue in every joint. late: a delay, a lag, a lower no-load speed. stiff: twice the
gain, less than half the damping. What they hide was chosen by what the naive policy loses by it and by what can be won
back, since nothing of it takes away what the drives are able to do (lab/results/loop.md); the numbers are drawn.
"""

from __future__ import annotations

import sys

import numpy as np
import yaml

from dexsim.paths import CONFIGS

SEEDS = {"late": 4102, "stiff": 4104}


def draw(name: str) -> dict:
    """Return the numbers of a world."""
    from dexsim.tasks.reality import draw as other
    from tools.assets import xhand

    nominal = yaml.safe_load((CONFIGS / "servo" / "xhand.yaml").read_text(encoding="utf-8"))
    world = other(SEEDS[name], nominal)
    rng = np.random.default_rng(SEEDS[name])
    joints = {}
    for joint in xhand.JOINTS:
        b = nominal["joints"]["*"] | nominal["joints"].get(joint, {})
        p = {k: b[k] * rng.uniform(0.97, 1.03) for k in ("kp", "kd", "torque_limit", "no_load_speed",
                                                         "coulomb_friction")}
        p["delay"] = b["delay"]
        if name == "stiff":
            p["kp"] *= rng.uniform(1.7, 2.2)
            p["kd"] *= rng.uniform(0.3, 0.5)
        else:
            p["delay"] += rng.uniform(0.025, 0.035)
            p["lag"] = rng.uniform(0.015, 0.025)
            p["no_load_speed"] *= rng.uniform(0.4, 0.55)
        joints[joint] = {k: float(f"{v:.4g}") for k, v in p.items()}
    world["name"], world["seed"], world["servo"]["joints"] = name, SEEDS[name], joints
    return world


def main(argv: list[str]) -> int:
    """Writes the files."""
    from dexsim.errors import UserError
    from dexsim.tasks.reality import text

    if argv:
        raise UserError(f"'{argv[0]}': there are no settings; the numbers are drawn from SEEDS in"
                        " benchmarks/loop/worlds.py")

    for name in SEEDS:
        path = CONFIGS / "reality" / f"{name}.yaml"
        body = text(draw(name)).split("\n")
        lines = [line for line in body if not line.startswith("#")]
        head = ["# A concealed reality of the closed loop (`python -m benchmarks.loop`), standing in for hardware:"
                " never trained in.",
                "# Numbers drawn once: python -m benchmarks.loop.worlds. What it hides (in its servo) was chosen by",
                "# what it costs a naive policy."]
        path.write_text("\n".join(head + lines), encoding="utf-8")
        print(path)
    return 0


if __name__ == "__main__":
    from dexsim.console.ending import guard

    sys.exit(guard(main, sys.argv[1:], __doc__))
