"""Where the object is, from a depth image and its mask: an interface, and the rule of the paper behind it.

Paper, "Force-adaptive grasping": z is the distance between the palm's centre and the centroid of the segmented mask; x
and y are held at their first value (`dexsim.deploy.measure` holds them). The distance is taken along the palm's normal,
which is what z is in training; `rule="distance"` takes the straight distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dexsim.errors import UserError

RULES = ("normal", "distance")


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


class Camera(Protocol):
    """Depth and mask, newest first: a camera with a segmentation behind it."""

    pose: CameraPose

    def frame(self) -> Frame | None:
        """Return the newest frame, None before the first."""


class HeightSource(Protocol):
    """What the loop reads: the object's place [3] m in the palm frame and the time [s] it was seen; None if never."""

    def place(self, now: float) -> tuple[np.ndarray, float] | None: ...


def centroid(
    frame: Frame, pose: CameraPose, rule: str = "normal", least: int = 12, solid: bool = True
) -> np.ndarray | None:
    """Return the mask's centroid as (x, y, z) m in the palm frame; None where fewer than `least` pixels are the
    object's.

    The centroid is the mean of the mask's pixels; its depth is their median, so that a few pixels of the background (a
    mask's ragged edge) move nothing. The median lies on the side of the object that faces the camera; `solid` moves the
    point to where a ball of the mask's area has its centre (0.71 of its radius behind the median), since training knows
    the object's middle. Seen from the side this moves x and y, and hardly z.
    """
    if rule not in RULES:
        raise UserError(f"vision rule={rule}: must be one of {', '.join(RULES)}")
    good = frame.mask & np.isfinite(frame.depth) & (frame.depth > 0)
    if int(good.sum()) < least:
        return None
    v, u = np.nonzero(good)
    depth = float(np.median(frame.depth[good]))
    if solid:
        depth += np.sqrt(0.5) * np.sqrt(good.sum() / np.pi) * depth / pose.focal
    p = pose.point(float(u.mean()) + 0.5, float(v.mean()) + 0.5, depth)
    return p if rule == "normal" else np.array([p[0], p[1], np.linalg.norm(p)])


class Vision:
    """A HeightSource behind a camera. delay [s] is only reported; `lost` counts frames without the object."""

    def __init__(self, camera: Camera, rule: str = "normal"):
        self.camera, self.rule, self.lost = camera, rule, 0
        self._last: tuple[np.ndarray, float] | None = None
        self._frame_time = -np.inf

    def place(self, now: float) -> tuple[np.ndarray, float] | None:
        """Look at the newest frame if it is a new one; a frame without the object leaves the last place."""
        frame = self.camera.frame()
        if frame is not None and frame.time > self._frame_time:
            self._frame_time = frame.time
            seen = centroid(frame, self.camera.pose, self.rule)
            if seen is None:
                self.lost += 1
            else:
                self._last = (seen, frame.time)
        return self._last


class FixedPlace:
    """A HeightSource for trials without a camera: the object where it is said to be."""

    def __init__(self, place: np.ndarray):
        self._place = np.asarray(place, float)

    def place(self, now: float) -> tuple[np.ndarray, float] | None:
        return self._place, now
