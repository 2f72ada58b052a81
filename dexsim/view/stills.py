"""Pictures of models in poses, without a display."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from dexsim.view.frames import renderer
from dexsim.view.render import backdrop

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
    pictures: dict[int, np.ndarray] = {}
    for k in sorted({s.model for s in shots}):
        own = [(n, s) for n, s in enumerate(shots) if s.model == k]
        model = copy.copy(models[k])
        model.vis.global_.fovy = FIELD_OF_VIEW
        model.vis.global_.offwidth, model.vis.global_.offheight = (max(s.size[i] for _, s in own) for i in (0, 1))
        model.vis.quality.offsamples, model.vis.quality.shadowsize = 4, 2048
        light = model.vis.headlight
        light.ambient[:], light.diffuse[:], light.specular[:] = 0.45, 0.55, 0.1
        model.vis.map.znear = 0.01
        data = mujoco.MjData(model)
        for size in {s.size for _, s in own}:
            drawing = renderer(model, *size)
            for n, shot in [(n, s) for n, s in own if s.size == size]:
                data.qpos[:] = shot.qpos
                mujoco.mj_forward(model, data)
                camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
                camera.lookat[:] = shot.lookat
                camera.distance, camera.azimuth, camera.elevation = shot.distance, shot.azimuth, shot.elevation
                option.geomgroup[:] = 0
                option.geomgroup[list(shot.groups)] = 1
                drawing.update_scene(data, camera, option)
                image = drawing.render()
                pictures[n] = np.where(image.any(axis=2, keepdims=True), image, backdrop(size[1], size[0]))
            drawing.close()
    return [pictures[n] for n in range(len(shots))]
