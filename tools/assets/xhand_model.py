"""Write xhand_right.xml, meshes/*.obj and the derived taxel columns: `python -m tools.assets.xhand_model`.

Input: joints.csv, bodies.csv and the x, y, z columns of taxels_*.csv (measured). The results are committed.
"""

from __future__ import annotations

import csv

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, HalfspaceIntersection, cKDTree

from tools.assets import shells, xhand
from tools.assets.surface import PADS, Lattice, PadShape, tip_points, to_link, to_sensor

# Neither is published. Armature: the order of magnitude of a small geared motor's rotor seen at the joint
# (g cm^2 times a gear ratio of 100 to 200 squared); several times the links' own inertia about the joint.
# Damping: 8 % and 18 % of the effort at top speed. Dry friction is left to the servo model (0 here).
ARMATURE = {1.1: 5e-4, 0.4: 2e-4}  # kg m^2, by effort
DAMPING = {1.1: 0.01, 0.4: 0.005}  # N m s/rad
SOLREF = "0.005 1"  # a neutral contact; the scene writes the rubber's own stiffness

# Self collision: (contype, conaffinity) added to the object bits.
#   bit 4: every tip against every other tip
#   bit 8: the thumb's tip against the fingers' links and the palm
#   bit 16: the thumb's links against the fingers' tips
# 40 pairs of geoms. Left out: fingers against fingers other than at the tips (under 3 mm in random postures), thumb
# links against the palm and the finger links (rare), finger tips against the palm (out of reach).
TIP_BIT, THUMB_TIP_BIT, THUMB_LINK_BIT = 4, 8, 16

PALM_CENTRE = 0.065  # z of the palm frame on the root link's fingers axis (m)

Point = tuple[float, float, float]
Capsule = tuple[Point, Point, float]

# Capsules (from, to, radius) in link frames, m, inside the measured bounds.
# Only what an object in the palm can reach: the backs of palm and fingers have none.
_PHALANX: list[Capsule] = [((0.003, 0, 0), (0.003, 0, 0.0584), 0.0081)]
_PALM_RADIUS = 0.0115
_PALM_Y = np.linspace(-0.0502 + _PALM_RADIUS, 0.0437 - _PALM_RADIUS, 4)
_PALM_TOP = [0.082, 0.088, 0.089, 0.074]  # below each finger's root joint
CAPSULES: dict[str, list[Capsule]] = {
    "right_hand_link": [
        ((0.025 - _PALM_RADIUS, y, 0.0135), (0.025 - _PALM_RADIUS, y, top), _PALM_RADIUS)
        for y, top in zip(_PALM_Y, _PALM_TOP, strict=True)
    ],
    "right_hand_thumb_bend_link": [((0, 0, 0.0003), (0, 0.0275, 0.0003), 0.0095)],
    "right_hand_thumb_rota_link1": [
        ((0.006, 0.003, -0.0016), (0.006, 0.0535, -0.0016), 0.0135),
        ((-0.0055, 0.003, -0.0016), (-0.0055, 0.0535, -0.0016), 0.0135),
    ],
    "right_hand_thumb_rota_link2": [((-0.0095, 0, 0), (0.0095, 0, 0), 0.008)],
    "right_hand_index_bend_link": [],
    # The index finger's root barrel belongs to its sideways link.
    "right_hand_index_rota_link1": [((0.003, 0, 0.0138), (0.003, 0, 0.0584), 0.0081)],
    "right_hand_index_rota_link2": [],  # its barrel lies within the end of the link before it
}
for _finger in ("mid", "ring", "pinky"):
    CAPSULES[f"right_hand_{_finger}_link1"] = _PHALANX
    CAPSULES[f"right_hand_{_finger}_link2"] = CAPSULES["right_hand_index_rota_link2"]

MATERIALS = {
    "shell": ("0.150 0.156 0.168 1", 0.35, 0.45),
    "cover": ("0.255 0.263 0.278 1", 0.30, 0.40),
    "metal": ("0.500 0.510 0.530 1", 0.45, 0.60),
    "skin": ("0.800 0.805 0.810 1", 0.10, 0.15),
    "pad": ("0.400 0.408 0.420 1", 0.08, 0.10),
}


