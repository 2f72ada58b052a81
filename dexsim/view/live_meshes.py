"""Triangle meshes of a MuJoCo model's visible geoms, for a viewer in the browser."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from dexsim.surface import Surface, geom_surface, joined

FAR = 10.0  # m from its body: a parked geom slot


@dataclass(frozen=True)
class BodyMesh:
    """Vertices [V, 3] (m, body frame) and faces [F, 3] of one body's geoms of one colour (r, g, b, alpha in 0-1)."""

    vertices: np.ndarray
    faces: np.ndarray
    rgba: tuple[float, float, float, float]


def body_meshes(model: mujoco.MjModel) -> dict[int, list[BodyMesh]]:
    """Return the meshes of each body, geoms of one colour merged; geoms of groups 0 to 2 as MuJoCo's own viewer shows
    them, parked ones and planes left out."""
    parts: dict[tuple[int, tuple], list[Surface]] = {}
    for g in range(model.ngeom):
        rgba = model.mat_rgba[model.geom_matid[g]] if model.geom_matid[g] >= 0 else model.geom_rgba[g]
        if model.geom_group[g] > 2 or rgba[3] == 0 or np.abs(model.geom_pos[g]).max() > FAR:
            continue
        shape = geom_surface(model, g)
        if len(shape[1]):
            key = int(model.geom_bodyid[g]), tuple(round(float(c), 3) for c in rgba)
            parts.setdefault(key, []).append(shape)
    found: dict[int, list[BodyMesh]] = {}
    for (body, rgba), shapes in parts.items():
        found.setdefault(body, []).append(BodyMesh(*joined(shapes), rgba))
    return found
