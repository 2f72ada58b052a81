"""Film and frame strip of trials that a judging with states=true has kept: python -m benchmarks.touch_matters.film
states=FILE.npz out=FILE.mp4 [seconds=20] [trials=0,1,2,3]."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks import tools
from dexsim.tasks import make_env

OWN = {"states": "", "out": "", "seconds": "20", "trials": "0,1,2,3"}
CAMERA = {"lookat": [0.05, 0.0, 0.06], "distance": 0.34, "azimuth": 235.0, "elevation": -25.0}


def frames(states: Path, trials: list[int], seconds: float) -> dict:
    """What `dexsim.view.video.clips_of` takes, of kept trials."""
    cfg = tools.config(["task=rotate_fingertips", "device=cpu", "worlds=1"])
    env = make_env(cfg, 1, "cpu", 0, "mujoco")
    with np.load(states) as data:
        dt, models, qpos, overlay, label = float(data["dt"]), [], [], [], []
        for i in trials:
            model = env.drawn_model(0)
            model.geom_size[model.geom("object_box").id] = data["half"][i]
            stop = max(1, int(seconds / dt))
            models.append(model)
            qpos.append(data[f"qpos_{i}"][:stop].astype(float))
            overlay.append({"force": data[f"force_{i}"][:stop]})
            label.append(str(data["label"][i]))
        names = tuple(str(n) for n in data["names"])
    return {"model": models, "dt": dt, "names": names, "full": 8.0, "qpos": qpos, "label": label, "overlay": overlay,
            "camera": CAMERA}  # fmt: skip


def main(argv: list[str]) -> None:
    own, _ = tools.split(argv, OWN)
    from dexsim.view.video import clips_of, render

    trials = [int(v) for v in own["trials"].split(",")]
    found = frames(Path(own["states"]), trials, float(own["seconds"]))
    render(clips_of(found), Path(own["out"]), found["dt"], found["names"], found["full"], camera=CAMERA)
    print(own["out"])


if __name__ == "__main__":
    tools.command(main, __doc__)
