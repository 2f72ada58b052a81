"""A strict fake of the vendor's package `xhand_controller`, as far as public drivers of real hands show how it behaves:
`dexsim deploy driver=xhand port=fake`.

It is as unkind as the package: no call raises (but for arguments of another type, as a native binding does), every one
returns an error object; a round trip takes 9.6 ms with the tail that was measured; readings come from a cache without a
stamp, which holds zeros at first; a retry at once after a CRC error sends the firmware into its boot mode. Which hand
stands behind it is the user's: `LaggingHand`, or the simulated one with its physics.

No fake shows what nobody has published: what the hand does that no driver has met, how stiff the gears are, whether a
torque limit of 0 makes it limp.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np

from dexsim import typed
from dexsim.deploy.driver import PASSIVE, POSITION, Clock, HandCommand, HandState

JOINTS, BOARDS, TAXELS = 12, 5, 120
TRIP, TAIL, MOST, OUTLIER, RARE = 0.00945, 0.00017, 0.0107, 0.111, 1 / 1773
"""s of a round trip: least, its exponential tail's mean (median 9.57 ms), most but for an outlier, which is so rare."""
RETRY, BOOTING, REFUSING = 0.05, 4.2, 0.042
"""s after a CRC error before which another transaction starts the boot mode; its length; s that a refusal takes."""
CRC, BOOT, NO_SUMS, NO_TAXELS, NO_HAND, CLOSED = 1501070, 1501036, 1501018, 1501019, 1501003, 1501001
ENCODER_JITTER = 0.0014
"""rad, of the encoders of a real hand."""


