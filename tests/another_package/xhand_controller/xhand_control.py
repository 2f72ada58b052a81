"""Joints that follow in 30 ms, encoders and pads without any noise, one thread, the cache written as a call returns.

`faults` (or XHAND_FAULTS="crc=2,dead_board=0") has s since the port was opened: crc: one reply is damaged; stuck: the
bus dies behind its cache; refused; cable: the library aborts. dead_board, mute: one board, all boards fail from then.
"""

from __future__ import annotations

import os
import time

now, sleep = time.monotonic, time.sleep
faults = {k: float(v) for k, _, v in (x.partition("=") for x in os.environ.get("XHAND_FAULTS", "").split(",") if x)}
posture = float(os.environ.get("XHAND_POSTURE", "0.3"))
log: list[tuple[float, int, float, int]] = []  # of each command on the wire: s, mode and target of joint 4, tor_max


class ErrorStruct:
    def __init__(self, error_code: int):
        self.error_code, self.error_message = error_code, "ok" if error_code == 0 else f"error {error_code}"


class FingerCommand_t:
    __slots__ = ("id", "kp", "ki", "kd", "position", "tor_max", "mode", "res0", "res1", "res2", "res3")

    def __init__(self) -> None:
        for name in self.__slots__:
            setattr(self, name, 0)


class HandCommand_t:
    def __init__(self) -> None:
        self.finger_command = [FingerCommand_t() for _ in range(12)]


class _Fields:
    def __init__(self, **fields: object):
        self.__dict__.update(fields)


class XHandControl:
    def __init__(self) -> None:
        self.port = ""
        self.q, self.last, self.at = [posture] * 12, None, now()
        self.q[3] = 0.1
        self.cache, self.code, self.refused_until, self.damaged_at = self._state(False), 0, 0.0, -9.0

    def enumerate_devices(self, kind: str) -> list[str]:
        return ["/dev/ttyACM4", "/dev/ttyACM5"] if kind == "RS485" else []

    def open_serial(self, port_name: str, baud_rate: int) -> ErrorStruct:
        self.port, self.zero = port_name, now()
        os.write(1, b"[xhand] port opened\n")  # as a native library prints
        return ErrorStruct(0 if port_name.startswith("/dev/ttyACM") and baud_rate == 3000000 else 1501001)

    def close_device(self) -> None:
        self.port = ""

    def list_hands_id(self) -> list[int]:
        return [3] if self.port == "/dev/ttyACM5" else []

    def get_hand_type(self, hand_id: int) -> tuple[ErrorStruct, str]:
        return ErrorStruct(0), "R"

    def get_serial_number(self, hand_id: int) -> tuple[ErrorStruct, str]:
        return ErrorStruct(0), "012R3202601010001"

    def get_sdk_version(self) -> str:
        return "1.4.3"

    def read_version(self, hand_id: int, joint_id: int) -> tuple[ErrorStruct, str]:
        return ErrorStruct(0), "1.3.9"

    def send_command(self, hand_id: int, command: HandCommand_t) -> ErrorStruct:
        assert hand_id == 3
        self.last = [(f.mode, f.position, f.tor_max, f.kp) for f in command.finger_command]
        return ErrorStruct(self._trip())

    def read_state(self, hand_id: int, force_update: bool) -> tuple[ErrorStruct, _Fields]:
        if force_update:
            self._trip()
        return ErrorStruct(self.code), self.cache

    def _since(self, fault: str) -> bool:
        return now() - self.zero >= faults.get(fault, 1e9)

    def _trip(self) -> int:
        if self._since("cable"):
            os.abort()
        if now() < self.refused_until or now() < self.damaged_at + 0.05:  # its boot mode
            self.refused_until = max(self.refused_until, now() + 4.2)
            sleep(0.04)
            self.code = 1501036
            return self.code
        if self._since("refused"):
            sleep(0.0096)
            return 1501029
        sleep(0.0096)
        if self._since("stuck"):
            return 0
        joint = self.last[4] if self.last else (0, 0.0, 0, 0)
        log.append((now(), joint[0], joint[1], joint[2]))
        passed, self.at = now() - self.at, now()
        for i, (mode, target, limit, kp) in enumerate(self.last or ()):
            if mode == 3 and limit and kp:
                self.q[i] += (target - self.q[i]) * min(1.0, passed / 0.03)
        self.cache, self.code = self._state(True), 0
        if self._since("dead_board") or self._since("mute"):
            self.code = 1501019
        if self._since("crc"):
            faults.pop("crc")
            self.damaged_at, self.code = now(), 1501070
        return self.code

    def _state(self, whole: bool) -> _Fields:
        joints = [
            _Fields(id=i if whole else 0, sensor_id=0, position=self.q[i] if whole else 0.0, torque=65530 * whole,
                    raw_position=0, temperature=(1 << 8 | 31) * whole, commboard_err=0, jonitboard_err=0,
                    tipboard_err=0, default5=0, default6=0, default7=0)
            for i in range(12)
        ]  # fmt: skip
        boards = []
        for k in range(5):
            dead = not whole or self._since("mute") or (k == 1 and self._since("dead_board"))
            touch = _Fields(fx=0, fy=0, fz=0)
            boards.append(_Fields(calc_force=touch, raw_force=[touch] * 120, temperature=[0 if dead else 29] * 20,
                                  calc_temperature=0 if dead else 29))  # fmt: skip
        return _Fields(finger_state=joints, sensor_data=boards)
