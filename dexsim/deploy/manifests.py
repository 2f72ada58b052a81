"""What a bundle's manifest must say: names, types, and limits that the hand itself has."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from dexsim.deploy import measure
from dexsim.errors import UserError, about
from dexsim.hand import Hand
from dexsim.typed import Count, Positive, Real, convert

FORMAT, VERSION = "dexsim-bundle", 1
AGAIN = "export the bundle again"
Joints = Annotated[list[Real], msgspec.Meta(min_length=1, max_length=256)]
JointsAbove = Annotated[list[Positive], msgspec.Meta(min_length=1, max_length=256)]
Several = Annotated[list[Real], msgspec.Meta(max_length=4096)]
Any_ = dict[str, Any]
Layers = Annotated[int, msgspec.Meta(ge=1, le=10_000)]


class Network(msgspec.Struct):
    """The file's digest, names and sizes of its input and output; state: of a recurrent one, what it carries from step
    to step by name (inputs NAME_in, outputs NAME_out), layers and size of each."""

    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    input: str
    output: str
    observation_size: Annotated[int, msgspec.Meta(ge=1, le=100_000)]
    action_size: Annotated[int, msgspec.Meta(ge=1, le=256)]
    state: dict[str, tuple[Layers, Layers]] = {}


class Row(msgspec.Struct):
    """One row of the observation's table: entries start to stop."""

    name: str
    start: Count
    stop: Count
    unit: str


Lead = Annotated[float, msgspec.Meta(gt=0, le=10)]


class Action(msgspec.Struct):
    """See `dexsim.deploy.action.ActionRule`."""

    mode: Literal["relative", "absolute"]
    scale: Annotated[float, msgspec.Meta(gt=0, le=10)]
    lead: Lead | list[Lead]
    low: Joints
    high: Joints
    speed_limit_rad_s: JointsAbove
    std: JointsAbove | None = None


class Rates(msgspec.Struct):
    """s."""

    policy_period_s: Annotated[float, msgspec.Meta(ge=1e-3, le=1.0)]


class Normalization(msgspec.Struct):
    """N.m and N."""

    tau_max: JointsAbove
    force_max_N: Positive | None = None


class Golden(msgspec.Struct):
    """Of dexsim export check=DIR."""

    rows: Count
    tolerance: Annotated[float, msgspec.Meta(gt=0, le=1.0)]


class Goal(msgspec.Struct):
    """axis: unit vector, palm frame; angle: degrees."""

    axis: Annotated[list[Real], msgspec.Meta(min_length=3, max_length=3)]
    angle: Annotated[float, msgspec.Meta(gt=0, le=180)]
    keep_tilt: bool


class Reached(msgspec.Struct):
    """rad."""

    delta_rot: Annotated[float, msgspec.Meta(gt=0, le=3.2)]


class Observe(msgspec.Struct):
    """Which rows the rotation's observation has."""

    orientation: Literal["6d", "quaternion", "none"]
    force_weighted: bool = True
    last_action: Literal["step", "target"] | bool = "step"


class TaskSettings(msgspec.Struct):
    """The rotation's."""

    perception: Literal["imu", "proprioception"]
    history: Annotated[int, msgspec.Meta(ge=1, le=1000)]
    observe: Any_
    goal: Goal
    reward: Reached


class Grip(msgspec.Struct):
    """The held pose that a rotation begins with."""

    hand: Joints
    target: Joints
    object_pose: Annotated[list[Real], msgspec.Meta(min_length=7, max_length=7)]
    object_edge_m: Annotated[float, msgspec.Meta(gt=0, le=1.0)]
    object: Annotated[str, msgspec.Meta(max_length=256)] = "box"


class HandEntry(msgspec.Struct):
    """Which hand: one that comes with dexsim (`name`), or the bundle's own `folder`; mirrored, scaled."""

    name: Annotated[str, msgspec.Meta(max_length=64)]
    folder: Literal["hand"] | None = None
    mirror: bool = False
    scale: Annotated[float, msgspec.Meta(ge=0.2, le=5.0)] = 1.0


class TermRow(msgspec.Struct):
    """A declared observation: its value's width, and how many of its last values are seen, the newest first."""

    name: str
    width: Annotated[int, msgspec.Meta(ge=1, le=100_000)]
    frames: Annotated[int, msgspec.Meta(ge=1, le=64)]


class Terms(msgspec.Struct):
    """The observation of a task of declared terms: a network from signals to the values of all rows, one after the
    other; frames of each; then `history` of the whole. constant: commands by name, as the policy is told them."""

    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    signals: Annotated[dict[str, Count], msgspec.Meta(max_length=100)]
    rows: Annotated[list[TermRow], msgspec.Meta(min_length=1, max_length=1000)]
    history: Annotated[int, msgspec.Meta(ge=1, le=64)]
    commands: dict[str, Several]


class Manifest(msgspec.Struct):
    """What `dexsim.export.manifest` writes, as far as the loop and its check depend on it."""

    task: Annotated[str, msgspec.Meta(pattern="^[a-z][a-z0-9_]{0,63}$")]
    policy: Network
    observation: Annotated[list[Row], msgspec.Meta(min_length=1, max_length=1000)]
    joints: list[str]
    fingers: list[str]
    action: Action
    rates: Rates
    normalization: Normalization
    calibration: Any_
    perception: Any_
    servo: Any_
    initial_pose: Joints
    golden: Golden
    versions: Any_
    trained: Any_
    hand: HandEntry | None = None
    task_settings: TaskSettings | None = None
    grip: Grip | None = None
    terms: Terms | None = None


