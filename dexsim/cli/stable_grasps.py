"""`dexsim stable-grasps`: makes the held poses that rotation episodes start from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from dexsim.cli import start
from dexsim.console import folders
from dexsim.errors import UserError
from dexsim.paths import CONFIGS

USAGE = """usage: dexsim stable-grasps [key=value ...]

Let cubes fall into half-open hands, close the fingers, and keep the poses that hold in worlds with other mass,
friction and drives. Rotation episodes start from them: dexsim train task=rotate task.initial.poses=FILE
With hold=fingertips, fingertips close on cubes above the palm instead: for task=rotate_fingertips.

settings (key=default):
  hold=palm                   palm | fingertips: what carries the cube
  out=out/stable_grasps.npz   file to write
  count=2000                  poses wanted
  worlds=256                  hands tried at once, on the CPU
  seed=0                      of everything random
  sizes=[0.045,0.06]          edges of the cubes [m]: the smallest and the largest, within [0.01, 0.3], times the
                              span of the hand over 0.1 m;
                              [0.04,0.065] with hold=fingertips
  any setting of task=rotate, or task=rotate_fingertips  (dexsim train --help)
"""

TASK = {"palm": ("rotate", [0.045, 0.06]), "fingertips": ("rotate_fingertips", [0.04, 0.065])}
"""What carries the cube -> task whose episodes start so, usual edges of the cubes [m]."""


def main(argv: list[str]) -> int:
    """Returns the exit status. Raises UserError."""
    if any(a in ("-h", "--help", "help") for a in argv):
        print(USAGE, end="")
        return 0
    own: dict[str, Any] = {
        "out": "out/stable_grasps.npz",
        "count": 2000,
        "worlds": 256,
        "seed": 0,
        "sizes": None,
        "hold": "palm",
    }
    rest = []
    for text in argv:
        key, eq, value = text.partition("=")
        if eq and key in own:
            own[key] = yaml.safe_load(value)
        else:
            rest.append(text)
    if own["hold"] not in TASK:
        raise UserError(f"hold={own['hold']}: must be {' or '.join(TASK)}")
    task, usual = TASK[own["hold"]]
    sizes = usual if own["sizes"] is None else own["sizes"]
    if not (isinstance(sizes, list) and len(sizes) == 2 and 0.01 <= sizes[0] <= sizes[1] <= 0.3):
        raise UserError(f"sizes={sizes}: must be [low, high] edges within [0.01, 0.3] m")
    for key in ("count", "worlds"):
        if not (isinstance(own[key], int) and own[key] >= 1):
            raise UserError(f"{key}={own[key]}: must be a whole number from 1 up")
    begun = start.for_train([f"task={task}", "device=cpu", f"worlds={own['worlds']}", *rest], CONFIGS)
    if begun is None:
        return 0
    out = Path(str(own["out"])).expanduser()
    folders.make(out.parent, "out=")
    import torch

    from dexsim.sim.quiet import quiet_warp
    from dexsim.tasks import make_fingertip_grasps, make_grasps
    from dexsim.tasks.env import UNIT_SPAN, hand_of

    generate = (make_grasps if own["hold"] == "palm" else make_fingertip_grasps).generate
    torch.set_num_threads(1)
    quiet_warp("cpu")
    if own["sizes"] is None:  # as large for this hand as the usual ones for a hand of UNIT_SPAN
        sizes = [hand_of(begun.cfg).span / UNIT_SPAN * x for x in sizes]
    grasps = generate(begun.cfg, own["count"], own["worlds"], own["seed"], tuple(sizes))
    grasps.save(out)
    print(f"{len(grasps)} held poses, cubes of {1000 * grasps.edge.min():.0f}-{1000 * grasps.edge.max():.0f} mm: {out}")
    return 0
