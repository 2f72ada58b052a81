"""The right xHand (v1.3): names, limits, model file, taxel layout. See PROVENANCE.md for where the figures come from.

Light to import: numpy only; MuJoCo and scipy are imported by the functions that need them.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import dexsim

if TYPE_CHECKING:
    import mujoco

FOLDER = Path(dexsim.__file__).parent / "assets" / "xhand"
FINGERS = ("thumb", "index", "mid", "ring", "pinky")
JOINTS = (
    "thumb_bend_joint", "thumb_rota_joint1", "thumb_rota_joint2",
    "index_bend_joint", "index_joint1", "index_joint2",
    "mid_joint1", "mid_joint2", "ring_joint1", "ring_joint2", "pinky_joint1", "pinky_joint2",
)  # the vendor SDK's order  # fmt: skip
ROOT_BODY = "right_hand_link"
TIP_BODIES = (
    "right_hand_thumb_rota_link2", "right_hand_index_rota_link2",
    "right_hand_mid_link2", "right_hand_ring_link2", "right_hand_pinky_link2",
)  # fmt: skip
TIP_GEOMS = tuple(f"tip_{finger}" for finger in FINGERS)
COLUMNS, ROWS = 10, 12
TAXELS_PER_FINGER = COLUMNS * ROWS

# Collision bits. Hand geoms have contype HAND_BIT and conaffinity OBJECT_BIT; an object's geom has
# contype OBJECT_BIT and conaffinity HAND_BIT. Bits 4 and up are the hand's own, see tools/assets/xhand_model.py.
OBJECT_BIT, HAND_BIT = 1, 2


def xml_path() -> Path:
    """Return the committed MJCF; world frame = palm frame (x along the fingers, y to the little finger, z out of the
    palm)."""
    return FOLDER / "xhand_right.xml"


def hand_spec() -> mujoco.MjSpec:
    """Return a fresh `mujoco.MjSpec` of the hand alone, to be extended with objects."""
    import mujoco

    return mujoco.MjSpec.from_file(str(xml_path()))


@cache
def _rows(name: str) -> list[dict[str, str]]:
    with open(FOLDER / name, newline="", encoding="ascii") as f:
        return list(csv.DictReader(f))


def _joint_column(*names: str) -> np.ndarray:
    by_name = {row["joint"]: row for row in _rows("joints.csv")}
    return np.array([[float(by_name[joint][name]) for name in names] for joint in JOINTS])


def joint_limits() -> np.ndarray:
    """Lower and upper position limits [12, 2], rad."""
    return _joint_column("lower", "upper")


def efforts() -> np.ndarray:
    """Return largest joint torques [12], N m."""
    return _joint_column("effort")[:, 0]


def speeds() -> np.ndarray:
    """Return largest joint speeds [12], rad/s."""
    return _joint_column("speed")[:, 0]


def pad_of(finger: str) -> str:
    """Return which of the two sensor pads a finger carries: "thumb" or "finger"."""
    if finger not in FINGERS:
        raise ValueError(f"finger {finger!r} is not one of {', '.join(FINGERS)}")
    return "thumb" if finger == "thumb" else "finger"


def taxel_path(finger: str) -> Path:
    """Return the taxel table of a finger's pad."""
    return FOLDER / f"taxels_{pad_of(finger)}.csv"


def taxel_table(finger: str) -> dict[str, np.ndarray]:
    """Return taxels of one finger in its distal body's frame.

    Keys: position [120, 3] m, normal [120, 3] unit, out of the pad, tangent [120, 3] unit (the taxel's x axis; its y
    axis is normal x tangent), area [120] m^2. Taxel k = column * 12 + row; rows run from the joint to the tip.
    """
    rows = _rows(taxel_path(finger).name)
    get = lambda *names: np.array([[float(row[name]) for name in names] for row in rows])  # noqa: E731
    return {
        "position": get("x", "y", "z"),
        "normal": get("nx", "ny", "nz"),
        "tangent": get("tx", "ty", "tz"),
        "area": get("area")[:, 0],
    }


def tip_skin_mesh(finger: str) -> tuple[np.ndarray, np.ndarray]:
    """Return closed, convex, watertight fingertip (vertices [n, 3] m, outward triangles [m, 3]) in the distal body's
    frame.

    It passes through the taxels (within 0.1 mm; the lattice surface is convex to
    0.04 mm); `tip_*` in the MJCF is the same solid with at most 64 vertices.
    """
    return _tip_skin(pad_of(finger))


@cache
def _tip_skin(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return `tip_skin_mesh` of all fingers with this pad."""
    from dexsim.surface import hull as hull_mesh
    from tools.assets.surface import PADS, Lattice, tip_points, to_link, to_sensor

    pad = PADS[name]
    points = taxel_table(next(f for f in FINGERS if pad_of(f) == name))["position"].reshape(COLUMNS, ROWS, 3)
    skin, rest = tip_points(Lattice(to_sensor(points, pad)), pad)
    return hull_mesh(to_link(np.concatenate([skin, rest]), pad))
