"""Hands of MuJoCo Menagerie by name: `menagerie:leap_hand`, where its files are on this machine."""

from __future__ import annotations

import os
from pathlib import Path

from dexsim.errors import UserError

PREFIX = "menagerie:"
GET = "git clone https://github.com/google-deepmind/mujoco_menagerie, or pip install robot_descriptions and load one"


def folders() -> list[Path]:
    """Return where a copy of MuJoCo Menagerie may lie: $MUJOCO_MENAGERIE, beside or below the working directory, and
    the cache of the package robot_descriptions."""
    said = os.environ.get("MUJOCO_MENAGERIE")
    cache = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE") or "~/.cache/robot_descriptions").expanduser()
    places = [Path(said).expanduser()] if said else []
    places += [Path(name) for name in ("mujoco_menagerie", "../mujoco_menagerie")]
    return [*places, cache / "mujoco_menagerie"]


def model(text: str) -> Path:
    """Return the model file of `menagerie:NAME` (its right hand) or `menagerie:NAME/FILE`; any other text is a path
    itself.

    Raises UserError, which says how to get the files, where there are none, and which there are, where the name is
    none of them.
    """
    if not text.startswith(PREFIX):
        return Path(text).expanduser()
    name, _, file = text.removeprefix(PREFIX).partition("/")
    roots = [f for f in folders() if f.is_dir()]
    if not roots:
        raise UserError(
            f"{text}: no copy of MuJoCo Menagerie here (looked in {', '.join(map(str, folders()))}; the environment"
            f" variable MUJOCO_MENAGERIE says where one is): {GET}"
        )
    robot = next((r / name for r in roots if (r / name).is_dir()), None) if name and ".." not in name else None
    if robot is None:
        there = sorted({p.name for r in roots for p in r.iterdir() if p.is_dir() and list(p.glob("*hand*.xml"))})
        raise UserError(f"{text}: no such robot in {roots[0]}; hands there: {', '.join(there) or 'none'}")
    models = sorted(p for p in robot.glob("*.xml") if not p.name.startswith(("scene", "keyframes")))
    if file:
        models = [p for p in models if p.stem == file.removesuffix(".xml")]
    right = [p for p in models if "right" in p.stem] or models
    if not right:
        raise UserError(f"{text}: no model in {robot}")
    return right[0]
