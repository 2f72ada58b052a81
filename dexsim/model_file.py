"""MuJoCo models of strangers, read within limits (`dexsim.guard`)."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np

from dexsim import files, guard
from dexsim.errors import UserError

Edit = Callable[[mujoco.MjSpec], None] | None
MAX_BESIDE = 256 << 20
"""Bytes of meshes, with which the limits of reading grow at most."""
MAX_DOFS = 1000
"""Degrees of freedom of a model."""


def read(path: Path, where: str, edit: Edit = None) -> mujoco.MjSpec:
    """Return the model of an MJCF or URDF file, as `edit` changes it, which compiles. where: what the file is, for
    messages. Raises UserError."""
    if not guard.ours(path):
        files.check(path, f"{where}:")
        for text in guard.call(_tried, path, where, edit, what=where, size=weight(path)):
            print(f"warning: {where}: {text}", file=sys.stderr)
    with warned():
        spec = parsed(path)
    if edit is not None:
        edit(spec)
    return spec


def weight(path: Path, root: Path | None = None) -> int:
    """Return bytes of the files that a model names, and of those that these name, relative to `root` too: what reading
    it may take grows with them."""
    text = path.read_text(encoding="utf-8", errors="replace")
    own = {path.parent, root or path.parent}
    folders = [f / d for f in own for d in ("", *re.findall(r'(?:mesh|asset|texture)dir="([^"]+)"', text))]
    total = 0
    for package, name in set(re.findall(r'\bfile(?:name)?="(?:file://|(package://))?([^"]+)"', text)):
        rest = name, name.partition("/")[2]
        tries = [p / r for p in path.parents for r in rest] if package else [f / name for f in folders]
        there = next((f for f in tries if os.path.isfile(f)), path)  # not Path's, which raises for a long name
        if there != path:
            total += files.stored(about := there.stat())
            if there.suffix in (".xml", ".mjcf") and root is None and about.st_size < files.MAX_FILE:
                total += weight(there, path.parent)  # one level of files that are included
    return min(total, MAX_BESIDE)


def _tried(path: Path, where: str, edit: Edit) -> list[str]:
    """Return MuJoCo's warnings of a model that compiles and of its first step."""
    try:
        with warned() as said:
            spec = parsed(path)
            if edit is not None:
                edit(spec)
            step(spec.compile(), where)
    except ValueError as error:
        raise UserError(error if isinstance(error, UserError) else f"{where}: {error}") from None
    return list(dict.fromkeys(said))


def step(model: mujoco.MjModel, where: str) -> None:
    """Make a step, to see that one ends. Raises UserError for a model that is too large to be simulated, or has figures
    that no body has."""
    if model.nv > MAX_DOFS:
        raise UserError(f"{where}: has {model.nv:,} degrees of freedom; at most {MAX_DOFS:,} are simulated")
    _physical(model, where)
    mujoco.mj_step(model, mujoco.MjData(model))


def _physical(m: mujoco.MjModel, where: str) -> None:
    """Raise UserError for figures that would be fitted around in silence: MuJoCo's reader takes "nan" and -0.1."""
    dof = [m.joint(j) for j in m.dof_jntid]
    for what, values, low, high, whose in (
        ("gravity", m.opt.gravity[None], -100.0, 100.0, None), ("mass", m.body_mass, 0.0, 1e6, m.body),
        ("inertia", m.body_inertia, 0.0, 1e6, m.body), ("position", m.body_pos, -1e4, 1e4, m.body),
        ("orientation", m.body_quat, -1e4, 1e4, m.body), ("centre of mass", m.body_ipos, -1e4, 1e4, m.body),
        ("axis", m.jnt_axis, -1e4, 1e4, m.joint), ("range", m.jnt_range, -1e6, 1e6, m.joint),
        ("stiffness", m.jnt_stiffness, 0.0, 1e6, m.joint), ("armature", m.dof_armature, 0.0, 1e6, dof.__getitem__),
        ("damping", m.dof_damping, 0.0, 1e6, dof.__getitem__), ("size", m.geom_size, -1e6, 1e6, m.geom),
        ("frictionloss", m.dof_frictionloss, 0.0, 1e6, dof.__getitem__), ("position", m.geom_pos, -1e4, 1e4, m.geom),
    ):  # fmt: skip
        rows = np.atleast_2d(np.asarray(values, float).T).T
        bad = np.flatnonzero(~((rows >= low) & (rows <= high)).all(1))
        for k in bad[:1].tolist():
            name = f" of '{whose(k).name or k}'" if whose else ""
            said = " ".join(f"{x:g}" for x in rows[k])
            raise UserError(f"{where}: {what}{name} is {said}: must be numbers from {low:g} to {high:g}")


def parsed(path: Path) -> mujoco.MjSpec:
    """Return MuJoCo's reading of an MJCF or URDF file, whatever its name ends in: the root element says what it is.
    Raises ValueError, as MuJoCo does. Ask for it within limits (`dexsim.guard`)."""
    if path.suffix.lower() in (".xml", ".urdf"):
        return mujoco.MjSpec.from_file(str(path))
    included: dict[str, bytes] = {}
    waiting = [path.read_bytes()]
    while waiting:
        try:
            root = ET.fromstring(waiting.pop())
        except ET.ParseError as error:
            raise ValueError(f"{path.name}, or what it includes, is not XML: {error}") from None
        for name in {e.get("file", "") for e in root.iter("include")} - included.keys():
            if (path.parent / name).is_file():
                included[name] = (path.parent / name).read_bytes()
                waiting.append(included[name])
    spec = mujoco.MjSpec.from_string(path.read_text(encoding="utf-8"), include=included)
    spec.modelfiledir = str(path.parent)
    return spec


@contextlib.contextmanager
def warned() -> Iterator[list[str]]:
    """Yield what MuJoCo warns of meanwhile, a line each: else it says so on stderr without naming the file, and writes
    it to MUJOCO_LOG.TXT in whatever folder the user is in."""
    said: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: said.append(" ".join(str(text).split())))
    try:
        yield said
    finally:
        mujoco.set_mju_user_warning(before)
