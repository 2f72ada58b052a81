"""`dexsim train` on the dummy task, for torchrun in tests: rank_main.py CONFIGS MODE [key=value ...].

MODE: plain; report: each rank writes what it had and learned into out=; slow: steps take time;
fail<k>: rank k meets an error at its 60th step; bug<k>: an exception there instead.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import dummy_task
import torch

from dexsim.cli import commands, train
from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.learning.runner import Runner

torch.set_num_threads(1)


class RankEnv(dummy_task.DummyEnv):
    def __init__(self, cfg, n_worlds, device, seed, engine):
        super().__init__(cfg, n_worlds, device, seed, engine)
        self.first_x = self._x.clone()
        self._steps = 0

    def step(self, actions):
        self._steps += 1
        if MODE == "slow":
            time.sleep(0.005)
        if self._steps == 60 and MODE[-1] == os.environ.get("RANK", "0"):
            if MODE.startswith("fail"):
                raise UserError("contact overflow, say")
            if MODE.startswith("bug"):
                raise ValueError("a bug, say")
        return super().step(actions)


class ReportingRunner(Runner):
    """Keeps the initial and the last weights of each rank."""

    def learn(self, *args):
        rank = os.environ.get("RANK", "0")
        before = [str(p.sum().item()) for p in self.alg.actor.parameters()]
        iteration = self.iteration
        done = super().learn(*args)
        after = {k: v.double().sum().item() for k, v in self.alg.actor.state_dict().items()}
        row = {
            "before": before,
            "after": after,
            "first_x": self.env.first_x.tolist(),
            "x": self.env._x.tolist(),
            "from": iteration,
            "iteration": self.iteration,
            "steps": self.steps,
            "rate": self.alg.learning_rate,
        }
        Path(os.environ["REPORT"]).mkdir(exist_ok=True)
        Path(os.environ["REPORT"], f"{rank}.json").write_text(json.dumps(row))
        return done


if __name__ == "__main__":
    CONFIGS, MODE = Path(sys.argv[1]), sys.argv[2]
    if MODE == "report":
        train.Runner = ReportingRunner
    sys.exit(guard(lambda argv: commands.train(argv, CONFIGS, RankEnv), sys.argv[3:]))
