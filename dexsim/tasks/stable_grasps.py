"""Held poses that rotation episodes start from: `dexsim stable-grasps out=poses.npz count=2000`.

A file of them holds `GraspSet`; `dexsim.tasks.make_grasps` makes them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from dexsim import files
from dexsim.assets.objects.own import is_own
from dexsim.errors import UserError
from dexsim.hand import Hand

FOUND = "held_cubes.npz"
"""File of a hand's folder in which a search keeps what it found."""
FINGERTIPS = Path(__file__).parents[1] / "assets" / "grasps" / "fingertips.npz"
"""Cubes that fingertips alone hold above the palm (`task=rotate_fingertips`)."""


CUBE = "box"
"""Name of cubes among the objects of a task."""
ROWS = ("edge", "hand", "target", "pose")


def called(name: str) -> str:
    """Return what a file of held poses calls an object of a task: a user's own by its file's or folder's name, wherever
    that lies."""
    return Path(name).name if is_own(name) else name


@dataclass
class GraspSet:
    """K held poses. edge [K] m, of a cube, or of another object its width between the fingers as it fell; hand [K, J]
    rad, the joint angles; target [K, J] rad, what the servos are sent; pose [K, 7], the object (x y z m, quaternion w x
    y z), palm frame: tensors, float32. shape [K] int64: which of `names` (`called`) it is; empty: all the first."""

    edge: torch.Tensor
    hand: torch.Tensor
    target: torch.Tensor
    pose: torch.Tensor
    shape: torch.Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.long), kw_only=True)
    names: tuple[str, ...] = field(default=(CUBE,), kw_only=True)

    def __post_init__(self) -> None:
        if len(self.shape) == 0:
            self.shape = torch.zeros(len(self.edge), dtype=torch.long, device=self.edge.device)

    def of(self, edit: Callable[[torch.Tensor], torch.Tensor]) -> GraspSet:
        """Return every array as `edit` makes it, of the same objects."""
        return GraspSet(*(edit(getattr(self, k)) for k in ROWS), shape=edit(self.shape), names=self.names)

    @classmethod
    def load(cls, path: str | Path) -> GraspSet:
        """Read a file that this module wrote. Raises UserError."""
        path = files.place(path)
        try:
            data = files.arrays(path)
            out = cls(*(torch.as_tensor(data[k], dtype=torch.float32) for k in ROWS))
            if "names" in data:
                out.names = tuple(str(x) for x in np.atleast_1d(data["names"]))
                out.shape = torch.as_tensor(data["shape"]).long()
                if out.shape.shape != out.edge.shape or not 0 <= int(out.shape.min()) <= int(out.shape.max()) < len(
                    out.names
                ):
                    raise ValueError("shape: must number the objects in names")
            return out
        except (KeyError, ValueError, TypeError) as error:
            raise UserError(f"held poses {path}: cannot read them ({error}); make them with "
                            "dexsim stable-grasps out=PATH") from None

    def save(self, path: Path) -> None:
        """Write an npz file of float32 arrays, whole or not at all; with `shape` and `names` where there are
        others than cubes."""
        path.parent.mkdir(parents=True, exist_ok=True)
        out = {k: getattr(self, k).cpu().numpy().astype(np.float32) for k in ROWS}
        if self.names != (CUBE,):
            out |= {"shape": self.shape.cpu().numpy(), "names": np.array(self.names)}
        with files.beside(path) as part, open(part, "wb") as file:
            np.savez_compressed(file, **out)

    def within(self, low: float, high: float) -> GraspSet:
        """Return the poses of cubes with edges in [low, high] m, and all of other objects. Raises UserError when there
        are none."""
        cube = self.names.index(CUBE) if CUBE in self.names else -1
        keep = (self.shape != cube) | ((self.edge >= low - 1e-6) & (self.edge <= high + 1e-6))
        if not bool(keep.any()):
            raise UserError(f"randomize.object.size=[{low}, {high}]: no held poses of that size; the set has "
                            f"{self.edge.min():.3f} to {self.edge.max():.3f} m")
        return self[keep]

    def derived(self, mirror: bool, scale: float) -> GraspSet:
        """Return the same poses of the hand's mirror image (palm y -> -y), or of one with all lengths times scale."""
        if not mirror and scale == 1.0:
            return self
        flip = torch.tensor([1, -1, 1, 1, -1, 1, -1.0]) if mirror else torch.ones(7)
        size = torch.tensor([scale] * 3 + [1.0] * 4)
        return GraspSet(self.edge * scale, self.hand.clone(), self.target.clone(), self.pose * flip * size)

    def numbered(self, names: tuple[str, ...], source: str) -> GraspSet:
        """Return the poses of these objects, `shape` by their places in `names`. Raises UserError for one without
        poses; source: where they come from."""
        place = torch.tensor([names.index(n) if n in names else -1 for n in self.names], device=self.edge.device)
        out = replace(self, shape=place[self.shape], names=names)
        for k, name in enumerate(names):
            if not bool((out.shape == k).any()):
                raise UserError(
                    f"held poses {source}: none of object '{name}', of {', '.join(self.names)} only; make them with"
                    " dexsim stable-grasps objects=... out=FILE and give task.initial.poses=FILE"
                )
        return out[out.shape >= 0]

    def to(self, device: str) -> GraspSet:
        """Return the same on a device."""
        return self.of(lambda v: v.to(device))

    def __getitem__(self, rows: torch.Tensor) -> GraspSet:
        return self.of(lambda v: v[rows])

    def __len__(self) -> int:
        return len(self.edge)

    @staticmethod
    def join(parts: list[GraspSet]) -> GraspSet:
        """Return all poses of several sets of the same objects."""
        rows = (torch.cat([getattr(p, k) for p in parts]) for k in ROWS)
        return GraspSet(*rows, shape=torch.cat([p.shape for p in parts]), names=parts[0].names)


def held_file(hand: Hand) -> Path:
    """Return where a hand's held poses are, or would be kept."""
    return hand.folder / (hand.file.held_cubes or FOUND)


def held_poses(hand: Hand, path: str | Path | None = None) -> GraspSet:
    """Return held poses of a file, or of the hand's own (mirrored and scaled as the hand is). Raises UserError: no
    file, or one of a hand with other joints."""
    found = GraspSet.load(held_file(hand) if path is None else path)
    if found.hand.shape[1] != len(hand.joints):
        raise UserError(
            f"held poses {path or held_file(hand)}: of a hand with {found.hand.shape[1]} joints, {hand.name} has"
            f" {len(hand.joints)}; make them with dexsim stable-grasps hand={hand.folder} out=PATH"
        )
    return found.derived(hand.mirror, hand.scale) if path is None else found
