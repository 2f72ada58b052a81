"""Scenes with objects, small and still, for tests of what is written by world."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import torch

from dexsim.assets.objects import library
from dexsim.paths import CONFIGS
from dexsim.sim import ContactPair, make_engine
from dexsim.sim.scene import OBJECT, OBJECT_FIELDS, hand_object_scene
from dexsim.tasks.objects import Objects
from tools.assets import xhand

IMPEDANCE = 0.95
ALL = ["box", "sphere", "capsule", *(n for n, s in library().items() if s.kind == "grid")]


def grasp_cfg(*settings: str, worlds: int = 8) -> dict:
    """Return the resolved configuration of `dexsim train task=grasp preset=none SETTINGS`: all objects, on the CPU
    too."""
    return task_cfg(*settings, worlds=worlds)


def task_cfg(*settings: str, worlds: int = 8, task: str = "grasp") -> dict:
    """Return the same of any task."""

    from dexsim.cli import start

    return start.for_train([f"task={task}", "preset=none", f"worlds={worlds}", "device=cpu", *settings], CONFIGS).cfg


def grasp_env(*settings: str, worlds: int = 8, engine: str = "mujoco", seed: int = 0):
    from dexsim.tasks import make_env

    return make_env(grasp_cfg(*settings, worlds=worlds), worlds, "cpu", seed, engine)


def play_env(checkpoint: str, worlds: int, *settings: str, engine: str = "mujoco"):
    """Return (environment, policy) of an included checkpoint, as `python play.py checkpoint=... device=cpu SETTINGS`
    has them."""
    from dexsim.cli import start
    from dexsim.learning.ppo import load_policy
    from dexsim.paths import CONFIGS
    from dexsim.tasks import make_env

    path = Path(__file__).parents[1] / "checkpoints" / f"{checkpoint}.pt"
    begun = start.for_play(
        [
            f"checkpoint={path}",
            "device=cpu",
            f"episodes={worlds}",
            f"worlds={worlds}",
            f"sim.engine={engine}",
            *settings,
        ],
        CONFIGS,
    )
    env = make_env(begun.cfg, worlds, "cpu", begun.cfg["seed"], engine)
    return env, load_policy(begun.data, env, str(begun.source), begun.typed)


def hand_scene(n: int, shapes=ALL, kind: str = "mujoco", scales=(1.25,), timestep: float = 0.002, edit=None, **kw):
    """Return (engine, scene, objects): the hand and one object of `shapes` a world; edit(spec) changes the spec
    first."""
    names = list(shapes)
    spec = xhand.hand_spec()
    lib = library()
    scene = hand_object_scene(spec, [lib[s] for s in names], scales, timestep)
    for geom in list(spec.geoms):
        if not geom.contype and not geom.conaffinity:
            spec.delete(geom)
        elif geom.name in xhand.TIP_GEOMS:
            geom.solimp = [IMPEDANCE, IMPEDANCE, 1e-3, 0.5, 2.0]
    o = spec.option
    o.integrator, o.cone, o.impratio = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    o.iterations, o.ls_iterations = 30, 30
    o.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    if edit is not None:
        edit(spec)
    pairs = [ContactPair(f"tip_{f}", ("geom", f"tip_{f}"), ("body", OBJECT)) for f in xhand.FINGERS]
    fields = [*OBJECT_FIELDS, "dof_damping", "dof_frictionloss", "dof_armature"]
    e = make_engine(spec, n, "cpu", kind, fields=fields, pairs=pairs, **kw)
    return e, scene, Objects(e, scene, list(xhand.TIP_GEOMS), IMPEDANCE)


def write(objects: Objects, mask=None, **given) -> dict[str, torch.Tensor]:
    """Return objects.write with defaults for what is not given; returns what was written."""
    n = objects.engine.n
    values = {
        "variant": torch.arange(n) % len(objects.scene.variants),
        "scale": torch.ones(n, 3),
        "mass": torch.full((n,), 0.1),
        "com": torch.zeros(n, 3),
        "friction": torch.ones(n),
        "stiffness": torch.full((n,), 7000.0),
        "damping_ratio": torch.ones(n),
    }
    for k, v in given.items():
        values[k] = torch.as_tensor(v, dtype=values[k].dtype).expand_as(values[k]).clone()
    objects.write(torch.ones(n, dtype=torch.bool) if mask is None else mask, **values)
    return values


def random_values(n: int, rows: int, seed: int) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)

    def u(low, high, *shape):
        return low + (high - low) * torch.rand(n, *shape, generator=g)

    return {
        "variant": torch.randint(rows, (n,), generator=g),
        "scale": u(0.9, 1.5, 3),
        "mass": u(0.03, 0.5),
        "com": u(-0.1, 0.1, 3),
        "friction": u(0.4, 1.2),
        "stiffness": u(5e3, 9e3),
        "damping_ratio": u(0.3, 1.0),
    }


def put_object(engine, position, quat=(1.0, 0, 0, 0), hand=None) -> None:
    """Put the object of all worlds at rest at a pose ([3] or [N, 3], [4] or [N, 4]); the hand at `hand` [12] or
    zero."""
    q, v = engine.t.qpos.clone(), torch.zeros_like(engine.t.qvel)
    q[:] = torch.as_tensor(engine.mjm.qpos0)
    if hand is not None:
        q[:, engine.qpos_index(xhand.JOINTS)] = torch.as_tensor(np.asarray(hand), dtype=q.dtype)
    a = engine.mjm.jnt_qposadr[engine.joint("object_free")]
    q[:, a:a + 3] = torch.as_tensor(np.asarray(position), dtype=q.dtype)
    q[:, a + 3:a + 7] = torch.as_tensor(np.asarray(quat), dtype=q.dtype)
    engine.set_state(torch.ones(engine.n, dtype=torch.bool), q, v)
    engine.refresh()
