"""Bytes and operations that a touch launch asks for, counted from the layout, and the time below which no H200 can do
them.

Bytes: what must cross the memory bus once. Written: each pad's force, centre and force of other tips, and with `raw`
each taxel's force. Read: poses of the bodies that occur, contact forces, shape and size. The taxel table, shapes and
distance grids (a few MB in all) stay in the caches and are not counted. Operations: multiply, add, compare, absolute
value, minimum, root and quotient as one each, as `sdf.py` and `kernel.py` have them, every taxel of every pad of every
world (nothing culled); what is done once a pad (poses, boxes, reduction across lanes) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

PEAK_BYTES, PEAK_FLOPS = 4.8e12, 67e12
"""H200 (SXM), datasheet: bytes/s of its memory, float32 operations/s."""

TRANSFORM = 18  # 3 x 3 matrix times vector, plus vector
DISTANCE = {"box": 22, "sphere": 7, "capsule": 11, "cylinder": 16, "grid": 66}
FORCE = {"linear": 3, "hertz": 4, "mooney_rivlin": 14}
SHARE = 4  # depth under the level, its square, the area
SUM = 7  # moment (3 multiply-adds) and force


@dataclass(frozen=True)
class Cost:
    """Bytes across the memory bus, and floating-point operations, of one launch."""

    bytes: int
    flops: int

    def floor_us(self) -> float:
        """Microseconds that an H200 needs at its peak rates: the larger of the two."""
        return 1e6 * max(self.bytes / PEAK_BYTES, self.flops / PEAK_FLOPS)


def cost_of(touch: Any, shape: str, worlds: int) -> Cost:
    """Cost of the touch kernel (imperfections of a sensor not counted) on `worlds` hands that hold one shape."""
    layout, cfg = touch.layout, touch.cfg
    pads, taxels = layout.pads, sum(layout.count)
    solver = cfg.sum == "solver"
    kind = touch.shapes.kinds[touch.shapes.index(shape)]
    name = ("box", "sphere", "capsule", "cylinder", "grid")[int(kind)]
    per_taxel = TRANSFORM + DISTANCE[name] + SUM
    per_taxel += 1 + SHARE + 1 if solver else FORCE[cfg.law]
    written = pads * (4 + 12 + 4) + (4 * pads * layout.taxels if cfg.raw else 0)
    read = (pads + 1) * (12 + 36) + (4 * pads if solver else 0) + 4 + 12
    return Cost(int(worlds * (written + read)), int(worlds * taxels * per_taxel))
