"""A small hand made on the spot, as URDF: a palm, three fingers, a thumb; `python -m tests.hands FOLDER` writes it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh

FINGERS = (("index", -0.028), ("middle", 0.0), ("ring", 0.028))


def _inertial(mass: float, size: tuple[float, float, float], at: tuple[float, float, float]) -> str:
    a, b, c = size
    i = [mass / 12 * (b * b + c * c), mass / 12 * (a * a + c * c), mass / 12 * (a * a + b * b)]
    return (
        f'<inertial><origin xyz="{at[0]} {at[1]} {at[2]}"/><mass value="{mass}"/><inertia ixx="{i[0]:.3e}" '
        f'iyy="{i[1]:.3e}"'
        f' izz="{i[2]:.3e}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _shape(kind: str, at: tuple[float, float, float]) -> str:
    origin = f'<origin xyz="{at[0]} {at[1]} {at[2]}"/>'
    return "".join(f"<{tag}>{origin}<geometry>{kind}</geometry></{tag}>" for tag in ("visual", "collision"))


def _joint(name: str, parent: str, child: str, at: str, axis: str, low: float, high: float, extra: str = "") -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="0.6" velocity="7"/>{extra}</joint>'
    )


def urdf(mesh: str = "meshes/tip.stl", mirrored: bool = False) -> str:
    """Return the text: x along the fingers, z out of the palm, the thumb at negative y (a right hand) or mirrored."""
    s = -1 if mirrored else 1
    out = ['<robot name="claw">']
    out.append(
        '<link name="base">' + _inertial(0.3, (0.09, 0.09, 0.024), (0, 0, 0))
        + _shape('<box size="0.09 0.09 0.024"/>', (0, 0, 0)) + "</link>"
    )  # fmt: skip
    for name, y in FINGERS:
        out.append(
            f'<link name="{name}_near">' + _inertial(0.03, (0.045, 0.016, 0.016), (0.022, 0, 0))
            + _shape('<box size="0.040 0.015 0.015"/>', (0.0225, 0, 0)) + "</link>"
        )  # fmt: skip
        out.append(
            f'<link name="{name}_far">' + _inertial(0.02, (0.04, 0.014, 0.014), (0.02, 0, 0))
            + _shape(f'<mesh filename="{mesh}"/>', (0, 0, 0)) + "</link>"
        )  # fmt: skip
        out.append(_joint(f"{name}_1", "base", f"{name}_near", f"0.05 {s * y} 0.004", "0 -1 0", -0.2, 1.7))
        out.append(_joint(f"{name}_2", f"{name}_near", f"{name}_far", "0.045 0 0", "0 -1 0", 0.0, 1.6))
    out.append('<link name="thumb_base">' + _inertial(0.02, (0.016, 0.016, 0.016), (0, 0, 0))
               + _shape('<sphere radius="0.008"/>', (0, -0.006 * s, 0)) + "</link>")  # fmt: skip
    out.append('<link name="thumb_near">' + _inertial(0.03, (0.016, 0.045, 0.016), (0, -0.022 * s, 0))
               + _shape('<box size="0.015 0.040 0.015"/>', (0, -0.0225 * s, 0)) + "</link>")  # fmt: skip
    out.append(
        '<link name="thumb_far">'
        + _inertial(0.02, (0.014, 0.04, 0.014), (0, -0.02 * s, 0))
        + "".join(
            f'<{tag}><origin rpy="0 0 {-s * np.pi / 2}"/><geometry><mesh filename="{mesh}"/></geometry></{tag}>'
            for tag in ("visual", "collision")
        )
        + "</link>"
    )
    out.append(_joint("thumb_turn", "base", "thumb_base", f"0.0 {-0.05 * s} 0.004", f"{-s} 0 0", 0.0, 2.6))
    out.append(_joint("thumb_1", "thumb_base", "thumb_near", f"0 {-0.016 * s} 0", f"0 0 {s}", -0.3, 1.4))
    out.append(_joint("thumb_2", "thumb_near", "thumb_far", f"0 {-0.045 * s} 0", f"0 0 {s}", 0.0, 1.5))
    return "\n".join([*out, "</robot>"])


def tip(path: Path, hole: bool = False, scale: float = 1.0) -> None:
    """Return a rounded fingertip along x from the joint, 42 mm long and 15 mm thick."""
    mesh = trimesh.creation.capsule(radius=0.0075, height=0.030, count=(20, 10))
    mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], [1, 0, 0]))
    mesh.apply_translation([0.006 - mesh.bounds[0, 0], 0, 0])
    mesh.apply_scale(scale)
    if hole:
        mesh.update_faces(np.arange(len(mesh.faces)) % 7 != 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)


def write(folder: Path, mirrored: bool = False, mesh: str = "meshes/tip.stl") -> Path:
    """Return the hand's file with its mesh; returns the URDF's path."""
    folder.mkdir(parents=True, exist_ok=True)
    tip(folder / mesh.removeprefix("package://claw/"))
    path = folder / "claw.urdf"
    path.write_text(urdf(mesh, mirrored))
    return path


if __name__ == "__main__":
    print(write(Path(sys.argv[1] if len(sys.argv) > 1 else "claw")))
