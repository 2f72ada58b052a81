"""Recordings of the press rig (benchmarks/press_rig.py) with hidden effects of touch and contact.

The ball's motion and the contact's depth come from MuJoCo's geometry (the tip's hull), the readings from the touch
kernels that train policies (`dexsim.tactile`): neither is the diagnosis's own plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.press_rig import SERVO, Touch, gap, spec, write
from benchmarks.real.common import rig
from dexsim.hand import Hand, load_hand
from dexsim.tactile.sensors import Sensors

LSB, RATE = 0.1, 90.0


def path(kind: int, seconds: float, rng: np.random.Generator, slides: bool) -> tuple[np.ndarray, np.ndarray]:
    """Times [T] s and targets [T, 2] m of (slide, press): presses of several depths, fast and slow, some held."""
    t = np.arange(0.0, seconds, 0.01)
    q = np.zeros((len(t), 2))
    at = 0.2
    while at < seconds - 0.8:
        deep = 2e-3 + rng.uniform(0.3e-3, 1.1e-3)
        ramp, hold = rng.choice([0.08, 0.25, 0.7]), rng.choice([0.1, 0.5, 2.5 if kind == 1 else 1.0])
        x = np.interp(t, [at, at + ramp, at + ramp + hold, at + 2 * ramp + hold], [0, 1, 1, 0]) * deep
        q[:, 1] = np.maximum(q[:, 1], x)
        if slides:
            q[:, 0] += np.interp(t, [at + ramp, at + ramp + 0.5 * hold, at + ramp + hold], [0, 1, 0]) * rng.uniform(
                1e-3, 3e-3
            )
        else:
            q[:, 0] += (
                np.interp(t, [at - 0.2, at], [0, 1]) * rng.uniform(-2e-3, 2e-3) * (t < at + 2 * ramp + hold + 0.05)
            )
        at += 2 * ramp + hold + rng.uniform(0.25, 0.6)
    return t, q


def record(
    folder: Path,
    count: int = 3,
    seconds: float = 8.0,
    seed: int = 0,
    finger: str = "index",
    load_cell: bool = True,
    stiffness: float = 7000.0,
    friction: float = 0.8,
    sensor: dict | None = None,
    gains: dict[int, float] | None = None,
    swapped: Sequence[tuple[int, int]] = (),
    stuck: dict[int, float] | None = None,
    crosstalk: float = 0.0,
    rubber: tuple[float, float] | None = None,
    drift: float = 0.0,
    slides: bool = False,
    shear: bool = False,
    pressed: Sequence[np.ndarray] = (),
    hand: Hand | None = None,
) -> tuple[list[Path], Path, Path]:
    """Write `count` recordings, the rig's model and its servo; returns their paths.

    stiffness N/m, friction: of the contact. sensor: settings of `dexsim.tactile` (hysteresis, delay, ...). gains: taxel
    -> gain; swapped: pairs of taxels; stuck: taxel -> N; crosstalk: share of its force that a taxel gives its
    neighbours; rubber: (c10, c01) Pa of a Mooney-Rivlin skin in place of the linear contact; drift: relative gain lost
    or won a second over all recordings. pressed: contact forces [T] N of each recording that are given, in place of
    what the spring makes of the depth. hand: whose finger it is (the xHand).
    """
    hand = hand or load_hand()
    s, *_ = spec(finger, hand)
    model = s.compile()
    belief = rig(folder, "rig", s.to_xml(), SERVO)
    f, sensors, rng, paths = hand.finger_names.index(finger), Sensors(hand), np.random.default_rng(seed), []
    settings: dict = {"others": False, "period": 0.5 / RATE, "friction": friction, "shear": slides or shear}
    settings |= sensor or {}
    if rubber:
        settings |= {
            "sum": "spring",
            "law": "mooney_rivlin",
            "rubber": {"c10": rubber[0], "c01": rubber[1], "thickness": 2e-3},
            "stiffness": {"mooney_rivlin": dict.fromkeys(sensors.layout.kinds, 1.0)},
        }
    for k in range(count):
        t, q = path(k, seconds, rng, slides)
        real = np.zeros_like(q)  # the drives follow with a lag of 20 ms
        for i in range(1, len(q)):
            real[i] = real[i - 1] + (1 - np.exp(-0.01 / 0.02)) * (q[i - 1] - real[i - 1])
        n = int((t[-1] - 0.02) * RATE)
        seen = np.sort(rng.uniform(0, 1e-3, n) + np.arange(n) / RATE)
        now = np.stack([np.interp(seen, t, x) for x in real.T], 1)
        data, touch, z, cell = mujoco.MjData(model), Touch(hand, finger, settings), [], np.zeros((n, 6))
        for i in range(n):
            deep = max(-gap(model, data, now[i]), 0.0)
            cell[i, 0] = pressed[k][i] if len(pressed) else stiffness * deep
            z.append(touch.feel(float(seen[i]), data, cell[i, 0]))
            if rubber:
                cell[i, 0] = float(touch.touch.force_clean[0, f])
        z = np.array(z, float)
        if crosstalk:
            mine = z[:, f, : sensors.layout.count[f]]
            mine[:] = (1 - crosstalk) * mine + crosstalk * np.einsum("kl,tlc->tkc", sensors.mixing(f), mine)
        if load_cell:
            cell[:, 0] += 0.02 * rng.standard_normal(n)
        z[:, f] *= 1 + drift * (seen + k * seconds)[:, None, None]
        for taxel, g in (gains or {}).items():
            z[:, f, taxel] *= g
        for a, b in swapped:
            z[:, f, [a, b]] = z[:, f, [b, a]]
        for taxel, value in (stuck or {}).items():
            z[:, f, taxel, 2] = value
        paths.append(write(folder / f"press_{k + 1}.mcap", model, seen, now, z, LSB, sent=(t, q), source="sim",
                           cell=cell if load_cell else None, start=1 + k * seconds,
                           notes="a fingertip pressed by a ball"))  # fmt: skip
    return paths, *belief


def as_trained(content: dict) -> dict:
    """Return the settings of `record` for the rig that training would have with a tactile.yaml (its content): every
    best guess, and what was believed elsewhere."""

    def value(x):
        if not isinstance(x, dict):
            return x
        return x["value"] if "value" in x else {k: value(v) for k, v in x.items()}

    tactile, shared = content.get("tactile", {}), content.get("randomize", {})
    out: dict = {"sensor": {"pads": value(tactile["pads"])}} if "pads" in tactile else {}
    for name, key in (("contact.stiffness", "stiffness"), ("object.friction", "friction")):
        if name in shared:
            out[key] = value(shared[name])
    return out
