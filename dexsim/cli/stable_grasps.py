"""`dexsim stable-grasps`: makes the held poses that rotation episodes start from."""

from __future__ import annotations

from dexsim import files, outputs, typed, yaml_text
from dexsim.cli import start
from dexsim.errors import UserError
from dexsim.paths import CONFIGS
from dexsim.tasks import registry

USAGE = """usage: dexsim stable-grasps [key=value ...]

Let cubes fall into half-open hands, close the fingers, and keep the poses that hold in worlds with other mass,
friction and drives. Rotation episodes start from them: dexsim train task=rotate task.initial.poses=FILE
With objects=[mug.obj,bolt.stl] (kept_out= too) they hold a user's own objects, about as many poses of each; train with
the same objects=, kept_out=.
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


def tasks() -> dict[str, tuple[str, list[float]]]:
    """Map what carries the cube to the task whose episodes start so, usual edges of the cubes [m]."""
    made = {name: registry.load(where) for name, where in registry.built_in().items()}
    held = {name: task.holds for name, task in made.items() if hasattr(task, "holds")}
    return {carries: (name, list(edges)) for name, (carries, edges) in held.items()}


USUAL = typed.defaults(USAGE) | {"sizes": ""}


def main(argv: list[str]) -> int:
    """Returns the exit status. Raises UserError."""
    mine = [a for a in argv if a.partition("=")[0] in USUAL]
    own, known = USUAL | typed.settings(mine, USUAL), tasks()
    task, usual = known[typed.one_of("hold", own["hold"], [*known])]
    count = typed.whole("count", own["count"], 1, 10**6)
    worlds, seed = typed.whole("worlds", own["worlds"], 1, 10**5), typed.whole("seed", own["seed"])
    sizes = usual if not own["sizes"] else yaml_text.parse(own["sizes"], f"sizes={own['sizes'][:40]}")
    if not (
        isinstance(sizes, list)
        and len(sizes) == 2
        and all(type(x) in (int, float) for x in sizes)
        and 0.01 <= sizes[0] <= sizes[1] <= 0.3
    ):
        raise UserError(f"sizes={own['sizes']}: must be [low, high] edges within [0.01, 0.3] m")
    rest = [a for a in argv if a not in mine]
    begun = start.for_train([f"task={task}", "device=cpu", f"worlds={worlds}", *rest], CONFIGS)
    if begun is None:
        return 0
    out = files.place(own["out"])
    if out.name in ("", ".."):
        raise UserError(f"out={own['out']}: must be a file to write, e.g. out=poses.npz")
    out = out if out.suffix == ".npz" else out.with_name(out.name + ".npz")
    outputs.claim(out.parent, "out=", [out.name])
    import torch

    from dexsim.sim.quiet import quiet_warp
    from dexsim.tasks import make_fingertip_grasps, make_grasps
    from dexsim.tasks.building import UNIT_SPAN, hand_of

    generate = (make_grasps if own["hold"] == "palm" else make_fingertip_grasps).generate
    torch.set_num_threads(1)
    quiet_warp("cpu")
    if not own["sizes"]:  # as large for this hand as the usual ones for a hand of UNIT_SPAN
        sizes = [hand_of(begun.cfg).span / UNIT_SPAN * x for x in sizes]
    grasps = generate(begun.cfg, count, worlds, seed, tuple(sizes))
    with outputs.staged(out.parent) as stage:
        grasps.save(stage / out.name)
    what = "cubes" if grasps.names == ("box",) else ", ".join(grasps.names)
    low, high = 1000 * grasps.edge.min(), 1000 * grasps.edge.max()
    print(f"{len(grasps)} held poses, {what} of {low:.0f}-{high:.0f} mm: {out}")
    return 0
