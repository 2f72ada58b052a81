"""Hands by name: `menagerie:leap_hand` of MuJoCo Menagerie, `robot_descriptions:allegro_hand_mj_description`."""

from __future__ import annotations

import importlib
import importlib.util
import os
from pathlib import Path

from dexsim.errors import UserError

EXTRA = "pip install dexsim[hands] fetches it by name"


def model(text: str) -> Path:
    """Return the model file of `menagerie:NAME` (its right hand), `menagerie:NAME/FILE` or `robot_descriptions:NAME`,
    fetched by those packages where it is not on this machine yet; any other text is a path itself.

    Raises UserError, which says how to get the files, where there are none, and which there are, where the name is
    none of them.
    """
    source, colon, name = text.partition(":")
    if colon and source == "menagerie":
        return _of_menagerie(text, *name.partition("/")[::2])
    if colon and source == "robot_descriptions":
        return _described(text, name)
    return Path(text).expanduser()


def folders() -> list[Path]:
    """Return where a copy of MuJoCo Menagerie may lie: $MUJOCO_MENAGERIE, beside or below the working directory, and
    the cache of the package robot_descriptions."""
    said = os.environ.get("MUJOCO_MENAGERIE")
    cache = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE") or "~/.cache/robot_descriptions").expanduser()
    places = [Path(said).expanduser()] if said else []
    places += [Path(name) for name in ("mujoco_menagerie", "../mujoco_menagerie")]
    return [*places, cache / "mujoco_menagerie"]


def _of_menagerie(text: str, name: str, file: str) -> Path:
    roots = [f for f in folders() if f.is_dir()]
    robot = next((r / name for r in roots if (r / name).is_dir()), None) if name and ".." not in name else None
    if robot is None and importlib.util.find_spec("mujoco_menagerie"):
        import mujoco_menagerie  # it fetches one robot, a few megabytes, and keeps it

        try:
            robot = mujoco_menagerie.get(name).path()
        except (mujoco_menagerie.MenagerieError, OSError) as error:
            raise UserError(f"{text}: {error}") from None
    if robot is None and not roots:
        raise UserError(
            f"{text}: no copy of MuJoCo Menagerie here (looked in {', '.join(map(str, folders()))}; the environment"
            f" variable MUJOCO_MENAGERIE says where one is): {EXTRA}, or git clone"
            " https://github.com/google-deepmind/mujoco_menagerie"
        )
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


def _described(text: str, name: str) -> Path:
    if importlib.util.find_spec("robot_descriptions") is None:
        raise UserError(f"{text}: the package robot_descriptions is not here: {EXTRA}")
    if not name.isidentifier() or importlib.util.find_spec(f"robot_descriptions.{name}") is None:
        raise UserError(f"{text}: no such description; `robot_descriptions list` names them, e.g. leap_hand_v1")
    try:
        found = importlib.import_module(f"robot_descriptions.{name}")  # clones its repository, where it has none yet
    except Exception as error:  # of git, the network, or the file system
        raise UserError(f"{text}: {type(error).__name__}: {str(error).strip().splitlines()[-1]}") from None
    path = getattr(found, "MJCF_PATH", None) or getattr(found, "URDF_PATH", None)
    if path is None:
        raise UserError(f"{text}: has neither an MJCF nor a URDF file")
    return Path(path)
