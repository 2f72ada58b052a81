"""Touch on given poses, and layouts to feel with."""

from __future__ import annotations

import numpy as np

from dexsim.tactile import ShapeSet, Tactile, TaxelLayout
from dexsim.tactile.posed import PosedEngine
from dexsim.tactile.shapes import TouchShape

SPRING = {"sum": "spring", "law": "linear", "stiffness": {"linear": 2.0e8, "hertz": 5.0e6, "mooney_rivlin": 1.0}}


def touch(n: int, layout: TaxelLayout, shapes: list, cfg: dict, **kw) -> tuple[PosedEngine, Tactile]:
    """Return an engine with the layout's bodies and `object`, and touch on it, one pair "pad" a pad."""
    bodies = ["world", *dict.fromkeys(layout.bodies), "object"]
    engine = PosedEngine(n, bodies, layout.names, kw.pop("device", "cpu"))
    tactile = Tactile(engine, layout, ShapeSet(shapes, engine.device), "object", cfg, pairs=list(layout.names), **kw)
    return engine, tactile


def primitives() -> list[TouchShape]:
    return [TouchShape(k, k) for k in ("box", "sphere", "capsule", "cylinder")]


def flat_layout(half: float = 8e-3, n: int = 81) -> TaxelLayout:
    """Return a flat square pad in the plane z = 0, +z outward, n x n taxels that tile it evenly."""
    pitch = 2 * half / n
    x = -half + pitch * (np.arange(n) + 0.5)
    p = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((n, n))], -1).reshape(-1, 3)
    return TaxelLayout.build(
        [
            {
                "name": "flat",
                "body": "pad",
                "point": p,
                "normal": np.tile([0, 0, 1.0], (n * n, 1)),
                "area": np.full(n * n, pitch**2),
            }
        ]
    )


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def touch_result(recordings, m, held=frozenset(), allowed=None):
    """Return what a diagnosis says of touch alone."""
    from dexsim.gap.touch.diagnosis import Touch

    touch = Touch(recordings, m, set(held), allowed=allowed)
    touch.run()
    return touch.result
