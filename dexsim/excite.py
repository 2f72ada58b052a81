"""Safe command trajectories for a real hand: dexsim excite out=DIR."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from dexsim import typed
from dexsim.errors import UserError

USAGE = """usage: dexsim excite out=DIR [key=value ...]

Write commands that show what a hand's drives do: slow triangles, a speed ladder, a chirp, steps, holds, random motion
and repeats, in shuffled order. Every motion is simulated with the servo and made smaller until it keeps the limits of
position, speed and torque and no two bodies come near each other.

  out/excite.mcap            the commands (/joint_commands)
  out/excite.csv             the same: time [s], one column a joint [rad]
  out/excite_simulated.mcap  what the simulation makes of them
  out/excite.yaml            what moves when, the peaks, what was left out

settings (key=default):
  joints=all        comma-separated names of the joints to move
  kinds=all         comma-separated: triangles, ladder, chirp, steps, holds, random
  model=            MuJoCo or URDF file of another mechanism, or a hand's folder (default: hand=)
  hand=xhand        a hand that comes with dexsim, or a folder
  hand_mirror=false   its mirror image: a left hand of a right one
  servo=            servo.yaml believed of its drives (default: the hand's)
  seed=0            of the order and the random motion
  rate=100          commands a second
  repeats=1         motions of each group of joints that come twice
  speed=0.6         largest joint speed, over the no-load speed
  torque=0.8        largest motor torque, over the stall torque
  current=          A that no motor may draw, e.g. 0.3 for a firmware limit of 300 mA (by current_per_torque)
  margin=0.05       share of each joint's range kept free at both ends
  clearance=0.002   m between bodies that are not neighbours
  gravity=          in the model's frame, e.g. gravity="0 0 -9.81": how the hand is mounted (default: the model's)
"""
KEYS = typed.defaults(USAGE) | {"out": ""}


def main(argv: Sequence[str]) -> int:
    """Make and write a plan; returns the exit status. Raises UserError."""
    given = KEYS | typed.settings(argv, KEYS)

    from dexsim import files, outputs
    from dexsim.recording.excitation import FILES, Limits, plan, write_plan
    from dexsim.recording.mechanism import mechanism, stated_hand
    from dexsim.recording.schema import numbers
    from dexsim.sim.quiet import quiet_warp

    if not given["out"]:
        raise UserError("say where to write: out=DIR")
    quiet_warp("cpu")
    gravity = numbers(given["gravity"], 3, "gravity", "excite") if given["gravity"] else None
    named = any(a.startswith("hand=") for a in argv)
    hand = stated_hand(given["hand"] if named else None, typed.truth("hand_mirror", given["hand_mirror"]))
    if hand is not None and given["model"]:
        raise UserError(f"model={given['model']}: is not moved beside hand=; say one of them")
    m = mechanism(given["model"] or None, given["servo"] or None, gravity=gravity, hand=hand)
    limits = Limits(
        **{k: typed.number(k, given[k]) for k in ("speed", "torque", "margin", "clearance", "current") if given[k]}
    )
    seed, repeats = typed.whole("seed", given["seed"]), typed.whole("repeats", given["repeats"], 0, 20)
    out = files.place(given["out"])
    outputs.claim(out, "out=", FILES)
    start = time.perf_counter()
    p = plan(
        m, _list(given["joints"]), _list(given["kinds"]), seed, typed.number("rate", given["rate"], 20, 5000), limits,
        repeats, say=lambda text: print(f"  {text}", flush=True),
    )  # fmt: skip
    print(f"\n{'start s':>9}{'end s':>9}  {'kind':<11}{'scale':>6}  joints")
    for s in p.segments:
        again = "" if s.repeats is None else f"  (repeats the one at {p.segments[s.repeats].start:.1f} s)"
        print(f"{s.start:>9.2f}{s.end:>9.2f}  {s.kind:<11}{s.scale:>6.2f}  {', '.join(s.joints)}{again}")
    for text in p.left_out:
        print(f"left out: {text}")
    print(
        f"\nsimulated: speed at most {100 * p.peaks.speed.max():.0f} % of no-load,"
        f" torque at most {100 * p.peaks.torque.max():.0f} % of stall{_current(m, p.peaks)},"
        f" no contact; {p.t[-1]:.0f} s of commands, made in {time.perf_counter() - start:.0f} s"
    )
    with outputs.staged(out) as stage:
        made = write_plan(p, stage)
    for path in made:
        print(out / path.name)
    return 0


def _current(m: Any, peaks: Any) -> str:
    """Return the largest current of the simulated motions, in words."""
    import numpy as np

    from dexsim.recording.excitation import current_per_torque

    most = float((peaks.torque * m.column("torque_limit") * current_per_torque(m)).max())
    known = np.isfinite(np.asarray(m.table.current(m.joints), float)).all()
    return f" ({most:.2f} A{'' if known else ', with current_per_torque assumed'})" if np.isfinite(most) else ""


def _list(value: str) -> list[str] | None:
    return None if value in ("all", "") else [v.strip() for v in value.split(",") if v.strip()]
