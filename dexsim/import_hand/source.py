"""The robot as its author wrote it: one tree of bodies, read from URDF or MJCF and stripped of what a hand is not."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim import files, guard, model_file
from dexsim.errors import UserError
from dexsim.import_hand import drives, inertias, routed, ties, urdf
from dexsim.import_hand.drives import Drives
from dexsim.import_hand.inertias import Moments

ONE_DOF = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
FASTENED = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)


@dataclass
class Source:
    """model: of the hand alone. drives: what the file's actuators say; speeds: by joint, where the file says them
    (rad/s). bare: moving bodies whose inertia the file does not give. notes: what was left out, a line each. coupled:
    what ties joints, a line each; passive: joints that it moves; sensed: of these, the ones with a sensor of position.
    limits: [rad, m] by joint, as a URDF says them: MuJoCo leaves out what is none. mended: by body, the
    moments that no body has, for which the model has others."""

    path: Path
    model: mujoco.MjModel
    drives: Drives
    speeds: dict[str, float]
    bare: list[str]
    notes: list[str] = field(default_factory=list)
    coupled: list[str] = field(default_factory=list)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    mended: dict[str, Moments] = field(default_factory=dict)
    passive: set[str] = field(default_factory=set)
    sensed: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.path.stem


def read(
    path: Path, packages: Sequence[Path] = (), coupled: str = "keep", density: float | None = None,
    inertia: str | None = None,
) -> Source:  # fmt: skip
    """Return the robot in a URDF or MJCF file. packages: where package:// is looked for. coupled: "keep" what ties
    joints, or "independent": drive each by itself. density: kg/m3 of the shapes of links without an inertia. inertia:
    "shapes" takes one that is none from the link's shapes; else it is balanced, and stands in `Source.mended`.

    Raises UserError, one line, for what cannot be a hand: not XML, missing meshes, free or ball joints inside it,
    coupled joints, links without inertia, limits that are none.
    """
    size = files.check(path, "model") + model_file.weight(path)
    with tempfile.TemporaryDirectory(prefix="dexsim_import_") as scratch:
        given = path, packages, coupled, density, inertia, Path(scratch)
        return guard.call(_read, *given, what=f"model {path}", size=size)


def _read(
    path: Path, packages: Sequence[Path], coupled: str, density: float | None, inertia: str | None, scratch: Path
) -> Source:
    with model_file.warned() as said, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of textures, which are left out
        out = _source(path, packages, coupled, density, inertia, scratch)
    model_file.step(out.model, f"model {path}")
    out.notes += [f"MuJoCo warns: {text}" for text in dict.fromkeys(said)]
    return out


def _source(
    path: Path, packages: Sequence[Path], coupled: str, density: float | None, inertia: str | None, scratch: Path
) -> Source:
    speeds: dict[str, float] = {}
    bare: list[str] = []
    limits: dict[str, tuple[float, float]] = {}
    if urdf.is_urdf(path):
        text = urdf.read(path, packages, scratch)
        speeds, bare, limits = text.speeds, text.bare, text.limits
        spec = _parsed(path, lambda: mujoco.MjSpec.from_string(text.text))
    else:
        spec = _parsed(path, lambda: model_file.parsed(path))
        _meshes_there(spec, path)
    notes: list[str] = []
    _one_tree(spec, path, notes)
    _not_in_force(spec, notes)
    try:
        bent = {} if coupled == "independent" else routed.straighten(spec, notes)
    except (ValueError, RuntimeError) as error:  # of a file that MuJoCo does not compile
        raise UserError(f"model {path}: {_said(error)}") from error
    said = drives.read(spec)
    tied, passive = ties.read(spec, path, coupled, said.moved, bent)
    if coupled == "independent":
        said.pulls.clear()
    read = {s.objname for s in spec.sensors if s.type == mujoco.mjtSensor.mjSENS_JOINTPOS}
    notes += said.notes + drives.contacts(spec) + drives.unused(spec)
    _strip(spec, path, notes)
    for body in spec.bodies:
        if body.name in bare and body.joints and not _shaped(body):
            bare.remove(body.name)
            notes.append(f"link '{body.name}' has neither mass nor shape: {1e3 * inertias.SPECK:g} g taken")
            inertias.speck(body)
    mended = inertias.balanced(spec)
    if spec.compiler.balanceinertia:
        notes += [f"inertia of '{name}' is no body's: the mean of the three taken, as the file says" for name in mended]
        mended = {}
    if bare and density is None:
        first = ", ".join(bare[:5]) + (" ..." if len(bare) > 5 else "")
        no = [f"'{b.name}'" for b in spec.bodies if b.name in mended and b.joints]
        also = f"; and inertia=shapes or =balance, for the moments of {', '.join(no)} are no body's" if no else ""
        raise UserError(
            f"model {path}: link{'s' if len(bare) > 1 else ''} {first} without <inertial>, or without mass in it: give"
            f" mass and inertia, or density=1000 (kg/m3) to take those of the shapes{also if inertia is None else ''}"
        )
    for body in spec.bodies:
        if body.name in bare and density is not None:
            inertias.fill(body, density)
    if inertia == "shapes":
        inertias.from_shapes(spec, mended, path)
    model = _compiled(spec, path, notes)
    ties.give_limits(model)
    for j in range(model.njnt):
        if model.jnt_actfrclimited[j] and model.jnt_actfrcrange[j].max() > 0:
            name, most = model.joint(j).name, float(np.abs(model.jnt_actfrcrange[j]).max())
            said.effort[name] = min(said.effort.get(name, most), most)
    sensed = [model.joint(j).name for j in range(model.njnt) if model.joint(j).name in passive & read]
    return Source(path, model, said, speeds, bare, notes, tied, limits, mended, passive, sensed)


def _parsed(path: Path, read: Callable[[], mujoco.MjSpec]) -> mujoco.MjSpec:
    try:
        return read()
    except (ValueError, RuntimeError) as error:
        raise UserError(f"model {path}: {_said(error)}") from None


FIXES = (
    ("repeated name", "every link and joint needs a name of its own"),
    ("axis too small", "<axis> must not be 0 0 0"),
    ("URDF body not found", "the links must be one tree: the chain of parents of one of them comes back to it"),
    ("parent or child missing", "<parent link=> and <child link=> must name links of the file"),
    ("bad format in attribute", "must be a number, or as many as the attribute has"),
)
"""What MuJoCo says of a file, and what to do about it."""


def _said(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return "; ".join([text, *(fix for words, fix in FIXES if words in text)])


def _meshes_there(spec: mujoco.MjSpec, path: Path) -> None:
    for mesh in spec.meshes:
        if not mesh.file:
            continue
        name = Path(mesh.file).name if spec.strippath else mesh.file
        at = Path(spec.modelfiledir or path.parent) / (spec.meshdir or "") / name
        if not at.is_file() and not Path(mesh.file).is_file():
            raise UserError(f"model {path}: mesh '{mesh.name or mesh.file}': no such file {at}")


def _one_tree(spec: mujoco.MjSpec, path: Path, notes: list[str]) -> None:
    """Leave one tree with hinges: objects, floors and tables are not the hand."""

    trees = {b.name or f"body {k}": b for k, b in enumerate(spec.worldbody.bodies)}
    hands = [n for n, b in trees.items() if _hinges(b) >= 2]
    if len(hands) > 1:  # a door and a ball on six joints have no fingers
        hands = [n for n in hands if _ends(trees[n]) >= 2] or hands
    if not hands:
        raise UserError(
            f"model {path}: has no tree of bodies with two hinges or more; "
            f"{len(trees)} bodies, {len(list(spec.joints))} joints: this is not a hand"
        )
    if len(hands) > 1:
        raise UserError(
            f"model {path}: {len(hands)} trees with hinges ({', '.join(hands)}): leave one hand in the file"
        )
    for name, body in trees.items():
        if name != hands[0]:
            notes.append(f"left out: '{name}' (another tree)")
            spec.delete(body)
    for geom in list(spec.worldbody.geoms):
        notes.append(f"left out: geom '{geom.name or 'unnamed'}' of the world (a floor?)")
        spec.delete(geom)


def _not_in_force(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Take out equalities that the file switches off, and what fastens the hand's base to the world: it is held."""
    whole = _hinges(spec.worldbody)
    for equality in list(spec.equalities):
        ends = [_body_of(spec, n) for n in (equality.name1, equality.name2)]
        free = [b for b in ends if b is not None and b.name != "world"]
        if not equality.active:
            notes.append(f"left out: equality '{equality.name or equality.name1}', which the file switches off")
        elif equality.type in FASTENED and len(free) == 1 and _hinges(free[0]) == whole:
            notes.append(f"left out: what fastens '{free[0].name}' to the world: the hand's base is held")
        else:
            continue
        spec.delete(equality)


