"""Writes the two data sets beside it, as the real `lerobot` package does: `python write.py FOLDER`.

v2.1 was written by lerobot 0.3.3 (with datasets 3.6.0), v3.0 by lerobot 0.4.3 (with datasets 4.1.1); neither is needed
to read them. Motion: that of `motion` in tests/test_readers.py, at other lengths.
"""

from __future__ import annotations

import sys

import numpy as np

LENGTHS, FPS = (60, 80, 50), 50


def motion(episode: int) -> tuple[np.ndarray, np.ndarray]:
    """Return targets and positions [n, 2] of an episode."""
    t = np.arange(LENGTHS[episode])[:, None] / FPS
    k = np.arange(2)
    return 0.4 * np.sin(2 * t + k + episode), 0.4 * np.sin(2 * (t - 0.04) + k + episode)


def main(folder: str) -> None:
    """Write the data set."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    vector = {"dtype": "float32", "shape": (2,), "names": ["shoulder_pan.pos", "elbow_flex.pos"]}
    features = {"observation.state": vector, "action": dict(vector)}
    made = LeRobotDataset.create(
        "me/tiny", fps=FPS, features=features, root=folder, robot_type="so100_follower", use_videos=False
    )
    for episode in range(len(LENGTHS)):
        for c, q in zip(*map(np.float32, motion(episode)), strict=True):
            frame = {"observation.state": q, "action": c}
            try:
                made.add_frame(frame | {"task": "wave"})
            except ValueError:  # before 0.4
                made.add_frame(frame, task="wave")
        made.save_episode()
    if hasattr(made, "finalize"):
        made.finalize()


if __name__ == "__main__":
    main(sys.argv[1])
