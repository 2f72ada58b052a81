"""Recordings written and read back: whole, foreign, truncated, damaged."""

from __future__ import annotations

import io
import json
import multiprocessing
import struct
import time

import numpy as np
import pytest
import recordings
import yaml
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.writer import Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as Ros2Writer

from dexsim.errors import UserError
from dexsim.recording import Writer, cdr, read, ros2, write
from dexsim.recording.schema import IMU_TYPE, JOINT_STATE, MULTI_ARRAY, POSE, WRENCH
from tools.assets import xhand

DEFINITIONS = {kind: cdr.definition(kind) for kind in (IMU_TYPE, JOINT_STATE, MULTI_ARRAY, POSE, WRENCH)}
HEADER = {"stamp": {"sec": 12, "nanosec": 34}, "frame_id": "palm"}


def ros2_bytes(kind, definition, message):
    """Return a message as mcap_ros2 encodes it, read back from a file that its writer wrote."""
    file = io.BytesIO()
    w = Ros2Writer(file)
    w.write_message("/any", w.register_msgdef(kind, definition), message, 1)
    w.finish()
    ((_, _, written),) = make_reader(io.BytesIO(file.getvalue())).iter_messages()
    return written.data


def ros2_decoder(kind, definition):
    """Return mcap_ros2's decoder of messages of a kind."""
    return DecoderFactory().decoder_for("cdr", Schema(id=1, name=kind, encoding="ros2msg", data=definition.encode()))


def kinds(recording, severity=None):
    return [f.kind for f in recording.findings if severity is None or f.severity == severity]


# --- bytes


def test_messages_are_the_bytes_that_mcap_ros2_writes():
    stamp = 12 * 10**9 + 34
    position, effort = np.array([1.0, -2.5]), np.array([0.25, np.nan])
    made = {
        JOINT_STATE: (
            cdr.joint_state(stamp, ("one", "two"), position, None, effort),
            {
                "header": HEADER | {"frame_id": ""},
                "name": ["one", "two"],
                "position": [1.0, -2.5],
                "velocity": [],
                "effort": [0.25, float("nan")],
            },
        ),
        MULTI_ARRAY: (
            cdr.multi_array(np.arange(6.0).reshape(2, 3), ("row", "column")),
            {
                "layout": {
                    "dim": [{"label": "row", "size": 2, "stride": 6}, {"label": "column", "size": 3, "stride": 3}],
                    "data_offset": 0,
                },
                "data": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
            },
        ),
        WRENCH: (
            cdr.wrench(stamp, "palm", np.arange(6.0)),
            {
                "header": HEADER,
                "wrench": {"force": {"x": 0.0, "y": 1.0, "z": 2.0}, "torque": {"x": 3.0, "y": 4.0, "z": 5.0}},
            },
        ),
        POSE: (
            cdr.pose(stamp, "palm", np.arange(7.0)),
            {
                "header": HEADER,
                "pose": {
                    "position": {"x": 0.0, "y": 1.0, "z": 2.0},
                    "orientation": {"w": 3.0, "x": 4.0, "y": 5.0, "z": 6.0},
                },
            },
        ),
        IMU_TYPE: (
            cdr.imu(stamp, "palm", np.arange(10.0)),
            {
                "header": HEADER,
                "orientation": {"w": 0.0, "x": 1.0, "y": 2.0, "z": 3.0},
                "orientation_covariance": [0.0] * 9,
                "angular_velocity": {"x": 4.0, "y": 5.0, "z": 6.0},
                "angular_velocity_covariance": [0.0] * 9,
                "linear_acceleration": {"x": 7.0, "y": 8.0, "z": 9.0},
                "linear_acceleration_covariance": [0.0] * 9,
            },
        ),
    }
    for kind, (ours, message) in made.items():
        assert ours == ros2_bytes(kind, DEFINITIONS[kind], message), kind


def plain(m):
    """Return a message of either library as plain data."""
    if hasattr(m, "__slots__") or hasattr(m, "__dataclass_fields__"):
        names = getattr(m, "__dataclass_fields__", None) or m.__slots__
        return {n: plain(getattr(m, n)) for n in names if not n.startswith("_")}
    return [plain(x) for x in m] if isinstance(m, (list, tuple, np.ndarray)) else m


