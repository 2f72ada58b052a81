"""The xHand by the vendor's Python package `xhand_controller`, which the user installs; imported only when opened.

Not run on a hand by us. How the package behaves is taken from drivers that run real hands: every call returns an error
object and raises nothing; `send_command` is one round trip of about 9.6 ms on RS485; `read_state(id, True)` sends the
last command once more, `read_state(id, False)` gives the cache that a thread of the package fills, without a stamp. The
package may print, hang or abort: it lives in a process of its own (`dexsim.deploy.process`).

    theirs                                          ours (`HandState`)
    finger_state[i].position        rad             position
    finger_state[i].torque          mA, + opening   current (uint16 in package 0.10.3, int16 in newer ones)
    finger_state[i].default5        1000 rad/s      velocity (newer firmware; older leaves every joint's 0: none then)
    finger_state[i].temperature     low byte degC   temperature
    finger_state[i].commboard_err, jonitboard_err   error (`tipboard_err` is of the taxels, not of the joint)
    sensor_data[f].raw_force[k].fx, fy (int8), fz (uint8)         tactile counts
    HandCommand_t.finger_command[i]: id, kp, ki, kd, position rad, tor_max mA, mode (0 passive, 3 position)
"""

from __future__ import annotations

import contextlib
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from dexsim.deploy.driver import PASSIVE, POSITION, Clock, HandCommand, HandState
from dexsim.deploy.process import HANG, BusDriver
from dexsim.deploy.readings import Frozen
from dexsim.errors import UserError

BAUD = 3_000_000
JOINTS, TAXELS = 12, (5, 120, 3)
"""Of the only hand that this package drives."""
MOST_CURRENT = 400.0
"""mA, of a run that does not say: what others drive this hand with (300 to 400)."""
NO_SUMS, NO_TAXELS, NO_TAXEL_TEMPERATURES, AT_LIMIT, CRC = 1501018, 1501019, 1501020, 1501035, 1501070
TOO_WARM, BOOT = 1501028, 1501036
ACCEPTED = frozenset((0, NO_SUMS, NO_TAXELS, NO_TAXEL_TEMPERATURES, AT_LIMIT))
"""Codes with which a command has reached the hand; `AT_LIMIT`: its current is at its limit, as in a grasp."""
GOOD_JOINTS = ACCEPTED | {CRC}
"""Codes with which a whole frame's joints are good. Its touch is with 0, `AT_LIMIT` and `NO_TAXEL_TEMPERATURES`."""
GOOD_TOUCH = frozenset((0, AT_LIMIT, NO_TAXEL_TEMPERATURES))
PAUSE = 0.06
"""s of silence after a CRC error: a retry at once sends the firmware into its boot mode for 4.2 s, 50 to 80 ms do
not."""
TRIES, BETWEEN = 3, {"serial": 2.0, "ethercat": 3.0}
"""Tries to open a bus, and s between them."""
SEED = 3
"""Forced readings before the first command, 20 ms apart: until then the cache holds zeros."""
LOST = 0.1
"""s without an answer of all taxel boards, or of one: silent; without an accepted command: refused."""
FEW, STILL = 8, 0.08
"""Frames in a row, and s: one that is late (111 ms were seen) or torn proves nothing, nor do many within a moment."""
SHORTEST = 0.002
"""s between two cycles, where a command does not wait for its round trip (EtherCAT)."""
LIMP, YIELD, WATCH = 30.0, 0.02, 0.1
"""mA that motors may draw in a limp hand; rad by which a joint that gives way shows that it is; s that a hand is
watched for each way to let go."""


