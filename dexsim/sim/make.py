"""Which engine steps a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco

from dexsim.errors import UserError
from dexsim.sim.engine import ContactPair, Engine


def no_log_file() -> None:
    """Send MuJoCo's warnings to stderr, not also to MUJOCO_LOG.TXT in whatever folder the user is in. A file that
    somebody chose stays."""
    log = mujoco.MjLogConfig.get()
    if log.logto_file and log.logfile == "MUJOCO_LOG.TXT":
        log.logto_file = False
        log.set()


MUJOCO_ITERATIONS, MUJOCO_LINE_SEARCH = 50, 100
"""Newton and line-search iterations that C MuJoCo gets where no more are said (the first: `sim.iterations_mujoco`)."""


def engine_of(engine: str, device: str) -> str:
    """Return the engine that `sim.engine` names on a device: "warp" or "mujoco"."""
    if engine not in ("auto", "warp", "mujoco"):
        raise UserError(f"sim.engine='{engine}': must be auto, warp or mujoco")
    if engine == "auto":
        return "warp" if device.startswith("cuda") else "mujoco"
    return engine


def solver_iterations(sim: Mapping[str, Any], engine: str) -> tuple[int, int]:
    """Return Newton and line-search iterations at most of "warp" or "mujoco", from the settings `sim`.

    C MuJoCo gets `iterations_mujoco`, or `iterations` where that is more, and MUJOCO_LINE_SEARCH: its iterations are
    cheap, it stops by itself when it has converged (after 2 on average in a grasp), and where either is cut off it
    throws an object out of a firm grasp now and then. A line search that stops at 20 ends the solver, too.
    """
    newton, line = int(sim["iterations"]), int(sim.get("ls_iterations", 0))
    if engine == "warp":
        return newton, line
    return max(newton, int(sim.get("iterations_mujoco", MUJOCO_ITERATIONS))), max(line, MUJOCO_LINE_SEARCH)


def make_engine(
    spec: mujoco.MjSpec, worlds: int, device: str = "cpu", engine: str = "auto", fields: Sequence[str] = (),
    pairs: Sequence[ContactPair] = (), deterministic: bool = False, nconmax: int = 40, njmax: int = 160,
    threads: int = 0, collision: str = "auto", solver: str = "auto",
) -> Engine:  # fmt: skip
    """Compile `spec` and build the engine named by `engine`: "warp", "mujoco", or "auto" (Warp on CUDA, C MuJoCo on a
    CPU).

    fields: model fields that vary by world. nconmax: contacts a world on average; njmax: constraint rows a world
    (MuJoCo-Warp only). threads: CPU threads of C MuJoCo, 0 = all. collision (MuJoCo-Warp only): who finds the contacts
    of convex hulls: "hand" (`dexsim.sim.collision`), "mujoco" (MuJoCo-Warp itself), "auto" (hand, where it serves the
    model). solver (MuJoCo-Warp only): who finds the contact forces: "hand" (`dexsim.sim.solver`), "mujoco", "auto",
    likewise.
    """
    no_log_file()
    engine = engine_of(engine, device)
    if collision not in ("auto", "hand", "mujoco"):
        raise UserError(f"sim.collision='{collision}': must be auto, hand or mujoco")
    if solver not in ("auto", "hand", "mujoco"):
        raise UserError(f"sim.solver='{solver}': must be auto, hand or mujoco")
    device = "cuda:0" if device == "cuda" else device  # torch.cuda.set_device wants a number
    if engine == "mujoco" and device != "cpu":
        raise UserError(
            f"sim.engine=mujoco runs on the CPU only, not on device={device}; use sim.engine=warp or device=cpu"
        )
    if engine == "warp":
        from dexsim.sim.warp_engine import WarpEngine

        return WarpEngine(
            spec.compile(), worlds, device, fields, pairs, deterministic, nconmax, njmax, collision, solver
        )
    from dexsim.sim.mujoco_engine import MujocoEngine, compile_with_sensors

    return MujocoEngine(compile_with_sensors(spec, pairs), worlds, fields, pairs, threads)
