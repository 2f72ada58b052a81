"""A hand over ROS 2's wire: a DDS participant on loopback stands for the robot's node."""

from __future__ import annotations

import os
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.cli.record import main as record
from dexsim.deploy.driver import PASSIVE, HandCommand
from dexsim.deploy.ros2 import Dds, Ros2Hand, of_xhand
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.recording.reader import read

pytest.importorskip("cyclonedds")
HAND = load_hand("xhand")


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """A domain of its own for each test: nobody else's topics, on this machine alone."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 200))
    monkeypatch.setenv("CYCLONEDDS_URI", "<General><Interfaces><NetworkInterface name='lo'/></Interfaces></General>")


class Node:
    """The robot's side: follows commands, publishes states in another order of joints, with one joint more."""

    def __init__(self, state="/joint_states", command="/joint_commands", resists=False, names=None):
        self.by, self.command = Dds(), []
        self.names = names or ["wrist", *reversed(HAND.joints)]
        self.q, self.limit, self.resists = {n: 0.05 for n in self.names}, 0.0, resists
        self.topics, self.on = (state, command), True
        self.by.subscribe(command, self.heard)
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def heard(self, names, position, velocity, effort):
        self.command.append((time.monotonic(), dict(zip(names, position, strict=True)), max(effort)))
        self.limit = max(effort)
        if self.limit:
            self.q |= dict(zip(names, position, strict=True))

    def run(self):
        while self.on:
            q = np.array([self.q[n] for n in self.names])
            drive = np.full(len(q), 80.0 if self.limit or self.resists else 0.0)
            self.by.publish(self.topics[0], self.names, HandCommand(q, drive))
            time.sleep(0.01)

    def close(self):
        self.on = False
        self.thread.join()
        self.by.close()


def wait(until, seconds=5.0):
    end = time.monotonic() + seconds
    while not until() and time.monotonic() < end:
        time.sleep(0.01)
    return until()


def test_the_wire_is_that_of_ros_2():
    """Byte for byte what another implementation of its messages writes."""
    from rosbags.typesys import Stores, get_typestore

    from dexsim.deploy import ros2_types as t

    store = get_typestore(Stores.ROS2_HUMBLE)
    T = store.types
    stamp = T["builtin_interfaces/msg/Time"](sec=5, nanosec=7)
    arrays = [np.array(x) for x in ([0.1, 0.2], [0.3, 0.4], [5.0, 6.0])]
    theirs = T["sensor_msgs/msg/JointState"](
        T["std_msgs/msg/Header"](stamp=stamp, frame_id="palm"), ["a", "bcd"], *arrays
    )
    ours = t.JointState(t.Header(t.Time(5, 7), "palm"), ["a", "bcd"], *(x.tolist() for x in arrays))
    want, got = bytes(store.serialize_cdr(theirs, "sensor_msgs/msg/JointState")), bytes(ours.serialize())
    assert got[:2] == want[:2] and got[4:] == want[4:], "the two bytes between say how much was padded"
    assert t.JointState.__idl__.idl_transformed_typename == "sensor_msgs::msg::dds_::JointState_"


def test_a_hand_is_driven_and_let_go():
    node = Node()
    hand = Ros2Hand(HAND)
    try:
        assert "DDS" in hand.open()["driver"]
        goal = np.linspace(0.0, 0.15, 12)
        assert wait(lambda: (hand.send(HandCommand(goal, np.full(12, 300))), len(node.command) > 3)[1])
        assert wait(lambda: np.abs(hand.read().position - goal).max() < 1e-6), "in the hand's order of joints"
        state = hand.read()
        assert (state.current == 80).all() and abs(time.monotonic() - state.time) < 1.0
        assert node.command[-1][2] == 300 and set(node.command[-1][1]) == set(HAND.joints)
        hand.relax()
        assert wait(lambda: hand.released() is not None) and hand.released()[0], hand.released()
        assert node.command[-1][2] == 0 and np.allclose(list(node.command[-1][1].values()), goal)
    finally:
        hand.close()
        node.close()


def test_a_node_that_does_not_let_go_is_said():
    node = Node(resists=True)
    hand = Ros2Hand(HAND)
    try:
        hand.open()
        hand.send(HandCommand(np.full(12, 0.1), np.full(12, 300)))
        hand.relax()
        assert wait(lambda: hand.released() is not None) and not hand.released()[0]
        assert "still draws 80 mA" in hand.released()[1]
    finally:
        hand.close()
        node.close()


def test_topics_that_are_silent_or_of_another_robot_are_said(monkeypatch):
    node = Node(names=["wheel_left", "wheel_right"])
    try:
        with pytest.raises(UserError, match="lacks right_hand_thumb_bend_joint|lacks thumb_bend_joint"):
            Ros2Hand(HAND).open()
    finally:
        node.close()
    now = time.monotonic()
    ticks = iter(np.arange(now, now + 100, 3.0))
    monkeypatch.setattr("dexsim.deploy.ros2.time", SimpleNamespace(monotonic=lambda: next(ticks), sleep=time.sleep))
    with pytest.raises(UserError, match="nothing came on /elsewhere within 5 s"):
        Ros2Hand(HAND, state="/elsewhere").open()


def test_the_xhands_own_message_is_read():
    state = SimpleNamespace(name=["thumb_bend_joint"], position=[0.2], effort=[-120], temperature=[0], error_code=[0])
    assert of_xhand(SimpleNamespace(hand_states=[state])) == (["thumb_bend_joint"], [0.2], None, [-120])
    hand = Ros2Hand(HAND)
    names = [j.removeprefix("right_hand_") for j in HAND.joints]
    hand._heard(names, np.arange(12) * 0.01, None, -np.arange(12.0))
    assert hand.read().position[5] == pytest.approx(0.05) and hand.read().current[5] == -5
    with pytest.raises(UserError, match="needs rclpy"):
        Dds().subscribe("/x", lambda *a: None, "xhand")


def test_a_recording_of_what_is_said(tmp_path, capsys):
    node = Node()
    sender = Dds()
    stop = threading.Event()

    def send():
        while not stop.wait(0.02):
            c = HandCommand(np.full(12, 0.1), np.full(12, 300.0), mode=PASSIVE)
            sender.publish("/joint_commands", HAND.joints, c)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        topics = "ros2=/joint_states,/joint_commands"
        assert record([f"out={tmp_path / 'a'}", topics, "seconds=1.5", "effort=current_A"]) == 0
    finally:
        stop.set()
        thread.join()
        node.close()
        sender.close()
    out = read(tmp_path / "a.mcap", audit=False)
    moved = [out.joints.index(j) for j in out.joints if j != "wrist"]
    assert len(moved) == 12 and len(out.states.position) > 40
    assert np.allclose(out.states.position.value[-1, moved], 0.1) and "of 13 joints" in capsys.readouterr().out
    with pytest.raises(UserError, match="is there already"):
        record([f"out={tmp_path / 'a'}", "ros2=/joint_states"])
    for wrong in ("seconds=0", "effort=x", "z=1"):
        with pytest.raises(UserError, match=wrong.split("=")[0]):
            record([f"out={tmp_path / 'b'}", "ros2=/x", wrong])
