"""Held poses that rotation episodes start from: `dexsim stable-grasps out=poses.npz count=2000`.

A file of them holds `GraspSet`; `dexsim.tasks.make_grasps` makes them.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

from dexsim import files
from dexsim.errors import UserError
from dexsim.hand import Hand

FOUND = "held_cubes.npz"
"""File of a hand's folder in which a search keeps what it found."""
MOST_BYTES = 256 << 20
"""Of a file of held poses, packed or not."""
FINGERTIPS = Path(__file__).parents[1] / "assets" / "grasps" / "fingertips.npz"
"""Cubes that fingertips alone hold above the palm (`task=rotate_fingertips`)."""


@dataclass
class GraspSet:
    """K held poses. edge [K] m; hand [K, J] rad, the joint angles; target [K, J] rad, what the servos are sent; pose
    [K, 7], the cube (x y z m, quaternion w x y z), palm frame. Tensors, float32."""

    edge: torch.Tensor
    hand: torch.Tensor
    target: torch.Tensor
    pose: torch.Tensor

    @classmethod
    def load(cls, path: str | Path) -> GraspSet:
        """Read a file that this module wrote. Raises UserError."""
        path = files.place(path)
        try:
            data = files.arrays(path, MOST_BYTES)
            return cls(**{f.name: torch.as_tensor(data[f.name], dtype=torch.float32) for f in fields(cls)})
        except (KeyError, ValueError, TypeError) as error:
            raise UserError(f"held poses {path}: cannot read them ({error}); make them with "
                            "dexsim stable-grasps out=PATH") from None

    def save(self, path: Path) -> None:
        """Write an npz file of float32 arrays, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {k: v.cpu().numpy().astype(np.float32) for k, v in vars(self).items()}
        with files.beside(path) as part, open(part, "wb") as file:
            np.savez_compressed(file, **arrays)

    def within(self, low: float, high: float) -> GraspSet:
        """The poses of cubes with edges in [low, high] m. Raises UserError when there are none."""
        keep = (self.edge >= low - 1e-6) & (self.edge <= high + 1e-6)
        if not bool(keep.any()):
            raise UserError(f"randomize.object.size=[{low}, {high}]: no held poses of that size; the set has "
                            f"{self.edge.min():.3f} to {self.edge.max():.3f} m")
        return self[keep]

    def derived(self, mirror: bool, scale: float) -> GraspSet:
        """The same poses of the hand's mirror image (palm y -> -y), or of one with all lengths times scale."""
        if not mirror and scale == 1.0:
            return self
        flip = torch.tensor([1, -1, 1, 1, -1, 1, -1.0]) if mirror else torch.ones(7)
        size = torch.tensor([scale] * 3 + [1.0] * 4)
        return GraspSet(self.edge * scale, self.hand.clone(), self.target.clone(), self.pose * flip * size)

    def to(self, device: str) -> GraspSet:
        """The same on a device."""
        return GraspSet(*(v.to(device) for v in vars(self).values()))

    def __getitem__(self, rows: torch.Tensor) -> GraspSet:
        return GraspSet(*(v[rows] for v in vars(self).values()))

    def __len__(self) -> int:
        return len(self.edge)

    @staticmethod
    def join(parts: list[GraspSet]) -> GraspSet:
        """All poses of several sets."""
        return GraspSet(*(torch.cat([vars(p)[f.name] for p in parts]) for f in fields(GraspSet)))


def held_file(hand: Hand) -> Path:
    """Where a hand's held poses are, or would be kept."""
    return hand.folder / (hand.file.held_cubes or FOUND)


def held_poses(hand: Hand, path: str | Path | None = None) -> GraspSet:
    """Held poses of a file, or of the hand's own (mirrored and scaled as the hand is). Raises UserError: no file, or
    one of a hand with other joints."""
    found = GraspSet.load(held_file(hand) if path is None else path)
    if found.hand.shape[1] != len(hand.joints):
        raise UserError(
            f"held poses {path or held_file(hand)}: of a hand with {found.hand.shape[1]} joints, {hand.name} has"
            f" {len(hand.joints)}; make them with dexsim stable-grasps hand={hand.folder} out=PATH"
        )
    return found.derived(hand.mirror, hand.scale) if path is None else found


if __name__ == "__main__":  # python -m dexsim.tasks.stable_grasps out=poses.npz
    from dexsim.cli.stable_grasps import main
    from dexsim.console.ending import guard

    sys.exit(guard(main, sys.argv[1:]))
