"""Renders poses of models; and the rendering process of :mod:`dexsim.view.video`, not for direct use.

    MUJOCO_GL=egl python -m dexsim.view.render FOLDER OUT.mp4
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypedDict

import numpy as np

NO_GL = 3
LONGEST_S = 60.0
FASTEST = 30.0  # frames per second that a video needs at most

class Camera(TypedDict):
    """A view: a point [3] m, the distance from it [m], azimuth and elevation [deg]."""

    lookat: list[float]
    distance: float
    azimuth: float
    elevation: float


# Palm frame = world frame: fingers along +x, palm normal +z. Three-quarter view from the fingers' side, a little above.
CAMERA: Camera = {"lookat": [0.045, -0.01, 0.025], "distance": 0.38, "azimuth": 140.0, "elevation": -28.0}


def main(folder: Path, path: Path) -> int:
    """Render what ``folder`` holds; prints ``frame <k> <n>`` lines."""
    try:
        import mujoco

        context = mujoco.GLContext(64, 64)
        context.make_current()
        context.free()
    except Exception as error:  # whatever a driver or loader raises, the answer is the next backend
        print(why(error))
        return NO_GL
    settings = json.loads((folder / "settings.json").read_text("utf-8"))
    try:
        film(folder, path, settings)
    except OSError as error:
        print(error.strerror or error)
        return 1
    return 0


def why(error: Exception) -> str:
    """Say in a line why no OpenGL context opens."""
    if isinstance(error, (ImportError, AttributeError)):  # PyOpenGL's way to say that a library is not there
        return "library not found"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def film(folder: Path, path: Path, settings: dict[str, Any]) -> None:
    """Render all frames and pipe them to ffmpeg; the file appears under its name only when it is whole."""
    import imageio_ffmpeg

    tiles = [Tile(folder, k, clip, settings) for k, clip in enumerate(settings["clips"])]
    every = max(1, math.ceil(1.0 / settings["dt"] / FASTEST - 1e-6))
    rate = 1.0 / (settings["dt"] * every)
    longest = max(len(t.qpos) for t in tiles)
    chosen = range(0, min(longest, int(LONGEST_S / settings["dt"])), every)
    part = path.with_name(f".{path.stem}.{os.getpid()}.tmp.mp4")
    writer = None
    try:
        for n, k in enumerate(chosen):
            frame = grid([tile.frame(k) for tile in tiles])
            if writer is None:
                writer = imageio_ffmpeg.write_frames(
                    str(part), (frame.shape[1], frame.shape[0]), fps=rate, codec="libx264", pix_fmt_in="rgb24",
                    pix_fmt_out="yuv420p", quality=7, macro_block_size=2, output_params=["-movflags", "+faststart"])
                writer.send(None)
            writer.send(np.ascontiguousarray(frame))
            if n % 10 == 0 or n == len(chosen) - 1:
                print("frame", n + 1, len(chosen), flush=True)
        if writer is not None:
            writer.close()
            os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


class Pictures:
    """Renders poses of a model, in the OpenGL context of this process. size: width and height [pixels]; renderer:
    makes MuJoCo's from a model, a height and a width."""

    def __init__(self, model: Any, size: Sequence[int], renderer: Callable[..., Any] | None = None) -> None:
        import mujoco

        width, height = size
        look = model.vis
        look.global_.offwidth, look.global_.offheight = width, height
        look.quality.offsamples, look.quality.shadowsize = 4, 2048
        look.headlight.ambient[:], look.headlight.diffuse[:], look.headlight.specular[:] = 0.45, 0.55, 0.15
        look.map.znear = 0.01
        self.model, self.data = model, mujoco.MjData(model)
        self._renderer = (renderer or partial(mujoco.Renderer, max_geom=20_000))(model, height, width)
        self._sky = any(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
        self._behind = backdrop(height, width)

    def __call__(
        self, qpos: Any, camera: Camera = CAMERA, groups: Sequence[int] = (0, 1, 2),
        draw: Callable[[Any, Any], None] = lambda scene, data: None,
    ) -> np.ndarray:  # fmt: skip
        """Return the picture [H, W, 3] uint8 of a pose [nq]; groups: of geoms that are drawn; draw: is given the scene
        and the model's data, to add to it."""
        import mujoco

        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        view, option = mujoco.MjvCamera(), mujoco.MjvOption()
        for name, value in camera.items():
            setattr(view, name, value)
        option.geomgroup[:] = [k in groups for k in range(len(option.geomgroup))]
        self._renderer.update_scene(self.data, view, option)
        draw(self._renderer.scene, self.data)
        image = self._renderer.render()
        return image if self._sky else np.where(image.any(axis=2, keepdims=True), image, self._behind)

    def close(self) -> None:
        """Give back the context."""
        self._renderer.close()


class Tile:
    """One world: renders its frames with label and bars."""

    def __init__(self, folder: Path, index: int, clip: dict[str, Any], settings: dict[str, Any]) -> None:
        import mujoco

        from dexsim.view.decor import FULL_TAXEL, Decor
        from dexsim.view.live_panels import TaxelMap
        from dexsim.view.overlay import room

        self._full_taxel = FULL_TAXEL
        self._clip, self._settings = clip, settings
        arrays = np.load(folder / f"{index}.npz")
        self.qpos = arrays["qpos"]
        self._force = arrays["force"] if "force" in arrays else None
        self._command = arrays["command"] if "command" in arrays else None
        width, height = settings["size"]
        model = mujoco.MjModel.from_binary_path(str(folder / f"{index}.mjb"))
        self._titled = bool(clip["label"] or clip["text"])
        above, below = room(height, self._titled, self._force is not None)
        self._height, height = height, height - above - below
        self._taxels: Any = None
        if "taxels" in arrays:
            parts: Any = {name: arrays[f"taxel_{name}"] for name in ("point", "normal", "ty", "count")}
            layout: Any = SimpleNamespace(pads=len(parts["count"]), **parts)
            self._taxels, self._map = arrays["taxels"], TaxelMap(layout)
        self._decor = Decor(model, arrays, clip["bodies"], clip["colours"]) if clip["decor"] else None
        self._pictures, self._view = Pictures(model, (width, height)), CAMERA | settings["camera"]

    def frame(self, k: int) -> np.ndarray:
        """Return the frame ``k`` [H, W, 3] uint8; past the end, the last one."""
        from dexsim.view.overlay import DARK, annotate

        k = min(k, len(self.qpos) - 1)
        if self._decor is None:
            image = self._pictures(self.qpos[k], self._view)
        else:
            image = self._pictures(
                self._decor.turn(k, self.qpos[k]), self._view, draw=partial(self._decor.draw, k=k)
            )
        pads = None
        if self._taxels is not None:
            pads = self._map.pictures(self._taxels[k], self._full_taxel, np.array(DARK, np.uint8))
            pads = pads[: len(self._settings["names"])]  # fingers'
        lines = self._clip["text"]
        text = "   ".join(t for t in (self._clip["label"], lines[min(k, len(lines) - 1)] if lines else "") if t)
        return annotate(
            image, text, None if self._force is None else self._force[min(k, len(self._force) - 1)],
            None if self._command is None else self._command[min(k, len(self._command) - 1)],
            self._settings["names"], self._settings["full"], self._height, pads)


def backdrop(height: int, width: int) -> np.ndarray:
    """Return a quiet grey-blue gradient [H, W, 3] uint8 where nothing was drawn."""
    mix = np.linspace(0.0, 1.0, height)[:, None, None]
    colour = (1 - mix) * np.array([206, 214, 224]) + mix * np.array([120, 132, 148])
    return np.broadcast_to(colour, (height, width, 3)).astype(np.uint8)


def grid(tiles: list[np.ndarray]) -> np.ndarray:
    """Return the tiles [H, W, 3] in rows: 1, 1x2, 2x2, 2x3, 3x3 ...; empty places stay dark."""
    across = math.ceil(math.sqrt(len(tiles)))
    down = math.ceil(len(tiles) / across)
    blank = np.full_like(tiles[0], 24)
    tiles = tiles + [blank] * (across * down - len(tiles))
    return np.concatenate([np.concatenate(tiles[r * across:(r + 1) * across], axis=1) for r in range(down)], axis=0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