class XHandBus:
    """The hand's side: the package, one round trip a cycle. Runs where the package may block and abort.

    port: "auto" (every RS485 port is asked), a serial port, "ethercat" or "ethercat:INTERFACE". serial: the hand's
    serial number, of several; side: "right" or "left", another hand is refused. package: gives the module.
    """

    def __init__(
        self, clock: Clock, port: str, serial: str | None, side: str | None, package: Callable[[Clock], Any] | None
    ):
        self.clock, self.port, self.serial, self.side = clock, port, serial, side
        self.label = _label(serial, side)
        self._sdk = package(clock) if package is not None else _import()
        self.counts: Counter = Counter()
        self._pause_until = self._refused_at = self._next = clock.now()
        self._sent: HandCommand | None = None
        self._driven: tuple[Any, Any] = None, None  # targets and limits of the last command that was not passive
        self._frozen = Frozen()
        self._frame: list[Any] = []
        self._sequence, self._fast = 0, False
        self._last_bits: tuple[list, list] = ([], [])
        self._stirred, self._restless, self._same, self._unfelt = clock.now(), False, 0, 0
        self._steps = np.zeros(JOINTS)
        self._boards, self._changed = [b""] * TAXELS[0], np.full(TAXELS[0], clock.now())
        self._rested = np.zeros(TAXELS[0])  # s that a board which answers has given the same
        self._touch = np.zeros(TAXELS, np.int16)
        self._touched = np.full(TAXELS[0], -np.inf)
        self._touch_worked, self._why, self._refusal = False, "", ""
        self._state: HandState | None = None
        self._letting_go: dict[str, Any] | None = None

    @property
    def due(self) -> float:
        """When the next round trip may begin [s]."""
        return max(self.clock.now(), self._pause_until, self._next)

    # -- opening
    def open(self) -> dict[str, str]:
        """Find the hand and read it; nothing moves. Returns what to log. Raises UserError."""
        kind = "ethercat" if self.port.startswith("ethercat") else "serial"
        wrong: list[str] = []
        for attempt in range(TRIES):
            if attempt:
                self.clock.sleep_until(self.clock.now() + BETWEEN[kind])
            wrong, missing = [], False
            for port in self._ports(kind):
                device = self._sdk.XHandControl()
                code, message = _error(
                    device.open_serial(port, BAUD) if kind == "serial" else device.open_ethercat(port)
                )
                if code != 0:
                    wrong.append(f"{port} does not open: {message or code}")
                    missing = True
                elif info := self._take(device, port, wrong):
                    return info
                with contextlib.suppress(Exception):
                    device.close_device()
            if wrong and not missing:
                break  # what opens and is not the hand that is asked for stays so
        hint = (
            "EtherCAT needs cap_net_raw (setcap cap_net_raw+ep on the python that runs this), and 3 s after a session"
            " that broke off"
            if kind == "ethercat"
            else "check power and cable; a hand has two ports, /dev/ttyACM*, whose numbers change when it is plugged"
            " in, and its auxiliary one lists no hand: port=auto finds the other"
        )
        raise UserError(f"no hand to drive ({'; '.join(wrong) or 'no port is there'}): {hint}")

    def _ports(self, kind: str) -> list[str]:
        name, _, interface = self.port.partition(":")
        if kind == "ethercat":
            return [interface] if interface else list(_enumerate(self._sdk, "EtherCAT"))
        return list(_enumerate(self._sdk, "RS485")) if name == "auto" else [self.port]

    def _take(self, device: Any, port: str, wrong: list[str], taken: Sequence[int] = ()) -> dict[str, str] | None:
        """Return the hand that is asked for, on an open port, but for ids that are taken; None, with the reason in
        `wrong`, where it is not there."""
        hands = [x for x in device.list_hands_id() or () if x not in taken]
        if not hands:
            wrong.append(f"{port} opens and lists no hand (the auxiliary port?)")
        for hand in hands:
            serial, side = _value(device, "get_serial_number", hand), _side(_value(device, "get_hand_type", hand))
            if self.serial and serial.strip() != self.serial.strip():
                wrong.append(f"{port} has hand {serial or hand}, not {self.serial}")
            elif self.side and side and side != self.side:
                wrong.append(f"{port} has a {side} hand, the policy is for a {self.side} one")
            else:
                self._device, self._id = device, hand
                self._wire = self._sdk.HandCommand_t()
                self._seed(port)
                return {
                    "driver": "xhand_controller", "port": port, "hand_id": str(hand), "serial": serial,
                    "side": side or "not said", "sdk": _value(device, "get_sdk_version"),
                    "firmware": _value(device, "read_version", hand, 0),
                }  # fmt: skip
        return None

    def _seed(self, port: str) -> None:
        """Ask for whole frames until the cache holds what the hand reads: before, it holds zeros."""
        limit, whole = self.clock.now() + 6.0, 0
        while whole < SEED:
            whole += self.cycle(None) is not None
            if whole < SEED:
                self.clock.sleep_until(self.clock.now() + 0.02)
            if self.clock.now() > limit:
                raise UserError(f"{port}: the hand gives no whole reading ({self._why or 'no answer'})")

    # -- a cycle
    def cycle(self, command: HandCommand | None) -> HandState | None:
        """Send, one round trip; then the state that it brought. None where it brought nothing that is new and whole."""
        self.clock.sleep_until(self.due)
        self._next, code = self.clock.now() + SHORTEST, 0
        if command is None:
            error, raw = self._call(lambda: self._device.read_state(self._id, True), (None, None))
        else:
            self._sent = command
            if command.mode != PASSIVE:
                self._letting_go, self._driven = None, (command.position, command.tor_max)
            code = self._send(self._letting(command) if command.mode == PASSIVE else command)
            error, raw = self._call(lambda: self._device.read_state(self._id, False), (None, None))
        state = self._call(lambda: self._state_of(error, raw, code), None)  # fields may be others in another package
        if state is not None:
            self._state = state
            self._frozen.note(state.time, state, self._driven[0])
        if self._letting_go is not None:
            self._watch_limp(code, state)
        return state

    def _call(self, work: Callable[[], Any], default: Any) -> Any:
        """Return what the package answers; what it raises is counted, and is no answer."""
        try:
            return work()
        except Exception as error:
            self.counts["raised"] += 1
            self._why = f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
            self.clock.sleep_until(self.clock.now() + 0.002)
            return default

    def _send(self, c: HandCommand) -> int:
        """Return one round trip; the code of its answer."""
        for i in range(JOINTS):
            f = self._wire.finger_command[i]
            f.id, f.kp, f.ki, f.kd = i, int(c.kp), int(c.ki), int(c.kd)
            f.position, f.tor_max, f.mode = float(c.position[i]), int(c.tor_max[i]), int(c.mode)
        answer = self._call(lambda: self._device.send_command(self._id, self._wire), None)
        code, message = _error(answer)
        now = self.clock.now()
        if code == CRC:  # not confirmed, which is no refusal
            self._pause_until = now + PAUSE
            return code
        if code in ACCEPTED:
            self._refusal = ""
            return code
        if not self._refusal:
            self._refused_at = now
        self.counts[f"code {code}"] += 1
        if code == TOO_WARM:
            self._refusal = f"a motor is too warm (code {code})"
        elif code == BOOT:
            self._refusal = f"the firmware is in its boot mode (code {code}), for about 4 s after errors of the bus"
            self._pause_until = now + PAUSE
        else:
            self._refusal = f"the hand refuses commands: {message or self._why or 'no answer'} (code {code})"
        return code

    def _state_of(self, error: Any, raw: Any, sent: int) -> HandState | None:
        now = self.clock.now()
        code, message = _error(error)
        if code == CRC:
            self.counts["crc"] += 1
            self._pause_until = max(self._pause_until, now + PAUSE)
        if raw is None or code not in GOOD_JOINTS:
            self._why = f"{message or self._why or 'no answer'} (code {code})"
            self.counts["no reading"] += 1
            if code == BOOT:
                self._pause_until = max(self._pause_until, now + PAUSE)
            return None
        joints = _whole(raw)
        if joints is None and code != CRC:  # the package's thread is writing it: look again, the bus is not needed
            self.clock.sleep_until(now + 0.002)
            error, raw = self._call(lambda: self._device.read_state(self._id, False), (error, None))
            joints = _whole(raw)
        if joints is None:
            self.counts["torn"] += 1
            self._why = "a torn frame: its joints are not 0 to 11, each once"
            return None
        frame = [(j.position, j.torque, j.temperature, getattr(j, "raw_position", 0)) for j in joints]
        if sent not in ACCEPTED and frame == self._frame:
            return None  # the cache of before; nothing says that the hand has answered
        self._frame = frame
        self._feel(raw, code, now)
        speed = _int16([getattr(j, "default5", 0) for j in joints]).astype(np.float32) * 1e-3
        self._fast = self._fast or bool(speed.any())
        self._stir(now)
        errors = [getattr(j, "commboard_err", 0) or getattr(j, "jonitboard_err", 0) for j in joints]
        self._sequence += 1
        silent = now - self._touched > LOST
        touch = np.where(silent[:, None, None], 0, self._touch).astype(np.int16)
        return HandState(
            now, self._sequence, np.array([j.position for j in joints], np.float32),
            _int16([j.torque for j in joints]), np.array([j.temperature & 0xFF for j in joints], float),
            np.array(errors, np.int64) * (code != CRC), touch,
            speed if self._fast else None, silent if silent.any() else None)  # fmt: skip

    def _feel(self, raw: Any, code: int, now: float) -> None:
        """Return the taxels of boards that answer: of all with a good code; else of those whose content changes, or is
        there and stood still before, too."""
        self._unfelt += 1
        if code == CRC:
            return
        for f in range(TAXELS[0]):
            board = raw.sensor_data[f]
            flat = [x for t in board.raw_force for x in (t.fx, t.fy, t.fz)]
            touch = np.array(flat, np.int16).reshape(TAXELS[1:])
            content = touch.tobytes() + bytes([int(x) & 0xFF for x in getattr(board, "temperature", ())])
            if content != self._boards[f]:
                self._boards[f], self._changed[f] = content, now
            rested = now - self._changed[f]
            if code in GOOD_TOUCH:
                self._rested[f] = max(self._rested[f], rested)
            if code in GOOD_TOUCH or (
                any(content) and (not rested or self._rested[f] > LOST or not self._touch_worked)
            ):
                self._touch[f], self._touched[f], self._unfelt = touch, now, 0
        self._touch_worked = self._touch_worked or code in GOOD_TOUCH

    def _stir(self, now: float) -> None:
        """Note since when no bit of the cache has changed. Encoders that go to and fro while the hand stands still show
        that its readings never stand."""
        bits = (self._frame, list(self._boards))
        self._same += 1
        if bits != self._last_bits:
            if self._sent is None and self._last_bits[0]:
                steps = np.array([a[0] - b[0] for a, b in zip(self._frame, self._last_bits[0], strict=True)])
                self._restless = self._restless or int((steps * self._steps < 0).sum()) >= 3
                self._steps = steps
            self._last_bits, self._stirred, self._same = bits, now, 0

    def _dead(self) -> str:
        """Return what is said of a bus whose cache alone answers; empty where it lives."""
        now = self.clock.now()
        still = now - self._stirred
        if self._restless and self._same >= FEW and still > STILL:
            why = "of a hand whose encoders never stand still"
        elif self._state and self._frozen.problem(now, self._driven[0], self._state, self._driven[1]):
            why = "while its targets moved and it drew no more current"
        else:
            return ""
        return (
            f"no bit of the readings has changed for {1e3 * still:.0f} ms, {why}: the bus is dead, and the package's"
            " cache answers"
        )

    # -- what the loop asks
    def problem(self) -> str:
        """Return why the hand cannot be driven any longer; empty while it can."""
        now = self.clock.now()
        if self._refusal and (self._refusal.startswith("a motor") or now - self._refused_at > LOST - 0.03):
            return self._refusal
        if self._touch_worked and self._unfelt >= FEW and (now - self._touched > LOST).all():
            return f"no taxel board has answered for {1e3 * (now - self._touched.max()):.0f} ms"
        return self._dead()

    # -- letting go
    def _letting(self, command: HandCommand) -> HandCommand:
        """Return passive, without stiffness and torque, where the joints are. Where the hand still draws current, the
        same in position mode: a firmware may not know the passive one."""
        if self._letting_go is None:
            before = 0.0 if self._state is None else float(np.abs(self._state.current).max())
            self._letting_go = {"mode": PASSIVE, "since": None, "before": before, "began": self.clock.now(),
                                "from": None, "loads": {}}  # fmt: skip
        at = command.position if self._state is None else self._state.position
        return HandCommand(at, np.zeros(JOINTS), 0, 0, 0, self._letting_go["mode"])

    def _watch_limp(self, code: int, state: HandState | None) -> None:
        """Watch currents and joints after the hand has taken the command; take the second way where they do not end."""
        go, now = self._letting_go, self.clock.now()
        assert go is not None
        if dead := self._dead():
            go["proof"] = False, f"{dead}; cut the hand's power"
            return
        if go["since"] is None:
            if code in ACCEPTED and state is not None:
                go["since"], go["from"] = now, state.position
                go["peak"] = 0.0
            return
        if state is None or now - go["since"] < 0.5 * WATCH:
            return
        go["peak"] = max(go["peak"], float(np.abs(state.current).max()))
        if now - go["since"] < WATCH:
            return
        moved, name = float(np.abs(state.position - go["from"]).max()), int(np.abs(state.current).argmax())
        how = "passive mode" if go["mode"] == PASSIVE else "a torque limit of 0 in position mode, not by passive mode"
        if go["peak"] <= LIMP:
            what = (
                f"the largest current went from {go['before']:.0f} to {go['peak']:.0f} mA, joints moved {moved:.3f} rad"
            )
            proven = max(go["before"], *go["loads"].values(), 0.0) > LIMP or moved > YIELD
            go["proof"] = True, (
                f"limp by {how}: {what}"
                if proven
                else f"the hand took the command; {what}: that it is limp shows when somebody moves a joint"
            )
            return
        go["loads"][go["mode"]] = go["peak"]
        if len(go["loads"]) == 1:
            go["mode"], go["since"] = POSITION, None
            return
        go["mode"] = min(go["loads"], key=go["loads"].get)
        go["since"], go["peak"] = now, 0.0
        go["proof"] = False, (
            f"the hand took the command and still resists: joint {name} draws {abs(int(state.current[name]))} mA; its"
            " torque limit is held at 0"
        )

    def released(self) -> tuple[bool, str] | None:
        """Return whether the hand is limp, and by what that is known; None while it is not known."""
        go = self._letting_go
        if go is None:
            return None
        if "proof" in go:
            return go["proof"]
        if self.clock.now() - go["began"] > 5.5:
            return False, self._refusal or f"the hand does not say that it has let go ({self._why or 'no answer'})"
        return None

    def seen(self) -> np.ndarray:
        """Return the object, of a simulated hand behind the package."""
        look = getattr(self._sdk, "seen", None)
        return np.full(9, np.nan) if look is None else look()

    def handle(self, what: int) -> None:
        """Hold out or let go the object of a simulated hand behind the package."""
        if (act := getattr(self._sdk, "handle", None)) is not None:
            act(what)

    def close(self) -> None:
        """Close the connection. EtherCAT is asked to go to INIT before: the next session finds it there."""
        init = getattr(self._device, "set_firmware_state", None)
        if self.port.startswith("ethercat") and init is not None:
            self._call(lambda: init(self._id, 1, 1, 500_000), None)
            self.clock.sleep_until(self.clock.now() + 0.2)
        self._device.close_device()


