"""Where the object is, from a depth image and its mask: an interface, and the rule of the paper behind it.

Paper, "Force-adaptive grasping": z is the distance between the palm's centre and the centroid of the segmented mask; x
and y are held at their first value (`dexsim.deploy.of_grasp` holds them). The distance is taken along the palm's
normal, which is what z is in training.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

LEAST = 12
"""Pixels of a mask, below which nothing is seen of the object."""


@dataclass(frozen=True)
class CameraPose:
    """A pinhole camera in the palm frame. position [3] m; rotation [3, 3]: columns are the camera's right, up and
    backward axes (OpenGL, as MuJoCo's cam_xmat); focal: pixels; centre (u, v): pixels from the image's upper left
    corner."""

    position: np.ndarray
    rotation: np.ndarray
    focal: float
    centre: tuple[float, float]

    def point(self, u: float, v: float, depth: float) -> np.ndarray:
        """Return the point [3] m, palm frame, at pixel (u, v) and depth [m] along the viewing axis."""
        x, y = (u - self.centre[0]) / self.focal, (v - self.centre[1]) / self.focal
        return self.position + self.rotation @ np.array([x * depth, -y * depth, -depth])


@dataclass(frozen=True)
class Frame:
    """depth [H, W] m along the viewing axis (0 or NaN: none), mask [H, W] bool of the object, time [s] it was taken."""

    depth: np.ndarray
    mask: np.ndarray
    time: float


class HeightSource(Protocol):
    """What the loop reads: the object's place [3] m in the palm frame and the time [s] it was seen; None if never."""

    def place(self, now: float) -> tuple[np.ndarray, float] | None: ...


def centroid(frame: Frame, pose: CameraPose) -> np.ndarray | None:
    """Return the mask's centroid as (x, y, z) m in the palm frame; None where fewer than `LEAST` pixels are the
    object's.

    The centroid is the mean of the mask's pixels; its depth is their median, so that a few pixels of the background (a
    mask's ragged edge) move nothing. The median lies on the side of the object that faces the camera; the point is
    moved to where a ball of the mask's area has its centre (0.71 of its radius behind the median), since training
    knows the object's middle. Seen from the side this moves x and y, and hardly z.
    """
    good = frame.mask & np.isfinite(frame.depth) & (frame.depth > 0)
    if int(good.sum()) < LEAST:
        return None
    v, u = np.nonzero(good)
    depth = float(np.median(frame.depth[good]))
    depth += np.sqrt(0.5) * np.sqrt(good.sum() / np.pi) * depth / pose.focal
    return pose.point(float(u.mean()) + 0.5, float(v.mean()) + 0.5, depth)


class FixedPlace:
    """A HeightSource for trials without a camera: the object where it is said to be."""

    def __init__(self, place: np.ndarray):
        self._place = np.asarray(place, float)

    def place(self, now: float) -> tuple[np.ndarray, float] | None:
        return self._place, now
