"""The code of the pages on a task, a driver, an effect and a reader of one's own: out of the page, beside an installed
wheel, in an empty folder outside the checkout."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest
import yaml
from fresh import call, provide

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
GYM = """
import gymnasium
import dexsim.gym

batch = gymnasium.make("dexsim/CatchIt-v0", num_envs=3, device="cpu", settings=["preset=none"])
seen = batch.reset(seed=1)[0]
assert len(seen) == 3 and batch.step(batch.action_space.sample())[1].shape == (3,)
one = gymnasium.make("dexsim/CatchIt-v0", device="cpu", settings=["preset=none"])
assert one.reset(seed=1)[0].shape == seen.shape[1:]
"""
WORN = """
drive: torque
joints:
  "*": {kp: 2.0, kd: 0.05, torque_limit: 1.1, no_load_speed: 12.0, tight_spot: 0.05, tight_spot_at: 0.4}
"""


def code_of(page: str) -> str:
    return re.search(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.S)[1]


@pytest.mark.slow
def test_a_task_of_ones_own(installed, tmp_path):
    """By the commands of the page; then as an installed package's, by name, in gymnasium too."""
    page = (ROOT / "docs" / "tutorials" / "own_task.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(from dexsim.tasks import Task, done.*?)```", page, re.S)[1]
    assert len([line for line in code.splitlines() if line.strip()]) <= 40
    (tmp_path / "catch_it.py").write_text(code)
    own = "task=catch_it:CatchIt"

    def run(*words):
        return call(installed, tmp_path, "dexsim", *words)

    run("train", "worlds=4", "iterations=2", "device=cpu", "final_episodes=0", "out=run", own)
    said = run("play", "checkpoint=run/policy.pt", "episodes=4", "device=cpu", "video=false", "out=play", own)
    assert "height_at_the_end" in said and (tmp_path / "play" / "metrics.json").is_file()
    assert "largest difference 0 over" in run("export", "checkpoint=run/policy.pt", "out=bundle", own)
    (tmp_path / "catch_it.py").unlink()
    provide(installed, "catch_it.py", code, "dexsim.tasks", "catch_it = catch_it:CatchIt")
    assert "catch_it" in run("tasks")
    run("play", "checkpoint=run/policy.pt", "episodes=4", "device=cpu", "video=false", "out=again")
    call(installed, tmp_path, "python", "-c", GYM)


@pytest.mark.slow
def test_a_driver_of_ones_own(installed, tmp_path):
    provide(installed, "my_hand.py", code_of("howto/own_driver.md"), "dexsim.drivers",
            "my_hand = my_hand:MyHand")  # fmt: skip
    (tmp_path / "still.py").write_text(TASK)
    own = "task=still:Still"
    call(installed, tmp_path, "dexsim", "train", own, "worlds=2", "iterations=1", "device=cpu", "final_episodes=0",
         "out=run", "agent.num_steps_per_env=8")  # fmt: skip
    call(installed, tmp_path, "dexsim", "export", "checkpoint=run/policy.pt", own, "out=bundle", "steps=4")
    for name in ("my_hand", "my_hand:MyHand"):
        said = call(installed, tmp_path, "dexsim", "deploy", "bundle=bundle", f"driver={name}", "seconds=0.5",
                    "record=none", "settle=0.1", "late=5", "stale=5", "hang=5", "overruns=1000")  # fmt: skip
        assert "ended    done after" in said and "my hand" in said


@pytest.mark.slow
def test_a_law_and_an_effect_of_ones_own(installed, tmp_path):
    """Both files of the page in an installed package: what the law does is found, named, written and trained with."""
    law, effect = re.findall(r"```python\n(.*?)```", (ROOT / "docs/howto/own_effect.md").read_text("utf-8"), re.S)
    (tmp_path / "tight_spot_law.py").write_text(law)
    (tmp_path / "tight_spot_effect.py").write_text(effect)
    own = ("law=tight_spot_law:TIGHT_SPOT", "effect=tight_spot_effect:TightSpot")
    assert "that angle" in call(installed, tmp_path, "dexsim", "diagnose", "columns=true", *own)
    call(installed, tmp_path, "dexsim", "diagnose", "demo=tight_spot", "effects=[tight_spot]", "out=typed", *own)
    for file in ("tight_spot_law.py", "tight_spot_effect.py"):
        (tmp_path / file).unlink()
    provide(installed, "tight_spot_law.py", law, "dexsim.laws", "tight_spot = tight_spot_law:TIGHT_SPOT")
    provide(installed, "tight_spot_effect.py", effect, "dexsim.effects", "tight_spot = tight_spot_effect:TightSpot")

    def run(*words):
        return call(installed, tmp_path, "dexsim", *words)

    said = run("diagnose", "demo=tight_spot", "effects=[tight_spot,coulomb_friction,command_delay]", "out=found")
    found = json.loads((tmp_path / "found" / "diagnosis.json").read_text())["findings"]
    assert [f["effect"] for f in found if f["where"]["joints"]] == ["tight_spot"], said
    at = found[0]["parameters"]["place"]
    assert at["low"] - 0.05 < 0.4 < at["high"] + 0.05
    served = yaml.safe_load((tmp_path / "found" / "servo.yaml").read_text())["joints"]["knuckle"]["tight_spot"]
    assert served["low"] < served["value"] < served["high"]
    (tmp_path / "worn.yaml").write_text(WORN)
    run("train", "worlds=2", "iterations=1", "device=cpu", "final_episodes=0", "agent.num_steps_per_env=4", "out=run",
        "servo_file=worn.yaml", "+randomize.servo.tight_spot=[0,0.02]")  # fmt: skip


@pytest.mark.slow
def test_a_reader_of_ones_own(installed, tmp_path):
    provide(installed, "lab_files.py", code_of("howto/own_reader.md"), "dexsim.readers",
            "lab = lab_files:LabFiles")  # fmt: skip
    rows = [{"joints": ["shoulder", "elbow"]}]
    for k in range(300):
        goal = [40 * math.sin(0.02 * k), 30 + 20 * math.sin(0.02 * k + 1)]
        late = [40 * math.sin(0.02 * (k - 4)), 30 + 20 * math.sin(0.02 * (k - 4) + 1)]
        rows.append({"ms": 10 * k, "goal": goal, "angle": late})
    (tmp_path / "run.lab").write_text("\n".join(map(json.dumps, rows)) + "\n")
    said = call(installed, tmp_path, "dexsim", "audit", "run.lab")
    assert "shoulder" in said and "elbow" in said
    call(installed, tmp_path, "dexsim", "convert", "run.lab", "out=run.mcap")
    assert (tmp_path / "run.mcap").is_file()
    (tmp_path / "run.lab").write_text('{"joints": ["shoulder"]}\n{"ms": 1}\n')
    with pytest.raises(AssertionError, match="run.lab") as error:
        call(installed, tmp_path, "dexsim", "audit", "run.lab")
    assert "Traceback" not in str(error.value)
