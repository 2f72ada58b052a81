"""The hand's own model, written anew: what the source says of bodies and joints, with dexsim's collision shapes."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dexsim import surface
from dexsim.hand.model import DRIVE
from dexsim.import_hand import geometry
from dexsim.import_hand.drives import Pull
from dexsim.import_hand.figures import Figures
from dexsim.import_hand.shapes import MARGIN, Capsule, Shapes
from dexsim.import_hand.tree import Tree

OBJECT_BIT, HAND_BIT = 1, 2  # as dexsim.hand.model has them: the bits above are the hand's own, about itself
FIRST_OWN = 2
TIE = "0.01 1"  # of what ties joints: as stiff as two physics steps allow
SOLREF = "0.005 1"
PLAIN = "0.62 0.64 0.67 1"


@dataclass
class Model:
    """xml: the text of model.xml; meshes: OBJ text by file name, in meshes/."""

    xml: str
    meshes: dict[str, str] = field(default_factory=dict)

    def compile(self) -> mujoco.MjModel:
        """Return the model, without files."""
        return mujoco.MjModel.from_xml_string(self.xml, {f"meshes/{n}": t.encode() for n, t in self.meshes.items()})

    def write(self, folder: Path, name: str = "model.xml") -> None:
        """Write the model and its meshes into a folder."""
        (folder / "meshes").mkdir(parents=True, exist_ok=True)
        for file, text in self.meshes.items():
            (folder / "meshes" / file).write_text(text, encoding="ascii")
        (folder / name).write_text(self.xml, encoding="utf-8")


def build(
    name: str, m: mujoco.MjModel, tree: Tree, shapes: Shapes, figures: Figures, excluded: list[tuple[str, str]],
    note: str, pulls: Sequence[Pull] = (),
) -> Model:  # fmt: skip
    """Return the MJCF of the hand: its root is the palm, which stands in the world's origin.

    Links meet those of other fingers and objects; a tip meets objects with its mesh and the hand with a capsule inside.
    excluded: pairs of bodies that do not meet each other. pulls: actuators that pull a tendon, each a drum on the
    palm whose angle is the tendon's length.
    """
    out = Model("")
    owner: dict[int, int] = {}  # body -> finger
    for k, finger in enumerate(tree.fingers):
        b = finger.tip
        while b != tree.palm:
            owner.setdefault(b, k)
            b = int(m.body_parentid[b])
    bodies = [b for b in range(m.nbody) if tree.palm in geometry.path(m, b)]
    for b in bodies:
        if b != tree.palm and b not in owner:
            parent = int(m.body_parentid[b])
            owner[b] = owner.get(parent, -1)
    fingers = len(tree.fingers)
    bits = [1 << (FIRST_OWN + min(k, 27)) for k in range(fingers)] + [1 << (FIRST_OWN + min(fingers, 28))]
    everyone = sum(set(bits))
    root = ET.fromstring(_TEMPLATE.format(solref=SOLREF, margin=MARGIN))
    root.set("model", name)
    assets, tip_of = root.find("asset"), {f.tip: k for k, f in enumerate(tree.fingers)}

    def mesh(file: str, look: surface.Surface) -> str:
        out.meshes[file] = surface.obj(look)
        known = file.removesuffix(".obj")
        _put(assets, "mesh", name=known, file=file, inertia="shell")
        return known

    def emit(b: int, parent: Any) -> Any:
        body = _put(parent, "body", name=m.body(b).name)
        if b != tree.palm:
            body.attrib |= {"pos": _n(m.body_pos[b]), "quat": _n(m.body_quat[b])}
        if m.body_mass[b] > 0:
            _put(body, "inertial", pos=m.body_ipos[b], quat=m.body_iquat[b], mass=m.body_mass[b],
                 diaginertia=m.body_inertia[b])  # fmt: skip
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]) if b != tree.palm else ():
            joint, slides = m.joint(j).name, m.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE
            _put(body, "joint", name=joint, type="slide" if slides else None, pos=m.jnt_pos[j], axis=m.jnt_axis[j],
                 range=m.jnt_range[j], armature=figures.armature[joint], damping=figures.damping[joint],
                 **_spring(m, j), frictionloss=_rubs(m, j, tree))  # fmt: skip
        own = bits[owner.get(b, -1)]  # the last one: of no finger
        others = everyone & ~own
        for n, c in enumerate(c for c in shapes.capsules if c.body == b):
            _capsule(body, f"link_{m.body(b).name}_{n}", c, HAND_BIT | own, OBJECT_BIT | others)
        if b in tip_of:
            k = tip_of[b]
            tip = f"tip_{tree.fingers[k].name}"
            known = mesh(f"{tip}.obj", surface.hull(shapes.cores[k]))
            _put(body, "geom", class_="tip", name=tip, mesh=known, contype=HAND_BIT, conaffinity=OBJECT_BIT)
            for n, c in enumerate(c for c in shapes.proxies if c.body == b):
                _capsule(body, f"self_{tree.fingers[k].name}_{n}", c, own, others)
        drawn = geometry.seen(m, b)
        if b in tip_of and len(tree.fingers[tip_of[b]].geoms) < len(geometry.solid(m, b)):
            drawn = [*drawn, *(g for g in tree.fingers[tip_of[b]].geoms if g not in drawn)]  # a rubber tip of its own
        for n, g in enumerate(drawn):
            look = surface.geom_surface(m, g)
            if not len(look[1]):
                continue
            file = f"{_safe(m.body(b).name)}_{n}.obj"
            while file.lower() in {other.lower() for other in out.meshes}:  # names that differ in a dot or a case alone
                file = f"_{file}"
            _put(body, "geom", class_="visual", name=f"visual_{m.body(b).name}_{n}", mesh=mesh(file, look),
                 rgba=_colour(m, g))  # fmt: skip
        for child in bodies:
            if m.body_parentid[child] == b:
                emit(child, body)
        return body

    palm = emit(tree.palm, root.find("worldbody"))
    for one, other in excluded:
        _put(_section(root, "contact"), "exclude", body1=one, body2=other)
    _ties(m, tree, figures, pulls, palm, root)
    ET.indent(root)
    note = re.sub("-{2,}", "-", note)
    out.xml = f"<!-- {note} -->\n{ET.tostring(root, encoding='unicode')}\n"
    return out


def _put(parent: Any, kind: str, **said: Any) -> Any:
    """Append an element with those attributes that are not None, and return it; class_ stands for class."""
    text = {k.rstrip("_"): str(v) if isinstance(v, (str, int)) else _n(v) for k, v in said.items() if v is not None}
    return ET.SubElement(parent, kind, text)


def _section(root: ET.Element, name: str) -> Any:
    """Return a section of the model, made where it is not there yet."""
    found = root.find(name)
    return ET.SubElement(root, name) if found is None else found


def _spring(m: mujoco.MjModel, j: int) -> dict[str, float]:
    """Return what a joint is where the model is drawn, and its spring, where it has them."""
    at, stiff = int(m.jnt_qposadr[j]), m.jnt_stiffness[j]
    said = {"ref": m.qpos0[at], "stiffness": stiff, "springref": m.qpos_spring[at] if stiff else 0.0}
    return {key: value for key, value in said.items() if value}


def _rubs(m: mujoco.MjModel, j: int, tree: Tree) -> float | None:
    """Return dry friction of a joint without a drive: that of driven ones is their servo's."""
    level = float(m.dof_frictionloss[m.jnt_dofadr[j]])
    return level if j in tree.passive and level else None