class XHandsBus:
    """The hands' side of two on one bus: a round trip of each in turn, some 50 cycles a second. Commands and states
    hold one hand's joints and pads after the other's; a hand whose torque limits are all 0 is let go. See `XHandBus`.

    serials, sides: of the hands, in that order.
    """

    def __init__(
        self, clock: Clock, port: str, serials: Sequence[str | None], sides: Sequence[str | None],
        package: Callable[[Clock], Any] | None,
    ):  # fmt: skip
        sdk = package(clock) if package is not None else _import()
        self.clock = clock
        self.hands = [XHandBus(clock, port, s, side, lambda _: sdk) for s, side in zip(serials, sides, strict=True)]
        self._states: list[HandState | None] = [None] * len(self.hands)
        self._sequence = 0

    @property
    def due(self) -> float:
        return max(h.due for h in self.hands)

    def open(self) -> dict[str, str]:
        """Find one hand, and the others beside it; nothing moves. Raises UserError."""
        first, *others = self.hands
        infos = [first.open()]
        for hand in others:
            wrong: list[str] = []
            more = hand._take(first._device, infos[0]["port"], wrong, [h._id for h in self.hands[: len(infos)]])
            if more is None:
                first.close()
                raise UserError(f"no second hand to drive on the same bus ({'; '.join(wrong)})")
            infos.append(more)
        self._states = [h._state for h in self.hands]
        return {k: ", ".join(dict.fromkeys(i[k] for i in infos)) for k in infos[0]}

    def cycle(self, command: HandCommand | None) -> HandState | None:
        """Make a round trip of each hand."""
        new = False
        for k, hand in enumerate(self.hands):
            hand._pause_until = max(h._pause_until for h in self.hands)  # a bus rests as a whole
            state = hand.cycle(None if command is None else _part(command, k))
            if state is not None:
                self._states[k], new = state, True
        states = [s for s in self._states if s is not None]
        if not new or len(states) < len(self.hands):
            return None
        self._sequence += 1
        join = lambda name: np.concatenate([getattr(s, name) for s in states])  # noqa: E731
        nobody = np.zeros(TAXELS[0], bool)
        return HandState(
            min(s.time for s in states), self._sequence, join("position"), join("current"), join("temperature"),
            join("error"), join("tactile"), None if any(s.velocity is None for s in states) else join("velocity"),
            np.concatenate([nobody if s.silent is None else s.silent for s in states]))  # fmt: skip

    def problem(self) -> str:
        """Return the problem of either hand."""
        return "; ".join(f"{h.label}: {why}" for h in self.hands if (why := h.problem()))

    def released(self) -> tuple[bool, str] | None:
        """Return what is known of hands that are let go: None until all are known."""
        proofs = [(h, h.released()) for h in self.hands if h._letting_go is not None]
        known = [(h, p) for h, p in proofs if p is not None]
        if not proofs or len(known) < len(proofs):
            return None
        return all(p[0] for _, p in known), "; ".join(f"{h.label}: {p[1]}" for h, p in known)

    def seen(self) -> np.ndarray:
        return self.hands[0].seen()

    def handle(self, what: int) -> None:
        self.hands[0].handle(what)

    def close(self) -> None:
        self.hands[0].close()


