"""Touch with fewer taxels (`task.observe.taxels`): a pad's wired together in patches, or only whether it touches."""

from __future__ import annotations

import numpy as np
import torch
from scipy.cluster.vq import kmeans2

from dexsim.errors import UserError
from dexsim.tactile.layout import TaxelLayout

BITS = "bits"
"""Instead of a number of patches: whether a pad touches at all, 1 N where it does, at the pad's centre."""


class Patches:
    """Readings of a hand whose pads have `count` patches each, of taxels that lie together, wired to one output.

    layout: where the taxels are (link frames). count: 1 to the taxels of a pad, or "bits". A patch reads the sum of its
    taxels, at their middle. Raises UserError for another count.
    """

    def __init__(self, layout: TaxelLayout, count: int | str, device: str):
        most = int(layout.point.shape[1])
        if count != BITS and not (isinstance(count, int) and not isinstance(count, bool) and 1 <= count <= most):
            raise UserError(f"task.observe.taxels={count}: must be {BITS}, or a number of a pad from 1 to {most}")
        self.bits = count == BITS
        k = 1 if self.bits else int(count)
        pads = len(layout.point)
        member = np.zeros((pads, most, k), dtype=np.float32)
        for f in range(pads):
            n = int(layout.count[f])
            group = np.arange(n) if k >= n else kmeans2(layout.point[f, :n], k, minit="++", seed=0)[1]
            member[f, np.arange(n), group] = 1.0
        middle = np.einsum("ftk,ftc->fkc", member, layout.point) / np.maximum(member.sum(1), 1)[..., None]
        self.member = torch.as_tensor(member, device=device)
        self.middle = torch.as_tensor(middle, dtype=torch.float32, device=device)
        self.centre = torch.as_tensor(layout.centre(), dtype=torch.float32, device=device)

    def read(self, raw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Force [N, F] N and its centre [N, F, 3] m (link frames; the pad's centre where nothing touches) of taxels
        raw [N, F, T] N."""
        patch = torch.einsum("nft,ftk->nfk", raw, self.member)
        force = patch.sum(-1)
        if self.bits:
            return (force > 0).float(), self.centre.expand(*force.shape, 3)
        at = torch.einsum("nfk,fkc->nfc", patch, self.middle) / force.clamp(min=1e-9)[..., None]
        return force, torch.where((force > 0)[..., None], at, self.centre)
