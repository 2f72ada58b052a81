"""What the rest of dexsim knows of a hand."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dexsim.hand.couplings import Couplings
from dexsim.hand.model import HAND_BIT, OBJECT_BIT
from dexsim.hand.schema import HandFile, Pad

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class Finger:
    """A finger. joints, flexion: indices in the hand's order, root to tip; closes: +1 or -1 for each of flexion, the
    sign of the motion that closes it; root: body of its first joint; body: the distal one, in whose frame position [3]
    m (the finger's end) and normal [3] (unit, out of the palmar side) are; geoms: what presses objects."""

    name: str
    joints: tuple[int, ...]
    flexion: tuple[int, ...]
    closes: tuple[int, ...]
    root: str
    body: str
    position: tuple[float, float, float]
    normal: tuple[float, float, float]
    geoms: tuple[str, ...]
    pad: Pad | None

    @property
    def presses(self) -> tuple[str, str]:
        """Return what presses objects, as a contact pair takes it: one geom, or of several the whole distal link."""
        return ("geom", self.geoms[0]) if len(self.geoms) == 1 else ("body", self.body)


@dataclass(frozen=True)
class TouchPad:
    """A touch pad: `taxels`, kind and rows as in the file; body: what carries it."""

    name: str
    body: str
    taxels: str
    kind: str
    rows: int = 0


@dataclass(frozen=True)
class Hand:
    """A hand, checked against its model. Joints [J] in the order on the wire, fingers [F] in the file's.

    limits [J, 2] rad, efforts [J] N m, speeds [J] rad/s; opposing and others: indices of the fingers that press against
    the others, and of those; palm_body; span m and force (N, or how it is told) as in the file; mirror, scale: what was
    derived.
    """

    folder: Path
    file: HandFile
    mirror: bool
    scale: float
    joints: tuple[str, ...]
    fingers: tuple[Finger, ...]
    limits: np.ndarray
    efforts: np.ndarray
    speeds: np.ndarray
    opposing: tuple[int, ...]
    others: tuple[int, ...]
    span: float
    force: float | str | None
    _spec: mujoco.MjSpec = field(repr=False)

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh model of the hand alone: world frame = palm frame, no actuators, sensors or lights."""
        return self._spec.copy()

    @cached_property
    def compiled(self) -> mujoco.MjModel:
        """Return the compiled model of the hand alone, shared: not to be changed."""
        return self._spec.copy().compile()

    @cached_property
    def couplings(self) -> Couplings:
        """Return how joints without a drive of their own follow those that have one, of `compiled`."""
        return Couplings(self.compiled, self.joints, f"hand {self.folder}")

    @property
    def sensed(self) -> tuple[str, ...]:
        """Return joints without a drive that are measured: those of `sensed` in hand.yaml."""
        return tuple(self.file.sensed)

    @property
    def name(self) -> str:
        return self.file.name

    @property
    def handedness(self) -> str:
        """Return right, left or none, mirrored where the hand is."""
        other = {"right": "left", "left": "right"}
        return other.get(self.file.handedness, "none") if self.mirror else self.file.handedness

    @property
    def robot(self) -> str:
        """Return what recordings and bundles call it: name and handedness."""
        scaled = "" if self.scale == 1.0 else f"_x{self.scale:g}"
        side = "" if self.handedness == "none" else f"_{self.handedness}"
        return f"{self.name}{side}{scaled}"

    @property
    def palm_body(self) -> str:
        return self.file.palm.body

    @property
    def finger_names(self) -> tuple[str, ...]:
        return tuple(f.name for f in self.fingers)

    @property
    def tip_bodies(self) -> tuple[str, ...]:
        return tuple(f.body for f in self.fingers)

    @property
    def tip_geoms(self) -> tuple[str, ...]:
        """Return names of the fingertips' geoms, finger by finger."""
        return tuple(g for f in self.fingers for g in f.geoms)

    @property
    def touches(self) -> bool:
        """Return whether its fingertips carry touch pads."""
        return self.fingers[0].pad is not None

    @property
    def pads(self) -> tuple[TouchPad, ...]:
        """Return its touch pads: pad f on finger f, then those of `skin`; none where its fingertips have none."""
        tips = [TouchPad(f.name, f.body, f.pad.taxels, f.pad.kind, f.pad.rows) for f in self.fingers if f.pad]
        return (*tips, *(TouchPad(p.name, p.body, p.taxels, p.kind) for p in self.file.skin))

    @cached_property
    def links(self) -> dict[str, tuple[str, ...]]:
        """Return geoms that press objects, by body, without those of fingertips; a body without any is not there."""
        out: dict[str, tuple[str, ...]] = {}
        m, tips = self.compiled, set(self.tip_geoms)
        for g in range(m.ngeom):
            name = m.geom(g).name
            if m.geom_contype[g] & HAND_BIT and m.geom_conaffinity[g] & OBJECT_BIT and name not in tips:
                body = m.body(m.geom_bodyid[g]).name
                out[body] = (*out.get(body, ()), name)
        return out

    @property
    def finger_of_joint(self) -> tuple[int, ...]:
        """Finger of each joint [J], -1 where it belongs to none (a wrist)."""
        owner = {j: k for k, f in enumerate(self.fingers) for j in f.joints}
        return tuple(owner.get(j, -1) for j in range(len(self.joints)))

    @property
    def closing(self) -> np.ndarray:
        """Return +1 or -1 of each flexion joint, 0 of every other [J]."""
        out = np.zeros(len(self.joints))
        for f in self.fingers:
            out[list(f.flexion)] = f.closes
        return out

    @property
    def servo_path(self) -> Path:
        return self.folder / self.file.servo

    @property
    def identity(self) -> dict[str, object]:
        """Return what `load_hand` needs to make it again."""
        return {
            "hand": self.name if self.comes_along else str(self.folder),
            "hand_mirror": self.mirror,
            "hand_scale": self.scale,
        }

    @property
    def comes_along(self) -> bool:
        """Return whether it is one of those in dexsim itself."""
        return self.folder == Path(__file__).parents[1] / "assets" / self.name

    def pose(self, which: str) -> np.ndarray:
        """Return joint angles [J] rad of the pose "open" or "cupped"."""
        angles = getattr(self.file.poses, which)
        return np.array([angles[j] for j in self.joints])