class VendorXHands(BusDriver):
    """Two xHands on one RS485 bus, in a child process; `hands` are a driver of each, for a `Loop` of its own. Letting
    go of one leaves the other driven; a fault of the bus lets go of both. See `VendorXHand`."""

    name = "xHands"

    def __init__(
        self, serials: Sequence[str | None] = (None, None), sides: Sequence[str | None] = ("right", "left"),
        port: str = "auto", clock: Clock | None = None, package: Callable[[Clock], Any] | None = None,
        hang: float = HANG,
    ):  # fmt: skip
        n = len(sides)
        make = partial(XHandsBus, port=port, serials=serials, sides=sides, package=package)
        super().__init__(make, n * JOINTS, (n * TAXELS[0], TAXELS[1]), clock, hang)
        labels = map(_label, serials, sides)
        self._parts: list[HandCommand | None] = [None] * n
        self.hands = [OneOfTwo(self, k, label) for k, label in enumerate(labels)]

    def open(self) -> dict[str, str]:
        """Connect, whichever hand asks first; returns what to log. Raises UserError."""
        with self._parts_lock:
            if not self._opened:
                self._info, self._opened = super().open(), True
            return self._info

    _opened, _info = False, {}  # type: ignore[var-annotated]
    _parts_lock = threading.RLock()

    def part(self, k: int, command: HandCommand | None) -> None:
        """Send hand k its command: None lets go of it; nothing that was sent before drives it again."""
        with self._parts_lock:
            self._parts[k] = command
            driven = next((c for c in self._parts if c is not None), None)
            if driven is None:
                return self.relax()
            zero = np.zeros(JOINTS)
            position, limit = (
                np.concatenate([zero if c is None else getattr(c, name) for c in self._parts])
                for name in ("position", "tor_max")
            )
            if command is None:
                self.renew()
            self.send(HandCommand(position, limit, driven.kp, driven.ki, driven.kd))


