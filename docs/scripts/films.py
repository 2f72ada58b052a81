"""Makes the films and pictures of the documentation from the included policies, on a CPU.

    python docs/scripts/films.py grasp | rotate | fingertips | touch | gap | overview [out=docs/media]

Each is played with seeds that nobody chose by how they look, on C MuJoCo, and cut to what happens. Needs OpenGL for
offscreen rendering (EGL or OSMesa).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import imageio_ffmpeg  # noqa: E402
from PIL import Image  # noqa: E402

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
        if hasattr(env, "commanded_force"):
            rows["command"].append(env.commanded_force().cpu().numpy().copy())
            rows["push"].append(env.engine.t.xfrc_applied[:, env.objects.body, :3].cpu().numpy().copy())
    arrays = {k: np.stack(v, 1) for k, v in rows.items() if v}
    names = [env.objects.scene.variants[int(v)].shape.name for v in env.objects.variant]
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
    for crf in range(32, 46, 3):
        part = path.with_suffix(".part.mp4")
        how = f"-c:v libx264 -preset medium -tune animation -crf {crf} -pix_fmt yuv420p -movflags +faststart"
        command = [ffmpeg, "-y", "-loglevel", "error", "-i", str(path), *how.split(), str(part)]
        subprocess.run(command, check=True)
        if part.stat().st_size <= most:
            part.replace(path)
            return
        part.unlink()
    raise SystemExit(f"error: {path} stays above {most} bytes")


def film(clips: list[Clip], env: Any, path: Path, full: float, camera: dict[str, Any], size: tuple[int, int]) -> None:
    """Render clips side by side into a film of at most 1 MB."""
    render(clips, path, env.dt, env.hand.finger_names, full, size, camera)
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
    """Show six objects that are caught, pressed as commanded, and pushed twice each."""

    def steer(env: Any, t: float) -> None:
        env.pushes = False
        commanded(env, t)

    env, clips = played("grasp", [], 6, seconds, steer)
    film(clips, env, out / "grasp.mp4", 1.2 * env.f_max, NEAR, (640, 540))


def rotate(out: Path, seconds: float = 4.0) -> None:
    """Show a cube with six colours that is turned on the palm, in two worlds."""
    env, clips = played("rotate", [], 2, seconds)
    for clip in clips:
        clip.colours = True
    film(clips, env, out / "rotate.mp4", 5.0, ABOVE, (960, 1080))


def fingertips(out: Path, seconds: float = 6.0) -> None:
    """Show a cube that is turned between fingertips, in two worlds."""
    env, clips = played("rotate_fingertips", [], 2, seconds)
    for clip in clips:
        clip.colours = True
    film(clips, env, out / "rotate_fingertips.mp4", 8.0, ABOVE, (960, 1080))


def touch(out: Path) -> None:
    """Draw a fingertip that presses on an object, which is glass here, with the taxels that feel it lit."""
    env, clips = played("grasp", ["task.objects.train=[sphere]", "task.objects.emphasis={}"], 1, 3.0, commanded)
    clip = clips[0]
    body = clip.model.body("object").id
    clip.model.geom_rgba[clip.model.geom_bodyid == body, 3] = 0.25
    for name in ("qpos", "force", "command", "push", "taxels"):
        setattr(clip, name, getattr(clip, name)[-2:])
    camera = {"lookat": [0.07, 0.0, 0.095], "distance": 0.25, "azimuth": 150.0, "elevation": -25.0}
    film = out / ".touch.mp4"
    render([clip], film, 0.05, env.hand.finger_names, 1.2 * env.f_max, (1280, 720), camera)
    still(film, 0, out / "touch.png")
    film.unlink()


def still(film: Path, frame: int, path: Path) -> None:
    """Write one frame of a film as a picture."""
    reader = imageio_ffmpeg.read_frames(str(film))
    width, height = next(reader)["size"]
    for k, data in enumerate(reader):
        if k == frame:
            picture = Image.fromarray(np.frombuffer(data, np.uint8).reshape(height, width, 3))
            picture.quantize(256).save(path, optimize=True)
            return


def gap(out: Path) -> None:
    """Plot the demo's recorded angle beside the simulation as believed, and beside the one with what was found."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths, model, servo, _ = dexsim.demo_recordings(folder / "demo")
        dexsim.diagnose(paths, model, servo, out=folder / "found", next_recording=False)
        recording = dexsim.read_recording(paths[-1])
        made = [dexsim.replay_recording(recording, model, s) for s in (servo, folder / "found" / "servo.yaml")]
    fig, axes = plt.subplots(2, 2, figsize=(10, 4.2), sharex=True, sharey="row", height_ratios=(2, 1))
    t, q = recording.states.position.t, recording.states.position.value[:, 0]
    for column, (run, title) in enumerate(zip(made, ("as believed", "with the delay that was found"), strict=True)):
        simulated = np.interp(t, run.states.position.t, run.states.position.value[:, 0])
        axes[0, column].plot(t, q, color="#888888", lw=3, label="recorded")
        axes[0, column].plot(t, simulated, color="#1f6fb4", lw=1.2, label="simulated")
        axes[0, column].set_title(title)
        axes[1, column].plot(t, 1e3 * (simulated - q), color="#c0392b", lw=1)
        axes[1, column].set_xlabel("s")
    axes[0, 0].set_ylim(-0.5, 0.7)
    axes[0, 0].legend(loc="upper center", ncol=2)
    axes[0, 0].set_ylabel("angle, rad")
    axes[1, 0].set_ylabel("error, mrad")
    axes[0, 0].set_xlim(t[0] + 1.0, t[0] + 4.0)
    fig.tight_layout()
    fig.savefig(out / "gap.png", dpi=110)