def _body_of(spec: mujoco.MjSpec, name: str) -> Any:
    """Return the body of this name, or that a site of this name is on; None: there is none."""
    site = spec.site(name) if name else None
    return site.parent if site is not None else spec.body(name) if name else None


def _strip(spec: mujoco.MjSpec, path: Path, notes: list[str]) -> None:
    """Take out what is not the hand's body, and what moves its base: that is held."""
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for group in (
        spec.sensors, spec.keys, spec.lights, spec.cameras, spec.excludes, spec.pairs, spec.skins, spec.sites,
    ):  # fmt: skip
        for item in list(group):
            spec.delete(item)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in list(spec.textures):
        spec.delete(texture)
    if list(spec.flexes):
        raise UserError(f"model {path}: has soft bodies (flex); only rigid links are simulated")
    hinges = _hinges(spec.worldbody)
    for k, body in enumerate(spec.bodies):
        if not body.name:
            body.name = f"body_{k}"
        for n, joint in enumerate(list(body.joints)):
            if joint.type not in ONE_DOF:
                kind = "free" if joint.type == mujoco.mjtJoint.mjJNT_FREE else "ball"
                if _hinges(body) == hinges:  # the hand's base
                    notes.append(f"left out: {kind} joint '{joint.name}' of '{body.name}': the hand's base is held")
                    spec.delete(joint)
                    continue
                raise UserError(
                    f"model {path}: joint '{joint.name}' of '{body.name}' is a {kind} joint inside the hand, whose"
                    " joints are hinges and slides: put hinges in its place, or take it out"
                )
            if not joint.name:
                joint.name = f"{body.name}_joint{n or ''}"
                notes.append(f"joint without a name on '{body.name}': called '{joint.name}'")


