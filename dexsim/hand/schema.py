"""`hand.yaml`: its declared types, read. What must hold between its fields and the model's is checked by
`dexsim.hand.load`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from dexsim import yaml_text
from dexsim.errors import UserError
from dexsim.typed import Positive, Real, convert

FORMAT = "dexsim-hand"
FILE = "hand.yaml"
SEE = "see docs/reference/hand.md"

Name = Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]
Vector = Annotated[list[Real], msgspec.Meta(min_length=3, max_length=3)]
Metre = Annotated[float, msgspec.Meta(gt=0.01, le=10.0)]


class JointEntry(msgspec.Struct, forbid_unknown_fields=True):
    """A driven joint: what a command goes to. Those that follow it by an equality or a tendon of the model are not
    named. effort: N m (N of a slide), speed: rad/s (m/s), the largest of each; its range is the model's.
    armature: kg m2 (kg) of the rotor seen at the joint, instead of the model's, which often has none."""

    name: Text
    effort: Positive
    speed: Positive
    armature: Annotated[float, msgspec.Meta(ge=0, le=10)] | None = None


class Palm(msgspec.Struct, forbid_unknown_fields=True):
    """The palm frame, in the frame of `body`: origin `position` [m], x along `forward` (made orthogonal to the normal),
    z along `normal`, out of the palm; y = z x x."""

    body: Text
    position: Vector
    forward: Vector
    normal: Vector


class Tip(msgspec.Struct, forbid_unknown_fields=True):
    """A fingertip, in the frame of its distal `body`: `position` [m] is the finger's end, `normal` points out of the
    palmar side. geoms: collision geoms that press objects; None: all colliding ones of the body."""

    body: Text
    position: Vector
    normal: Vector
    geoms: Annotated[list[Text], msgspec.Meta(min_length=1, max_length=64)] | None = None


class Pad(msgspec.Struct, forbid_unknown_fields=True):
    """Touch: `taxels`, a CSV file (`dexsim.tactile.layout.load_layout`) in the tip body's frame; kind: the key of
    `tactile.stiffness`; rows: of the lattice that the taxels form, k = column * rows + row, 0 = none; skin: an OBJ file
    whose convex hull carries the taxels, None: the hull of the tip's geoms."""

    taxels: Text
    kind: Text = "finger"
    rows: Annotated[int, msgspec.Meta(ge=0, le=4096)] = 0
    skin: Text | None = None


class SkinEntry(msgspec.Struct, forbid_unknown_fields=True):
    """A further touch pad, on any `body`: `taxels`, a CSV file as of a fingertip's pad, in that body's frame. Several
    may lie on one body."""

    name: Name
    body: Text
    taxels: Text
    kind: Text = "finger"


class FingerEntry(msgspec.Struct, forbid_unknown_fields=True):
    """A finger. joints: driven ones root to tip, then drives that pull it by a tendon; none of a finger that follows
    another; flexion: those that close it, root to tip; closes: the sign of the motion of each
    that closes it (all +1 without)."""

    name: Name
    joints: Annotated[list[Text], msgspec.Meta(max_length=32)]
    flexion: Annotated[list[Text], msgspec.Meta(max_length=32)]
    tip: Tip
    pad: Pad | None = None
    closes: list[Literal[1, -1]] | None = None


class Poses(msgspec.Struct, forbid_unknown_fields=True):
    """Joint angles by name [rad], of every joint. open: ready to catch; cupped: closed around an object in the palm."""

    open: dict[str, Real]
    cupped: dict[str, Real]


class PlacesEntry(msgspec.Struct, forbid_unknown_fields=True):
    """Points [m], palm frame; each is told from the cupped pose where it is left out. catch: on the palm, an object is
    let fall over it; middle: of what the hand can reach; beside: its y is where an object lies in the reach of all
    fingers."""

    catch: Vector | None = None
    middle: Vector | None = None
    beside: Vector | None = None


class HandFile(msgspec.Struct, forbid_unknown_fields=True):
    """The file. Paths are relative to its folder. force: N that a fingertip can press with; None: from the servo's
    torque limits and the levers, press: from a simulated press (pads with a lattice); span: m, width of what the
    hand can grasp; skin: touch beyond the fingertips; held_cubes: poses that rotation begins with (dexsim
    stable-grasps), None: searched for; sensed: joints without a drive that have an encoder of their own; guessed:
    places of this file that a program guessed; source: free."""

    format: Literal["dexsim-hand"]
    version: Literal[1]
    name: Name
    handedness: Literal["right", "left", "none"]
    model: Text
    servo: Text
    joints: Annotated[list[JointEntry], msgspec.Meta(min_length=1, max_length=256)]
    palm: Palm
    fingers: Annotated[list[FingerEntry], msgspec.Meta(min_length=2, max_length=32)]
    opposing: Annotated[list[Name], msgspec.Meta(min_length=1, max_length=31)]
    poses: Poses
    span: Metre
    force: Positive | Literal["press"] | None = None
    skin: Annotated[list[SkinEntry], msgspec.Meta(max_length=256)] = []
    places: PlacesEntry | None = None
    held_cubes: Text | None = None
    sensed: list[Text] = []
    guessed: list[str] = []
    source: dict[str, Any] = {}


def read(path: Path) -> HandFile:
    """Return the file's content, its types checked. Raises UserError naming file, field, value and what must be
    there."""
    raw = yaml_text.load(path, "hand")
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        raise UserError(f"hand {path}: format: must be {FORMAT} in its first line; {SEE}")
    return convert(raw, HandFile, f"hand {path}", SEE)