@pytest.mark.parametrize("kind", sorted(DEFINITIONS))
def test_messages_are_decoded_to_what_mcap_ros2_decodes(kind):
    """Both libraries, on messages that either of them wrote, of both byte orders for those of numbers alone."""
    rng = np.random.default_rng(0)
    t, x = 12 * 10**9 + 34, rng.standard_normal(12)
    made = {
        JOINT_STATE: cdr.joint_state(t, ("one", "two"), x[:2], None, x[2:4]),
        MULTI_ARRAY: cdr.multi_array(x.reshape(3, 4), ("row", "column")),
        WRENCH: cdr.wrench(t, "palm", x[:6]),
        POSE: cdr.pose(t, "", x[:7]),
        IMU_TYPE: cdr.imu(t, "object", x[:10]),
    }[kind]
    theirs = ros2_decoder(kind, DEFINITIONS[kind])
    ours = ros2.decoder(kind, "ros2msg", DEFINITIONS[kind])
    assert ours is ros2.decoder(kind, "ros2msg", DEFINITIONS[kind])  # parsed once
    for data in (made, ros2_bytes(kind, DEFINITIONS[kind], theirs(made))):
        assert plain(ours(data)) == plain(theirs(data))
    with pytest.raises(Exception, match=".+"):
        ours(made[: len(made) // 2])


def test_a_bag_that_rosbags_wrote(tmp_path):
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Bag
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    Time, Header, State = (store.types[k] for k in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header", JOINT_STATE))
    q = np.random.default_rng(0).standard_normal((20, 2))
    with Bag(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for topic in ("/joint_states", "/joint_commands"):
            connection = bag.add_connection(topic, JOINT_STATE, typestore=store)
            for i, x in enumerate(q):
                ns = 10**18 + i * 10**7
                m = State(Header(Time(ns // 10**9, ns % 10**9), ""), ["a", "b"], x, np.zeros(0), 2 * x)
                bag.write(connection, ns, store.serialize_cdr(m, JOINT_STATE))
    r = read(tmp_path / "bag", audit=False)
    np.testing.assert_array_equal(r.states.position.value, q)
    np.testing.assert_array_equal(r.states.effort.value, 2 * q)
    assert r.states.position.stamp[7] == pytest.approx(0.07) and r.states.velocity is None


@pytest.mark.parametrize(
    "name, text, says",
    [
        ("a/msg/B", "a/C c\n", "a/msg/C"),
        ("a/msg/B", "B b\n", "recursion"),
        ("a/msg/B\nimport os", "float64 x\n", "no message's"),
        ("a/msg/B", "float64 x\n" * 9999, "characters"),
        ("B", "float64 x", "no message's"),
        ("a/msg/B", "float64 1x\n", "."),
        ("a/msg/B", "\x00", "."),
    ],
)
def test_definitions_of_no_message_are_refused(name, text, says):
    with pytest.raises(ros2.BadDefinition, match=says):
        ros2.decoder(name, "ros2msg", text)


# --- round trip


def test_every_topic_comes_back_as_it_was(tmp_path):
    made = recordings.signal(2.0, tactile=True)
    made.enabled, made.duty = made.temperature, made.temperature
    made.config = "worlds: 3\n"
    write(tmp_path / "a.mcap", made)
    back = read(tmp_path / "a.mcap", audit=False)
    assert back.joints == ("a", "b") and back.start_ns == made.start_ns and back.config == made.config
    assert {k: v for k, v in back.meta.items() if k != "effort_sign"} == {
        k: v for k, v in made.meta.items() if k != "effort_sign"
    }
    assert list(back.effort_sign) == [1, 1] and back.findings == []
    pairs = [
        (made.commands, back.commands),
        (made.imu, back.imu),
        (made.object_pose, back.object_pose),
        (made.external_force, back.external_force),
    ]
    pairs += [(getattr(made.states, n), getattr(back.states, n)) for n in ("position", "velocity", "effort")]
    for a, b in pairs:
        np.testing.assert_allclose(b.t, a.t, atol=1e-9)
        np.testing.assert_array_equal(b.value, a.value)
        # a stamp of 0 means none, but these are ns since 1970
        np.testing.assert_allclose(b.stamp, a.stamp, atol=1e-9)
    assert back.external_force.frame == "load_cell"
    for name in ("temperature", "enabled", "duty", "supply_voltage", "tactile"):  # float32 on the wire
        np.testing.assert_array_equal(getattr(back, name).value, getattr(made, name).value.astype(np.float32))
    newtons = back.tactile_newtons().value
    np.testing.assert_allclose(newtons, 0.1 * back.tactile.value)


def test_other_programs_read_what_we_write(tmp_path):
    made = recordings.signal(1.0)
    write(tmp_path / "a.mcap", made)
    with open(tmp_path / "a.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        (record,) = [m for m in reader.iter_metadata() if m.name == "dexsim"]
        assert record.metadata["effort_is"] == "current_A"
        rows = [m for *_, m in reader.iter_decoded_messages(topics=["/joint_states"])]
    assert len(rows) == len(made.states.position) and rows[3].name == ["a", "b"]
    np.testing.assert_array_equal([r.position for r in rows], made.states.position.value)


def test_a_bad_metadata_key_or_place_is_refused(tmp_path):
    with pytest.raises(UserError, match="'efort_is' does not exist"):
        Writer(tmp_path / "a.mcap", ("a",), {"efort_is": "none"})
    with pytest.raises(UserError, match="cannot write recording"):
        Writer(tmp_path / "nowhere" / "a.mcap", ("a",))


# --- recordings of others


def foreign(
    path,
    names=("right_hand_index_joint1", "right_hand_mid_joint1"),
    topics=("/hand/joint_states", "/hand/controller/joint_commands"),
    count=50,
    effort=True,
):
    """Return a bag as rosbag2 would write it: no metadata of ours, a prefix, a namespace, no velocity."""
    with open(path, "wb") as file:
        w = Ros2Writer(file, chunk_size=2000)
        kind = w.register_msgdef(JOINT_STATE, DEFINITIONS[JOINT_STATE] + "# a comment\n")
        for i in range(count):
            t = 10**18 + i * 10_000_000
            stamp = {"sec": t // 10**9, "nanosec": t % 10**9}
            header = {"stamp": stamp, "frame_id": ""}
            x = [0.5 + 0.3 * np.sin(0.1 * i), 0.4 + 0.2 * np.cos(0.1 * i)]
            w.write_message(
                topics[0],
                kind,
                {"header": header, "name": list(names), "position": x, "velocity": [], "effort": x if effort else []},
                t,
            )
            # the command names its joints the other way round
            w.write_message(
                topics[1],
                kind,
                {"header": header, "name": list(names)[::-1], "position": x[::-1], "velocity": [], "effort": []},
                t,
            )
        w.finish()
    return path


def test_a_ros2_bag_of_another_driver(tmp_path):
    r = read(foreign(tmp_path / "bag.mcap"))
    assert r.joints == ("index_joint1", "mid_joint1")
    np.testing.assert_array_equal(r.commands.value, r.states.position.value)
    assert r.states.velocity is None and r.states.effort is not None
    topics = {f.topic: f.text for f in r.findings if f.kind == "topic"}
    assert (
        "/hand/joint_states" in topics["/joint_states"]
        and "/hand/controller/joint_commands" in topics["/joint_commands"]
    )
    stated = {f.text.split()[0]: f.severity for f in r.findings if f.kind == "missing_metadata"}
    assert stated["effort_is"] == stated["effort_sign"] == stated["gravity"] == "warning" and r.effort_is == "torque_Nm"


def test_topics_and_names_given_by_hand(tmp_path):
    path = foreign(tmp_path / "bag.mcap", names=("m7", "m9"), topics=("/a", "/b"))
    assert read(path, remap={"/joint_states": "/a"}).joints == ("m7", "m9")
    r = read(
        path,
        remap={"joint_states": "/a", "/joint_commands": "/b", "elbow": "m9", "shoulder": "m7"},
        joints=("shoulder", "elbow", "wrist"),
    )
    assert r.joints == ("shoulder", "elbow")
    assert r.states.position.value[0, 0] == pytest.approx(0.5)
    r = read(
        path, remap={"/joint_states": "/a", "elbow": "m9"}, joints=("elbow",)
    )  # a subset: the other is left out, and said
    assert r.joints == ("elbow",) and any("left out: m7" in f.text for f in r.findings)
    with pytest.raises(UserError, match="has no topic '/c'.*/a .*JointState"):
        read(path, remap={"/joint_states": "/c"})
    with pytest.raises(UserError, match="no joint 'm8'; it has: m7, m9"):
        read(path, remap={"/joint_states": "/a", "elbow": "m8"}, joints=("elbow",))
    with pytest.raises(UserError, match="none of its joints"):
        read(path, remap={"/joint_states": "/a"}, joints=("index_joint1",))


def test_a_short_name_is_not_taken_for_another(tmp_path):
    assert read(foreign(tmp_path / "a.mcap", names=("joint", "bend_joint"))).joints == ("joint", "bend_joint")
    r = read(
        foreign(tmp_path / "b.mcap", names=("joint1", "mid_joint1")), joints=("rig_joint1", "mid_joint1", "x_joint2")
    )
    assert r.joints == ("rig_joint1", "mid_joint1")
    assert read(foreign(tmp_path / "c.mcap", names=("joint1", "b")), joints=("x_joint1", "y_joint1", "b")).joints == (
        "b",
    )


def test_two_hands_in_one_bag(tmp_path):
    r = read(
        foreign(tmp_path / "b.mcap", names=("left_hand_index_joint1", "right_hand_index_joint1")), joints=xhand.JOINTS
    )
    assert r.joints == ("index_joint1",) and r.states.position.value[0, 0] == pytest.approx(0.6)
    with pytest.raises(UserError, match="could both be joint 'index_joint1'.*remap.index_joint1="):
        read(foreign(tmp_path / "c.mcap", names=("one/index_joint1", "two/index_joint1")), joints=xhand.JOINTS)


def test_metadata_beside_the_file_and_by_hand(tmp_path):
    path = foreign(tmp_path / "bag.mcap")
    (tmp_path / "bag.mcap.yaml").write_text(
        yaml.safe_dump(
            {
                "effort_is": "current_A",
                "effort_sign": -1,
                "effort_unit": "mA",
                "gravity": [0, 0, 9.81],
                "servo": {"joints": {"*": {"kp": 2}}},
            }
        )
    )
    r = read(path, meta={"robot": "mine", "effort_sign": "-1,+1"})
    assert r.effort_is == "current_A" and r.meta["robot"] == "mine" and r.gravity[2] == 9.81
    assert list(r.effort_sign) == [-1, 1] and yaml.safe_load(r.meta["servo"]) == {"joints": {"*": {"kp": 2}}}
    np.testing.assert_allclose(r.states.effort.value, 1e-3 * r.states.position.value)
    np.testing.assert_allclose(r.signed_effort().value[:, 0], -r.states.effort.value[:, 0])
    assert "metadata_override" in kinds(r) and "unit" in kinds(r)
    for bad, text in (
        ({"effort_is": "mA"}, "must be one of current_A"),
        ({"effort": "x"}, "does not exist"),
        ({"effort_sign": "+1,-1,+1"}, "must be 2 finite numbers"),
        ({"servo": "a: [1"}, "cannot be read as YAML"),
    ):
        with pytest.raises(UserError, match=text):
            read(path, meta=bad)


@pytest.mark.parametrize(
    "key, value", [("gravity", "down"), ("gravity", "0 0"), ("tactile_axis_sign", "1"), ("tactile_lsb", "a tenth")]
)
def test_metadata_that_is_no_number_is_named(tmp_path, key, value):
    path = foreign(tmp_path / "a.mcap")
    with pytest.raises(UserError, match=f"metadata {key}='{value}'"):
        read(path, meta={key: value})


def test_signs_follow_the_joints_when_they_are_reordered(tmp_path):
    made = recordings.signal(1.0, ("index_joint1", "thumb_bend_joint"))
    made.meta["effort_sign"] = "-1,0"
    write(tmp_path / "a.mcap", made)
    r = read(tmp_path / "a.mcap")
    assert r.joints == ("thumb_bend_joint", "index_joint1") and list(r.effort_sign) == [0, -1]
    assert np.isnan(r.signed_effort().value[:, 0]).all()


def test_a_split_bag_folder(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    made = recordings.signal(2.0)
    first, second = recordings.signal(2.0), recordings.signal(2.0)
    for part, keep in ((first, made.commands.t < 1.0), (second, made.commands.t >= 1.0)):
        part.temperature = part.supply_voltage = None
        for s in (part.commands, part.states.position, part.states.velocity, part.states.effort):
            s.t, s.value, s.stamp = s.t[keep], s.value[keep], s.stamp[keep]
    write(folder / "bag_0.mcap", first)
    write(folder / "bag_1.mcap", second)
    r = read(folder)
    assert len(r.commands) == len(made.commands) and not kinds(r, "error")
    np.testing.assert_array_equal(r.states.position.value, made.states.position.value)


def test_json_messages(tmp_path):
    with open(tmp_path / "j.mcap", "wb") as file:
        w = McapWriter(file)
        w.start()
        schema = w.register_schema("JointState", "jsonschema", b"{}")
        states = w.register_channel("/robot/joint_states", "json", schema)
        touch = w.register_channel("/tactile", "json", schema)
        for i in range(20):
            t = 5 * 10**9 + i * 10**7
            message = {
                "header": {"stamp": {"sec": t // 10**9, "nsec": t % 10**9}},
                "name": ["b", "a"],
                "position": [0.1 * i, None],
                "effort": [1, 2],
            }
            w.add_message(states, t, json.dumps(message).encode(), t)
            w.add_message(touch, t, json.dumps({"data": [float(i)] * 30}).encode(), t)
        w.finish()
    r = read(tmp_path / "j.mcap", joints=("a", "b"))
    np.testing.assert_allclose(r.states.position.value[:, 1], 0.1 * np.arange(20))
    assert np.isnan(r.states.position.value[:, 0]).all() and r.states.effort.value[0, 0] == 2.0
    assert r.states.position.stamp[3] == pytest.approx(0.03) and r.tactile.value.shape == (20, 5, 2, 3)


def test_protobuf_messages(tmp_path):
    pb = pytest.importorskip("google.protobuf.descriptor_pb2")
    from google.protobuf import descriptor_pool, message_factory

    file = pb.FileDescriptorProto(name="x.proto", package="x", syntax="proto3")
    m = file.message_type.add(name="Joints")
    m.field.add(name="name", number=1, type=9, label=3)
    m.field.add(name="position", number=2, type=1, label=3)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    cls = message_factory.GetMessageClass(pool.FindMessageTypeByName("x.Joints"))
    with open(tmp_path / "p.mcap", "wb") as out:
        w = McapWriter(out)
        w.start()
        schema = w.register_schema("x.Joints", "protobuf", pb.FileDescriptorSet(file=[file]).SerializeToString())
        channel = w.register_channel("/joint_states", "protobuf", schema)
        for i in range(5):
            w.add_message(channel, 10**9 + i, cls(name=["a"], position=[0.5 * i]).SerializeToString(), 0)
        w.finish()
    assert read(tmp_path / "p.mcap", audit=False).states.position.value[:, 0].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]


IDL = '''
================================================================================
IDL: my_robot/msg/HandState
// generated by rosidl
#include "std_msgs/msg/Header.idl"
module my_robot {
  module msg {
    typedef double double__3[3];
    module HandState_Constants {
      const uint8 MODE_PASSIVE = 0;
    };
    @verbatim (language="comment", text="a hand; with (brackets)" "and two strings")
    struct HandState {
      std_msgs::msg::Header header;
      uint8 mode;
      sequence<string> name;
      sequence<double, 16> position;
      @unit (value="A")
      double__3 effort;
      sequence<my_robot::msg::Board> boards;
      boolean ok, homed;
    };
  };
};

================================================================================
IDL: my_robot/msg/Board
module my_robot { module msg { struct Board { unsigned short code; float temperature; string<8> label; }; }; };
================================================================================
IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
================================================================================
IDL: builtin_interfaces/msg/Time
module builtin_interfaces { module msg { struct Time { long sec; unsigned long nanosec; }; }; };
'''
SAME = """std_msgs/Header header
uint8 mode
string[] name
float64[] position
float64[3] effort
my_robot/Board[] boards
bool ok
bool homed
================================================================================
MSG: my_robot/Board
uint16 code
float32 temperature
string label
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def write_idl(path, definition):
    """Return a bag whose joint states are of a type of its own, described in IDL, beside commands of the standard
    type, also in IDL."""
    with open(path, "wb") as file:
        w = McapWriter(file)
        w.start(profile="ros2")
        states = w.register_channel(
            "/joint_states", "cdr", w.register_schema("my_robot/msg/HandState", "ros2idl", definition.encode())
        )
        commands = w.register_channel(
            "/joint_commands", "cdr", w.register_schema(JOINT_STATE, "ros2idl", b"module sensor_msgs {};")
        )
        for i in range(20):
            t = 10**18 + i * 10**7
            header = {"stamp": {"sec": t // 10**9, "nanosec": t % 10**9}, "frame_id": "palm"}
            boards = [{"code": 7, "temperature": 30.5, "label": "tip"}] * (i % 3)
            w.add_message(
                states,
                t,
                ros2_bytes(
                    "my_robot/msg/HandState",
                    SAME,
                    {
                        "header": header,
                        "mode": 3,
                        "name": ["a", "b", "c"],
                        "position": [0.1 * i, 0.2, 0.3],
                        "effort": [1.0, 2.0, i],
                        "boards": boards,
                        "ok": True,
                        "homed": False,
                    },
                ),
                t,
            )
            w.add_message(commands, t, cdr.joint_state(t, ("a", "b", "c"), np.array([0.0, 0.1, 0.2])), t)
        w.finish()
    return path


def test_messages_described_in_idl(tmp_path):
    r = read(write_idl(tmp_path / "i.mcap", IDL))
    np.testing.assert_allclose(r.states.position.value[:, 0], 0.1 * np.arange(20))
    np.testing.assert_allclose(r.states.effort.value[:, 2], np.arange(20))
    assert r.joints == ("a", "b", "c") and r.states.position.stamp[3] == pytest.approx(0.03) and len(r.commands) == 20


@pytest.mark.parametrize("change, says", [
    (lambda s: s.replace("boolean ok, homed;", "map<string, long> "
                                               "ok;"), "IDL definition of my_robot/msg/HandState is not read"),
    (lambda s: s[:300], "is not read"),
    (lambda s: s.replace("IDL: my_robot/msg/Board", "").replace("struct Board", "struct Bored"), "my_robot/msg/Board "
                                                                                                 "is used and not "
                                                                                                 "defined"),
    (lambda s: s.replace("struct HandState", "union HandState"), "is not"),
])  # fmt: skip
def test_idl_that_is_not_read_says_so(tmp_path, change, says):
    with pytest.raises(UserError, match=says) as caught:
        read(write_idl(tmp_path / "i.mcap", change(IDL)))
    assert "\n" not in str(caught.value)


def test_an_unknown_encoding_is_named(tmp_path):
    with open(tmp_path / "p.mcap", "wb") as out:
        w = McapWriter(out)
        w.start()
        w.add_message(
            w.register_channel("/joint_states", "ros1", w.register_schema("sensor_msgs/JointState", "ros1msg", b"x")),
            1,
            b"abc",
            1,
        )
        w.finish()
    with pytest.raises(UserError, match="encoded as 'ros1'"):
        read(tmp_path / "p.mcap")


# --- files in a bad state


@pytest.mark.parametrize(
    "content, text",
    [
        (b"", "is empty"),
        (b"hello world", "not an MCAP"),
        (b"SQLite format 3\0", "SQLite file cannot be read"),
        (b"#ROSBAG V2.0\n", "rosbags-convert"),
        (None, "does not exist"),
    ],
)
def test_what_is_no_recording(tmp_path, content, text):
    if content is not None:
        (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(UserError, match=text):
        read(tmp_path / "a.mcap")


def test_a_recording_without_joints_lists_what_it_has(tmp_path):
    with open(tmp_path / "a.mcap", "wb") as file:
        w = Ros2Writer(file)
        w.write_message(
            "/odd",
            w.register_msgdef(MULTI_ARRAY, DEFINITIONS[MULTI_ARRAY]),
            {"layout": {"dim": [], "data_offset": 0}, "data": [1.0]},
            1,
        )
        w.finish()
    with pytest.raises(UserError, match="neither /joint_states nor /joint_commands.*/odd"):
        read(tmp_path / "a.mcap")


@pytest.fixture(scope="module")
def chunked(tmp_path_factory):
    """Return a file of about ten chunks, its bytes and the offsets of its chunk records."""
    path = tmp_path_factory.mktemp("chunked") / "whole.mcap"
    write(path, recordings.signal(10.0))
    data = path.read_bytes()
    at, offsets = 8, []
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == 6:
            offsets.append((at, length))
        at += 9 + length
    return path, data, offsets


def test_a_truncated_file_gives_what_is_whole(chunked, tmp_path):
    path, data, offsets = chunked
    whole = read(path)
    assert len(offsets) >= 8 and "damage" not in kinds(whole)
    at, length = offsets[5]
    counts = []
    for cut in (at, at + 9 + length // 2, at + 9 + length):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        r = read(tmp_path / "cut.mcap")
        n = len(r.states.position)
        counts.append(n)
        np.testing.assert_array_equal(r.states.position.value, whole.states.position.value[:n])
        assert "damage" in kinds(r, "error")
    assert 450 <= counts[0] <= counts[1] <= counts[2] < 1000 and counts[2] > counts[0] + 50


@pytest.mark.parametrize("damage", ["byte", "length"])
def test_a_damaged_chunk_costs_only_itself(chunked, tmp_path, damage):
    path, data, offsets = chunked
    whole, (at, length) = read(path), offsets[4]
    broken = bytearray(data)
    if damage == "byte":
        broken[at + 9 + length // 2] ^= 0xFF
    else:  # the length of the record itself: the reader has to find its place again
        broken[at + 1 : at + 9] = struct.pack("<Q", 2**40)
    (tmp_path / "bad.mcap").write_bytes(broken)
    r = read(tmp_path / "bad.mcap")
    lost = len(whole.states.position) - len(r.states.position)
    assert 50 < lost < 150, lost
    saved = np.isin(np.round(whole.states.position.t, 6), np.round(r.states.position.t, 6))
    np.testing.assert_array_equal(r.states.position.value, whole.states.position.value[saved])
    assert "damage" in kinds(r, "error") and "gap" in kinds(r)


def test_the_first_chunk_lost_still_names_the_channels(chunked, tmp_path):
    path, data, offsets = chunked  # schemas and channels are repeated at the end of a finished file
    broken = bytearray(data)
    broken[offsets[0][0] + 60] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(broken)
    assert len(read(tmp_path / "bad.mcap").states.position) > 850
    (tmp_path / "bad.mcap").write_bytes(broken[: offsets[6][0]])  # and where they are not, it is said
    with pytest.raises(UserError, match="chunk .* is lost"):
        read(tmp_path / "bad.mcap")


def test_a_killed_writer_leaves_its_finished_chunks(tmp_path):
    fork = multiprocessing.get_context("fork")
    now = fork.Event()

    def write_for_ever():
        w = Writer(tmp_path / "k.mcap", ("a",))
        for i in range(100000):
            w.add_state(0.01 * i, np.array([0.01 * i]))
            w.add_command(0.01 * i, np.array([0.01 * i]))
            if i == 1250:
                now.set()
            if i > 1250:
                time.sleep(0.01)

    process = fork.Process(target=write_for_ever)
    process.start()
    assert now.wait(60)
    time.sleep(0.05)
    process.kill()
    process.join()
    r = read(tmp_path / "k.mcap")
    assert 1150 <= len(r.states.position) <= 1400 and r.states.position.t[-1] >= 11.5
    assert "damage" in kinds(r, "error")


def test_messages_that_cannot_be_decoded_are_counted(tmp_path):
    with open(tmp_path / "a.mcap", "wb") as file:
        w = McapWriter(file)
        w.start(profile="ros2")
        channel = w.register_channel(
            "/joint_states", "cdr", w.register_schema(JOINT_STATE, "ros2msg", DEFINITIONS[JOINT_STATE].encode())
        )
        for i in range(30):
            data = cdr.joint_state(10**9 + i, ("a",), np.array([float(i)]))
            w.add_message(channel, 10**9 + i * 10**7, data[:30] if i in (7, 8) else data, 0)
        w.finish()
    r = read(tmp_path / "a.mcap")
    (bad,) = [f for f in r.findings if f.kind == "unreadable"]
    assert bad.count == 2 and bad.time == pytest.approx(0.07) and len(r.states.position) == 28


def test_a_recording_whose_name_leaves_no_room_for_the_file_beside_it(tmp_path):
    from dexsim.recording import read, write

    write(tmp_path / "x.mcap", recordings.signal(1.0))
    long = (tmp_path / "x.mcap").rename(tmp_path / ("a" * 248 + ".mcap"))
    assert len(read(long).states.position) == 100
