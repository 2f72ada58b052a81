"""A URDF as MuJoCo should read it: meshes found, frames and visuals kept; and what MuJoCo does not read of it."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dexsim import files
from dexsim.errors import UserError

READS = (".stl", ".obj", ".msh")
"""Mesh files that MuJoCo reads."""


@dataclass
class Urdf:
    """text: for MuJoCo, mesh files as absolute paths; speeds: rad/s by joint, of its limits; limits: rad or m by joint,
    as they stand there; bare: moving links without an inertia."""

    text: str
    speeds: dict[str, float] = field(default_factory=dict)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    bare: list[str] = field(default_factory=list)


def is_urdf(path: Path) -> bool:
    """Return whether a model file's root element is `robot`. Raises UserError for one that is neither URDF nor MJCF."""
    return _root(path).tag == "robot"


def _root_of_any(path: Path, what: str = "mesh") -> ET.Element:
    return ET.fromstring(files.text(path, what, files.MAX_FILE))


def _root(path: Path) -> ET.Element:
    try:
        root = _root_of_any(path, "model")
    except UserError:
        raise
    except (ET.ParseError, ValueError, LookupError) as error:  # the latter two of an encoding
        what = "a xacro program's input? run xacro on it first" if path.suffix == ".xacro" else "URDF or MJCF is needed"
        raise UserError(f"model {path}: is not XML ({error}); {what}") from None
    if root.tag == "mujocoinclude":
        raise UserError(
            f"model {path}: its root element is <mujocoinclude>: a part of a model; give the file that includes it"
        )
    if root.tag not in ("robot", "mujoco"):
        raise UserError(
            f"model {path}: its root element is <{root.tag}>; a robot's is <robot> (URDF) or <mujoco> (MJCF)"
        )
    return root


def read(path: Path, packages: Sequence[Path], scratch: Path) -> Urdf:
    """Return the URDF at `path`. packages: folders in which package://NAME/ is looked for, beside those above the file;
    scratch: where meshes go that MuJoCo does not read. Raises UserError for missing meshes, and for masses, limits,
    efforts and speeds that are none."""
    root = _root(path)
    out = Urdf("")
    words = [v for e in root.iter() for v in (*e.attrib.values(), e.tag if e.tag.startswith("{") else "")]
    if any("xacro" in v and v.startswith("{") or "${" in v or "$(" in v for v in words):
        raise UserError(f"model {path}: has xacro macros in it; run xacro on it first: xacro {path.name} > robot.urdf")
    for tag in ("link", "joint"):
        names = [e.get("name", "") for e in root.findall(tag)]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise UserError(f"model {path}: two {tag}s have the name '{twice[0]}'; every {tag} needs a name of its own")
    converted: dict[Path, Path] = {}
    for mesh in root.iter("mesh"):
        name = mesh.get("filename") or ""
        found = _find(path, name, packages)
        if found.suffix.lower() not in READS or _ascii_stl(found):
            if found not in converted:
                converted[found] = _convert(found, scratch / f"{found.stem}_{len(converted)}.obj")
            found = converted[found]
        mesh.set("filename", str(found))
    for element in root.findall("mujoco"):
        root.remove(element)
    options = ET.SubElement(ET.SubElement(root, "mujoco"), "compiler")
    for key in ("fusestatic", "discardvisual", "strippath"):
        options.set(key, "false")
    for material in root.iter("material"):  # a texture is only looks, and often not there
        for texture in material.findall("texture"):
            material.remove(texture)
    moved = set()
    moves = {joint.get("name"): joint.get("type") for joint in root.findall("joint")}
    for joint in root.findall("joint"):
        name, kind = joint.get("name", ""), joint.get("type", "")
        child, limit = joint.find("child"), joint.find("limit")
        if kind != "fixed" and child is not None:
            moved.add(child.get("link", ""))
        for mimic in joint.findall("mimic"):
            if moves.get(other := mimic.get("joint", "")) in (None, "fixed"):
                why = "does not move" if other in moves else "is no joint of the file"
                raise UserError(f"model {path}: joint '{name}' mimics '{other}', which {why}: name one that moves, or"
                                f" make '{name}' type=\"fixed\"")  # fmt: skip
        if limit is not None:
            where = f"model {path}: joint '{name}': <limit"
            most = "a number above 0; 0, or nothing, where it is not known"
            low, high = (_number(f"{where} {k}=", limit.get(k)) for k in ("lower", "upper"))
            if kind != "continuous":
                out.limits[name] = low, high
            _number(f"{where} effort=", limit.get("effort"), f"{most} (N m, of a slide N)", 0.0)
            speed = _number(f"{where} velocity=", limit.get("velocity"), f"{most} (rad/s, of a slide m/s)", 0.0)
            if speed > 0:
                out.speeds[name] = speed
    for link in root.findall("link"):
        name, inertial, mass = link.get("name", ""), link.find("inertial"), 0.0
        where = f"model {path}: link '{name}': <"
        for moments in link.iterfind("inertial/inertia"):
            for key, text in moments.items():
                _number(f"{where}inertia {key}=", text)
        for element in link.iterfind("inertial/mass"):
            allowed = "a number of kg, above 0 of a link that moves"
            mass = _number(f"{where}mass value=", element.get("value"), allowed, 0.0)
        if name in moved and not mass:
            out.bare.append(name)
            if inertial is not None:
                link.remove(inertial)
    out.text = ET.tostring(root, encoding="unicode")
    return out