class Faults(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Faults that the fake has, times in s since it was opened: crc, torn: shares of frames; board: a taxel board that
    is dead (-1: none) from board_s on; silent_s: all boards are silent from then on; freeze_s: the bus dies, the cache
    answers on; abort_s: the native library aborts the process; hang_s: a call never returns; refuse_s: commands are
    refused with the code `refuse`; unplug_s: the cable is out for two seconds, and the port's number is another then;
    outlier: share of round trips of 111 ms; opens: how often opening fails first; limp: what makes the hand limp
    (passive: mode 0, torque: a torque limit of 0, never); sdk: version, 0.10.3 has unsigned currents; side, serial;
    second: serial number of a second hand on the same bus, of the other side; ethercat: 1: its bus is EtherCAT, on
    `eth9`, and no serial port has it;
    press: the taxel that is felt when somebody presses a finger, later presses of it wander over its pad, -1: none;
    dead: a taxel that says nothing, on every board; jitter rad of the encoders; seed; log: a
    file to which a line is added for each command that the hand has taken, its time (monotonic, s), mode and largest
    torque limit (mA)."""

    crc: float = 0.0
    torn: float = 0.0
    board: int = -1
    board_s: float = 0.0
    silent_s: float = float("inf")
    freeze_s: float = float("inf")
    abort_s: float = float("inf")
    hang_s: float = float("inf")
    refuse_s: float = float("inf")
    refuse: int = 1501029
    unplug_s: float = float("inf")
    outlier: float = RARE
    opens: int = 0
    limp: str = "passive"
    sdk: str = "1.5.2"
    side: str = "R"
    serial: str = "FAKE0001"
    second: str = ""
    ethercat: int = 0
    press: int = -1
    dead: int = -1
    jitter: float = ENCODER_JITTER
    seed: int = 0
    log: str = ""

    @classmethod
    def parse(cls, text: str) -> Faults:
        """Read faults from text such as `crc=0.005,board=2`. Raises UserError."""
        given = dict(part.partition("=")[::2] for part in text.split(",") if part)
        return typed.convert(given, cls, f"port=fake:{text}", lax=True)


SOUND = Faults()


class LaggingHand:
    """Twelve joints that follow their targets with a lag [s], where their current limit is over `least` mA, and draw
    current as they do; nothing is touched. start: rad; push: rad that somebody holds them away from their targets."""

    lag = 0.04

    def __init__(self, start: float = 0.05, push: float = 0.0, least: float = 0.0):
        self.q, self.time = np.full(JOINTS, start), 0.0
        self.q[3] = min(start, 0.15)  # the index's abduction has no more
        self.target = self.q.copy()
        self.stiff, self.limit, self.least = 0.0, np.zeros(JOINTS), least
        self.push = np.full(JOINTS, push)

    def command(self, c: HandCommand) -> None:
        """Takes effect now."""
        self.target, self.stiff, self.limit = np.array(c.position, float), float(c.kp), np.array(c.tor_max, float)

    def relax(self) -> None:
        """Turn the motors off."""
        self.stiff = 0.0

    def advance(self, t: float) -> None:
        """Advance up to time t [s]."""
        step, self.time = max(t - self.time, 0.0), t
        driven = (self.stiff > 0) & (self.limit > self.least)
        self.q = self.q + driven * (self.target - self.q) * (1 - np.exp(-step / self.lag))

    def state(self, now: float) -> HandState:
        """Return the state as the SDK would give it."""
        drive = np.clip(20.0 * (self.target - self.q - self.push), -1, 1) * self.limit * (self.stiff > 0)
        touch = np.zeros((BOARDS, TAXELS, 3), np.int16)
        return HandState(now, 0, self.q + self.push, np.round(-drive), np.full(JOINTS, 33.0), tactile=touch)


class FakeXHand:
    """The module `xhand_controller.xhand_control`, over a hand (`LaggingHand`, `SimulatedHand`) and a clock."""

    def __init__(self, clock: Clock, make: Callable[[], Any] = LaggingHand, faults: Faults = SOUND):
        self.clock, self.faults = clock, faults
        self.hands = [make() for _ in range(1 + bool(faults.second))]
        self.hand = self.hands[0]
        self.rng = np.random.default_rng(faults.seed)
        for k in range(1, 4):
            for hand in self.hands:
                hand.advance(k * TRIP)  # compiles what is left
        self.zero = clock.now()
        self._slip = -self.hand.time
        self.firmware: list[tuple[float, int]] = []  # when it was asked to go to which EtherCAT state
        self.closed: list[float] = []
        self.blocked = -1, float("nan")  # a joint that something hard is held to, and where
        self.opened, self.pressed, self.presses = 0, (-1, 0.0), [0] * BOARDS
        # when a command went over the wire, and what, by hand; of the first
        self.by_hand: list[list[tuple[float, tuple]]] = [[] for _ in self.hands]
        self.trips = self.by_hand[0]
        self.HandCommand_t, self.FingerCommand_t = _HandCommand, _FingerCommand

    def XHandControl(self) -> _Control:
        """Return a connection."""
        return _Control(self)

    def seen(self) -> np.ndarray:
        """Return the object [9], NaN where the hand behind knows none (not of the package: the simulated world's)."""
        out = np.full(9, np.nan)
        for part, name in ((slice(0, 4), "place"), (slice(4, 9), "orientation")):
            look = getattr(self.hand, name, lambda: None)()
            if look is not None:
                out[part] = np.append(look[0], look[1] + self.zero + self._slip)
        return out

    def handle(self, what: int) -> None:
        """Act as a person beside the simulated hand would: hold the object out (1), let it go (2), press finger k (3 +
        k), hold something hard to joint j (101 + j), or no longer (100)."""
        if what >= 100:
            self.blocked = (what - 101, float("nan")) if what > 100 else (-1, float("nan"))
        elif what > 2:
            self.pressed = what - 3, self.clock.now()
            self.presses[what - 3] += 1
        elif hasattr(self.hand, "present"):
            (self.hand.present if what == 1 else self.hand.release)()

    @property
    def time(self) -> float:
        """s since it was made."""
        return self.clock.now() - self.zero

    def move(self, t: float, which: int = 0) -> HandState:
        """Return a hand's state at time t [s]; on too slow a machine its time stands still rather than jump."""
        hand = self.hands[which]
        if t - self._slip - hand.time > 0.25:
            self._slip = t - hand.time - TRIP
        while hand.time < t - self._slip - TRIP:  # what looks at the object does so all the while
            hand.advance(hand.time + TRIP)
        hand.advance(t - self._slip)
        return hand.state(t + self.zero)

    def ports(self) -> dict[str, bool]:
        """Return serial ports now, and whether the hand's bus is on it: the other is its auxiliary one."""
        if self.faults.ethercat:
            return {"eth9": True}
        if self.faults.unplug_s <= self.time < self.faults.unplug_s + 2.0:
            return {}
        first = 2 if self.time >= self.faults.unplug_s else 0
        return {f"/dev/ttyACM{first}": False, f"/dev/ttyACM{first + 1}": True}


class _FingerCommand:
    """A struct of the binding: 16-bit integers and a float; others are refused."""

    __slots__ = ("id", "kp", "ki", "kd", "position", "tor_max", "mode", "res0", "res1", "res2", "res3")

    def __init__(self, other: _FingerCommand | None = None) -> None:
        for name in self.__slots__:
            setattr(self, name, getattr(other, name, 0))

    def __setattr__(self, name: str, value: Any) -> None:
        low = -32768 if name in ("kp", "ki", "kd", "tor_max") else 0
        good = isinstance(value, (int, float) if name == "position" else int)
        if not good or (name != "position" and not low <= value < low + 65536):
            raise TypeError(f"{name}: {value!r} is no number of its type")
        object.__setattr__(self, name, value)


@dataclass(frozen=True, slots=True)
class _Force:
    fx: int = 0
    fy: int = 0
    fz: int = 0


class _HandCommand:
    def __init__(self, other: _HandCommand | None = None) -> None:
        fingers: list[Any] = [None] * JOINTS if other is None else other.finger_command
        self.finger_command: list[Any] = [_FingerCommand(f) for f in fingers]


class _Kept:
    """What the package keeps of a hand."""

    def __init__(self, cache: Any):
        self.last = _HandCommand()  # what is sent again: zeros at first
        self.cache, self.code = cache, 0
        self.half: tuple[float, Any] | None = None  # until when the cache is torn, and the whole frame


class _Control:
    """A connection: see the module. Hands have the ids 0, 1."""

    def __init__(self, fake: FakeXHand):
        self._fake, self._port = fake, ""
        self._held = [_Kept(self._zeros()) for _ in fake.hands]
        self._crc_at, self._boot_until = -np.inf, -np.inf

    # -- the package's calls
    def enumerate_devices(self, kind: str) -> list[str]:
        """Return ports of a kind: RS485, EtherCAT."""
        return list(self._fake.ports()) if kind == ("EtherCAT" if self._fake.faults.ethercat else "RS485") else []

    def open_serial(self, port: str, baud: int) -> SimpleNamespace:
        """Return error object."""
        fake = self._fake
        fake.opened += 1
        known = fake.ports() | ({"fake": True} if fake.ports() else {})
        if fake.opened <= fake.faults.opens or port not in known or baud != 3_000_000:
            return _error(CLOSED, f"cannot open {port}")
        self._port = port
        return _error()

    def open_ethercat(self, name: str) -> SimpleNamespace:
        """Return error object."""
        self._fake.opened += 1
        if not self._fake.faults.ethercat or name != "eth9" or self._fake.opened <= self._fake.faults.opens:
            return _error(CLOSED, f"no EtherCAT on {name}")
        self._port = name
        return _error()

    def set_firmware_state(self, hand: int, state: int, *_: int) -> SimpleNamespace:
        """Return an error object, as EtherCAT does."""
        self._fake.firmware.append((self._fake.time, state))
        return _error()

    def list_hands_id(self) -> list[int]:
        """Return ids on the bus; none on the auxiliary port."""
        return list(range(len(self._held))) if (self._fake.ports() | {"fake": True}).get(self._port) else []

    def get_hand_type(self, hand: int) -> tuple:
        """Return (error, L or R)."""
        return self._said(hand, ("R" if self._fake.faults.side == "L" else "L") if hand else self._fake.faults.side)

    def get_serial_number(self, hand: int) -> tuple:
        """Return (error, text)."""
        return self._said(hand, self._fake.faults.second if hand else self._fake.faults.serial)

    def read_version(self, hand: int, part: int) -> tuple:
        """Return (error, text)."""
        return self._said(hand, "1.3.9")

    def get_sdk_version(self) -> str:
        """Return text alone."""
        return self._fake.faults.sdk

    def send_command(self, hand: int, command: _HandCommand) -> SimpleNamespace:
        """Return one round trip; error object."""
        if not isinstance(command, _HandCommand):
            raise TypeError("send_command(): incompatible function arguments")
        if not self._port or not 0 <= hand < len(self._held):
            return _error(NO_HAND, "no such hand")
        self._held[hand].last = _HandCommand(command)
        return _error(self._trip(hand))

    def read_state(self, hand: int, force_update: bool = False) -> tuple:
        """Return (error, state): forced, the last command goes out once more; the cache either way."""
        if not self._port or not 0 <= hand < len(self._held):
            return _error(NO_HAND, "no such hand"), self._zeros()
        if force_update:
            self._trip(hand)
        held = self._held[hand]
        if held.half is not None and self._fake.clock.now() >= held.half[0]:
            held.cache, held.half = held.half[1], None
        return _error(held.code), held.cache  # a frame is not written again once it is there

    def close_device(self) -> None:
        """Close the connection; the hand keeps its last command."""
        self._fake.closed.append(self._fake.time)
        self._port = ""

    # -- the wire
    def _said(self, hand: int, value: str) -> tuple:
        there = hand in self.list_hands_id()
        return (_error(), value) if there else (_error(NO_HAND, "no such hand"), "")

    def _trip(self, hand: int) -> int:
        """Return the command goes out, the state comes back; the code of it."""
        fake, f, held = self._fake, self._fake.faults, self._held[hand]
        clock, t = fake.clock, fake.time
        if t >= f.abort_s:
            os.abort()
        while t >= f.hang_s:
            clock.sleep_until(clock.now() + 3600.0)
        now = clock.now()
        if now < self._crc_at + RETRY and now >= self._boot_until:
            self._boot_until = now + BOOTING
        if now < self._boot_until:
            clock.sleep_until(now + REFUSING)
            held.code = BOOT
            return BOOT
        if not fake.ports() or not (fake.ports() | {"fake": True}).get(self._port):
            clock.sleep_until(now + REFUSING)
            held.code = NO_HAND
            return NO_HAND
        dead = t >= f.freeze_s
        refused = t >= f.refuse_s
        if not dead and not refused:
            self._carry(hand)
        long = OUTLIER if fake.rng.random() < f.outlier else min(TRIP + fake.rng.exponential(TAIL), MOST)
        if dead:
            clock.sleep_until(now + long)
            return 0  # the cache answers on
        broken = fake.rng.random() < f.crc
        frame = self._frame(fake.move(t + long, hand), broken, hand)
        clock.sleep_until(now + long)
        self._store(frame, held)
        if refused:
            held.code = 0
            return f.refuse
        boards = t >= f.silent_s or (f.board >= 0 and t >= f.board_s)
        held.code = CRC if broken else NO_TAXELS if boards else 0
        if broken:
            self._crc_at = clock.now()
        return held.code

    def _carry(self, which: int) -> None:
        fake, fingers, hand = self._fake, self._held[which].last.finger_command, self._fake.hands[which]
        mode, kp, limit = fingers[0].mode, fingers[0].kp, np.array([f.tor_max for f in fingers], float)
        position = np.array([f.position for f in fingers])
        fake.by_hand[which].append((fake.time, (mode, kp, position, limit)))
        f = fake.faults
        if f.log:
            with open(f.log, "a", encoding="utf-8") as log:
                log.write(f"{fake.clock.now():.4f} {mode} {limit.max():g}\n")
        if mode == PASSIVE and f.limp == "passive" or mode != PASSIVE and not limit.any() and f.limp == "torque":
            hand.relax()
        elif mode == POSITION and limit.any():
            hand.command(HandCommand(position, limit, kp))

    def _frame(self, s: HandState, broken: bool, hand: int) -> SimpleNamespace:
        fake, f = self._fake, self._fake.faults
        unsigned = f.sdk.startswith("0.10")
        integer = (lambda x: int(round(x)) & 0xFFFF) if unsigned else (lambda x: int(round(x)))
        frame = self._zeros()
        speed = s.velocity if s.velocity is not None else np.zeros(JOINTS)
        self._hold(s, hand)
        noise = f.jitter * fake.rng.standard_normal(JOINTS)
        for i, j in enumerate(frame.finger_state):
            j.id, j.position, j.torque = i, float(np.float32(s.position[i] + noise[i])), integer(s.current[i])
            j.temperature, j.raw_position = 0x0100 | int(s.temperature[i]), int(s.position[i] * 652) & 0xFFF
            j.default5 = integer(1e3 * speed[i])
            j.tipboard_err = 307 if broken and i == 2 else 0
        for k, board in enumerate(frame.sensor_data):
            if fake.time >= f.silent_s or (k == f.board and fake.time >= f.board_s) or broken:
                frame.sensor_data[k] = self._held[hand].cache.sensor_data[k]
                continue
            touch = s.tactile[k] if k < len(s.tactile) else np.zeros((TAXELS, 3))
            since = fake.clock.now() - fake.pressed[1]
            if f.press >= 0 and fake.pressed[0] == k and since < 0.5:
                touch = touch.copy()
                if (n := fake.presses[k]) == 1:
                    touch[f.press] = 0, 0, 60
                else:  # a blunt tool, harder and softer again; where: a sequence that covers a pad evenly
                    at = np.array([0.7549 * n % 1.0 * 9.0, 0.5698 * n % 1.0 * 11.0])
                    away = np.stack(np.divmod(np.arange(TAXELS), 12), 1) - at
                    blob = np.exp(-0.5 * (away**2).sum(1) / 1.5**2)
                    touch[:, 2] = np.round((40 + 40 * (n % 3)) * blob * np.sin(np.pi * min(since / 0.25, 1.0)))
            if f.dead >= 0:
                touch = touch.copy()
                touch[f.dead] = 0
            if touch.any():
                rows = np.clip(touch, [-128, -128, 0], [127, 127, 255]).astype(int).tolist()
                total = np.clip(touch.sum(0), [-128, -128, 0], [127, 127, 255]).astype(int).tolist()
                board.raw_force, board.calc_force = [_Force(*x) for x in rows], _Force(*total)
            board.temperature = (30 + (fake.rng.random(20) < 0.5)).tolist()
            board.calc_temperature = 30
        return frame

    def _hold(self, s: HandState, hand: int) -> None:
        """Stop a joint that something is held to: it draws 3 A a rad that its target is ahead, and presses."""
        j, at = self._fake.blocked
        if j < 0:
            return
        self._fake.blocked = j, (at := float(s.position[j]) if np.isnan(at) else at)
        c = self._held[hand].last.finger_command[j]
        push = min(max(3e3 * (c.position - at), 0.0), c.tor_max) if c.mode == POSITION and c.kp else 0.0
        s.position, s.current, s.tactile = np.array(s.position), np.array(s.current), np.array(s.tactile)
        s.position[j] = min(s.position[j], at)
        s.current[j] = -push
        board = int(np.searchsorted((3, 6, 8, 10), j, side="right"))
        s.tactile[board, 60:66, 2] += int(0.02 * push)

    def _store(self, frame: SimpleNamespace, held: _Kept) -> None:
        """Write the cache, as the package's thread does: now, or, of a torn frame, to its end in 1.5 ms."""
        fake = self._fake
        held.cache, held.half = frame, None
        if fake.rng.random() < fake.faults.torn:
            joints = frame.finger_state[:7] + self._zeros().finger_state[7:]
            held.cache = SimpleNamespace(finger_state=joints, sensor_data=frame.sensor_data)
            held.half = fake.clock.now() + 0.0015, frame

    def _zeros(self) -> SimpleNamespace:
        names = ("id sensor_id position torque raw_position temperature commboard_err jonitboard_err tipboard_err"
                 " default5 default6 default7").split()  # fmt: skip
        nothing = [_Force()] * TAXELS
        return SimpleNamespace(
            finger_state=[SimpleNamespace(**(dict.fromkeys(names, 0) | {"position": 0.0})) for _ in range(JOINTS)],
            sensor_data=[
                SimpleNamespace(calc_force=nothing[0], raw_force=nothing, temperature=[0] * 20, calc_temperature=0)
                for _ in range(BOARDS)
            ],
        )


def _error(code: int = 0, message: str = "") -> SimpleNamespace:
    return SimpleNamespace(error_code=code, error_message=message or ("" if not code else f"code {code}"))