def _ties(
    m: mujoco.MjModel, tree: Tree, figures: Figures, pulls: Sequence[Pull], palm: ET.Element, root: ET.Element
) -> None:
    """Add the drums to the palm, and to the model the tendons and equalities that tie the hand's joints."""
    names, driven = {m.joint(j).name for j in tree.every}, set()

    def tendon(name: str, arms: Mapping[str, float], **own: Any) -> None:
        fixed = _put(_section(root, "tendon"), "fixed", name=name, **own)
        for joint, coef in arms.items():
            _put(fixed, "joint", joint=joint, coef=coef)

    for pull in pulls:
        at = sum(c * m.qpos0[m.joint(j).qposadr[0]] for j, c in pull.arms.items())
        drum = _put(palm, "body", name=f"{DRIVE}{pull.name}")
        _put(drum, "inertial", pos="0 0 0", mass="1e-4", diaginertia="1e-9 1e-9 1e-9")
        _put(drum, "joint", name=pull.name, axis="0 0 1", range=pull_range(m, pull), ref=at,
             armature=figures.armature[pull.name], damping=figures.damping[pull.name])  # fmt: skip
        tendon(f"{DRIVE}{pull.name}", {**pull.arms, pull.name: -1.0})
        _put(_section(root, "equality"), "tendon", tendon1=f"{DRIVE}{pull.name}", solref=TIE)
    for t in range(m.ntendon):
        wraps = range(m.tendon_adr[t], m.tendon_adr[t] + m.tendon_num[t])
        arms = {m.joint(m.wrap_objid[w]).name: m.wrap_prm[w] for w in wraps}
        still = sum(c * m.qpos0[m.joint(j).qposadr[0]] for j, c in arms.items() if j not in names)
        arms = {j: c for j, c in arms.items() if j in names}
        if not arms:
            continue
        driven.add(t)
        own = {key: getattr(m, f"tendon_{key}")[t] or None for key in ("stiffness", "damping", "armature",
                                                                       "frictionloss")}  # fmt: skip
        if m.tendon_stiffness[t]:
            own["springlength"] = m.tendon_lengthspring[t] - still
        if m.tendon_limited[t]:
            own["range"] = m.tendon_range[t] - still
        tendon(m.tendon(t).name or f"tendon_{t}", arms, **own)
    for e in range(m.neq):
        pair = [int(m.eq_obj1id[e]), int(m.eq_obj2id[e])]
        if m.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT:
            what, of = "joint", [m.joint(k).name for k in pair if k >= 0 and m.joint(k).name in names]
            if m.joint(pair[0]).name not in names:
                continue
        else:
            what, of = "tendon", [m.tendon(k).name or f"tendon_{k}" for k in pair if k in driven]
            if pair[0] not in driven:
                continue
        both = {f"{what}{n}": x for n, x in enumerate(of, 1)}
        _put(_section(root, "equality"), what, **both, polycoef=m.eq_data[e, :5], solref=TIE)


