"""Pictures of models in poses, rendered in a process of their own (MuJoCo fixes its OpenGL backend at import).

MUJOCO_GL=egl python -m dexsim.view.stills FOLDER
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import system

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
    import mujoco

    from dexsim.view import video

    with tempfile.TemporaryDirectory(prefix="dexsim_stills_") as name:
        folder = Path(name)
        for k, model in enumerate(models):
            mujoco.mj_saveModel(model, str(folder / f"{k}.mjb"), None)
        plain = [
            asdict(s) | {"qpos": [float(x) for x in s.qpos], "lookat": [float(x) for x in s.lookat]} for s in shots
        ]
        (folder / "shots.json").write_text(json.dumps(plain), "utf-8")
        reasons = []
        for backend in system.renderers():
            env = os.environ | system.renderer_environment(backend)
            done = subprocess.run(
                [sys.executable, "-m", "dexsim.view.stills", name],
                env=env, capture_output=True, encoding="utf-8", errors="replace",
            )  # fmt: skip
            if done.returncode == 0:
                return [np.load(folder / f"{k}.npy") for k in range(len(shots))]
            said = (done.stdout + done.stderr).strip().splitlines()
            reasons.append(f"{backend}: {said[-1] if said else f'status {done.returncode}'}")
    raise video.NoRenderer(
        f"no picture: no OpenGL for offscreen rendering ({'; '.join(reasons)}); {system.no_renderer()}"
    )


def main(folder: Path) -> int:
    """Return the rendering process."""
    import mujoco

    from dexsim.view.render import NO_GL, backdrop, why

    try:
        context = mujoco.GLContext(64, 64)
        context.make_current()
        context.free()
    except Exception as error:  # whatever a driver or loader raises, the answer is the next backend
        print(why(error))
        return NO_GL
    shots = [Shot(**s) for s in json.loads((folder / "shots.json").read_text("utf-8"))]
    for k in sorted({s.model for s in shots}):
        model = mujoco.MjModel.from_binary_path(str(folder / f"{k}.mjb"))
        own = [(n, s) for n, s in enumerate(shots) if s.model == k]
        model.vis.global_.fovy = FIELD_OF_VIEW
        model.vis.global_.offwidth = max(s.size[0] for _, s in own)
        model.vis.global_.offheight = max(s.size[1] for _, s in own)
        model.vis.quality.offsamples, model.vis.quality.shadowsize = 4, 2048
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:], model.vis.headlight.specular[:] = (
            0.45,
            0.55,
            0.1,
        )
        model.vis.map.znear = 0.01
        data = mujoco.MjData(model)
        renderers: dict[tuple[int, int], Any] = {}
        for n, shot in own:
            width, height = shot.size
            size = width, height
            if size not in renderers:
                renderers[size] = mujoco.Renderer(model, size[1], size[0])
            data.qpos[:] = shot.qpos
            mujoco.mj_forward(model, data)
            camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
            camera.lookat[:] = shot.lookat
            camera.distance, camera.azimuth, camera.elevation = shot.distance, shot.azimuth, shot.elevation
            option.geomgroup[:] = 0
            option.geomgroup[list(shot.groups)] = 1
            renderers[size].update_scene(data, camera, option)
            image = renderers[size].render()
            np.save(folder / f"{n}.npy", np.where(image.any(axis=2, keepdims=True), image, backdrop(size[1], size[0])))
        for renderer in renderers.values():
            renderer.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
