"""Renders pictures of a world in this process, without a display: EGL, else OSMesa, whichever opens."""

from __future__ import annotations

import importlib
import os
from functools import cache
from typing import Any

import mujoco
import numpy as np

from dexsim import system
from dexsim.view.render import CAMERA, Pictures
from dexsim.view.video import NoRenderer


class Frames:
    """Renders worlds of one scene. size: width, height; camera: what differs from the usual view (`render.CAMERA`)."""

    def __init__(self, size: tuple[int, int] = (640, 480), camera: dict[str, Any] | None = None):
        self.size = size
        self._view: Any = CAMERA | (camera or {})
        self._pictures: Pictures | None = None

    def __call__(self, model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
        """Return the picture [H, W, 3] uint8 of a model at qpos [nq]. Raises NoRenderer."""
        if self._pictures is None or self._pictures.model is not model:
            self.close()
            self._pictures = Pictures(model, self.size, renderer)
        return self._pictures(qpos, self._view)

    def close(self) -> None:
        """Give back the context."""
        if self._pictures is not None:
            self._pictures.close()
        self._pictures = None


def renderer(model: mujoco.MjModel, height: int, width: int) -> Any:
    """Return MuJoCo's renderer on the first backend that opens; MUJOCO_GL asks for one. MuJoCo chooses as it is
    imported, and chooses a window where nothing is said, so the choice is made here. Raises NoRenderer."""
    backend = _backend()
    if backend is None:
        names = ", ".join(system.renderers())
        raise NoRenderer(f"no picture: no OpenGL for offscreen rendering opens ({names}); {system.no_renderer()}")
    os.environ |= system.renderer_environment(backend)
    if backend in system.RENDERERS["linux"]:
        contexts = importlib.import_module("mujoco.rendering.classic.gl_context")
        contexts.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext  # type: ignore[attr-defined]
    return mujoco.Renderer(model, height, width)


@cache
def _backend() -> str | None:
    """Return it; each is tried in a process of its own: a driver may crash, and a process keeps to the first."""
    return system.renderer()