def _read(name: str) -> list[dict[str, str]]:
    with open(xhand.FOLDER / name, newline="", encoding="ascii") as f:
        return list(csv.DictReader(f))


def write_taxels(pad_name: str) -> Lattice:
    """Fill the normal, tangent and area columns of a taxel table; returns its surface."""
    path = xhand.FOLDER / f"taxels_{pad_name}.csv"
    rows = _read(path.name)
    pad = PADS[pad_name]
    points = np.array([[float(row[c]) for c in "xyz"] for row in rows]).reshape(xhand.COLUMNS, xhand.ROWS, 3)
    lattice = Lattice(to_sensor(points, pad))
    normal = lattice.taxel_normals()
    columns = np.concatenate(
        [to_link(normal, pad), to_link(tangents(normal), pad), lattice.taxel_areas()[..., None]], axis=-1
    ).reshape(-1, 7)
    header = "k column row x y z nx ny nz tx ty tz area".split()
    with open(path, "w", newline="", encoding="ascii") as f:
        writer = csv.writer(f, lineterminator="\n")
        writer.writerow(header)
        for row, extra in zip(rows, columns, strict=True):
            writer.writerow([row[c] for c in header[:6]] + [f"{x + 0.0:.6f}" for x in extra[:6]] + [f"{extra[6]:.6e}"])
    return lattice


def tip_meshes(pad_name: str, lattice: Lattice) -> dict[str, shells.Mesh]:
    """Return the collision hull, skin and dark core of a fingertip, in link axes."""
    pad = PADS[pad_name]
    u, v = lattice.grid(28, 34)
    outer, normal = lattice.position(u, v), lattice.normal(u, v)
    _, rest = tip_points(lattice, pad, 28, 34, under=0.0006)
    return {
        f"tip_{pad_name}": shells.hull_mesh(to_link(tip_hull(lattice, pad), pad)),
        f"skin_{pad_name}": shells.loft(to_link(outer, pad), to_link(normal, pad), 0.0012),
        f"core_{pad_name}": shells.hull_mesh(to_link(rest, pad)),
    }


def write_skin(pad_name: str) -> None:
    """Return the surface that carries a pad's taxels, to the last bit, for hand.yaml."""
    finger = next(f for f in xhand.FINGERS if xhand.pad_of(f) == pad_name)
    vertices, faces = xhand.tip_skin_mesh(finger)
    lines = ["# dexsim, drawn by tools/assets/xhand_model.py; metres: the surface that carries the taxels"]
    lines += ["v " + " ".join(repr(float(x)) for x in v) for v in vertices]
    lines += ["f " + " ".join(str(int(k) + 1) for k in f) for f in faces]
    (xhand.FOLDER / f"skin_{pad_name}_hull.obj").write_text("\n".join(lines) + "\n", encoding="ascii")


