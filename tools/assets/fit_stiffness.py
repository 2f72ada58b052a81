"""Choose the foundation stiffness: `python -m tools.assets.fit_stiffness`.

Presses primitives and the object library on each kind of pad and compares the plain sum of springs with the contact law
of the physics, force = K * depth (K is our assumption: 5 N at 0.71 mm). For each force law it prints the stiffness at
which the median ratio is 1 on average of 0.7 and 1.0 mm, and the spread of the ratio. The figures live in
configs/tactile/default.yaml.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence

import numpy as np

from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.tactile.config import TactileConfig
from dexsim.tactile.kernel import LAWS
from dexsim.tactile.layout import TaxelLayout
from dexsim.tactile.sensors import Sensors
from tools.assets.presses import Press, presses, taxel_force

CONTACT_STIFFNESS = 7000.0  # N/m
DEPTHS = (0.3e-3, 0.7e-3, 1.0e-3)  # m
RUBBER = TactileConfig().rubber
SIZES = {"box": (0.03, 0.024, 0.02), "sphere": (0.03, 0.0, 0.0), "capsule": (0.019, 0.011, 0.0)}


def press_library(sensors: Sensors, pad: int, count: int, seed: int = 0) -> list[Press]:
    """`count` presses of every shape at each of `DEPTHS`, on pad number `pad`."""
    from dexsim.assets.objects import library

    rng = np.random.default_rng(seed)
    layout, skin = sensors.lifted, sensors.skin(pad, fine=6)
    out: list[Press] = []
    for name, shape in library().items():
        size = np.array(SIZES.get(name, (1.0, 0.0, 0.0)))
        out += presses(rng, layout, pad, skin, shape, size, DEPTHS, count)
    return out


def calibrate_stiffness(
    layout: TaxelLayout,
    pad: int,
    pressed: Sequence[Press],
    law: str,
    contact: float = CONTACT_STIFFNESS,
    rubber: Mapping = RUBBER,
) -> tuple[float, dict[float, np.ndarray]]:
    """Return the stiffness at which the medians of (spring sum / (contact * depth)) at depths over 0.5 mm average to 1,
    and the 5, 25, 50, 75 and 95 % points of that ratio by depth [m]."""
    area = layout.area[pad, : layout.count[pad]]
    ratio: dict[float, list[float]] = {}
    for p in pressed:
        f = taxel_force(law, -p.d, area, 1.0, rubber).sum()
        ratio.setdefault(p.depth, []).append(f / (contact * p.depth))
    k = 1.0 / np.mean([np.median(r) for depth, r in ratio.items() if depth > 0.5e-3])
    return float(k), {d: np.percentile(np.array(r) * k, [5, 25, 50, 75, 95]) for d, r in ratio.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=30, help="presses of each shape")
    parser.add_argument("--contact", type=float, default=CONTACT_STIFFNESS, help="K of the physics, N/m")
    parser.add_argument("--hand", default="xhand", help="a hand that comes with dexsim, or a folder")
    args = parser.parse_args()
    sensors = Sensors(load_hand(args.hand))
    if (layout := sensors.layout) is None:
        raise UserError(f"--hand {args.hand}: has no touch pads")
    report: dict = {"contact": args.contact}
    for kind in dict.fromkeys(layout.kinds):
        pad = layout.kinds.index(kind)
        pressed = press_library(sensors, pad, args.count)
        for law in LAWS:
            k, spread = calibrate_stiffness(sensors.lifted, pad, pressed, law, args.contact)
            by_depth = {f"{d * 1e3:.1f} mm": np.round(s, 3).tolist() for d, s in spread.items()}
            report[f"{law}.{kind}"] = {"stiffness": k, **by_depth}
            print(f"{kind:7s} {law:14s} stiffness {k:.4g}; spring sum / (K depth), 5 25 50 75 95 %:")
            for d, s in spread.items():
                print(f"    {d * 1e3:.1f} mm   " + "  ".join(f"{v:5.2f}" for v in s))
    print(json.dumps(report))


if __name__ == "__main__":
    main()
