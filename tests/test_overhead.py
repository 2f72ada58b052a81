"""A control step must not drift away from the bare physics in it: the ratio of both, measured in one run, never a
time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

LIMIT = 2.5
"""Full step over bare physics: C MuJoCo, CPU, 256 worlds, two threads for physics (all else has one, so that on a
machine of many cores the ratio would be another). Measured 1.1 to 1.4 on two busy cores; on a GPU, where the step is
what training waits for, 1.10 at 8,192 worlds. An allocation a world or a Python loop over worlds goes far over."""


@pytest.mark.slow
def test_a_control_step_costs_little_more_than_its_physics():
    ratios = []
    for _ in range(3):  # the machine may be busy: one undisturbed run is enough
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "benchmarks.step",
                "task=grasp",
                "device=cpu",
                "worlds=256",
                "steps=8",
                "rounds=2",
                "sim.threads=2",
            ],
            cwd=Path(__file__).parents[1],
            capture_output=True,
            text=True,
            timeout=600,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        assert done.returncode == 0, done.stderr
        ratios.append(1 + json.loads(done.stdout.splitlines()[-1])["overhead"])
        if ratios[-1] < LIMIT:
            return
    raise AssertionError(f"full step / bare physics: {', '.join(f'{r:.2f}' for r in ratios)}; must be below {LIMIT}")