def shell_meshes() -> dict[str, tuple[str, str, shells.Mesh]]:
    """Return the visual shells: name -> (body, material, mesh); the fingers' are listed once, for the middle finger."""
    mm = lambda *p: [[0.001 * x for x in q] for q in p]  # noqa: E731
    box = shells.rounded_box
    palm, thumb1, thumb2 = "right_hand_link", "right_hand_thumb_rota_link1", "right_hand_thumb_rota_link2"
    bend, index = "right_hand_thumb_bend_link", "right_hand_index_bend_link"
    link1, link2 = "right_hand_mid_link1", "right_hand_mid_link2"
    body = mm((-22, 6), (22, 6), (40, 24), (42, 46), (37, 82), (34, 87), (15, 98), (-8, 98), (-46, 90), (-49, 84),
              (-49, 34), (-38, 14))  # fmt: skip
    back = mm((-20, 17), (20, 17), (36, 30), (37, 50), (33, 82), (14, 93), (-8, 93), (-42, 86), (-45, 80), (-45, 36),
              (-36, 20))  # fmt: skip
    cushion = mm((-38, 26), (-30, 18), (6, 18), (14, 26), (18, 60), (24, 78), (10, 92), (-8, 92), (-44, 84), (-46, 76),
                 (-45, 36))  # fmt: skip
    out = {
        "palm_body": (palm, "shell", shells.slab(body, -0.018, 0.0225, 0.006)),
        "palm_back": (palm, "cover", shells.slab(back, -0.023, -0.008, 0.005)),
        "palm_pad": (palm, "pad", shells.slab(cushion, 0.012, 0.025, 0.004)),
        "thumb_base": (bend, "metal", box((-0.0100, 0.000, -0.0090), (0.0095, 0.036, 0.0098), 0.004)),
        "thumb_body": (thumb1, "shell", box((-0.0165, -0.002, -0.0125), (0.0165, 0.049, 0.0118), 0.006)),
        "thumb_back": (thumb1, "cover", box((-0.0188, 0.001, -0.0178), (0.0195, 0.050, 0.004), 0.006)),
        "thumb_ear_a": (thumb1, "shell", shells.ear((0.0553, 0), 0.0112, mm((40, -10), (40, 10)), 0.0125, 0.0165, 0)),
        "thumb_ear_b": (thumb1, "shell", shells.ear((0.0553, 0), 0.0112, mm((40, -10), (40, 10)), -0.0165, -0.0125, 0)),
        "thumb_neck": (thumb2, "shell", box((-0.0118, -0.002, -0.0115), (0.0118, 0.022, 0.0072), 0.004)),
        "index_base": (index, "shell", box((-0.0155, -0.0070, -0.0030), (0.0090, 0.0070, 0.0150), 0.003)),
        "phalanx": (link1, "shell", box((-0.0100, -0.0080, 0.0085), (0.0108, 0.0080, 0.0500), 0.004)),
        "phalanx_back": (link1, "cover", box((-0.0169, -0.0081, 0.0066), (-0.002, 0.0081, 0.0575), 0.004)),
        "phalanx_pad": (link1, "pad", box((0.0070, -0.0062, 0.0130), (0.0111, 0.0062, 0.0465), 0.0018)),
        "phalanx_root": (link1, "shell", box((-0.0072, -0.0070, 0.0000), (0.0080, 0.0070, 0.0140), 0.003)),
        "phalanx_ear_a": (link1, "shell", shells.ear((0, 0.0558), 0.0098, mm((-9, 44), (10, 44)), 0.0064, 0.0081, 1)),
        "phalanx_ear_b": (link1, "shell", shells.ear((0, 0.0558), 0.0098, mm((-9, 44), (10, 44)), -0.0081, -0.0064, 1)),
        "tip_neck": (link2, "shell", box((-0.0072, -0.0058, -0.001), (0.0076, 0.0058, 0.018), 0.003)),
    }
    # Hinge plates of the knuckles, either side of each finger root (z up to the measured 117.6 mm).
    for name, y, z, half in (("mid", 4.0, 108.2, 8.9), ("ring", -16.0, 105.2, 8.9), ("pinky", -36.0, 102.2, 8.9)):
        for side, sign in (("a", 1), ("b", -1)):
            low = (y + sign * half) * 1e-3
            mesh = shells.ear((0.0065, z * 1e-3), 0.0093, mm((-10, 84), (20, 84)), low - 0.0007, low + 0.0007, 1)
            out[f"knuckle_{name}_{side}"] = (palm, "shell", mesh)
        corners = (-0.0060, (y - 8.2) * 1e-3, 0.080), (0.0190, (y + 8.2) * 1e-3, (z - 8.3) * 1e-3)
        out[f"knuckle_{name}"] = (palm, "shell", shells.rounded_box(*corners, 0.003))
    return out


# Visual cylinders: body -> (material, centre, axis, radius, half length), link frame.
PINS: dict[str, list[tuple[str, Point, Point, float, float]]] = {
    "right_hand_link": [("metal", (0, 0, 0.005), (0, 0, 1), 0.025, 0.005)],
    "right_hand_thumb_bend_link": [("metal", (0, 0, 0.0004), (0, 0, 1), 0.0089, 0.0094)],
    "right_hand_thumb_rota_link1": [
        ("metal", (0, 0, 0), (1, 0, 0), 0.0103, 0.0150), ("metal", (0, 0.0553, 0), (1, 0, 0), 0.0045, 0.0171)],
    "right_hand_thumb_rota_link2": [("metal", (0, 0, 0), (1, 0, 0), 0.0079, 0.0120)],
    "link1": [("metal", (0, 0, 0), (0, 1, 0), 0.0078, 0.0076), ("metal", (0, 0, 0.0558), (0, 1, 0), 0.0038, 0.00825)],
    "link2": [("metal", (0, 0, 0), (0, 1, 0), 0.0077, 0.0061)],
}  # fmt: skip


