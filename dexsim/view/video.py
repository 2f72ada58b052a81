"""Headless video of simulated worlds: MuJoCo's offscreen renderer, several worlds in a grid, as H.264 mp4.

Rendering runs in a process of its own, because MuJoCo fixes its OpenGL backend at import and a broken driver may take
the process down with it. Which are tried: `dexsim.system.renderers`; ``MUJOCO_GL=...`` asks for one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import system
from dexsim.errors import UserError

NO_GL = 3  # exit status of the renderer: this backend cannot open a context


@dataclass
class Clip:
    """One world's film.

    model: mujoco.MjModel; qpos [T, nq]; label: a line of text; force [T, F] measured force of each finger (N) and
    command [T] or [T, F] (N), drawn as bars, or None; text: a line for each frame, or none. What is drawn in the scene
    beside the model: push [T, 3] N on the object, an arrow; taxels [T, F, K] N of a layout
    (`dexsim.tactile.layout.TaxelLayout`), lit; gravity [T, 3] m/s^2, by which the hand is turned; colours: six for a
    box's faces; decor: a table and a forearm.
    """

    model: Any
    qpos: np.ndarray
    label: str = ""
    force: np.ndarray | None = None
    command: np.ndarray | None = None
    text: Sequence[str] = field(default_factory=tuple)
    push: np.ndarray | None = None
    taxels: np.ndarray | None = None
    layout: Any = None
    gravity: np.ndarray | None = None
    colours: bool = False
    decor: bool = False


class NoRenderer(UserError):
    """No OpenGL backend works on this machine."""


def drawn(draw: Callable[[], object], say: Callable[[str], object] = print, what: str = "") -> bool:
    """Return whether something could be drawn; where no OpenGL works, that is said, and all else stands without it."""
    try:
        draw()
    except NoRenderer as error:
        say(f"{what}{error}")
        return False
    return True


def clips_of(frames: dict[str, Any]) -> list[Clip]:
    """Return the clips from the ``frames`` of ``env.evaluate``: lists ``model``, ``qpos`` and, where there are any,
    ``overlay`` (dicts with ``force``, ``command``, ``text``, ``push``, ``taxels``, ``layout``, ``gravity``) and
    ``label``, one entry for each shown world; ``colours`` for all."""
    clips = []
    for k, (model, qpos) in enumerate(zip(frames["model"], frames["qpos"])):
        overlay = (frames.get("overlay") or [{}] * (k + 1))[k]
        labels = frames.get("label")
        clips.append(Clip(model, np.asarray(qpos, np.float64), labels[k] if labels else "",
                          _array(overlay.get("force")), _array(overlay.get("command")),
                          tuple(overlay.get("text", ())), _array(overlay.get("push")), _array(overlay.get("taxels")),
                          overlay.get("layout"), _array(overlay.get("gravity")), bool(frames.get("colours")), True))
    return clips


def _array(value: Any) -> np.ndarray | None:
    return None if value is None else np.asarray(value, np.float64)


def render(
    clips: Sequence[Clip], path: Path, dt: float, names: Sequence[str] = (), full: float = 10.0,
    size: tuple[int, int] = (480, 368), camera: dict[str, Any] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> str:  # fmt: skip
    """Write an mp4 of the clips side by side, in real time; returns the backend used.

    Args:
        dt: time between two rows of ``qpos`` (s).
        names: one name for each finger, under its bar.
        full: force of a full bar (N).
        size: width and height of one world's tile (pixels; multiples of 16 fill whole video blocks).
        camera: lookat [3] (m), distance (m), azimuth and elevation (deg) instead of the usual view.

    Raises:
        NoRenderer: no OpenGL of this system opens a context; the message says what to install.
        UserError: the video cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="dexsim_video_") as folder:
        _hand_over(Path(folder), clips, dict(dt=dt, names=list(names), full=full, size=list(size), camera=camera or {}))
        reasons = []
        for backend in system.renderers():
            status, said = _run(Path(folder), path, backend, progress)
            if status == 0:
                return backend
            reasons.append(f"{backend}: {said}")
            if status != NO_GL and not system.crashed(status):
                raise UserError(f"cannot write {path}: {said}")
    raise NoRenderer(f"no video: no OpenGL for offscreen rendering ({'; '.join(reasons)}); {system.no_renderer()}")


def _hand_over(folder: Path, clips: Sequence[Clip], settings: dict[str, Any]) -> None:
    """Write what the rendering process reads: the models, the arrays and the settings."""
    import mujoco

    for k, clip in enumerate(clips):
        mujoco.mj_saveModel(clip.model, str(folder / f"{k}.mjb"), None)
        names = ("qpos", "force", "command", "push", "taxels", "gravity")
        arrays = {n: getattr(clip, n) for n in names if getattr(clip, n) is not None}
        if clip.taxels is not None:
            for name in ("point", "normal", "ty", "count"):
                arrays[f"taxel_{name}"] = getattr(clip.layout, name)
        np.savez(folder / f"{k}.npz", **arrays)
    settings["clips"] = [
        {
            "label": clip.label,
            "text": list(clip.text),
            "bodies": [] if clip.taxels is None else list(clip.layout.bodies),
            "colours": clip.colours,
            "decor": clip.decor,
        }
        for clip in clips
    ]
    (folder / "settings.json").write_text(json.dumps(settings), "utf-8")


def _run(folder: Path, path: Path, backend: str, progress: Callable[[int, int], None]) -> tuple[int, str]:
    """Return one try with one backend: exit status and the last line it said."""
    env = os.environ | system.renderer_environment(backend)
    command = [sys.executable, "-m", "dexsim.view.render", str(folder), str(path)]
    last = ""
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8",
                          errors="replace") as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                words = line.split()
                if words[:1] == ["frame"]:
                    progress(int(words[1]), int(words[2]))
                elif words:
                    last = line.strip()
        except BaseException:
            process.kill()
            raise
    return process.returncode, last or f"the renderer ended with status {process.returncode}"
