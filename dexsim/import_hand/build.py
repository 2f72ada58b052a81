"""The hand's own model, written anew: what the source says of bodies and joints, with dexsim's collision shapes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

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
    """xml: the text of model.xml; meshes: OBJ text by file name, in meshes/; tip_geoms: name of each finger's."""

    xml: str
    meshes: dict[str, str] = field(default_factory=dict)
    tip_geoms: list[str] = field(default_factory=list)

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
    everyone = 0
    for bit in bits:
        everyone |= bit

    def own(body: int) -> int:
        return bits[owner[body]] if owner.get(body, -1) >= 0 else bits[-1]

    files: list[str] = []
    lines: list[str] = []
    tip_of = {f.tip: k for k, f in enumerate(tree.fingers)}

    def emit(b: int, depth: int) -> None:
        pad = "  " * depth
        at = "" if b == tree.palm else f' pos="{_n(m.body_pos[b])}" quat="{_n(m.body_quat[b])}"'
        lines.append(f'{pad}<body name="{_t(m.body(b).name)}"{at}>')
        inner = pad + "  "
        if m.body_mass[b] > 0:
            lines.append(
                f'{inner}<inertial pos="{_n(m.body_ipos[b])}" quat="{_n(m.body_iquat[b])}" mass="{_n(m.body_mass[b])}"'
                f' diaginertia="{_n(m.body_inertia[b])}"/>'
            )
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]) if b != tree.palm else ():
            joint = m.joint(j).name
            kind = "" if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE else ' type="slide"'
            lines.append(
                f'{inner}<joint name="{_t(joint)}"{kind} pos="{_n(m.jnt_pos[j])}" axis="{_n(m.jnt_axis[j])}"'
                f' range="{_n(m.jnt_range[j])}" armature="{_n(figures.armature[joint])}"'
                f' damping="{_n(figures.damping[joint])}"{_spring(m, j)}{_rubs(m, j, tree)}/>'
            )
        for n, c in enumerate(c for c in shapes.capsules if c.body == b):
            others = everyone & ~own(b)
            lines.append(inner + _capsule(f"link_{m.body(b).name}_{n}", c, HAND_BIT | own(b), OBJECT_BIT | others))
        if b in tip_of:
            k = tip_of[b]
            finger = tree.fingers[k].name
            out.meshes[f"tip_{finger}.obj"] = surface.obj(surface.hull(shapes.cores[k]))
            files.append(f"tip_{finger}.obj")
            out.tip_geoms.append(f"tip_{finger}")
            lines.append(
                f'{inner}<geom class="tip" name="tip_{finger}" mesh="tip_{finger}" contype="{HAND_BIT}"'
                f' conaffinity="{OBJECT_BIT}"/>'
            )
            others = everyone & ~own(b)
            for n, c in enumerate(c for c in shapes.proxies if c.body == b):
                lines.append(inner + _capsule(f"self_{finger}_{n}", c, own(b), others))
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
            out.meshes[file] = surface.obj(look)
            files.append(file)
            lines.append(
                f'{inner}<geom class="visual" name="visual_{_t(m.body(b).name)}_{n}" mesh="{file.removesuffix(".obj")}"'
                f' rgba="{_colour(m, g)}"/>'
            )
        for child in bodies:
            if m.body_parentid[child] == b:
                emit(child, depth + 1)
        lines.append(f"{pad}</body>")

    emit(tree.palm, 2)
    drums, tendons, equalities = _ties(m, tree, figures, pulls)
    lines[-1:-1] = drums
    order = {f"tip_{f.name}": k for k, f in enumerate(tree.fingers)}
    out.tip_geoms.sort(key=lambda g: order[g])
    assets = "\n".join(f'    <mesh name="{f.removesuffix(".obj")}" file="{f}" inertia="shell"/>' for f in files)
    excluding = "\n".join(f'    <exclude body1="{_t(a)}" body2="{_t(b)}"/>' for a, b in excluded)
    out.xml = _TEMPLATE.format(
        name=_t(name), note=re.sub("-{2,}", "-", note), assets=assets, bodies="\n".join(lines), solref=SOLREF,
        margin=MARGIN,
        contact=(f"\n  <contact>\n{excluding}\n  </contact>" if excluding else "") + tendons + equalities,
    )  # fmt: skip
    return out


def _spring(m: mujoco.MjModel, j: int) -> str:
    """Return what a joint is where the model is drawn, and its spring, where it has them."""
    at = int(m.jnt_qposadr[j])
    said = [("ref", m.qpos0[at]), ("stiffness", m.jnt_stiffness[j])]
    if m.jnt_stiffness[j]:
        said.append(("springref", m.qpos_spring[at]))
    return "".join(f' {key}="{_n(value)}"' for key, value in said if value)


def _rubs(m: mujoco.MjModel, j: int, tree: Tree) -> str:
    """Return dry friction of a joint without a drive: that of driven ones is their servo's."""
    level = m.dof_frictionloss[m.jnt_dofadr[j]]
    return f' frictionloss="{_n(level)}"' if j in tree.passive and level else ""


