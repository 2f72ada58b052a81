"""Recordings as people have them: trajectories, values without names, a message for each joint, packed bags."""

from __future__ import annotations

import numpy as np
import pytest
import recordings
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dexsim.gap.audit import main
from dexsim.gap.plant.case import refined_cases
from dexsim.gap.read import inputs
from dexsim.gap.read.noise import noise_of
from dexsim.recording import read
from dexsim.recording.audit import audit
from dexsim.recording.mechanism import mechanism

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
TOPIC = {"/joint_commands": "/controller/joint_trajectory"}


def stamp(t):
    return TYPES["builtin_interfaces/msg/Time"](sec=int(t // 1), nanosec=int(round((t % 1) * 1e9)))


def header(t):
    return TYPES["std_msgs/msg/Header"](stamp=stamp(t), frame_id="")


def state(t, names, q):
    none = np.zeros(0)
    return TYPES["sensor_msgs/msg/JointState"](header=header(t), name=list(names), position=np.array(q, float),
                                               velocity=none, effort=none)  # fmt: skip


def array(q):
    layout = TYPES["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return TYPES["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array(q, float))


def trajectory(t, names, points, begin=None):
    """points: (s after the start, position, velocity)."""
    none = np.zeros(0)
    each = [
        TYPES["trajectory_msgs/msg/JointTrajectoryPoint"](
            positions=np.array(q, float), velocities=np.array(v, float), accelerations=none, effort=none,
            time_from_start=TYPES["builtin_interfaces/msg/Duration"](sec=int(a // 1), nanosec=int(round(a % 1 * 1e9))))
        for a, q, v in points
    ]  # fmt: skip
    return TYPES["trajectory_msgs/msg/JointTrajectory"](
        header=header(t if begin is None else begin), joint_names=list(names), points=each
    )


START = 1_700_000_000


def bag(folder, messages, storage=StoragePlugin.MCAP, packed=None, store=STORE):
    """Write a bag as `rosbags` writes it. messages: (topic, s since the start, message)."""
    writer = Writer(folder, version=9, storage_plugin=storage)
    if packed is not None:
        writer.set_compression(packed, CompressionFormat.ZSTD)
    with writer:
        channels = {}
        for topic, t, m in messages:
            kind = m.__msgtype__
            if topic not in channels:
                channels[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(channels[topic], START * 10**9 + int(round(t * 1e9)), store.serialize_cdr(m, kind))
    return folder


def follow(t, joint, delay=0.03):
    return 0.5 * np.sin(2 * np.pi * (0.4 + 0.27 * joint) * (t - delay) + joint)


def states(names, seconds=6.0, rate=100.0, noise=0.0, separate=None):
    """Return joint states, all in a message, or each in one of its own, `apart` s after the other."""
    rng = np.random.default_rng(0)
    out = []
    for t in np.arange(0.001, seconds, 1 / rate):
        if separate is None:
            q = [follow(t, k) + noise * rng.standard_normal() for k in range(len(names))]
            out.append(("/joint_states", t, state(START + t, names, q)))
            continue
        for k, name in enumerate(names):
            own = t + k * separate
            q = follow(own, k) + noise * rng.standard_normal()
            out.append(("/joint_states", own, state(START + own, [name], [q])))
    return out


@pytest.mark.parametrize("packed", [None, CompressionMode.MESSAGE, CompressionMode.FILE])
@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_bags_are_read_however_they_are_stored_and_packed(tmp_path, storage, packed):
    made = bag(tmp_path / "bag", states(("a", "b")), storage, packed)
    r = read(made)
    assert r.joints == ("a", "b") and len(r.states.position) == 600
    assert np.allclose(r.states.position.value[:, 1], follow(r.states.position.t + 0.001, 1), atol=1e-6)


def test_every_point_of_a_trajectory_is_a_target_of_its_own_time(tmp_path):
    names, messages = ("a", "b"), states(("a", "b"))
    for begin in (0.0, 2.0, 4.0):
        points = [(a, [follow(begin + a, k, 0.0) for k in (0, 1)], []) for a in np.arange(0, 2.001, 0.05)]
        messages.append((TOPIC["/joint_commands"], begin, trajectory(START + begin, names, points)))
    messages.sort(key=lambda x: x[1])
    r = read(bag(tmp_path / "bag", messages), remap=TOPIC)
    assert len(r.commands) == 3 * 41
    assert np.allclose(r.commands.value[:, 0], follow(r.commands.t, 0, 0.0), atol=1e-6)
    line = r.targets()
    assert np.diff(line.t).max() < 0.0051 and np.abs(line.value[:, 0] - follow(line.t, 0, 0.0)).max() < 2e-3
    assert not [f for f in audit(r) if f.kind == "clock_skew"]


def test_single_points_ahead_of_time_are_targets_of_that_time(tmp_path):
    messages = states(("a",))
    for t in np.arange(0, 6, 0.01):
        points = [(0.2, [follow(t + 0.2, 0, 0.0)], [])]
        messages.append((TOPIC["/joint_commands"], t, trajectory(START + t, ["a"], points)))
    r = read(bag(tmp_path / "bag", messages), remap=TOPIC)
    assert r.commands.t[0] == pytest.approx(0.2) and len(r.commands) == 600
    assert np.allclose(r.commands.value[:, 0], follow(r.commands.t, 0, 0.0), atol=1e-6)


def test_a_trajectory_replaces_what_has_not_come_yet_and_its_start_may_be_stated(tmp_path):
    messages = [
        (TOPIC["/joint_commands"], 0.0, trajectory(START, ["a"], [(0.0, [0.0], []), (4.0, [4.0], [])])),
        (TOPIC["/joint_commands"], 1.0, trajectory(START + 1, "a", [(1.0, [1.0], []), (2.0, [1.0], [])], START + 1.5)),
    ]
    r = read(bag(tmp_path / "bag", [*messages, *states(("a",))]), remap=TOPIC)
    at = lambda t: float(np.interp(t, r.commands.t, r.commands.value[:, 0]))  # noqa: E731
    assert at(1.4) == pytest.approx(1.4) and at(2.5) == pytest.approx(1.0) and at(3.5) == pytest.approx(1.0)
    assert r.commands.t[-1] == pytest.approx(3.5)


def test_points_far_apart_are_joined_as_a_controller_joins_them(tmp_path):
    """Between points with speeds the controller goes along a cubic, which at rest at both ends is slowest there."""
    points = [(0.0, [0.0], [0.0]), (2.0, [1.0], [0.0])]
    m = [(TOPIC["/joint_commands"], 0.0, trajectory(START, ["a"], points))]
    r = read(bag(tmp_path / "bag", [*m, *states(("a",))]), remap=TOPIC)
    u = r.commands.t / 2
    assert len(r.commands) > 19 and np.allclose(r.commands.value[:, 0], 3 * u**2 - 2 * u**3, atol=1e-9)


def commands(order, seconds=6.0):
    return [("/joint_commands", t, array([follow(t, k, 0.0) for k in order])) for t in np.arange(0, seconds, 0.01)]


def test_values_without_names_are_said_and_found_where_another_joint_follows_them(tmp_path, capsys):
    made = bag(tmp_path / "bag", [*states(("a", "b", "c")), *commands((0, 2, 1))])
    r = read(made)
    said = {f.kind: f for f in r.findings if f.topic == "/joint_commands"}
    assert "taken in the order a, b, c" in said["joint_names"].text and said["joint_names"].severity == "warning"
    found = [f for f in r.findings if f.kind == "joint_order"]
    assert {f.joint for f in found} == {"b", "c"} and all(f.severity == "error" for f in found)
    assert all(f.text.endswith("meta.joint_names=a,c,b") for f in found)
    assert main([str(made)]) == 1 and "meta.joint_names=a,c,b out=" in capsys.readouterr().out  # what to run next
    a_models_order = read(made, joints=("c", "b", "a")).findings  # the values' own is what is said
    assert all(f.text.endswith("meta.joint_names=a,c,b") for f in a_models_order if f.kind == "joint_order")
    right = read(made, meta={"joint_names": "[a,c,b]"})
    assert not [f for f in right.findings if f.kind == "joint_order" or f.severity == "warning" and "order" in f.text]
    k = right.joints.index("c")
    assert np.allclose(right.commands.value[:, k], follow(right.commands.t, 2, 0.0), atol=1e-6)


def test_an_array_for_some_of_the_joints_takes_the_names_that_are_stated(tmp_path):
    """A controller of one joint of three, whose commands are arrays of one value."""
    made = bag(tmp_path / "bag", [*states(("a", "b", "c")), *commands((1,))])
    (f,) = [f for f in read(made).findings if f.kind == "malformed"]
    assert "meta.joint_names=a,b,..." in f.text
    r = read(made, meta={"joint_names": "b"})
    sent = r.commands.value[:, r.joints.index("b")]
    assert np.allclose(sent, follow(r.commands.t, 1, 0.0), atol=1e-6) and set(r.joints) == {"a", "b", "c"}
    assert np.isfinite(r.states.position.value).all() and not [f for f in r.findings if f.kind == "malformed"]


def test_joints_that_move_alike_are_not_taken_for_one_another(tmp_path):
    r = read(bag(tmp_path / "bag", [*states(("a", "b")), *commands((0, 1))]))
    assert not [f for f in r.findings if f.kind == "joint_order"]
    same = [("/joint_commands", t, array([follow(t, 0, 0.0)] * 2)) for t in np.arange(0, 6, 0.01)]
    both = [("/joint_states", t, state(START + t, "ab", [follow(t, 0)] * 2)) for t in np.arange(0.001, 6, 0.01)]
    r = read(bag(tmp_path / "same", [*both, *same]))
    assert not [f for f in r.findings if f.kind == "joint_order"]


CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
POINT = "trajectory_msgs/JointTrajectoryPoint"


def controllers(fields):
    """Return the types of messages, with a controller's state of these fields."""
    own = get_typestore(Stores.ROS2_HUMBLE)
    text = "\n".join(["std_msgs/Header header", "string[] joint_names", *(f"{POINT} {n}" for n in fields)])
    own.register(get_types_from_msg(text, CONTROLLER))
    return own


def controller_state(typestore, t, names, fields):
    """Return fields: name -> positions."""
    none, zero = np.zeros(0), TYPES["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
    kind = TYPES["trajectory_msgs/msg/JointTrajectoryPoint"]
    rest = {"velocities": none, "accelerations": none, "effort": none, "time_from_start": zero}
    each = {n: kind(positions=np.array(q, float), **rest) for n, q in fields.items()}
    return typestore.types[CONTROLLER](header=header(START + t), joint_names=list(names), **each)


@pytest.mark.parametrize("fields", [("reference", "feedback", "error", "output"), ("desired", "actual", "error")])
@pytest.mark.parametrize("alone", [True, False])
def test_the_state_of_a_trajectory_controller_is_read_by_itself(tmp_path, fields, alone):
    """`control_msgs/JointTrajectoryControllerState`, new and old: its reference is the command, as it was
    interpolated."""
    own = controllers(fields)
    messages = [] if alone else states(("a", "b"))
    for t in np.arange(0, 6, 0.02):
        goal, read_ = [follow(t, k, 0.0) for k in (1, 0)], [follow(t, k) for k in (1, 0)]
        values = {n: (goal, read_, [0.0, 0.0], [])[k] for k, n in enumerate(fields)}
        messages.append(("/arm_controller/controller_state", t, controller_state(own, t, "ba", values)))
    r = read(bag(tmp_path / "bag", sorted(messages, key=lambda m: m[1]), store=own))
    j = r.joints.index("b")
    assert len(r.commands) == 300 and np.allclose(r.commands.value[:, j], follow(r.commands.t, 1, 0.0), atol=1e-6)
    assert len(r.states.position) == (300 if alone else 600)
    assert any("a controller's " + fields[0] in f.text or "controller's reference" in f.text for f in r.findings)


def test_what_a_controller_is_sent_is_the_command_where_nothing_else_is(tmp_path):
    points = [(a, [follow(a, k, 0.0) for k in (0, 1)], []) for a in np.arange(0, 5.9, 0.05)]
    sent = ("/arm/joint_trajectory", 0.0, trajectory(START, ("a", "b"), points))
    r = read(bag(tmp_path / "one", [sent, *states(("a", "b"))]))
    assert len(r.commands) == len(points) and any("a trajectory; say otherwise" in f.text for f in r.findings)
    more = [("/hand_controller/commands", t, m) for _, t, m in commands((0, 1))]
    assert len(read(bag(tmp_path / "two", [*states(("a", "b")), *more])).commands) == len(more)
    two = [sent, ("/leg/joint_trajectory", *sent[1:]), *states(("a", "b"))]
    r = read(bag(tmp_path / "three", two))
    assert not len(r.commands) and any("could be any of" in f.text for f in r.findings)


RIG = """<mujoco><compiler angle="radian"/><worldbody>{}</worldbody></mujoco>"""
LINK = """<body pos="0 {k} 0"><joint name="{n}" axis="0 1 0" armature="1e-3" range="-2 2"/>
<geom type="sphere" size="0.02" pos="0 0 -0.1" mass="0.1" contype="0" conaffinity="0"/></body>"""


@pytest.mark.slow
@pytest.mark.parametrize("joints", [("a", "b"), ("a", "b", "c")])
def test_a_joint_has_a_time_axis_of_its_own(tmp_path, joints):
    """A message for each joint says of it what a message for all does: its noise, its rate, and no faults."""
    rig = tmp_path / "rig.xml"
    rig.write_text(RIG.format("".join(LINK.format(k=k, n=n) for k, n in enumerate(joints))))
    m = mechanism(str(rig), {"joints": {"*": {"kp": 2.0, "kd": 0.04}}})
    noise, number = 4e-4, range(len(joints))
    goals = [(t, [follow(t, k, 0.0) for k in number]) for t in np.arange(0, 6, 0.01)]
    sent = [("/joint_commands", t, state(START + t, joints, q)) for t, q in goals]
    sigma = {}
    for kind, separate in (("all", None), ("each", 2e-4), ("spread", 3e-3)):
        r = read(bag(tmp_path / kind, [*states(joints, noise=noise, separate=separate), *sent]), joints=joints)
        assert {f.kind for f in r.findings} <= {"missing_metadata"}, [f.text for f in r.findings]
        run = inputs.to_run(r, m, notes := [])
        assert run.joints == joints and not notes and run.period == pytest.approx(0.01)
        sigma[kind] = [noise_of(run, j)[0] for j in range(len(joints))]
        cases = refined_cases(m.spec.compile(), [run], "cpu", 1e-3)
        assert [len(c.plant.windows(None).sample_row) for c in cases] == [600] * len(joints)
        for j in range(len(joints)):
            t, q = run.readings(j)
            assert len(t) == 600 and np.abs(q - follow(t, j)).max() < 5 * noise
    assert np.allclose(sigma["each"], sigma["all"], rtol=0.15) and np.allclose(sigma["spread"], sigma["all"], rtol=0.15)
    assert np.allclose(sigma["all"], noise, rtol=0.15)


def test_a_value_that_is_missing_in_a_message_of_its_joint_is_still_a_fault(tmp_path):
    r = recordings.signal(joints=("a", "b"))
    r.states.position.value[100:140, 0] = np.nan
    found = [f for f in audit(r) if f.kind == "nan"]
    assert len(found) == 1 and found[0].count == 40 and found[0].joint == "a"
