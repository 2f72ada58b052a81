"""The resolved config that a simulated recording carries (config.yaml), as far as it is read again: the object and the
solver."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from dexsim import typed, yaml_text

Length = Annotated[float, msgspec.Meta(ge=0, le=10)]


class Thing(msgspec.Struct):
    """`recorded_world.object`: MuJoCo's sizes [m], kg, friction, N/m, damping ratio."""

    kind: str
    shape: str
    size: Annotated[list[Length], msgspec.Meta(min_length=1, max_length=3)]
    mass: typed.Positive
    friction: typed.Positive
    stiffness: typed.Positive
    damping_ratio: typed.Positive


class World(msgspec.Struct):
    """`recorded_world`."""

    index: typed.Count = 0
    object: Thing | None = None


class Contact(msgspec.Struct):
    """`task.contact`."""

    impedance: Annotated[float, msgspec.Meta(gt=0, lt=1)] | None = None


class Task(msgspec.Struct):
    """`task`."""

    contact: Contact | None = None


class Sim(msgspec.Struct):
    """`sim`: s, and the solver's counts."""

    timestep: Annotated[float, msgspec.Meta(ge=1e-5, le=0.1)] | None = None
    impratio: typed.Positive | None = None
    iterations: typed.Count | None = None
    iterations_mujoco: typed.Count | None = None
    ls_iterations: typed.Count | None = None
    noslip_iterations: typed.Count | None = None


class Config(msgspec.Struct):
    """The parts that are read; the rest is carried along."""

    recorded_world: World | None = None
    task: Task | None = None
    sim: Sim | None = None


def config(text: str | None, source: object) -> Config:
    """Return what is read of an attached config; nothing of none. Raises UserError."""
    raw: Any = (yaml_text.parse(text, f"{source}: attached config") if text else None) or {}
    return typed.convert(raw, Config, f"{source}: attached config")