def _num(values: ArrayLike) -> str:
    return " ".join(f"{float(x) + 0.0:.9g}" for x in np.atleast_1d(values))


def build() -> str:
    """Write every derived file; returns the MJCF text."""
    meshes: dict[str, shells.Mesh] = {}
    for pad_name in PADS:
        meshes |= tip_meshes(pad_name, write_taxels(pad_name))
        write_skin(pad_name)
    visuals = shell_meshes()
    meshes |= {name: mesh for name, (_, _, mesh) in visuals.items()}
    folder = xhand.FOLDER / "meshes"
    folder.mkdir(exist_ok=True)
    for name, mesh in meshes.items():
        shells.write_obj(folder / f"{name}.obj", mesh, "dexsim, drawn by tools/assets/xhand_model.py; metres")

    bodies = {row["body"]: row for row in _read("bodies.csv")}
    joints = {row["body"]: row for row in _read("joints.csv")}
    lines: list[str] = []

    def emit_body(name: str, depth: int) -> None:
        pad = "  " * depth
        row = bodies[name]
        get = lambda *keys: [float(row[key]) for key in keys]  # noqa: E731
        position, quat = get("x", "y", "z"), get("qw", "qx", "qy", "qz")
        if row["parent"] == "world":
            # Link x, y, z = palm z, -y, x: half a turn about (1, 0, 1).
            position, quat = [-PALM_CENTRE, 0, 0], [0, 0.5**0.5, 0, 0.5**0.5]
        lines.append(f'{pad}<body name="{name}" pos="{_num(position)}" quat="{_num(quat)}">')
        pad += "  "
        lines.append(
            f'{pad}<inertial pos="{_num(get("com_x", "com_y", "com_z"))}" mass="{_num(get("mass"))}"'
            f' fullinertia="{_num(get("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))}"/>'
        )
        if name in joints:
            j = joints[name]
            effort = float(j["effort"])
            lines.append(
                f'{pad}<joint name="{j["joint"]}" axis="{j["axis_x"]} {j["axis_y"]} {j["axis_z"]}"'
                f' range="{j["lower"]} {j["upper"]}" armature="{ARMATURE[effort]}" damping="{DAMPING[effort]}"/>'
            )
        lines.extend(pad + line for line in _sites(name))
        lines.extend(pad + line for line in _collision(name))
        lines.extend(pad + line for line in _visual(name, visuals))
        for child, child_row in bodies.items():
            if child_row["parent"] == name:
                emit_body(child, depth + 1)
        lines.append("  " * depth + "</body>")

    emit_body(xhand.ROOT_BODY, 2)
    assets = [f'    <mesh name="{name}" file="{name}.obj"/>' for name in meshes]
    materials = [
        f'    <material name="xhand_{name}" rgba="{rgba}" specular="{specular}" shininess="{shininess}"/>'
        for name, (rgba, specular, shininess) in MATERIALS.items()
    ]
    text = _TEMPLATE.format(
        assets="\n".join(materials + assets), bodies="\n".join(lines), solref=SOLREF, margin=TIP_MARGIN
    )
    xhand.xml_path().write_text(text, encoding="ascii")
    return text


def _sites(body: str) -> list[str]:
    if body == xhand.ROOT_BODY:
        half_turn = _num([0, 0.5**0.5, 0, 0.5**0.5])
        return [f'<site class="xhand_site" name="palm" pos="0 0 {PALM_CENTRE}" quat="{half_turn}"/>']
    if body not in xhand.TIP_BODIES:
        return []
    finger = xhand.FINGERS[xhand.TIP_BODIES.index(body)]
    offset = {"thumb": "0 0.0502276 0", "mid": "0 0 0.042248"}.get(finger, "0 0 0.0422483")
    return [f'<site class="xhand_site" name="tip_{finger}" pos="{offset}"/>']