def _ends(body: Any) -> int:
    """Return bodies on joints, behind which nothing moves."""
    behind = sum(_ends(b) for b in body.bodies)
    return behind or int(any(j.type in ONE_DOF for j in body.joints))


def _shaped(body: Any) -> bool:
    """Return whether a body, or what is fixed to it, has a shape or a mass."""
    return bool(body.geoms) or body.mass > 0 or any(_shaped(b) for b in body.bodies if not b.joints)


def _hinges(body: Any) -> int:
    """Return hinges and slides on a body and below it."""
    return sum(j.type in ONE_DOF for j in body.joints) + sum(_hinges(b) for b in body.bodies)


def _compiled(spec: mujoco.MjSpec, path: Path, notes: list[str]) -> mujoco.MjModel:
    try:
        return spec.compile()
    except (ValueError, RuntimeError) as error:
        said = _said(error)
    if "volume" in said or "orient" in said.lower():
        # Volume and winding matter only where an inertia is to be had from the mesh.
        for mesh in spec.meshes:
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        try:
            model = spec.compile()
            notes.append(f"a mesh is not a closed, outward surface ({said[:120]}); taken as a thin shell")
            return model
        except (ValueError, RuntimeError) as error:
            said = _said(error)
    if "mjMINVAL" in said or "mass and inertia" in said:
        said += ": a moving link without mass; give its <inertial>"
    raise UserError(f"model {path}: {said}")
