"""Makes the films and pictures of the documentation from the included policies, on a CPU.

    python docs/scripts/films.py grasp | rotate | fingertips | three [out=docs/media]

Each is played with seeds that nobody chose by how they look, on C MuJoCo, and cut to what happens. Needs OpenGL for
offscreen rendering (EGL or OSMesa).
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import imageio_ffmpeg  # noqa: E402

import dexsim  # noqa: E402
from dexsim.view.video import Clip, render  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
NEAR = {"lookat": [0.03, 0.0, 0.028], "distance": 0.255, "azimuth": 132.0, "elevation": -24.0}
ABOVE = {"lookat": [0.06, 0.0, 0.03], "distance": 0.3, "azimuth": 230.0, "elevation": -48.0}


def played(
    checkpoint: str, settings: list[str], worlds: int, seconds: float, steer: Callable[[Any, float], None] | None = None
) -> tuple[Any, list[Clip]]:
    """Play a policy in several worlds and return the environment and one clip of each."""
    path = ROOT / "checkpoints" / f"{checkpoint}.pt"
    settings = ["tactile.raw=true", *settings]
    env = dexsim.make_env(worlds=worlds, device="cpu", seed=7, settings=settings, checkpoint=path)
    policy = dexsim.load_policy(path, env)
    env.reset_all()
    obs = env.get_observations()
    models = [env.drawn_model(w) for w in range(worlds)]
    rows: dict[str, list[np.ndarray]] = {k: [] for k in ("qpos", "force", "command", "push", "taxels")}
    for k in range(int(seconds / env.dt)):
        if steer is not None:
            steer(env, k * env.dt)
        obs, *_ = env.step(policy(obs))
        rows["qpos"].append(env.engine.t.qpos.double().cpu().numpy().copy())
        rows["force"].append(env.touch.force_clean.cpu().numpy().copy())
        rows["taxels"].append(env.touch.raw.cpu().numpy().copy())
        if hasattr(env, "command"):
            rows["command"].append((env.command * env.f_max).cpu().numpy().copy())
            rows["push"].append(env.engine.t.xfrc_applied[:, env.objects.body, :3].cpu().numpy().copy())
    arrays = {k: np.stack(v, 1) for k, v in rows.items() if v}
    names = [env.scene.variants[int(v)].shape.name for v in env.objects.variant]
    clips = [
        Clip(
            models[w], arrays["qpos"][w],
            label=f"{names[w]}, {1000 * float(env.objects.mass[w]):.0f} g",
            layout=env.touch.layout, decor=True,
            **{k: arrays[k][w] for k in ("force", "command", "push", "taxels") if k in arrays},
        )
        for w in range(worlds)
    ]  # fmt: skip
    return env, clips


def squeeze(path: Path, most: int = 1_000_000) -> None:
    """Encode a film again, smaller, until it has at most so many bytes."""
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    for crf in range(24, 46, 3):
        part = path.with_suffix(".part.mp4")
        how = f"-c:v libx264 -preset slow -crf {crf} -pix_fmt yuv420p -movflags +faststart"
        command = [ffmpeg, "-y", "-loglevel", "error", "-i", str(path), *how.split(), str(part)]
        subprocess.run(command, check=True)
        if part.stat().st_size <= most:
            part.replace(path)
            return
        part.unlink()
    raise SystemExit(f"error: {path} stays above {most} bytes")


def film(clips: list[Clip], env: Any, path: Path, full: float, camera: dict[str, Any], size: tuple[int, int]) -> None:
    """Render clips side by side into a film of at most 1 MB."""
    every = max(1, round(1 / 24 / env.dt))  # 24 frames a second are enough
    for clip in clips:
        for name in ("qpos", "force", "command", "push", "taxels"):
            rows = getattr(clip, name)
            setattr(clip, name, None if rows is None else rows[::every])
    render(clips, path, every * env.dt, env.hand.finger_names, full, size, camera)
    squeeze(path)
    print(path, path.stat().st_size)


def commanded(env: Any, t: float) -> None:
    """Change the commanded force, and push the object, each at a time of its own."""
    level = 0.25 if t < 2.2 else 0.8 if t < 3.8 else 0.35
    env.fixed_command = torch.full((env.num_envs,), level)
    env.command[:] = level
    mass, push = env.objects.mass, torch.zeros(env.num_envs, 3)
    if 4.4 < t < 4.8:
        push[:, 0] = 2 * 9.81 * mass
    if 5.4 < t < 5.8:
        push[:, 1] = -2 * 9.81 * mass
    env.outside_force.copy_(push)


def grasp(out: Path, seconds: float = 6.4) -> None:
    """Six objects are caught; the command changes; each is pushed twice."""
    def steer(env: Any, t: float) -> None:
        env.pushes = False
        commanded(env, t)

    env, clips = played("grasp", [], 6, seconds, steer)
    film(clips, env, out / "grasp.mp4", 1.2 * env.f_max, NEAR, (640, 540))


def rotate(out: Path, seconds: float = 4.0) -> None:
    """A cube with six colours is turned on the palm, in two worlds."""
    env, clips = played("rotate", [], 2, seconds)
    for clip in clips:
        clip.colours = True
    film(clips, env, out / "rotate.mp4", 5.0, ABOVE, (960, 1080))


def fingertips(out: Path, seconds: float = 6.0) -> None:
    """A cube is turned between fingertips, in two worlds."""
    env, clips = played("rotate_fingertips", [], 2, seconds)
    for clip in clips:
        clip.colours = True
    film(clips, env, out / "rotate_fingertips.mp4", 8.0, ABOVE, (960, 1080))


FILMS = {"grasp": grasp, "rotate": rotate, "fingertips": fingertips}


def main(argv: list[str]) -> int:
    """Make one film; return the exit status."""
    if not argv or argv[0] not in FILMS:
        print(__doc__)
        return 2
    out = Path(argv[1].removeprefix("out=")) if len(argv) > 1 else ROOT / "docs" / "media"
    FILMS[argv[0]](out)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