def floats(x: Any) -> list[float]:
    """Numbers as a manifest has them."""
    return [round(float(v), 9) for v in x]


def grip(g: Any) -> dict[str, Any]:
    """Return the held pose (`dexsim.tasks.stable_grasps.GraspSet`) that is most like all others: where fingers wait for
    the object, and the targets they close to."""
    middle = int((g.hand - g.hand.mean(0)).norm(dim=1).argmin())
    return {
        "hand": floats(g.hand[middle]), "target": floats(g.target[middle]), "object_pose": floats(g.pose[middle]),
        "object": g.names[int(g.shape[middle])], "object_edge_m": round(float(g.edge[middle]), 6),
    }  # fmt: skip


def hand_entry(raw: dict[str, Any], source: object) -> HandEntry:
    """Return which hand a manifest is of: bundles from before there was a choice are of the xHand."""
    return convert(raw.get("hand") or {"name": "xhand"}, HandEntry, f"{source}: hand", AGAIN)


def check(raw: dict[str, Any], source: object, hand: Hand) -> Manifest:
    """Return the manifest as declared above, of this hand. Raises UserError, one line: not a manifest, another version,
    a key missing or of the wrong type, a value outside its range or beyond what the hand can do."""
    with about(source, AGAIN):
        if raw.get("format") != FORMAT:
            raise UserError("not the manifest of a policy bundle")
        if raw.get("version") != VERSION:
            raise UserError(f"bundle version {raw.get('version')}; this dexsim reads version {VERSION}")
        m = convert(raw, Manifest, source)
        measure.of(m.task).check(m)
        for key, theirs, ours in (("joints", m.joints, hand.joints), ("fingers", m.fingers, hand.finger_names)):
            if theirs != list(ours):
                raise UserError(f"{key} are {', '.join(theirs)[:120]}, must be {', '.join(ours)}, in this order")
        _table(m)
        _rows(m, hand)
        _limits(m, hand)
    return m


def _table(m: Manifest) -> None:
    """Check that the rows follow one another and fill the observation."""
    at = 0
    for k, row in enumerate(m.observation):
        if row.start != at or row.stop <= row.start:
            raise UserError(f"observation[{k}] ({row.name}) is {row.start} to {row.stop}, must begin at {at}")
        at = row.stop
    if at != m.policy.observation_size:
        raise UserError(f"policy.observation_size={m.policy.observation_size}, its observation table has {at}")


def _rows(m: Manifest, hand: Hand) -> None:
    """Check that the loop builds each row, as wide as the policy was trained with; those of declared terms are built by
    a network of the bundle's own."""
    if m.terms is not None:
        return
    known, J, P = measure.of(m.task).ROWS, len(hand.joints), len(hand.pads)
    widths: dict[str, tuple[int, ...]] = {
        "follower_angle": (len(hand.sensed),), "object_position": (3,), "object_velocity": (3,),
        "relative_orientation": (4, 6), "contact_force": (P,), "contact_centre": (3 * P,),
        "fingertip_position": (3 * len(hand.fingers),), "force_command": (1, 2),
    }  # fmt: skip
    blind = m.task_settings is not None and m.task_settings.perception == "proprioception"
    times = m.task_settings.history if blind and m.task_settings else 1
    for row in m.observation:
        sizes = [times * n for n in widths.get(row.name, (J,))] if row.name in known else []
        if row.stop - row.start not in sizes or row.unit != known[row.name][0]:
            here = f"{' or '.join(map(str, sizes))} {known[row.name][0]}" if sizes else "no such row"
            wide = f"{row.stop - row.start} {row.unit}"
            raise UserError(f"observation {row.name} of {wide}, here {here}: use the dexsim of the bundle's versions")


def _limits(m: Manifest, hand: Hand) -> None:
    """Check that each joint has a number, that ranges and speeds lie within the hand's own, poses within the ranges."""
    low, high = hand.limits.T
    J, slack = len(hand.joints), 1e-3
    checks = [
        ("action.low", m.action.low, low, high),
        ("action.high", m.action.high, low, high),
        ("action.speed_limit_rad_s", m.action.speed_limit_rad_s, np.zeros(J), hand.speeds),
        ("initial_pose", m.initial_pose, low, high),
    ]
    if m.grip is not None:
        checks += [("grip.target", m.grip.target, low, high)]
    sizes = {key: len(values) for key, values, *_ in checks}
    sizes |= {"normalization.tau_max": len(m.normalization.tau_max), "policy.action_size": m.policy.action_size}
    if isinstance(m.action.lead, list):
        sizes["action.lead"] = len(m.action.lead)
    if m.grip is not None:
        sizes["grip.hand"] = len(m.grip.hand)
    for key, count in sizes.items():
        if count != J:
            raise UserError(f"{key}: {count}, must be {J}, one a joint of {hand.name}")
    for key, values, least, most in checks:
        for joint, value, a, b in zip(hand.joints, values, least, most, strict=True):
            if not a - slack <= value <= b + slack:
                raise UserError(f"{key} of {joint} is {value:g}, the hand's range is {a:.4g} to {b:.4g}")
    for joint, a, b in zip(hand.joints, m.action.low, m.action.high, strict=True):
        if not a < b:
            raise UserError(f"action.low of {joint} is {a:g}, action.high {b:g}; low must be below high")
