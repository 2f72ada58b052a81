"""A hand over ROS 2: commands are published, `sensor_msgs/JointState` is read. No installation of ours: by `rclpy`
where the user's shell has it, else by DDS alone (the package `cyclonedds`), in the wire format that ROS 2 uses.

The DDS path is tested on loopback. Of `rclpy` and of the xHand's own messages (`xhand_control_interfaces`) only the
calls that are documented are used; neither was here to be tried.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from dexsim.deploy.driver import PASSIVE, Clock, HandCommand, HandState
from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.recording import schema

STATE, COMMAND = schema.STATES, schema.COMMANDS
MESSAGES = ("joint_state", "xhand")
LIMP, WATCH = 30.0, 0.15
"""mA of a limp hand; s that it is watched."""
Heard = Callable[[Sequence[str], Any, Any, Any], None]
"""Called with the names, position, velocity and effort of a message."""


class Transport(Protocol):
    """What carries messages."""

    name: str

    def subscribe(self, topic: str, heard: Heard, message: str = "joint_state") -> None:
        """Call `heard` from a thread of the transport's, for each message."""

    def publish(self, topic: str, names: Sequence[str], c: HandCommand, message: str = "joint_state") -> None:
        """Publish one command: targets, and the current limits as effort."""

    def close(self) -> None:
        """End the subscriptions."""


def transport() -> Transport:
    """Return ROS 2's own library where the shell has it, else DDS. Raises UserError where there is neither."""
    try:
        return Rclpy()
    except ImportError:
        pass
    try:
        return Dds()
    except ImportError:
        raise UserError(
            "driver=ros2: neither rclpy (source your ROS 2's setup.bash) nor cyclonedds is here: pip install cyclonedds"
        ) from None


class Rclpy:
    """By the user's ROS 2."""

    name = "rclpy"

    def __init__(self) -> None:
        import rclpy
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState

        self._rclpy, self._state, self._quality = rclpy, JointState, qos_profile_sensor_data
        if not rclpy.ok():
            rclpy.init()
        self._node = rclpy.create_node("dexsim")
        self._publishers: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        with contextlib.suppress(Exception):  # what it raises when the node goes
            self._rclpy.spin(self._node)

    def subscribe(self, topic: str, heard: Heard, message: str = "joint_state") -> None:
        if message == "xhand":
            from xhand_control_interfaces.msg import XHandStateArray

            self._node.create_subscription(XHandStateArray, topic, lambda m: heard(*of_xhand(m)), self._quality)
            return
        self._node.create_subscription(
            self._state, topic, lambda m: heard(m.name, m.position, m.velocity, m.effort), self._quality
        )

    def publish(self, topic: str, names: Sequence[str], c: HandCommand, message: str = "joint_state") -> None:
        kind: Any = self._state
        if message == "xhand":
            from xhand_control_interfaces.msg import XHandCommand

            kind = XHandCommand
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(kind, topic, 10)
        m = kind()
        m.header.stamp = self._node.get_clock().now().to_msg()
        m.name, m.position = [bare(n) if message == "xhand" else n for n in names], [float(x) for x in c.position]
        if message == "xhand":
            J = len(names)
            m.kp, m.ki, m.kd, m.mode = [int(c.kp)] * J, [int(c.ki)] * J, [int(c.kd)] * J, int(c.mode)
            m.effort_limit = [int(x) for x in c.tor_max]
        else:
            m.effort = [float(x) for x in c.tor_max]
        self._publishers[topic].publish(m)

    def close(self) -> None:
        self._node.destroy_node()