class OneOfTwo:
    """A hand of a bus with several: a `HandDriver`."""

    def __init__(self, bus: VendorXHands, k: int, name: str):
        self.bus, self.k, self.name = bus, k, name

    def open(self) -> dict[str, str]:
        """Connect, unless another hand has; returns what to log. Raises UserError."""
        return self.bus.open()

    def read(self) -> HandState | None:
        """Return the newest state of this hand, None before the first."""
        state = self.bus.read()
        if state is None:
            return None
        j, p = (slice(self.k * n, (self.k + 1) * n) for n in (JOINTS, TAXELS[0]))
        silent = None if state.silent is None or not state.silent[p].any() else state.silent[p]
        return HandState(state.time, state.sequence, state.position[j], state.current[j], state.temperature[j],
                         state.error[j], state.tactile[p], None if state.velocity is None else state.velocity[j],
                         silent)  # fmt: skip

    def send(self, command: HandCommand) -> None:
        """Hand over targets for the next bus cycle."""
        self.bus.part(self.k, None if command.mode == PASSIVE else command)

    def relax(self) -> None:
        """Let go of this hand."""
        self.bus.part(self.k, None)

    def problem(self) -> str:
        """Return why the bus cannot be driven any longer; empty while it can."""
        return self.bus.problem()

    def released(self) -> tuple[bool, str] | None:
        """Return whether this hand is limp since it was let go, and by what that is known; None while it is not."""
        proof = self.bus.released()
        return proof if proof is not None and (self.name in proof[1] or not proof[0]) else None

    def close(self) -> None:
        """Let go; the bus is closed with the last of its hands."""
        self.relax()
        if all(c is None for c in self.bus._parts):
            self.bus.close()


