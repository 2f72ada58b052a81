"""Sampling of what varies by episode: named ranges from `dexsim/configs/randomize/`, drawn for all worlds at once."""

from __future__ import annotations

import math

import torch

from dexsim.errors import UserError


class Sampler:
    """Draws the ranges of a randomization config.

    cfg: nested dict whose leaves are `[low, high]` (uniform), `{log: [low, high]}` (log-uniform) or a number (fixed).
    Draws are independent by world (and by column); nothing depends on earlier draws.
    """

    def __init__(self, cfg: dict, rng: torch.Generator, n: int, device: str):
        self.cfg, self.rng, self.n, self.device = cfg, rng, n, device
        self.ranges: dict[str, tuple[float, float, bool]] = {}
        # share of each range, about its middle, that `draw` uses: a curriculum widens it
        self.width = torch.ones((), device=device)
        self._read("randomize", cfg)

    def _read(self, path: str, node) -> None:
        for key, value in node.items():
            here = f"{path}.{key}"
            name = here.removeprefix("randomize.")
            if isinstance(value, dict) and set(value) != {"log"}:
                self._read(here, value)
                continue
            log = isinstance(value, dict)
            pair = value["log"] if log else value
            pair = [pair, pair] if isinstance(pair, (int, float)) else pair
            if not (
                isinstance(pair, (list, tuple)) and len(pair) == 2 and all(isinstance(v, (int, float)) for v in pair)
            ):
                raise UserError(f"{here}={value}: must be a number, [low, high], or {{log: [low, high]}}")
            low, high = float(pair[0]), float(pair[1])
            if not (math.isfinite(low) and math.isfinite(high)):
                raise UserError(f"{here}=[{low}, {high}]: both ends must be finite")
            if not low <= high:
                raise UserError(f"{here}=[{low}, {high}]: low must not exceed high")
            if log and low <= 0:
                raise UserError(f"{here}: a log range needs low > 0, not {low}")
            self.ranges[name] = (low, high, log)

    def check(self, name: str, low: float, high: float) -> None:
        """Raise UserError unless the range `name` lies in [low, high]."""
        a, b, _ = self.range(name)
        if a < low or b > high:
            raise UserError(f"randomize.{name}=[{a:g}, {b:g}]: must lie in [{low:g}, {high:g}]")

    def range(self, name: str) -> tuple[float, float, bool]:
        if name not in self.ranges:
            raise UserError(f"randomize.{name} is missing; the file has: {', '.join(self.ranges)}")
        return self.ranges[name]

    def draw(self, name: str, *shape: int) -> torch.Tensor:
        """[N, *shape] samples of the range `name`, float32."""
        low, high, log = self.range(name)
        u = 0.5 + self.width * (self.uniform(*shape) - 0.5)
        if log:
            return low * (high / low) ** u
        return low + (high - low) * u

    def uniform(self, *shape: int) -> torch.Tensor:
        """[N, *shape] uniform in [0, 1)."""
        return torch.rand(self.n, *shape, generator=self.rng, device=self.device)

    def normal(self, *shape: int) -> torch.Tensor:
        """[N, *shape] standard normal."""
        return torch.randn(self.n, *shape, generator=self.rng, device=self.device)

    def direction(self) -> torch.Tensor:
        """[N, 3] unit vectors, uniform on the sphere."""
        v = self.normal(3)
        return v / v.norm(dim=1, keepdim=True).clamp(min=1e-9)

    def quaternion(self) -> torch.Tensor:
        """[N, 4] rotations (w x y z), uniform."""
        q = self.normal(4)
        return q / q.norm(dim=1, keepdim=True).clamp(min=1e-9)