class Dds:
    """By DDS alone: the domain of ROS_DOMAIN_ID, topics with the prefix that ROS 2 gives them."""

    name = "DDS (cyclonedds)"

    def __init__(self) -> None:
        from cyclonedds.domain import DomainParticipant

        from dexsim.deploy import ros2_types

        self._types = ros2_types
        self._domain = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", "0") or 0))
        self._writers: dict[str, Any] = {}
        self._readers: list[tuple[Any, Heard]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._poll, daemon=True)
        self._thread.start()

    def _poll(self) -> None:
        while not self._stop.wait(0.001):
            for reader, heard in list(self._readers):
                for m in reader.take(100):
                    if isinstance(m, self._types.JointState):
                        heard(m.name, m.position, m.velocity, m.effort)

    def _topic(self, topic: str) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._domain, "rt/" + topic.lstrip("/"), self._types.JointState)

    def subscribe(self, topic: str, heard: Heard, message: str = "joint_state") -> None:
        from cyclonedds.sub import DataReader

        if message != "joint_state":
            raise UserError(f"ros2_message={message}: its definition is not public, so it needs rclpy and the vendor's"
                            " xhand_control_interfaces; source your ROS 2's setup.bash")  # fmt: skip
        self._readers.append((DataReader(self._domain, self._topic(topic)), heard))

    def publish(self, topic: str, names: Sequence[str], c: HandCommand, message: str = "joint_state") -> None:
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy, Qos

        t = self._types
        if topic not in self._writers:
            reliable = Qos(Policy.Reliability.Reliable(100_000_000), Policy.History.KeepLast(10))  # ns
            self._writers[topic] = DataWriter(self._domain, self._topic(topic), qos=reliable)
        now = time.time_ns()
        stamp = t.Time(sec=now // 10**9, nanosec=now % 10**9)
        self._writers[topic].write(
            t.JointState(t.Header(stamp), list(names), [float(x) for x in c.position], [],
                         [float(x) for x in c.tor_max])
        )  # fmt: skip

    def close(self) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self._readers.clear()
        self._writers.clear()


def bare(joint: str) -> str:
    """Return a joint's name without its side, as the xHand's own messages have it."""
    return joint.removeprefix("right_hand_").removeprefix("left_hand_")


def of_xhand(m: Any) -> tuple[Sequence[str], Any, None, Any]:
    """Names, position rad and current mA of the first hand of an `XHandStateArray`. It has no speeds; its temperature
    and error codes are never filled."""
    state = m.hand_states[0]
    return list(state.name), state.position, None, state.effort


class Ros2Hand:
    """A `HandDriver` over ROS 2, of any hand.

    state, command: topics. message: joint_state, or xhand for the messages of the vendor's ROS driver. effort: mA a
    unit of a state's effort. A command's effort is the current limit in mA; a limit of 0, with the joints' own angles
    as targets, is what lets go: whether the node behind does that, its effort shows.
    """

    name = "ROS 2 hand"

    def __init__(
        self, hand: Hand, state: str = STATE, command: str = COMMAND, clock: Clock | None = None,
        message: str = "joint_state", effort: float = 1.0, by: Transport | None = None,
    ):  # fmt: skip
        self.hand, self.topics, self.clock, self.message = hand, (state, command), clock or Clock(), message
        self.effort, self._by = effort, by
        self._lock = threading.Lock()
        self._state: HandState | None = None
        self._order: list[int] | None = None
        self._wrong, self._count, self._let_go = "", 0, 0.0
        self._peak, self._relaxed = 0.0, False

    def open(self) -> dict[str, str]:
        """Open the subscriptions and wait for the first message. Raises UserError."""
        self._by = self._by or transport()
        self._by.subscribe(self.topics[0], self._heard, self.message)
        limit = time.monotonic() + 5.0
        while self._state is None and not self._wrong:
            if time.monotonic() > limit:
                raise UserError(
                    f"driver=ros2: nothing came on {self.topics[0]} within 5 s (by {self._by.name}, ROS_DOMAIN_ID="
                    f"{os.environ.get('ROS_DOMAIN_ID', '0')}): does ros2 topic echo {self.topics[0]} show it?"
                )
            time.sleep(0.01)
        if self._wrong:
            raise UserError(f"driver=ros2: {self._wrong}")
        return {"driver": f"ros2 by {self._by.name}", "state": self.topics[0], "command": self.topics[1]}

    def _heard(self, names: Sequence[str], position: Any, velocity: Any, effort: Any) -> None:
        joints = self.hand.joints
        if self._order is None or len(names) <= max(self._order):
            plain = [bare(n) for n in names]
            joints = (*joints, *self.hand.sensed)
            missing = [j for j in joints if j not in names and bare(j) not in plain]
            if missing:
                self._wrong = f"{self.topics[0]} lacks {', '.join(missing)[:120]}: it has {', '.join(names)[:120]}"
                return
            self._order = [plain.index(bare(j)) for j in joints]
        joints = self.hand.joints

        def part(x: Any) -> np.ndarray | None:
            return None if x is None or len(x) < len(names) else np.asarray(x, float)[self._order]

        q, current = part(position), part(effort)
        if q is None:
            return
        n, speed = len(joints), part(velocity)
        amps = np.zeros(n) if current is None else self.effort * current[:n]
        with self._lock:
            self._count += 1
            self._state = HandState(
                self.clock.now(), self._count, q[:n], amps, velocity=None if speed is None else speed[:n],
                follower=q[n:] if len(q) > n else None,
            )  # fmt: skip
            if self._relaxed and self.clock.now() - self._let_go > 0.5 * WATCH:
                self._peak = max(self._peak, float(np.abs(amps).max()))

    def read(self) -> HandState | None:
        """Return the newest state, stamped when it came: the sender's clock is another."""
        return self._state

    def send(self, command: HandCommand) -> None:
        """Publish targets."""
        assert self._by is not None  # open
        if command.mode != PASSIVE:
            self._relaxed = False
        self._by.publish(self.topics[1], self.hand.joints, command, self.message)

    def relax(self) -> None:
        """Publish the joints' own angles as targets, with a current limit of 0."""
        if self._by is None or self._state is None:
            return
        if not self._relaxed:
            self._relaxed, self._let_go, self._peak = True, self.clock.now(), 0.0
        zero = np.zeros(len(self.hand.joints))
        self.send(HandCommand(self._state.position, zero, kp=0, mode=PASSIVE))

    def released(self) -> tuple[bool, str] | None:
        """Return whether its effort has ended since."""
        if not self._relaxed or self._state is None:
            return None
        since = self.clock.now() - self._let_go
        if self.clock.now() - self._state.time > WATCH and since > WATCH:
            return False, f"nothing comes on {self.topics[0]} any more: whether the hand is limp is not known"
        if since < WATCH:
            self.relax()
            return None
        if self._peak <= LIMP:
            return True, f"its effort is at most {self._peak:.0f} mA since"
        if since < 0.6:
            self.relax()
            self._peak = float(np.abs(self._state.current).max())
            return None
        return False, f"the hand still draws {self._peak:.0f} mA: the node behind {self.topics[1]} does not let go"

    def close(self) -> None:
        """Let go, and hear no more."""
        self.relax()
        if self._by is not None:
            self._by.close()
