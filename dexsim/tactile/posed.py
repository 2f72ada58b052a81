"""N worlds whose poses and contact forces are given, not simulated: to feel recorded poses, to test, to measure."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import torch
import warp as wp

from dexsim.errors import UserError


class PosedEngine:
    """What `Tactile` reads of an engine, set by hand.

    wp / t: time [N], xpos [N, B] vec3, xmat [N, B] mat33 (unit at first), pair_normal [N, P], as Warp arrays and as
    torch tensors of the same memory.
    """

    def __init__(
        self, n: int, bodies: Sequence[str], pairs: Sequence[str] = (), device: str = "cpu", dt: float = 0.005
    ):
        self.n, self.device, self.dt = n, device, dt
        self.bodies, self.pairs = tuple(bodies), tuple(pairs)
        self.wp = SimpleNamespace(
            time=wp.zeros(n, dtype=float, device=device),
            xpos=wp.zeros((n, len(self.bodies)), dtype=wp.vec3, device=device),
            xmat=wp.zeros((n, len(self.bodies)), dtype=wp.mat33, device=device),
            pair_normal=wp.zeros((n, max(len(self.pairs), 1)), dtype=float, device=device),
        )
        self.t = SimpleNamespace(**{k: wp.to_torch(v) for k, v in vars(self.wp).items()})
        self.t.xmat[:] = torch.eye(3, device=device)

    def body(self, name: str) -> int:
        if name not in self.bodies:
            raise UserError(f"no body '{name}'; there are: {', '.join(self.bodies)}")
        return self.bodies.index(name)

    def pair(self, name: str) -> int:
        if name not in self.pairs:
            raise UserError(f"no contact pair '{name}'; declared: {', '.join(self.pairs) or 'none'}")
        return self.pairs.index(name)

    def place(self, world: int, body: str, position: np.ndarray, rotation: np.ndarray | None = None) -> None:
        """Set one body's pose in one world: position [3] (m), rotation [3, 3]."""
        b = self.body(body)
        self.t.xpos[world, b] = torch.as_tensor(np.asarray(position, np.float32))
        if rotation is not None:
            self.t.xmat[world, b] = torch.as_tensor(np.asarray(rotation, np.float32))
