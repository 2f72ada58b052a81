"""`dexsim train` on the dummy task, for torchrun in tests: rank_main.py CONFIGS MODE [key=value ...]; `launched` does
what torchrun does in a process that has torch loaded, and its ranks are forks of that: of this file, or of a program.

MODE: plain; report: each rank writes what it had and learned into out=; slow: steps take time;
fail<k>: rank k meets an error at its 60th step; bug<k>: an exception there instead.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import dummy_task
import forked
import torch

from dexsim.cli import commands, train
from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.learning.runner import Runner

torch.set_num_threads(1)
MODE = "plain"


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


def main(argv: list[str]) -> int:
    """Exit status of a rank; its process's number stands in REPORT meanwhile."""
    global MODE
    configs, MODE = Path(argv[0]), argv[1]
    folder = Path(os.environ["REPORT"])
    folder.mkdir(exist_ok=True)
    (folder / f"{os.environ['RANK']}.pid").write_text(str(os.getpid()))
    if MODE == "report":
        train.Runner = ReportingRunner
    return guard(lambda settings: commands.train(settings, configs, RankEnv), argv[2:])


def one_rank(argv: list[str]) -> None:
    """Run a rank that is a fork of torchrun: with the signals that a program begins with. argv: of `main`, or a program
    (NAME.py) and its arguments."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if argv[0].endswith(".py"):
        forked.script(*argv)
    else:
        sys.exit(main(argv))


def launched(options: list[str], argv: list[str]) -> None:
    """Run `torchrun options rank_main.py argv` (argv: as for `one_rank`), but that the ranks are forks."""
    from torch.distributed import run

    configured = run.config_from_args
    run.config_from_args = lambda args: (configured(args)[0], one_rank, [argv])
    run.main([*options, "--start-method=fork", __file__])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