def overview(out: Path) -> None:
    """Join the films of the rotation, of the grasp and of a report page, and draw a still of the three."""
    import imageio.v2 as imageio
    import matplotlib
    from PIL import ImageDraw, ImageFont

    font = ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans-Bold.ttf", 30)
    dark = (24, 28, 36)

    def titled(picture: Image.Image, title: str) -> np.ndarray:
        frame = Image.new("RGB", (1280, 780), dark)
        frame.paste(picture.convert("RGB").resize((1280, 720)), (0, 60))
        ImageDraw.Draw(frame).text((20, 12), title, font=font, fill="white")
        return np.asarray(frame)

    def save(name: str, frames: list[np.ndarray]) -> None:
        flags = ["-crf", "30", "-preset", "veryslow", "-movflags", "+faststart"]
        with imageio.get_writer(out / name, fps=24, macro_block_size=4, output_params=flags) as writer:
            for frame in frames:
                writer.append_data(frame)

    page = Image.open(out / "diagnosis_page.png").convert("RGB")
    tall = page.resize((1280, page.height * 1280 // page.width))
    part = np.clip((np.arange(140) - 40) / 80, 0, 1)
    tops = (part**2 * (3 - 2 * part) * (tall.height - 720)).astype(int)
    pages = [tall.crop((0, y, 1280, y + 720)) for y in tops]
    save("diagnosis_page.mp4", [np.asarray(p) for p in pages])
    turning = [Image.fromarray(x) for x in imageio.get_reader(out / "rotate.mp4")]
    holding = [Image.fromarray(x) for x in imageio.get_reader(out / "grasp.mp4")][30:140]
    titles = "1  Train: a policy turns a cube", "2  Feel: 600 taxels, a push", "3  Diagnose: your own machine"
    parts = zip((turning, holding, pages), titles, strict=True)
    save("dexsim.mp4", [titled(x, title) for frames, title in parts for x in frames])

    still = Image.new("RGB", (1284, 440), dark)
    touched, scale = Image.open(out / "touch.png").convert("RGB"), page.width / 891
    bars, hand = (page.crop([int(v * scale) for v in box]) for box in ((360, 275, 845, 405), (40, 270, 350, 605)))
    still.paste("white", (860, 56, 1284, 440))
    for picture, (x, y, width, height) in (
        (turning[60].resize((1280, 720)).crop((140, 50, 640, 518)), (0, 56, 424, 384)),
        (touched.crop((400, 150, 800, 460)), (430, 56, 424, 328)),
        (touched.crop((0, 555, 1280, 720)), (430, 385, 424, 55)),
        (bars, (866, 62, 412, 118)),
        (hand, (966, 182, 236, 256)),
    ):
        still.paste(picture.resize((width, height), Image.Resampling.LANCZOS), (x, y))
    for k, title in enumerate(titles):
        ImageDraw.Draw(still).text((430 * k + 10, 10), title.split(":")[0], font=font, fill="white")
    still.quantize(256).save(out / "dexsim.png", optimize=True)


FILMS = {"grasp": grasp, "rotate": rotate, "fingertips": fingertips, "touch": touch, "gap": gap, "overview": overview}


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
