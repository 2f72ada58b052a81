"""Pictures of models in poses, without a display."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dexsim.view.frames import renderer
from dexsim.view.render import CAMERA, Pictures

FIELD_OF_VIEW = 30.0  # degrees, from top to bottom


@dataclass
class Shot:
    """One picture. model: index into the models; qpos [nq]; lookat [3] m; distance m; azimuth, elevation degrees, as
    MuJoCo's free camera has them; size: width, height in pixels; groups: which groups of geoms are drawn."""

    model: int
    qpos: Sequence[float] | np.ndarray
    lookat: Sequence[float] | np.ndarray
    distance: float
    azimuth: float
    elevation: float
    size: tuple[int, int] = (480, 400)
    groups: Sequence[int] = field(default_factory=lambda: (0, 1, 2))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels [P, 2] (right, down from the upper left corner) of points [P, 3] m of the world."""
        az, el = np.radians(self.azimuth), np.radians(self.elevation)
        ahead = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
        right = np.array([np.sin(az), -np.cos(az), 0.0])
        up = np.cross(right, ahead)
        way = np.asarray(points, float) - (np.asarray(self.lookat) - self.distance * ahead)
        focal = 0.5 * self.size[1] / np.tan(np.radians(FIELD_OF_VIEW) / 2)
        depth = np.maximum(way @ ahead, 1e-6)
        return np.stack([
            0.5 * self.size[0] + focal * (way @ right) / depth, 0.5 * self.size[1] - focal * (way @ up) / depth
        ], 1)  # fmt: skip


def render(models: Sequence[Any], shots: Sequence[Shot]) -> list[np.ndarray]:
    """Return the pictures [H, W, 3] uint8. Raises `dexsim.view.video.NoRenderer` where no OpenGL backend works."""
    made: dict[tuple[int, ...], Pictures] = {}
    out = []
    for shot in shots:
        key = shot.model, *shot.size
        if key not in made:
            model = copy.copy(models[shot.model])
            model.vis.global_.fovy = FIELD_OF_VIEW
            made[key] = Pictures(model, shot.size, renderer)
        view: Any = {name: getattr(shot, name) for name in CAMERA}
        out.append(made[key](shot.qpos, view, shot.groups))
    for pictures in made.values():
        pictures.close()
    return out