def _label(serial: str | None, side: str | None) -> str:
    return f"{side or serial or 'any'} hand"


def _part(c: HandCommand, k: int) -> HandCommand:
    """Hand k's share of a command for several; without any torque it is let go."""
    j = slice(k * JOINTS, (k + 1) * JOINTS)
    mode = c.mode if c.tor_max[j].any() else PASSIVE
    return HandCommand(c.position[j], c.tor_max[j], c.kp, c.ki, c.kd, mode)


class VendorXHand(BusDriver):
    """An xHand over RS485 or EtherCAT, in a child process; see `XHandBus` for the settings, `BusDriver` for the
    rest."""

    name = "xHand"

    def __init__(
        self, port: str = "auto", clock: Clock | None = None, package: Callable[[Clock], Any] | None = None,
        serial: str | None = None, side: str | None = None, hang: float = HANG,
    ):  # fmt: skip
        make = partial(XHandBus, port=port, serial=serial, side=side, package=package)
        super().__init__(make, JOINTS, TAXELS[:2], clock, hang)


def _import() -> Any:
    try:
        from xhand_controller import xhand_control
    except ImportError as error:
        raise UserError(
            "the vendor's package xhand_controller is not installed; get it from the vendor of the hand, or use"
            f" driver=sim ({error})"
        ) from None
    return xhand_control