def _bits(body: str) -> tuple[int, int]:
    """Filter bits of a link's capsules: all meet the object; some meet the fingertips' proxies."""
    contype, conaffinity = xhand.HAND_BIT, xhand.OBJECT_BIT
    if "thumb_rota" in body:
        contype |= THUMB_LINK_BIT
    elif body == xhand.ROOT_BODY or body.endswith(("link1", "link2")):
        contype |= THUMB_TIP_BIT
    return contype, conaffinity


# Fingertips meet the hand itself through capsules inside them (within 2 mm of the skin): convex meshes against each
# other cost more than everything else in a closed grasp. They meet the object through the mesh alone.
PROXIES: dict[str, list[Capsule]] = {
    "thumb": [((x, 0.017, 0.0015), (x, 0.0415, -0.001), 0.0085) for x in (-0.006, 0.006)],
    "finger": [((0.002, 0, 0.013), (0.0005, 0, 0.0335), 0.008)],
}


def _collision(body: str) -> list[str]:
    contype, conaffinity = _bits(body)
    bits = f'contype="{contype}" conaffinity="{conaffinity}"'
    out = [
        f'<geom class="xhand_collision" name="col_{body.removeprefix("right_hand_")}_{k}" type="capsule"'
        f' fromto="{_num([*a, *b])}" size="{radius:.9g}" {bits}/>'
        for k, (a, b, radius) in enumerate(CAPSULES[body])
    ]
    if body in xhand.TIP_BODIES:
        finger = xhand.FINGERS[xhand.TIP_BODIES.index(body)]
        out.append(
            f'<geom class="xhand_tip" name="tip_{finger}" mesh="tip_{xhand.pad_of(finger)}"'
            f' contype="{xhand.HAND_BIT}" conaffinity="{xhand.OBJECT_BIT}"/>'
        )
        own, meets = (TIP_BIT | THUMB_TIP_BIT,) * 2 if finger == "thumb" else (TIP_BIT, TIP_BIT | THUMB_LINK_BIT)
        out += [
            f'<geom class="xhand_collision" name="self_{finger}_{k}" type="capsule" fromto="{_num([*a, *b])}"'
            f' size="{radius:.9g}" contype="{own}" conaffinity="{meets}"/>'
            for k, (a, b, radius) in enumerate(PROXIES[xhand.pad_of(finger)])
        ]
    return out


def _visual(body: str, visuals: dict) -> list[str]:
    short = body.removeprefix("right_hand_")
    same = body
    for finger in ("index_rota", "ring", "pinky"):
        same = same.replace(f"right_hand_{finger}_", "right_hand_mid_")
    out = []

    def add(part: str, mesh: str, material: str) -> None:
        out.append(f'<geom class="xhand_visual" name="vis_{short}_{part}" mesh="{mesh}" material="xhand_{material}"/>')

    for name, (owner, material, _) in visuals.items():
        if owner == same:
            add(name, name, material)
    if body in xhand.TIP_BODIES:
        kind = xhand.pad_of(xhand.FINGERS[xhand.TIP_BODIES.index(body)])
        for part, material in (("core", "shell"), ("skin", "skin")):
            add(part, f"{part}_{kind}", material)
    key = {"right_hand_mid_link1": "link1", "right_hand_mid_link2": "link2"}.get(same, same)
    for k, (material, centre, axis, radius, half) in enumerate(PINS.get(key, [])):
        ends = [*(np.array(centre) - half * np.array(axis)), *(np.array(centre) + half * np.array(axis))]
        out.append(
            f'<geom class="xhand_visual" name="vis_{short}_pin{k}" type="cylinder" fromto="{_num(ends)}"'
            f' size="{radius:.9g}" material="xhand_{material}"/>'
        )
    return out


def tangents(normals: np.ndarray) -> np.ndarray:
    """Return the sensor's x direction on the skin [..., 3] (sensor axes): across the pad, following its curve.

    It is y' x n with y' the sensor's y axis (along the finger) projected on the tangent plane. On the flat of the
    pad that is the sensor's x axis projected on the tangent plane; on the flanks, where the sensor's x axis is
    parallel to the normal and its projection has no direction, it goes on smoothly around the finger.
    """
    along = np.array([0.0, 1.0, 0.0]) - normals * normals[..., 1:2]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    return np.cross(along, normals)


