"""A minimal engine that only holds poses and contact forces, and layouts to feel with."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch
import warp as wp

from dexsim.errors import UserError
from dexsim.tactile import ShapeSet, Tactile, TaxelLayout
from dexsim.tactile.shapes import TouchShape

SPRING = {"sum": "spring", "law": "linear", "stiffness": {"linear": 2.0e8, "hertz": 5.0e6, "mooney_rivlin": 1.0}}


class PosedEngine:
    """N worlds whose body poses and contact forces are set by hand."""

    def __init__(self, n: int, bodies: list[str], pairs: list[str], device: str = "cpu"):
        self.n, self.device, self.dt = n, device, 0.005
        self.bodies, self.pairs = bodies, pairs
        self.wp = SimpleNamespace(
            time=wp.zeros(n, dtype=float, device=device),
            xpos=wp.zeros((n, len(bodies)), dtype=wp.vec3, device=device),
            xmat=wp.zeros((n, len(bodies)), dtype=wp.mat33, device=device),
            pair_normal=wp.zeros((n, len(pairs)), dtype=float, device=device),
        )
        self.t = SimpleNamespace(**{k: wp.to_torch(v) for k, v in vars(self.wp).items()})
        self.t.xmat[:] = torch.eye(3)

    def body(self, name: str) -> int:
        if name not in self.bodies:
            raise UserError(f"model has no body '{name}'")
        return self.bodies.index(name)

    def pair(self, name: str) -> int:
        return self.pairs.index(name)

    def place(self, world: int, body: str, position, rotation=None) -> None:
        b = self.body(body)
        self.t.xpos[world, b] = torch.as_tensor(np.asarray(position, np.float32))
        if rotation is not None:
            self.t.xmat[world, b] = torch.as_tensor(np.asarray(rotation, np.float32))


def touch(n: int, layout: TaxelLayout, shapes: list, cfg: dict, **kw) -> tuple[PosedEngine, Tactile]:
    """An engine with the layout's bodies and `object`, and touch on it, one pair "pad" a pad."""
    engine = PosedEngine(n, ["world", *dict.fromkeys(layout.bodies), "object"], list(layout.names), kw.pop("device", "cpu"))
    tactile = Tactile(engine, layout, ShapeSet(shapes, engine.device), "object", cfg, pairs=list(layout.names), **kw)
    return engine, tactile


def primitives() -> list[TouchShape]:
    return [TouchShape(k, k) for k in ("box", "sphere", "capsule", "cylinder")]


def flat_layout(half: float = 8e-3, n: int = 81) -> TaxelLayout:
    """A flat square pad in the plane z = 0, +z outward, n x n taxels that tile it evenly."""
    pitch = 2 * half / n
    x = -half + pitch * (np.arange(n) + 0.5)
    p = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((n, n))], -1).reshape(-1, 3)
    return TaxelLayout.build(
        [{"name": "flat", "body": "pad", "point": p, "normal": np.tile([0, 0, 1.0], (n * n, 1)), "area": np.full(n * n, pitch**2)}]
    )


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))