def _find(path: Path, name: str, packages: Sequence[Path]) -> Path:
    """Find the mesh file that a URDF names: package://, file://, relative to the file."""
    if not name:
        raise UserError(f"model {path}: a <mesh> without filename=")
    plain = name.removeprefix("file://")
    places = [*packages, path.parent, *path.parent.parents]
    if name.startswith("package://"):
        package, _, rest = name.removeprefix("package://").partition("/")
        tries = [p / package / rest for p in places] + [p / rest for p in places]
    else:
        tries = [path.parent / plain, *(p / plain for p in packages)]
    for there in tries:
        if there.is_file():
            return there.resolve()
    hint = (
        "packages=FOLDER says where packages are" if name.startswith("package://") else "paths are relative to the file"
    )
    raise UserError(f"model {path}: mesh {name}: no such file (looked first at {tries[0]}); {hint}")


def _ascii_stl(path: Path) -> bool:
    if path.suffix.lower() != ".stl":
        return False
    with open(path, "rb") as file:
        head = file.read(512)
    return head[:5] == b"solid" and b"facet" in head


def _convert(path: Path, to: Path) -> Path:
    """Write a mesh file that MuJoCo does not read as OBJ; return it."""
    import trimesh

    try:
        mesh: Any = trimesh.load(path, force="mesh")  # a Trimesh, or what has no faces
        if not len(mesh.faces):
            raise ValueError("it holds no triangles")
        if path.suffix.lower() == ".dae":  # trimesh leaves its <unit> alone
            mesh.apply_scale(_collada_unit(path))
        mesh.export(to, include_texture=False)
    except Exception as error:  # trimesh raises whatever its reader for the format does
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(
            f"mesh {path}: cannot be read ({reason[:120]}); save it as .stl or .obj (Blender: File > Export)"
        ) from None
    return to


def _collada_unit(path: Path) -> float:
    """Return metres a unit of a COLLADA file."""
    unit = _root_of_any(path).find("{*}asset/{*}unit")
    metres = float((unit.get("meter") if unit is not None else None) or 1.0)
    if not 0 < metres < math.inf:
        raise ValueError(f"its <unit meter=> is {metres:g}")
    return metres


def _number(what: str, text: str | None, allowed: str = "a finite number", low: float = -math.inf) -> float:
    """Return a finite number, not below low; 0 where there is none. what: the file, the element and "<tag key="."""
    try:
        value = float(text or 0.0)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < low:
        raise UserError(f'{what}"{text}">: must be {allowed}')
    return value