def hull_distance(points: np.ndarray, hull: ConvexHull) -> np.ndarray:
    """Return the signed distance [n] to a hull's planes: positive outside (a lower bound there), exact inside."""
    return (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)


TIP_MARGIN = 0.0015
"""Rounding of the fingertips [m]: the collision mesh is the tip shrunk by this, and its geom's `margin` adds it back.
The mesh itself then never overlaps an object (rubber yields about 1 mm), so that the collision of convex shapes stays a
distance query, several times cheaper than a penetration query, and the edges of its facets are rounded."""


def tip_hull(lattice: Lattice, pad: PadShape, vertices: int = 64, raise_by: float = 1.5e-4) -> np.ndarray:
    """Return the vertices [<= vertices, 3] (sensor axes) of the fingertip's convex core, mirror symmetric about a = 0:
    the points at least TIP_MARGIN inside the tip.

    Greedy: add the dense point farthest outside the present hull, and its mirror image. Skin points are raised by
    `raise_by` along the normal first, so that the facets' sagging is spread to both sides of the skin; points
    of the back count a tenth, for nothing is measured there.
    """
    u, v = lattice.grid(73, 89)
    skin, normal = lattice.position(u, v).reshape(-1, 3), lattice.normal(u, v).reshape(-1, 3)
    _, rest = tip_points(lattice, pad)
    raised = skin + normal * (raise_by * lattice.regular(u, v).reshape(-1, 1))
    whole = np.concatenate([raised, rest])
    planes = np.unique(ConvexHull(whole).equations.round(9), axis=0) + [0, 0, 0, TIP_MARGIN]
    points = HalfspaceIntersection(planes, whole.mean(axis=0)).intersections
    points = np.unique(points[np.isfinite(points).all(axis=1)].round(8), axis=0)
    near = cKDTree(whole).query(points)[1]
    weight = np.where(near < len(raised), 1.0, 0.1)
    half = points[:, 0] >= -1e-6
    points, weight = points[half], weight[half]
    points[:, 0] = np.where(points[:, 0] < 2e-5, 0.0, points[:, 0])

    chosen: list[int] = []
    for direction in [(0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0), (1, -1, 1), (1, -1, -1), (1, 1, 1)]:
        index = int(np.argmax(points @ np.array(direction, dtype=float)))
        if index not in chosen:
            chosen.append(index)

    def mirrored(index: list[int]) -> np.ndarray:
        half = points[index]
        other = half[half[:, 0] > 0] * np.array([-1.0, 1.0, 1.0])
        return np.concatenate([half, other])

    while True:
        hull = ConvexHull(mirrored(chosen))
        distance = hull_distance(points, hull) * weight
        best = int(np.argmax(distance))
        if distance[best] < 5e-6 or len(mirrored([*chosen, best])) > vertices:
            break
        chosen.append(best)
    out = mirrored(chosen)
    return out[ConvexHull(out).vertices]


_TEMPLATE = """\
<!-- Right xHand v1.3, written by tools/assets/xhand_model.py from joints.csv, bodies.csv and taxels_*.csv;
     do not edit by hand. World frame = palm frame: x along the fingers, y to the little finger, z out of the palm. -->
<mujoco model="xhand_right">
  <compiler angle="radian" meshdir="meshes" autolimits="true"/>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default>
    <default class="xhand_site">
      <site group="4" size="0.002" rgba="0.9 0.2 0.2 1"/>
    </default>
    <default class="xhand_visual">
      <geom type="mesh" contype="0" conaffinity="0" group="2" mass="0"/>
    </default>
    <default class="xhand_collision">
      <geom group="3" condim="3" friction="0.8 0.003 0.0001" solref="{solref}" rgba="0.9 0.5 0.2 0.4"/>
    </default>
    <default class="xhand_tip">
      <geom type="mesh" group="3" condim="4" priority="1" friction="0.9 0.003 0.0001" solref="{solref}"
        margin="{margin}" rgba="0.2 0.7 0.4 0.5"/>
    </default>
  </default>
  <asset>
{assets}
  </asset>
  <worldbody>
{bodies}
  </worldbody>
</mujoco>
"""


if __name__ == "__main__":
    build()
