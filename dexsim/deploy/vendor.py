"""The vendor's driver as a `HandDriver`: an adapter for the Python package `xhand_controller`, imported only when
opened.

Not run on a hand by us: written from the SDK's published fields (see the table below); check signs and limits at low
current first. The bus blocks for about 9.6 ms a round trip, so a thread of this driver's own talks to it, and the
newest state waits for `read`.

    theirs                                          ours (`HandState`)
    finger_state[i].position        rad             position
    finger_state[i].torque          mA, + opening   current
    finger_state[i].default5        1000 rad/s      velocity (newer firmware; older leaves every joint's 0: none then)
    finger_state[i].temperature     low byte degC   temperature
    finger_state[i].commboard_err, jonitboard_err, tipboard_err   error (the first that is not 0)
    sensor_data[f].raw_force[k].fx, fy (int8), fz (uint8)         tactile counts
    HandCommand_t.finger_command[i]: id, kp, ki, kd, position rad, tor_max mA, mode (0 passive, 3 position)
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from dexsim.deploy.driver import PASSIVE, Clock, HandCommand, HandState
from dexsim.errors import UserError

BAUD = 3_000_000
JOINTS, TAXELS = 12, (5, 120, 3)
"""Of the only hand that this package drives."""
CLOSE = 1.0  # s that the bus has to carry the command to relax


class VendorXHand:
    """An xHand over RS485 (port, e.g. /dev/ttyUSB0) or EtherCAT (port="ethercat")."""

    name = "xHand"

    def __init__(self, port: str, clock: Clock | None = None, package: Any = None):
        self.port, self.clock, self._package = port, clock or Clock(), package
        self._device = None
        self._state: HandState | None = None
        self._command: HandCommand | None = None
        self._lock = threading.Lock()
        self._stop, self._passive = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self.bad_reads = 0
        self.error = ""  # what the package said last when a bus cycle failed

    def open(self) -> dict[str, str]:
        sdk = self._package or self._import()
        self._sdk = sdk
        device = sdk.XHandControl()
        if self.port == "ethercat":
            ports = device.enumerate_devices("EtherCAT")
            if not ports:
                raise UserError("xHand: no EtherCAT device found; check cable and power")
            answer = device.open_ethercat(ports[0])
        else:
            answer = device.open_serial(self.port, BAUD)
        if getattr(answer, "error_code", 0) != 0:
            raise UserError(f"xHand on {self.port}: {getattr(answer, 'error_message', answer)}")
        hands = device.list_hands_id()
        if not hands:
            raise UserError(f"xHand on {self.port}: no hand answers on the bus")
        self._device, self._id, self._sequence = device, hands[0], 0
        self._wire = sdk.HandCommand_t()
        self._thread = threading.Thread(target=self._run, name="xhand bus", daemon=True)
        self._thread.start()
        return {"driver": "xhand_controller", "port": self.port, "hand_id": str(self._id)}

    def read(self) -> HandState | None:
        return self._state

    def send(self, command: HandCommand) -> None:
        with self._lock:
            self._passive.clear()
            self._command = command

    def relax(self) -> None:
        self.send(HandCommand(np.zeros(12), np.zeros(12), kp=0, mode=PASSIVE))

    def close(self) -> None:
        if self._device is None:
            return
        self.relax()
        self._passive.wait(CLOSE)  # until the bus has carried it
        self._stop.set()
        self._thread.join(1.0)
        carried = self._passive.is_set()
        try:
            self._device.close_device()
        finally:
            self._device = None
        if not carried:
            raise UserError(
                f"xHand on {self.port}: the bus did not carry the command to relax within {CLOSE:g} s"
                f"{f' ({self.error})' if self.error else ''}; cut the hand's power"
            )

    @staticmethod
    def _import() -> Any:
        try:
            from xhand_controller import xhand_control
        except ImportError:
            raise UserError(
                "driver=xhand: the vendor's package xhand_controller is not installed; get it from the vendor of the"
                " hand, or use driver=sim"
            ) from None
        return xhand_control

    def _run(self) -> None:
        """Bus cycles until the end; one that fails is counted, shows as no new state to the loop, and is tried
        again."""
        while not self._stop.is_set():
            try:
                self._cycle()
            except Exception as error:  # whatever the package raises; a thread that ended could relax no more
                self.bad_reads, self.error = (
                    self.bad_reads + 1,
                    f"{type(error).__name__}: {' '.join(str(error).split())[:160]}",
                )
                self._stop.wait(0.002)

    def _cycle(self) -> None:
        """Send the last command, read the state that comes back."""
        device = self._device
        if device is None:
            return  # closed while this thread waited
        with self._lock:
            command = self._command
        if command is not None:
            for i in range(JOINTS):
                f = self._wire.finger_command[i]
                f.id, f.kp, f.ki, f.kd = i, int(command.kp), int(command.ki), int(command.kd)
                f.position, f.tor_max, f.mode = float(command.position[i]), int(command.tor_max[i]), int(command.mode)
            device.send_command(self._id, self._wire)
            with self._lock:
                if command.mode == PASSIVE and self._command is command:
                    self._passive.set()
        # True would send the last command again; False reads what the bus delivered
        error, raw = device.read_state(self._id, command is not None)
        if getattr(error, "error_code", 0) != 0:
            self.bad_reads, self.error = self.bad_reads + 1, str(getattr(error, "error_message", error))[:160]
            return
        state = convert(raw, self.clock.now(), self._sequence + 1)
        self._sequence, self._state = state.sequence, state


def convert(raw: Any, now: float, sequence: int) -> HandState:
    """The SDK's state struct as ours; nothing scaled."""
    joints = [raw.finger_state[i] for i in range(JOINTS)]
    tactile = np.zeros(TAXELS, np.int16)
    for f in range(TAXELS[0]):
        force = raw.sensor_data[f].raw_force
        tactile[f] = [(force[k].fx, force[k].fy, force[k].fz) for k in range(TAXELS[1])]
    speed = np.array([getattr(j, "default5", 0) for j in joints], np.float32) * 1e-3
    error = [next((e for e in (j.commboard_err, j.jonitboard_err, j.tipboard_err) if e), 0) for j in joints]
    return HandState(
        now, sequence, np.array([j.position for j in joints], np.float32),
        np.array([j.torque for j in joints], np.int16),
        np.array([j.temperature & 0xFF for j in joints], float), np.array(error, np.int64), tactile,
        speed if speed.any() else None)  # fmt: skip
