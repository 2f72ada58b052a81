"""Film, or strip of frames, of trials that a judging with states=true has kept:
python -m benchmarks.touch_matters.film states=FILE.npz out=FILE.mp4 [trials=0,1,2,3] [seconds=20], or
out=FILE.png [trials=0] [seconds=6] [frames=6]: one row of frames a trial."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks import tools
from dexsim.errors import UserError
from dexsim.tasks import make_env

OWN = {"states": "", "out": "", "seconds": "20", "trials": "0,1,2,3", "frames": "6"}
CAMERA = {"lookat": [0.05, 0.0, 0.06], "distance": 0.34, "azimuth": 235.0, "elevation": -25.0}
TILE = (480, 368)  # pixels of a trial


def kept(states: Path, trials: list[int], seconds: float) -> dict:
    """What `dexsim.view.video.clips_of` takes, of kept trials."""
    cfg = tools.config(["task=rotate_fingertips", "device=cpu", "worlds=1"])
    env = make_env(cfg, 1, "cpu", 0, "mujoco")
    with np.load(states) as data:
        dt, models, qpos, overlay, label = float(data["dt"]), [], [], [], []
        for i in trials:
            if f"qpos_{i}" not in data:
                raise UserError(f"trials={i}: {states} holds 0 to {len(data['half']) - 1}")
            model = env.drawn_model(0)
            model.geom_size[model.geom("object_box").id] = data["half"][i]
            stop = max(1, int(seconds / dt))
            models.append(model)
            qpos.append(data[f"qpos_{i}"][:stop].astype(float))
            overlay.append({"force": data[f"force_{i}"][:stop]})
            label.append(str(data["label"][i]))
        names = tuple(str(n) for n in data["names"])
    return {"model": models, "dt": dt, "names": names, "full": 8.0, "qpos": qpos, "label": label, "overlay": overlay}


def film(found: dict, path: Path) -> None:
    from dexsim.view.video import clips_of, render

    render(clips_of(found), path, found["dt"], found["names"], found["full"], size=TILE, camera=CAMERA)


def strip(found: dict, path: Path, count: int) -> None:
    """`count` frames of each trial, evenly over its time, one row a trial."""
    import imageio_ffmpeg
    import matplotlib.image

    rows = []
    for i in range(len(found["qpos"])):
        one = {k: [v[i]] if isinstance(v, list) else v for k, v in found.items()}
        with tempfile.TemporaryDirectory() as folder:
            film(one, Path(folder) / "one.mp4")
            reader = imageio_ffmpeg.read_frames(str(Path(folder) / "one.mp4"))
            width, height = next(reader)["size"]
            every = [np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader]
        picks = np.linspace(0, len(every) - 1, count).round().astype(int)
        rows.append(np.concatenate([every[k] for k in picks], axis=1))
    matplotlib.image.imsave(path, np.concatenate(rows, axis=0)[::2, ::2].copy())


def main(argv: list[str]) -> None:
    own, rest = tools.split(argv, OWN)
    if rest:
        raise UserError(f"{rest[0]!r}: the settings are {', '.join(OWN)}")
    out = Path(own["out"]).expanduser()
    if out.suffix not in (".mp4", ".png"):
        raise UserError(f"out={own['out']}: must be a file .mp4 or .png")
    if not Path(own["states"]).expanduser().is_file():
        raise UserError(f"states={own['states']}: no such file; a judging with states=true writes one")
    trials = [int(v) for v in own["trials"].split(",")]
    found = kept(Path(own["states"]).expanduser(), trials, float(own["seconds"]))
    if out.suffix == ".mp4":
        film(found, out)
    else:
        strip(found, out, tools.numbers(own["frames"], "frames")[0])
    print(out)


if __name__ == "__main__":
    tools.command(main, __doc__)
