"""Seeding and building the environment, with the line that says why the first start takes long."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from dexsim.cli import machine
from dexsim.cli.report import versions_line
from dexsim.learning.ranks import seed_all
from dexsim.sim.quiet import quiet_warp

MakeEnv = Callable[..., Any]


def build_env(cfg: dict[str, Any], make_env: MakeEnv | None, facts: dict[str, Any], given: Sequence[str] = ()) -> Any:
    """Print versions, machine and ``facts``, seed everything, make the environment.

    ``make_env`` replaces :func:`dexsim.tasks.make_env` (tests). given: names of the settings that the user gave, each
    of which something must read. Raises UserError.
    """
    if make_env is None:
        from dexsim import tasks

        make_env = tasks.make_env
    where = cfg["device"]
    print(versions_line())
    facts = {
        "device": f"{machine.describe(where)}, memory {machine.memory(where)}",
        "task": f"{cfg['choices']['task']}, {cfg['worlds']} worlds, engine {cfg['sim']['engine']}, seed {cfg['seed']}",
    } | facts
    for name, value in facts.items():
        print(f"{name:<8} {value}")
    seed_all(cfg["seed"])
    machine.set_threads(where)
    print("compiling kernels (first run only; cached afterwards) ...", flush=True)
    start = time.perf_counter()
    quiet_warp(where)
    env = make_env(cfg, n_worlds=cfg["worlds"], device=where, seed=cfg["seed"], engine=cfg["sim"]["engine"])
    env.given = given
    with torch.no_grad():  # one step compiles the rest and captures the graph
        env.step(torch.zeros(env.num_envs, env.num_actions, device=env.device))
    print(f"ready after {time.perf_counter() - start:.1f} s", flush=True)
    return env


def close(env: Any) -> None:
    """Give back an environment's memory and threads, where it can."""
    getattr(env, "close", lambda: None)()
