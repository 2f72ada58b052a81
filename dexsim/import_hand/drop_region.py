"""Where the tasks let objects fall into an imported hand: searched for, so that what falls there is held."""

from __future__ import annotations

import math
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

WORLDS = 64
AREA = 0.045  # m, either side of the cupped pose's middle, of a hand of tasks.building.UNIT_SPAN; then half of it
FEWEST = 0.1
"""Share of the drops about a place that must be held for it to be taken."""


@dataclass(frozen=True)
class Region:
    """catch [3] m, palm frame: the place on the palm over which objects are let fall, None where hardly any is held;
    held: of `drops` that fell within `within` m of it, along x and y; middle: the same of the place that the cupped
    pose tells, None: it is that place; moved: m between the two."""

    catch: np.ndarray | None
    held: int
    drops: int
    within: float
    middle: int | None = None
    moved: float = 0.0


def search(folder: Path, count: int, seed: int = 0) -> Region:
    """Let primitives fall over a hand, by its folder, as `task=grasp` does on a CPU: a half of `count` over a wide area
    about the place that its cupped pose tells (dexsim.hand.places), a half over a narrower one about the best place of
    those. The best of all is then tried against the first place, a half of `count` at each, and taken if more are held.
    Numbers are rounded up to WORLDS. Raises UserError for a hand that the task refuses."""
    import torch

    from dexsim.cli import start
    from dexsim.hand.load import load_hand
    from dexsim.hand.places import surface
    from dexsim.paths import CONFIGS
    from dexsim.sim.quiet import quiet_warp
    from dexsim.tasks.grasp import GraspEnv
    from dexsim.tasks.held_drops import drop, scattered

    torch.set_num_threads(1)
    quiet_warp("cpu")
    with tempfile.TemporaryDirectory() as place:
        hand = Path(place) / "hand"
        shutil.copytree(folder, hand)  # any characters may be in the folder's own name, which the settings parse
        begun = start.for_train(["device=cpu", f"worlds={WORLDS}", f"hand={hand}"], CONFIGS)
        assert begun is not None  # only --help has nothing to begin
        env = GraspEnv(begun.cfg, WORLDS, "cpu", seed, "mujoco")
    half, area = WORLDS * math.ceil(count / 2 / WORLDS), env.unit * AREA
    within = env.unit * max(map(abs, begun.cfg["randomize"]["initial"]["object_xy"]))
    middle = env.places.catch[:2]
    wide = drop(env, scattered(middle, area, half, seed))
    near = drop(env, scattered(wide.best(env.unit, middle), area / 2, half, seed + 1))
    best = (wide + near).best(env.unit, middle)

    def held(at: np.ndarray) -> int:
        return int(drop(env, scattered(at, within, half, seed + 2)).held.sum())

    moved = float(np.linalg.norm(best - middle))
    there = held(middle)
    here = held(best) if moved > 0 else there
    if here <= there:
        best, here, moved = middle, there, 0.0
    if here < FEWEST * half:
        return Region(None, here, half, within)
    catch = np.append(best, 0.0)
    catch[2] = surface(load_hand(folder), catch)
    return Region(catch, here, half, within, there if moved > 0 else None, moved)