def _ties(m: mujoco.MjModel, tree: Tree, figures: Figures, pulls: Sequence[Pull]) -> tuple[list[str], str, str]:
    """Return lines of the drums, and the tendons and equalities that tie the hand's joints, as MJCF."""
    names = {m.joint(j).name for j in tree.every}
    drums, tendons, ties, driven = [], [], [], set()
    for pull in pulls:
        at = sum(c * m.qpos0[m.joint(j).qposadr[0]] for j, c in pull.arms.items())
        drum = _t(f"{DRIVE}{pull.name}")
        drums.append(
            f'      <body name="{drum}"><inertial pos="0 0 0" mass="1e-4" diaginertia="1e-9 1e-9 1e-9"/><joint'
            f' name="{_t(pull.name)}" axis="0 0 1" range="{_n(pull_range(m, pull))}" ref="{_n(at)}"'
            f' armature="{_n(figures.armature[pull.name])}" damping="{_n(figures.damping[pull.name])}"/></body>'
        )
        along = "".join(f'<joint joint="{_t(j)}" coef="{_n(c)}"/>' for j, c in {**pull.arms, pull.name: -1.0}.items())
        tendons.append(f'    <fixed name="{drum}">{along}</fixed>')
        ties.append(f'    <tendon tendon1="{drum}" solref="{TIE}"/>')
    for t in range(m.ntendon):
        wraps = range(m.tendon_adr[t], m.tendon_adr[t] + m.tendon_num[t])
        arms = {m.joint(m.wrap_objid[w]).name: m.wrap_prm[w] for w in wraps}
        still = sum(c * m.qpos0[m.joint(j).qposadr[0]] for j, c in arms.items() if j not in names)
        arms = {j: c for j, c in arms.items() if j in names}
        if not arms:
            continue
        driven.add(t)
        along = "".join(f'<joint joint="{_t(j)}" coef="{_n(c)}"/>' for j, c in arms.items())
        own = "".join(f' {key}="{_n(value)}"' for key, value in (
            ("stiffness", m.tendon_stiffness[t]), ("damping", m.tendon_damping[t]),
            ("armature", m.tendon_armature[t]), ("frictionloss", m.tendon_frictionloss[t])) if value)  # fmt: skip
        if m.tendon_stiffness[t]:
            own += f' springlength="{_n(m.tendon_lengthspring[t] - still)}"'
        if m.tendon_limited[t]:
            own += f' range="{_n(m.tendon_range[t] - still)}"'
        tendons.append(f'    <fixed name="{_t(m.tendon(t).name or f"tendon_{t}")}"{own}>{along}</fixed>')
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
        both = " ".join(f'{what}{n}="{_t(x)}"' for n, x in enumerate(of, 1))
        ties.append(f'    <{what} {both} polycoef="{_n(m.eq_data[e, :5])}" solref="{TIE}"/>')
    return (
        drums,
        "\n  <tendon>\n" + "\n".join(tendons) + "\n  </tendon>" if tendons else "",
        "\n  <equality>\n" + "\n".join(ties) + "\n  </equality>" if ties else "",
    )


def pull_range(m: mujoco.MjModel, pull: Pull) -> tuple[float, float]:
    """Return least and largest length of a pulled tendon: what its joints' limits leave, or the file's own range
    within."""
    ends = np.array([np.sort(c * m.jnt_range[m.joint(j).id]) for j, c in pull.arms.items()]).sum(0)
    low, high = (float(x) for x in ends)
    if pull.range is not None and low < pull.range[1] and pull.range[0] < high:
        low, high = max(low, pull.range[0]), min(high, pull.range[1])
    return low, high


def _capsule(name: str, c: Capsule, contype: int, conaffinity: int) -> str:
    bits = f'contype="{contype}" conaffinity="{conaffinity}"'
    if np.linalg.norm(c.b - c.a) < 1e-4:
        return f'<geom class="link" name="{_t(name)}" type="sphere" pos="{_n(c.a)}" size="{_n(c.radius)}" {bits}/>'
    ends = _n([*c.a, *c.b])
    return f'<geom class="link" name="{_t(name)}" type="capsule" fromto="{ends}" size="{_n(c.radius)}" {bits}/>'


def _colour(m: mujoco.MjModel, g: int) -> str:
    k = m.geom_matid[g]
    rgba = m.mat_rgba[k] if k >= 0 else m.geom_rgba[g]
    if k < 0 and np.allclose(rgba, [0.5, 0.5, 0.5, 1]):
        return PLAIN
    return _n([*np.clip(rgba[:3], 0.3, 1), 1.0])


def _n(values: ArrayLike) -> str:
    return " ".join(f"{float(x) + 0.0:.8g}" for x in np.atleast_1d(values))


def _t(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


def _safe(text: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in text)


_TEMPLATE = """\
<!-- {note} -->
<mujoco model="{name}">
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
  <asset>
{assets}
  </asset>
  <worldbody>
{bodies}
  </worldbody>{contact}
</mujoco>
"""
