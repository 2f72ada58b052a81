"""The code of the pages on a driver and an effect of one's own, out of the page into an empty folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TASK = '''
import torch

from dexsim.tasks import Scene, Task, observe, reward


class Still(Task):
    """Keep still."""

    scene = Scene(object=None)

    @observe("rad")
    def joint_position(self):
        return self.q

    @reward
    def one(self):
        return torch.ones(self.num_envs)
'''


def code_of(page: str) -> str:
    return re.search(r"```python\n(.*?)```", (ROOT / "docs" / "howto" / page).read_text(encoding="utf-8"), re.S)[1]


def provide(folder: Path, group: str, line: str) -> None:
    """What pip leaves of an installed package: its entry points."""
    made = folder / "mine-1.0.dist-info"
    made.mkdir()
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (made / "entry_points.txt").write_text(f"[{group}]\n{line}\n")


def run(folder: Path, *words: str) -> str:
    env = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}"}
    done = subprocess.run([sys.executable, "-m", "dexsim", *words], cwd=folder, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
def test_a_driver_of_ones_own(tmp_path):
    (tmp_path / "my_hand.py").write_text(code_of("own_driver.md"))
    (tmp_path / "still.py").write_text(TASK)
    provide(tmp_path, "dexsim.drivers", "my_hand = my_hand:MyHand")
    own = "task=still:Still"
    run(tmp_path, "train", own, "worlds=2", "iterations=1", "device=cpu", "final_episodes=0", "out=run",
        "agent.num_steps_per_env=8")  # fmt: skip
    run(tmp_path, "export", "checkpoint=run/policy.pt", own, "out=bundle", "steps=4")
    for name in ("my_hand", "my_hand:MyHand"):
        said = run(tmp_path, "deploy", "bundle=bundle", f"driver={name}", "seconds=0.5", "record=none", "settle=0.1",
                   "late=5", "stale=5", "hang=5", "overruns=1000")  # fmt: skip
        assert "ended    done after" in said and "my hand" in said


@pytest.mark.slow
def test_an_effect_of_ones_own(tmp_path):
    (tmp_path / "run_in.py").write_text(code_of("own_effect.md"))
    provide(tmp_path, "dexsim.effects", "run_in = run_in:RunIn")
    said = run(tmp_path, "diagnose", "demo=coulomb_friction", "effects=[run_in,coulomb_friction]", "out=found")
    assert "coulomb_friction" in said and (tmp_path / "found" / "diagnosis.json").is_file()
