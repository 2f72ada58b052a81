"""MuJoCo models of strangers: what MuJoCo would wait for, or build without end, is refused before it reads them."""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import mujoco

from dexsim import files
from dexsim.errors import UserError

MAX_MODEL = 64 << 20
"""Bytes of a model file."""
MAX_COPIES = 10_000
"""Of one element, by nested <replicate>."""
MAX_SIDE = 16_384
"""Pixels of a texture's side."""
MAX_INCLUDED = 50


def read(path: Path, where: str) -> mujoco.MjSpec:
    """The model of an MJCF or URDF file, which compiles. where: what the file is, for messages. Raises UserError."""
    check(path, where)
    try:
        with warned() as said:
            spec = parsed(path)
            spec.copy().compile()
    except (ValueError, RuntimeError) as error:
        raise UserError(f"{where}: {' '.join(str(error).split())}") from None
    for text in dict.fromkeys(said):
        print(f"warning: {where}: {text}", file=sys.stderr)
    return spec


def parsed(path: Path) -> mujoco.MjSpec:
    """MuJoCo's reading of an MJCF or URDF file, whatever its name ends in: the root element says what it is. Raises
    ValueError, as MuJoCo does. Give `check` the file first."""
    if path.suffix.lower() in (".xml", ".urdf"):
        return mujoco.MjSpec.from_file(str(path))
    included: dict[str, bytes] = {}
    waiting = [path]
    while waiting:
        file = waiting.pop()
        try:
            root = ET.fromstring(file.read_bytes())
        except ET.ParseError as error:
            raise ValueError(f"{file.name} is not XML: {error}") from None
        for element, name, places in _named(root, path.parent):
            if element.tag == "include" and name not in included:
                for place in places:
                    if place.is_file():
                        included[name] = place.read_bytes()
                        waiting.append(place)
                        break
    spec = mujoco.MjSpec.from_string(path.read_text(encoding="utf-8"), include=included)
    spec.modelfiledir = str(path.parent)
    return spec


@contextlib.contextmanager
def warned() -> Iterator[list[str]]:
    """What MuJoCo warns of meanwhile, a line each: else it says so on stderr without naming the file, and writes it to
    MUJOCO_LOG.TXT in whatever folder the user is in."""
    said: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: said.append(" ".join(str(text).split())))
    try:
        yield said
    finally:
        mujoco.set_mju_user_warning(before)


def check(path: Path, where: str) -> None:
    """Raise UserError where a model, or one that it includes, is no plain file or names one that is none (MuJoCo would
    wait for a pipe for ever), defines entities, or asks for more copies or pixels than a machine has room for."""
    waiting, seen = [path], set()
    while waiting:
        file = waiting.pop()
        if file in seen:
            continue
        seen.add(file)
        if len(seen) > MAX_INCLUDED:
            raise UserError(f"{where}: includes more than {MAX_INCLUDED} files")
        files.check(file, MAX_MODEL, f"{where}:")
        raw = file.read_bytes()
        if b"<!ENTITY" in raw:  # nothing that a robot needs, and a few of them can fill the memory
            raise UserError(f"{where}: {file.name} defines XML entities; write their values out")
        try:
            root = ET.fromstring(raw)
        except ET.ParseError:
            continue  # MuJoCo says where
        _sizes(root, f"{where}: {file.name}")
        for element, name, places in _named(root, path.parent):
            for place in places:
                try:
                    mode = os.stat(place).st_mode
                except (OSError, ValueError):
                    continue
                if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
                    raise UserError(
                        f"{where}: {file.name}: <{element.tag}> names {name}, a device, a pipe or a socket, not a file"
                    )
                if element.tag in ("include", "model") and stat.S_ISREG(mode):
                    waiting.append(place)


def _named(root: ET.Element, folder: Path) -> Iterator[tuple[ET.Element, str, list[Path]]]:
    """(element, name, where MuJoCo may look for it) of every file that a model names."""
    compiler = [c.get(k) for c in root.iter("compiler") for k in ("meshdir", "texturedir", "assetdir")]
    folders = [folder, *(folder / c for c in compiler if c)]
    for element in root.iter():
        for key, name in element.attrib.items():
            if not key.startswith("file") or not name:
                continue
            plain = name.removeprefix("file://").removeprefix("package://")
            names = {plain, plain.rpartition("/")[2]}  # of a URDF the folders are left off
            yield element, name, [f / n for f in folders for n in names if n]


def _sizes(root: ET.Element, where: str) -> None:
    waiting = [(root, 1)]
    while waiting:
        element, copies = waiting.pop()
        if element.tag == "replicate":
            copies *= max(_whole(element.get("count")), 1)
            if copies > MAX_COPIES:
                raise UserError(f"{where}: <replicate> asks for {copies:,} copies; at most {MAX_COPIES:,} are made")
        if element.tag == "texture":
            side = max(_whole(element.get("width")), _whole(element.get("height")))
            if side > MAX_SIDE:
                raise UserError(f"{where}: <texture> has a side of {side:,} pixels; at most {MAX_SIDE:,} are drawn")
        waiting += [(child, copies) for child in element]


def _whole(text: str | None) -> int:
    try:
        return int(text or 0)
    except ValueError:
        return 0  # MuJoCo says so