def _enumerate(sdk: Any, kind: str) -> list[str]:
    return list(sdk.XHandControl().enumerate_devices(kind) or ())


def _error(answer: Any) -> tuple[int, str]:
    """Return code and message of an error object; -1 for no answer."""
    if answer is None:
        return -1, ""
    message = str(getattr(answer, "error_message", "") or "")
    return int(getattr(answer, "error_code", 0)), " ".join(message.split())[:160]


def _value(device: Any, name: str, *arguments: Any) -> str:
    """Return what the hand says of itself; empty where it does not."""
    try:
        answer = getattr(device, name)(*arguments)
    except Exception:
        return ""
    if isinstance(answer, (tuple, list)) and len(answer) == 2 and hasattr(answer[0], "error_code"):
        return str(answer[1]).strip("\0 ") if answer[0].error_code == 0 else ""
    return str(answer).strip("\0 ")


def _side(said: str) -> str:
    return {"L": "left", "R": "right"}.get(said[:1].upper(), "")


def _whole(raw: Any) -> list[Any] | None:
    """Return the joints in their order, None of a frame that is not whole."""
    if raw is None:
        return None
    joints = list(raw.finger_state)
    order = [int(j.id) for j in joints]
    return sorted(joints, key=lambda j: int(j.id)) if sorted(order) == list(range(JOINTS)) else None


def _int16(values: list[int]) -> np.ndarray:
    """Read two's complement, of packages that give either sign."""
    return (np.array([int(x) for x in values], np.int64) & 0xFFFF).astype(np.uint16).view(np.int16)
