"""The touch sensors of a hand as its recordings hold them: pads by name, their skins, which taxels lie beside which."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.hand.skin import link_skins, tip_skins
from dexsim.tactile.layout import TaxelLayout, hand_layout, neighbours
from dexsim.tactile.pressing import Skin, skin_of


class Sensors:
    """The pads of a hand, pad f on finger f, then its skin's. names: theirs, or the fingers' where it has none; layout:
    None for a hand without touch; bodies: what carries the pads."""

    def __init__(self, hand: Hand):
        self.hand = hand
        self.names = tuple(p.name for p in hand.pads) or hand.finger_names
        self.layout: TaxelLayout | None = hand_layout(hand)

    @property
    def _pads(self) -> TaxelLayout:
        assert self.layout is not None  # asked for only where the hand has touch
        return self.layout

    @property
    def shape(self) -> tuple[int, int]:
        """Pads, and taxels of the largest; (0, 0) without touch."""
        return (0, 0) if self.layout is None else (self.layout.pads, self.layout.taxels)

    @cached_property
    def bodies(self) -> frozenset[str]:
        """All of the hand's bodies: what is not among them may be an object."""
        return frozenset(b.name for b in self.hand.spec().bodies)

    @cached_property
    def tips(self) -> list[np.ndarray]:
        """Corners [V, 3] m of each pad's fingertip or link, body frames."""
        tips, links = tip_skins(self.hand), dict(link_skins(self.hand) if self.hand.file.skin else [])
        return [*tips, *(links[p.body] for p in self.hand.pads[len(tips) :])]

    @cached_property
    def lifted(self) -> TaxelLayout:
        """Return the taxels on the surfaces that the physics presses; where they are where a tip does not follow its
        pad, as with `tactile.lift=false`. Only with touch."""
        try:
            return self._pads.lifted(tip_skins(self.hand))
        except UserError:
            return self._pads

    def lattice(self, pad: int) -> tuple[int, int] | None:
        """Return columns and rows of the lattice that a pad's taxels form, k = column * rows + row; None where none is
        known."""
        rows = self._pads.rows[pad]
        return (int(self._pads.count[pad]) // rows, rows) if rows else None

    def beside(self, pad: int) -> list[list[int]]:
        """Return taxels beside each taxel of a pad: in its lattice, or by where they lie where there is none."""
        lattice = self.lattice(pad)
        if lattice is not None:
            return neighbours(*lattice)
        return _gabriel(self._pads.point[pad, : self._pads.count[pad]])

    def mixing(self, pad: int) -> np.ndarray:
        """Return the shares [K, K] of a taxel's force shared equally by the taxels beside it (rows: who feels it)."""
        beside = self.beside(pad)
        out = np.zeros((len(beside), len(beside)))
        for k, others in enumerate(beside):
            out[others or [k], k] = 1.0 / max(len(others), 1)
        return out

    def middle(self, pad: int) -> int:
        """Return the taxel in a pad's middle."""
        lattice = self.lattice(pad)
        if lattice is not None:
            columns, rows = lattice
            return columns // 2 * rows + rows // 2
        p = self._pads.point[pad, : self._pads.count[pad]]
        return int(np.argmin(np.linalg.norm(p - self._pads.centre()[pad], axis=1)))

    def skin(self, pad: int, fine: int) -> Skin:
        """Return a pad's surface, `fine` times finer than its lattice; its lifted taxels where there is none."""
        lattice = self.lattice(pad)
        if lattice is not None and min(lattice) >= 4:  # as many as the bicubic surface needs
            return skin_of(self._pads, pad, *lattice, self.tips[pad], fine=fine)
        n, on = int(self._pads.count[pad]), self.lifted
        return Skin(on.point[pad, :n], on.normal[pad, :n], on.area[pad, :n])


def _gabriel(p: np.ndarray) -> list[list[int]]:
    """Return neighbours of each of points [K, 3] in their Gabriel graph: two with no other in the ball between them. Of
    a rectangular lattice those are the four beside."""
    out: list[list[int]] = [[] for _ in p]
    for i in range(len(p)):
        for j in range(i):
            off = np.sum((p - 0.5 * (p[i] + p[j])) ** 2, axis=1)
            off[[i, j]] = np.inf
            if off.min() > 0.25 * np.sum((p[i] - p[j]) ** 2) * (1 + 1e-6):
                out[i].append(j)
                out[j].append(i)
    return [sorted(x) for x in out]
