"""Robots with features of MuJoCo's files that none needs: every element and attribute of its own schema, sizes up to
10^9."""

from __future__ import annotations

import functools
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from dexsim import guard
from dexsim.errors import UserError

HAND = """<mujoco><compiler angle="radian"/>
<asset><material name="m"/><mesh name="s" builtin="sphere" params="2"/></asset>
<worldbody><body name="palm"><geom name="g" type="box" size=".04 .04 .01" mass=".2"/><site name="p"/>
{fingers}</body></worldbody></mujoco>"""
FINGER = """<body name="{n}1" pos="{x} 0 .01">
<joint name="{n}a" axis="0 1 0" range="0 1.5" limited="true" armature=".001"/>
<geom type="capsule" size=".008" fromto="0 0 0 0 0 .04" mass=".03"/><body name="{n}2" pos="0 0 .04">
<joint name="{n}b" axis="0 1 0" range="0 1.5" limited="true" armature=".001"/>
<geom type="capsule" size=".008" fromto="0 0 0 0 0 .03" mass=".02"/></body></body>"""
WORDS = (
    "x", "palm", "xa", "x1", "g", "p", "m", "s", "true", "false", "auto", "none", "box", "sphere", "mesh", "hfield",
    "sdf", "plane", "capsule", "ball", "free", "slide", "hinge", "grid", "circle", "gmsh", "direct", "2d", "cube",
    "skybox", "gradient", "checker", "flat", "hemisphere", "cone", "wedge", "supertorus", "plate", "prism", "full",
    "trilinear", "quadratic", "radial", "implicit", "Euler", "Newton", "elliptic", "exact", "shell", "convex",
    "mujoco.elasticity.cable", "mujoco.sdf.gear", "/dev/zero", "case.xml", ".", "image/png", "nan", "inf", "", "-1",
    "1e308", "0x10", "1;2", "a" * 3000, "\u00e9\u202e",
)  # fmt: skip


@dataclass
class Element:
    """An element of the schema: its name, attributes, and what may stand in it."""

    name: str
    attributes: list[str]
    inside: list[Element] = field(default_factory=list)


@functools.cache
def schema() -> Element:
    """Return the elements that MuJoCo reads, as it prints them."""
    above: list[Element] = []
    for line in mujoco.mj_printSchema(False, False).splitlines():
        head = re.match(r"^( *)(\S+) \(.\)\s*(.*)$", line)
        if head is None:
            above[-1].attributes += line.split()
            continue
        depth, name = len(head[1]) // 3, head[2].replace("(world)body", "body")
        element = Element(name, head[3].split())
        del above[depth:]
        if above:
            above[-1].inside.append(element)
        above.append(element)
    return above[0]


def value(rng: np.random.Generator) -> str:
    """Return a size up to 10^9, some numbers, or words."""
    how = rng.integers(0, 5)
    if how <= 1:
        return str(int(10 ** rng.uniform(0, 9)))
    if how == 2:
        return " ".join(str(int(10 ** rng.uniform(0, 6))) for _ in range(int(rng.integers(2, 5))))
    if how == 3:
        return " ".join(f"{x:.3g}" for x in rng.normal(0, 10 ** rng.uniform(-3, 3), int(rng.integers(1, 8))))
    return WORDS[int(rng.integers(0, len(WORDS)))]


def made(element: Element, rng: np.random.Generator, depth: int = 0) -> ET.Element:
    """Return an element with some of its attributes and of what may stand in it."""
    out = ET.Element(element.name)
    for name in element.attributes:
        if rng.random() < min(1.0, 3.0 / len(element.attributes)):
            out.set(name, value(rng))
    for inner in element.inside if depth < 3 else ():
        if rng.random() < 0.7 / len(element.inside):
            out.append(made(inner, rng, depth + 1))
    return out


def write(path: Path, rng: np.random.Generator) -> None:
    """Writes a hand with two fingers and one to three features more, most of which are legal of their own."""
    root = ET.fromstring(HAND.format(fingers="".join(FINGER.format(n=n, x=x) for n, x in (("x", 0.03), ("y", -0.03)))))
    known = schema()
    sections = [e for e in known.inside if e.inside or e.attributes]
    for _ in range(int(rng.integers(1, 4))):
        if rng.random() < 0.3:  # an attribute of what is there
            there = list(root.iter())
            node = there[int(rng.integers(0, len(there)))]
            like = [e for e in _all(known) if e.name == node.tag and e.attributes]
            if like:
                names = like[0].attributes
                node.set(names[int(rng.integers(0, len(names)))], value(rng))
            continue
        section = sections[int(rng.integers(0, len(sections)))]
        if section.name == "body":  # of the world, of a body, or copied
            bodies = [root.find("worldbody"), *root.iter("body")]
            into = bodies[int(rng.integers(0, len(bodies)))]
            if rng.random() < 0.4:
                copies = ET.SubElement(into, "replicate", count=str(int(10 ** rng.uniform(0, 9))), euler="0 0 .1")
                into = ET.SubElement(copies, "replicate", count="300") if rng.random() < 0.3 else copies
        else:
            into = root.find(section.name)
            into = ET.SubElement(root, section.name) if into is None else into
            for name in section.attributes:
                if rng.random() < 2.0 / len(section.attributes):
                    into.set(name, value(rng))
        if section.inside:
            into.append(made(section.inside[int(rng.integers(0, len(section.inside)))], rng))
    for _ in range(8):
        if not _mend(root):
            break
    text = ET.tostring(root, encoding="unicode")
    if rng.random() < 0.1:  # what our parser does not read, and MuJoCo's does
        text = text.replace("<worldbody>", "<!-- &nbsp; -- --><worldbody>", 1)
    path.write_text(text, encoding="utf-8", errors="replace")


def _mend(root: ET.Element) -> bool:
    """Change the attribute that MuJoCo's parser does not take; returns whether there was one."""
    try:
        guard.call(mujoco.MjSpec.from_string, ET.tostring(root, encoding="unicode"), what="case", wanted=False)
    except UserError as error:
        said = re.search(r"'([^']*)'.*Element '(\w+)'", str(error))
        found = [(n, k) for n in root.iter(said[2]) for k, v in n.items() if said[1] in (k, v)] if said else []
        for node, key in found:
            words = node.attrib.pop(key).split()
            if "too much data" in str(error) and len(words) > 1:
                node.set(key, " ".join(words[:-1]))
            elif "enough data" in str(error) and words:
                node.set(key, " ".join([*words, words[0]]))
        return bool(found)
    return False


def _all(element: Element) -> list[Element]:
    return [element, *(e for inner in element.inside for e in _all(inner))]