def pull_range(m: mujoco.MjModel, pull: Pull) -> tuple[float, float]:
    """Return least and largest length of a pulled tendon: what its joints' limits leave, or the file's own range
    within."""
    ends = np.array([np.sort(c * m.jnt_range[m.joint(j).id]) for j, c in pull.arms.items()]).sum(0)
    low, high = (float(x) for x in ends)
    if pull.range is not None and low < pull.range[1] and pull.range[0] < high:
        low, high = max(low, pull.range[0]), min(high, pull.range[1])
    return low, high


def _capsule(body: ET.Element, name: str, c: Capsule, contype: int, conaffinity: int) -> None:
    ball = np.linalg.norm(c.b - c.a) < 1e-4
    place = {"type": "sphere", "pos": c.a} if ball else {"type": "capsule", "fromto": [*c.a, *c.b]}
    _put(body, "geom", class_="link", name=name, **place, size=c.radius, contype=contype, conaffinity=conaffinity)


def _colour(m: mujoco.MjModel, g: int) -> str:
    k = m.geom_matid[g]
    rgba = m.mat_rgba[k] if k >= 0 else m.geom_rgba[g]
    if k < 0 and np.allclose(rgba, [0.5, 0.5, 0.5, 1]):
        return PLAIN
    return _n([*np.clip(rgba[:3], 0.3, 1), 1.0])


def _n(values: ArrayLike) -> str:
    return " ".join(f"{float(x) + 0.0:.8g}" for x in np.atleast_1d(values))


def _safe(text: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in text)


_TEMPLATE = """\
<mujoco>
  <compiler angle="radian" meshdir="meshes" autolimits="true"/>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default>
    <default class="visual">
      <geom type="mesh" contype="0" conaffinity="0" group="2" mass="0"/>
    </default>
    <default class="link">
      <geom group="3" mass="0" condim="3" friction="0.8 0.003 0.0001" solref="{solref}" rgba="0.9 0.5 0.2 0.4"/>
    </default>
    <default class="tip">
      <geom type="mesh" group="3" mass="0" condim="4" priority="1" friction="0.9 0.003 0.0001" solref="{solref}"
        margin="{margin}" rgba="0.2 0.7 0.4 0.5"/>
    </default>
  </default>
  <asset/>
  <worldbody/>
</mujoco>
"""
