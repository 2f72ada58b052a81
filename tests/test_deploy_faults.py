"""The real-time loop lets go: whatever the hand, the object's eye, the disk, the settings or the terminal do, the hand
is relaxed within 0.15 s, no target leaves that is not finite or lies outside the limits, and the recording and the
report are there."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from bundles import make_checkpoint
from test_deploy import FakeHand, recorder_at

from dexsim import export, system
from dexsim.calibration.file import Calibration
from dexsim.cli.deploy import _Stop
from dexsim.deploy import bundle
from dexsim.deploy.driver import PASSIVE, VirtualClock
from dexsim.deploy.imu import UdpImu
from dexsim.deploy.loop import LIMITS, Loop, LoopSettings
from dexsim.deploy.safety import Guard
from dexsim.deploy.vision import FixedPlace
from dexsim.errors import UserError
from dexsim.recording.reader import read
from tools.assets import xhand

torch.set_num_threads(1)
PLACE = np.array([0.055, 0.0, 0.04])
NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module")
def b(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    return bundle.load(export.export(str(make_checkpoint(folder / "policy.pt")), folder / "out", steps=2))


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Yield one hand model for all loops here, and no collection of torch's whole heap before each: a run is then a
    tenth of a second."""
    from dexsim.deploy import loop, measure

    with pytest.MonkeyPatch.context() as patch:
        model = measure.HandKinematics()
        patch.setattr(measure, "HandKinematics", lambda hand: model)
        patch.setattr(loop.gc, "collect", lambda: 0)
        yield


class Spoiled(FakeHand):
    """A hand whose readings are changed by `spoil(state, now)` from `at` s after the policy's begin on (None:
    always)."""

    def __init__(self, clock, spoil=None, at=0.3):
        super().__init__(clock, start=0.05)
        self.spoil, self.at, self.since, self.held = spoil, at, None, []

    def read(self):
        state, now = super().read(), self.clock.now()
        if self.spoil and (self.at is None or (self.begun and now >= self.begun + self.at)):
            self.since = now if self.since is None else self.since
            state = self.spoil(state, now, self.held) or state
        return state


class Eye:
    """Sees the object; its answers are changed by `spoil(now)` from `at` s after the policy's begin on."""

    def __init__(self, hand, spoil, at):
        self.hand, self.spoil, self.at, self.since = hand, spoil, at, None

    def place(self, now):
        if self.hand.begun and now >= self.hand.begun + self.at:
            self.since = now if self.since is None else self.since
            return self.spoil(now, self.since)
        return PLACE, now


def run(b, hand, eye=None, recorder=None, **changes):
    loop = Loop(
        b,
        hand,
        eye or FixedPlace(PLACE),
        Calibration.default(),
        LoopSettings(**{"seconds": 1.0, "tor_max": 300.0, "home_speed": 3.0} | changes),
        hand.clock,
        recorder,
    )
    try:
        loop.run()
    finally:
        check_sent(hand, loop.guard)
    return loop.report


def check_sent(hand, guard):
    """Check that nothing that is not finite or outside the limits has left, and nothing drives after the first letting
    go."""
    driven = [(t, q) for t, q, _, mode in hand.sent if mode != PASSIVE]
    for _, q in driven:
        assert np.isfinite(q).all() and (q >= guard.low - 1e-6).all() and (q <= guard.high + 1e-6).all()
    if hand.relaxed_at:
        assert not [t for t, _ in driven if t > hand.relaxed_at[0]]


def change(**fields):
    """Return a spoiler that sets these fields of a reading; a function gets (old value, now)."""

    def spoil(state, now, held=None):
        for name, value in fields.items():
            setattr(state, name, value(getattr(state, name), now) if callable(value) else value)

    return spoil


def one(value, joint=4):
    return lambda old, now: np.where(np.arange(12) == joint, value, np.asarray(old, float))


def frozen(**fields):
    """Return the same reading again and again, with these fields changed."""

    def spoil(state, now, held):
        held.append(dataclasses.replace(state))
        again = dataclasses.replace(held[0])
        change(**fields)(again, now)
        return again

    return spoil


def taxel(value):
    def put(old, now):
        new = np.asarray(old, float).copy()
        new[2, 60, 2] = value
        return new

    return put


HAND = {
    "stamps an hour ahead, frozen": frozen(time=lambda old, now: now + 3600),
    "stamps an hour ahead, frozen, counted on": frozen(
        time=lambda old, now: now + 3600, sequence=lambda old, now: int(1e6 * now)
    ),
    "stamps of NaN, frozen": frozen(time=NAN),
    "stamps of now, frozen": frozen(time=lambda old, now: now),
    "stamps ahead": change(time=lambda old, now: now + 1.0),
    "stamps of NaN": change(time=NAN),
    "stamps of inf": change(time=INF),
    "stamps of None": change(time=None),
    "stamps an hour old": change(time=lambda old, now: now - 3600),
    "stamps that run backwards": change(time=lambda old, now: 200 - now),
    "no reading any more": frozen(),
    "a position of NaN": change(position=one(NAN)),
    "positions of NaN": change(position=np.full(12, NAN)),
    "a position of 1e9": change(position=one(1e9)),
    "a position of -inf": change(position=one(-INF)),
    "11 positions": change(position=np.zeros(11)),
    "positions of text": change(position=["x"] * 12),
    "a current of NaN": change(current=one(NAN)),
    "currents of NaN": change(current=np.full(12, NAN)),
    "a current of 1e9": change(current=one(1e9)),
    "a temperature of NaN": change(temperature=one(NAN)),
    "a temperature of inf": change(temperature=one(INF)),
    "90 degC": change(temperature=one(90.0)),
    "a taxel of NaN": change(tactile=taxel(NAN)),
    "a taxel of 1e9": change(tactile=taxel(1e9)),
    "taxels of another shape": change(tactile=np.zeros((5, 12, 3))),
    "complex positions": change(position=np.full(12, 0.05j)),
    "a complex stamp": change(time=np.complex128(1j)),
    "a position that is none": change(position=None),
    "a velocity of 1e9": change(velocity=one(1e9)),
    "error codes": change(error=one(7)),
    "an error of NaN": change(error=np.full(12, NAN)),
}


@pytest.mark.parametrize("fault", HAND)
def test_a_fault_of_the_hands_readings_relaxes_it(b, fault):
    hand = Spoiled(VirtualClock(100.0), HAND[fault])
    report = run(b, hand)
    assert report.ended not in ("done", "") and report.counts["relaxed"] == 1
    assert hand.relaxed_at[0] - hand.since < 0.15, (hand.relaxed_at[0] - hand.since, report.ended)


@pytest.mark.parametrize("fault", HAND)
def test_a_fault_from_the_start_moves_nothing(b, fault):
    hand = Spoiled(VirtualClock(100.0), HAND[fault], at=None)
    begun = hand.clock.now()
    try:
        report = run(b, hand)
        assert report.ended != "done" and hand.relaxed_at[0] - begun < 0.15, report.ended
        moved = [0.05 - q for _, q, _, mode in hand.sent if mode != PASSIVE]
        assert np.abs(moved or 0.0).max() < 0.35, "at 3 rad/s, it was homing for a tenth of a second"
    except UserError as error:
        assert "no good reading of the hand within 2 s" in str(error) and not [x for x in hand.sent if x[3] != PASSIVE]
    assert hand.relaxed_at and hand.begun is None


def test_taxels_that_are_gone_relax_the_hand(b):
    """A driver may have none from the start; one that had them has them still, or its readings are not the hand's."""
    gone = np.zeros((0, 0, 3), np.int16)
    hand = Spoiled(VirtualClock(100.0), change(tactile=gone))
    report = run(b, hand)
    assert "tactile is not 5 x 120 x 3" in report.ended and hand.relaxed_at[0] - hand.since < 0.15, report.ended
    assert run(b, Spoiled(VirtualClock(100.0), change(tactile=gone), at=None)).ended == "done"


def test_one_bad_reading_in_ten_is_left_out_and_counted(b):
    hand = Spoiled(
        VirtualClock(100.0),
        lambda state, now, held: change(position=one(1e9))(state, now) if state.sequence % 10 == 0 else None,
        at=None,
    )
    report = run(b, hand)
    assert report.ended == "done" and 10 < report.counts["bad_readings"] < 60


EYE = {
    "an hour old": lambda now, since: (PLACE, now - 3600),
    "never": lambda now, since: None,
    "a stamp of NaN": lambda now, since: (PLACE, NAN),
    "an hour ahead": lambda now, since: (PLACE, now + 3600),
    "a place of NaN": lambda now, since: (PLACE * NAN, now),
    "a place of 1e9": lambda now, since: (PLACE * 1e10, now),
    "two numbers": lambda now, since: (PLACE[:2], now),
    "frozen": lambda now, since: (PLACE, since),
}


@pytest.mark.parametrize("at", [0.0, 0.3])
@pytest.mark.parametrize("fault", EYE)
def test_an_object_that_is_not_seen_relaxes_the_hand(b, fault, at):
    hand = Spoiled(VirtualClock(100.0))
    eye = Eye(hand, EYE[fault], at)
    report = run(b, hand, eye, seen=0.1, seconds=2.0)
    assert "object" in report.ended, report.ended
    assert hand.relaxed_at[0] - eye.since < 0.15, (hand.relaxed_at[0] - eye.since, report.ended)
    if fault == "an hour old":  # without a setting too: its age is beyond any
        hand = Spoiled(VirtualClock(100.0))
        eye = Eye(hand, EYE[fault], at)
        assert "object" in run(b, hand, eye).ended and hand.relaxed_at[0] - eye.since < 0.15


# -- settings
# ---------------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", LIMITS)
def test_settings_outside_their_range_are_refused_before_anything_moves(b, name):
    low, high, _ = LIMITS[name]
    for value in (NAN, INF, -INF, low - 1, high + 1, *([0.0] if low > 0 else [])):
        hand = Spoiled(VirtualClock(100.0))
        with pytest.raises(UserError, match=f"^{name}=.*must lie in") as error:
            run(b, hand, **{name: value})
        assert "\n" not in str(error.value) and not hand.sent


@pytest.mark.parametrize("margin", [0.1, 0.3, 0.5, 0.6, 1.0])
def test_a_margin_keeps_targets_inside_or_is_refused(b, margin):
    hand = Spoiled(VirtualClock(100.0))
    room = np.diff(xhand.joint_limits()).min()
    if 2 * margin >= room:
        with pytest.raises(UserError, match="smaller margin="):
            run(b, hand, margin=margin)
        assert not hand.sent
    else:
        assert run(b, hand, margin=margin, home_error=1.0).ended == "done"
        low, high = xhand.joint_limits().T
        q = np.stack([q for _, q, *_ in hand.sent])
        assert (q >= low + margin - 1e-6).all() and (q <= high - margin + 1e-6).all()


def test_the_guard_gives_finite_targets_inside_the_limits_whatever_comes_in():
    rng = np.random.default_rng(0)
    low, high = xhand.joint_limits().T
    g = Guard(low, high, np.full(12, 2.0), np.full(12, 300.0), np.full(12, -1.0), xhand.JOINTS)
    values = np.array([NAN, INF, -INF, 1e300, -1e300, 0.0, 0.3, -0.3])
    for _ in range(2000):
        target, before, q, current = rng.choice(values, (4, 12))
        out = g.apply(target, before, q, current, 0.02)
        assert np.isfinite(out).all() and (out >= low).all() and (out <= high).all()


# -- relaxing that fails, disks, signals
# ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("error", [RuntimeError("bus"), OSError(5, "I/O"), KeyboardInterrupt()])
def test_relaxing_is_tried_again_until_it_works(b, error):
    hand = Spoiled(VirtualClock(100.0), HAND["a position of 1e9"])
    relax, tries = hand.relax, []

    def failing():
        tries.append(hand.clock.now())
        if len(tries) <= 3:
            raise error
        relax()

    hand.relax = failing
    report = run(b, hand)
    assert len(tries) >= 4 and report.counts["relax_failed"] == 3 and not report.not_relaxed
    assert hand.relaxed_at[0] - hand.since < 0.15
    assert [mode for t, _, _, mode in hand.sent if t >= tries[0]] == [PASSIVE] * 3, (
        "and the passive mode is sent meanwhile"
    )


def test_a_hand_that_never_relaxes_is_said(b, capsys):
    from dexsim.cli.deploy import _ending

    hand = Spoiled(VirtualClock(100.0))

    def failing():
        raise OSError(5, "Input/output error")

    hand.relax = failing
    report = run(b, hand)
    assert "Input/output" in report.not_relaxed and report.counts["relax_failed"] >= 50
    _ending(report, None)
    out = capsys.readouterr().out
    assert "DANGER" in out and "cut its power" in out and "the hand is relaxed" not in out


@pytest.mark.parametrize("at", ["write", "close", "thread"])
def test_a_full_disk_costs_the_rest_of_the_recording_and_nothing_else(b, tmp_path, at):
    hand = Spoiled(VirtualClock(100.0))
    rec = recorder_at(tmp_path / "run.mcap")
    rec.zero -= 30.0

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    def odd(*_, **__):
        raise ValueError("what nobody thought of")

    setattr(
        rec.writer, {"write": "add_state", "close": "close", "thread": "add_array"}[at], odd if at == "thread" else full
    )
    report = run(b, hand, recorder=rec)
    assert report.ended == "done" and report.acts == 48 and hand.relaxed_at
    assert ("nobody thought" if at == "thread" else "No space left") in rec.error and rec.writer._file.closed
    if at == "write":  # of the first sample, however long the hand's start has taken
        assert "nothing is recorded from 0.0 s on" in rec.error
    if at == "close":
        assert len(read(tmp_path / "run.mcap", audit=False).commands) > 10, "what was written before is there"


def test_a_hand_that_cannot_be_opened_leaves_no_recording_open(b, tmp_path):
    hand = Spoiled(VirtualClock(100.0))

    def nobody():
        raise UserError("no hand answers on the bus")

    hand.open = nobody
    rec = recorder_at(tmp_path / "run.mcap")
    with pytest.raises(UserError, match="no hand answers"):
        run(b, hand, recorder=rec)
    assert rec.writer._file.closed and not rec._thread.is_alive() and not list(tmp_path.iterdir()) and not hand.sent


def test_a_disk_that_is_full_from_the_first_byte_is_one_line_with_the_place(tmp_path):
    (tmp_path / "run.mcap").symlink_to("/dev/full")
    with pytest.raises(UserError, match="cannot write recording .*run.mcap: No space left on device"):
        recorder_at(tmp_path / "run.mcap")


@pytest.mark.parametrize(
    ("setting", "said"),
    [("margin=0.6", "smaller margin="), ("seconds=1", "is there already"), ("tor_max=0", "tor_max")],
)
def test_a_recording_that_is_there_is_not_overwritten(b, tmp_path, setting, said, capsys):
    from dexsim.cli.main import main

    path = tmp_path / "of_yesterday.mcap"
    path.write_bytes(b"an hour of a real hand")
    assert main(["deploy", f"bundle={b.path}", f"record={path}", setting]) == 2
    assert said in capsys.readouterr().err and path.read_bytes() == b"an hour of a real hand"
    assert main(["deploy", f"bundle={b.path}", f"record={tmp_path / 'new.mcap'}", "margin=0.6"]) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["of_yesterday.mcap"], "what is refused leaves no file"


class Interrupting:
    """A lock on which the first signal comes at the worst moment: while the hand is let go."""

    def __init__(self, lock):
        self.lock, self.hits = lock, 0

    def acquire(self, timeout):
        self.hits += 1
        if self.hits == 1:
            raise KeyboardInterrupt
        return self.lock.acquire(timeout=timeout)

    def __getattr__(self, name):
        return getattr(self.lock, name)

    def __enter__(self):
        return self.lock.__enter__()

    def __exit__(self, *error):
        return self.lock.__exit__(*error)


@pytest.mark.parametrize("where", ["lock", "recorder"])
def test_a_signal_after_the_end_breaks_nothing_off(b, tmp_path, where):
    """The first signal may come when the policy is done: the hand is relaxed and its recording whole all the same."""
    hand = Spoiled(VirtualClock(100.0))
    rec = recorder_at(tmp_path / "run.mcap")
    loop = Loop(b, hand, FixedPlace(PLACE), Calibration.default(), LoopSettings(seconds=0.5, tor_max=300.0,
                home_speed=3.0), hand.clock, rec)  # fmt: skip
    if where == "lock":
        loop._lock = Interrupting(loop._lock)
    else:
        close, hits = rec.close, []

        def interrupted():
            hits.append(1)
            if len(hits) == 1:
                raise KeyboardInterrupt
            close()

        rec.close = interrupted
    report = loop.run()
    assert report.ended == "done" and hand.relaxed_at and rec.writer._file.closed and gc.isenabled()
    assert not [f for f in read(tmp_path / "run.mcap", audit=False).findings if f.kind == "damage"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_the_bus_is_closed_waits(b, number, monkeypatch, capsys):
    from dexsim.cli import deploy

    clock, closed = VirtualClock(100.0), []
    hand = Spoiled(clock)

    def close():
        os.kill(os.getpid(), number)
        closed.append(True)

    hand.close = close
    monkeypatch.setattr(deploy, "_hand", lambda *_: (hand, FixedPlace(PLACE)))
    monkeypatch.setattr("dexsim.deploy.loop.Clock", lambda: clock)
    assert deploy.main([f"bundle={b.path}", "record=none", "seconds=0.2", "home_speed=3"]) == 0
    assert closed and "the hand is relaxed" in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_relaxes_and_those_after_it_change_nothing(b, number, tmp_path):
    def hit(hand, now):
        if hand.begun and now > hand.begun + 0.3:
            hand.fault, hand.hit = None, now
            os.kill(os.getpid(), number)

    hand = Spoiled(VirtualClock(100.0))
    hand.fault = hit
    relax = hand.relax

    def impatient():
        relax()
        for other in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(os.getpid(), other)

    hand.relax = impatient
    rec = recorder_at(tmp_path / "run.mcap")
    with _Stop() as stop:
        report = run(b, hand, recorder=rec)
    assert stop.status == 128 + number and report.ended == f"stopped by {system.hand_signals()[number]}"
    assert hand.relaxed_at[0] - hand.hit < 0.02 and report.acts > 10 and not rec.writer._open


@pytest.mark.slow
def test_a_terminal_that_goes_away_leaves_a_relaxed_hand_and_a_whole_recording(b, tmp_path):
    path = tmp_path / "run.mcap"
    p = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "dexsim",
            "deploy",
            f"bundle={b.path}",
            "seconds=60",
            "home_speed=2",
            "late=2",
            "stale=2",
            "hang=3",
            "overruns=500",
            f"record={path}",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    limit = time.monotonic() + 120
    while not (path.exists() and path.stat().st_size > 40_000) and time.monotonic() < limit:
        time.sleep(0.1)
    os.kill(p.pid, signal.SIGHUP)
    out, _ = p.communicate(timeout=60)
    assert p.returncode == 129 and "stopped by SIGHUP" in out and "the hand is relaxed" in out
    assert not [f for f in read(path, audit=False).findings if f.kind == "damage"]


# -- the IMU's port
# ----------------------------------------------------------------------------------------------------------------
def udp():
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)


def test_the_first_sender_is_the_only_one():
    imu = UdpImu(0)
    with udp() as friend, udp() as stranger:
        at = ("127.0.0.1", imu.port)
        friend.sendto(b"1 0 0 0", at)
        stranger.sendto(b"0 1 0 0", at)
        assert imu.wait(2.0) and imu.sender[1] == friend.getsockname()[1] and imu.foreign == 1
        for _ in range(50):
            stranger.sendto(b"0 1 0 0", at)
        assert imu.orientation(7.0)[1] < 7.0 or imu.orientation(7.0)[0].tolist() == [1, 0, 0, 0]
        friend.sendto(b"0.6 0 0 0.8", at)
        time.sleep(0.01)
        q, seen = imu.orientation(8.0)
        assert q.tolist() == [0.6, 0, 0, 0.8] and seen == 8.0
    imu.close()


def test_a_named_sender_is_the_only_one_from_the_start():
    with udp() as friend, udp() as stranger:
        friend.bind(("127.0.0.1", 0))
        imu = UdpImu(0, sender_port=friend.getsockname()[1])
        at = ("127.0.0.1", imu.port)
        stranger.sendto(b"0 1 0 0", at)
        time.sleep(0.01)
        assert imu.orientation(1.0) is None
        friend.sendto(b"1 0 0 0", at)
        time.sleep(0.01)
        assert imu.orientation(2.0)[0].tolist() == [1, 0, 0, 0]
        imu.close()


FLOOD = """import socket, sys, time
s, at, n = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), ("127.0.0.1", int(sys.argv[1])), 0
end = time.monotonic() + 30
while time.monotonic() < end:
    for _ in range(100):
        try: s.sendto(sys.argv[2].encode(), at); n += 1
        except OSError: pass
    print(n, flush=True)
"""


@contextlib.contextmanager
def flood(port, line):
    """Start another program that sends a line as fast as it can; gives how many it has sent so far."""
    child = subprocess.Popen([sys.executable, "-c", FLOOD, str(port), line], stdout=subprocess.PIPE, text=True)
    sent = [int(child.stdout.readline())]
    reader = threading.Thread(target=lambda: [sent.append(int(x)) for x in child.stdout], daemon=True)
    reader.start()
    try:
        yield lambda: sent[-1]
    finally:
        child.kill()
        child.wait()
        reader.join()
        child.stdout.close()


@pytest.mark.parametrize(
    ("line", "named", "first"),
    [("0 1 0 0", False, False), ("0 1 0 0", True, True), ("nonsense", False, True), ("nonsense", True, True)],
    ids=["good lines later", "good lines first, sender named", "bad lines first", "bad lines first, sender named"],
)
def test_a_flood_of_others_starves_nothing(line, named, first, capsys):
    """Another program's lines, from before the first of the right sender's or after it: every turn has a new reading,
    and none is the stranger's."""
    with udp() as friend, contextlib.ExitStack() as open_:
        friend.bind(("127.0.0.1", 0))
        imu = UdpImu(0, sender_port=friend.getsockname()[1] if named else None)
        at = ("127.0.0.1", imu.port)
        stop = threading.Event()
        sent = open_.enter_context(flood(imu.port, line)) if first else None
        began = time.monotonic()

        def call():
            while not stop.wait(0.01):
                friend.sendto(b"1 0 0 0", at)

        calling = threading.Thread(target=call)
        calling.start()
        found = imu.wait(20.0)
        waited = time.monotonic() - began
        stop.set()
        calling.join()
        assert found and imu.sender == friend.getsockname()
        sent = sent or open_.enter_context(flood(imu.port, line))
        before, turns, fresh, foreign = sent(), 60, 0, 0
        began = time.monotonic()
        for k in range(turns):
            friend.sendto(f"{1 + k * 1e-3} 0 0 0.1".encode(), at)
            time.sleep(0.005)
            q, seen = imu.orientation(100.0 + k)
            fresh += seen == 100.0 + k
            foreign += q[1] != 0
        rate = (sent() - before) / (time.monotonic() - began)
    imu.close()
    with capsys.disabled():
        how = f"\nflood of {line!r}, {rate:.0f} lines/s, named={named}, first={first}"
        print(f"{how}: first reading after {waited:.2f} s, {fresh} of {turns} turns with a new one, {foreign} foreign")
    assert foreign == 0 and fresh >= turns - 3


def test_a_flood_of_the_sender_itself_is_read_young():
    """Lines that say when they were sent, as fast as they can be: what is read is not old."""
    turned = "cmath.exp(1j * (time.monotonic() % 100) / 40)"
    line = f"b'%.9f 0 0 %.9f' % ((z := {turned}).real, z.imag)"
    code = "import cmath\n" + FLOOD.replace("sys.argv[2].encode()", line)
    imu = UdpImu(0)
    child = subprocess.Popen([sys.executable, "-c", code, str(imu.port)], stdout=subprocess.DEVNULL)
    try:
        assert imu.wait(20.0)
        ages = []
        for _ in range(60):
            time.sleep(0.01)
            q, _ = imu.orientation(0.0)
            ages.append((time.monotonic() % 100 - 40 * np.arctan2(q[3], q[0])) % 100)
    finally:
        child.kill()
        child.wait()
        imu.close()
    assert np.median(ages) < 0.25, ages


# -- what a driver may not do, and signals of every kind
# ----------------------------------------------------------------------------------------------------------------
def every_second(spoil):
    return lambda state, now, held: spoil(state, now, held) if state.sequence % 2 else None


def still(state, now, held):
    """Counts on and says the same to the last bit; the time of it is its own."""
    held.append(dataclasses.replace(state))
    return dataclasses.replace(held[0], time=now, sequence=state.sequence)


WRONG = {
    "an error code in every second reading": (every_second(change(error=one(7))), "reports error code 7", 0.15),
    "a count that goes back": (
        lambda state, now, held: (held.append(1), change(sequence=3)(state, now) if len(held) > 5 else None)[1],
        "the count of its readings went back from", 0.15),
    "a count of NaN": (change(sequence=NAN), "count of its readings is nan", 0.15),
    "readings that never change": (still, "no bit of the readings has changed", 0.45),
}  # fmt: skip


@pytest.mark.parametrize("at", [0.3, None], ids=["in the run", "from the start"])
@pytest.mark.parametrize("fault", WRONG)
def test_what_a_driver_may_not_do_ends_the_run_with_its_reason(b, fault, at):
    spoil, says, limit = WRONG[fault]
    hand = Spoiled(VirtualClock(100.0), spoil, at)
    loop = Loop(b, hand, FixedPlace(PLACE), Calibration.default(),
                LoopSettings(seconds=2.0, tor_max=300.0, home_speed=3.0), hand.clock)  # fmt: skip
    wave = np.sin(np.arange(400) / 6.0)
    act, k = loop.bundle.act, iter(range(400))
    loop.bundle = dataclasses.replace(loop.bundle)
    loop.bundle.act = lambda obs: np.full_like(act(obs), wave[next(k)])  # targets move
    if (fault, at) == ("a count of NaN", None):  # never a good reading: the hand is not driven at all
        with pytest.raises(UserError, match=says):
            loop.run()
        return check_sent(hand, loop.guard)
    report = loop.run()
    check_sent(hand, loop.guard)
    first = 0.06 if fault == "a count that goes back" else 0.0
    assert says in report.ended and hand.relaxed_at[0] - hand.since - first < limit, report.ended


def test_one_error_code_in_ten_readings_is_counted_and_no_more(b):
    rare = lambda s, now, held: change(error=one(7))(s, now) if s.sequence % 10 == 0 else None  # noqa: E731
    hand = Spoiled(VirtualClock(100.0), rare)
    report = run(b, hand)
    assert report.ended == "done" and report.counts["error_codes"] > 3


def test_readings_that_never_change_under_load_may_be_those_of_a_blocked_hand(b):
    def spoil(state, now, held):
        state = still(state, now, held)
        state.current = np.full(12, -200.0)
        return state

    assert run(b, Spoiled(VirtualClock(100.0), spoil)).ended == "done"


class Said:
    error_code, error_message = 1501029, "refused"


@pytest.mark.parametrize("answer", ["no", Said(), False])
def test_a_send_that_returns_an_error_ends_the_run(b, answer):
    hand = Spoiled(VirtualClock(100.0))
    send, since = hand.send, []

    def refusing(command):
        if hand.begun and hand.clock.now() > hand.begun + 0.3:
            since.append(hand.clock.now())
            return answer
        return send(command)

    hand.send = refusing
    report = run(b, hand)
    assert "refuses what is sent" in report.ended and hand.relaxed_at[0] - since[0] < 0.15, report.ended
    assert run(b, Spoiled(VirtualClock(100.0))).ended == "done"


@pytest.mark.parametrize("name", ["position", "current", "tactile"])
def test_a_driver_that_changes_a_reading_it_gave_ends_the_run(b, name):
    hand = Spoiled(VirtualClock(100.0))
    read, since = hand.read, []

    def reusing():
        state = read()
        if hand.begun and hand.clock.now() > hand.begun + 0.3:
            since.append(hand.clock.now())
            if len(since) > 1:
                buffer = getattr(held[0], name)
                buffer += 1
            held[:] = [state]
        return state

    held = []
    hand.current = np.zeros(12)
    hand.read = reusing
    report = run(b, hand)
    assert f"changed the {name} of a reading" in report.ended and hand.relaxed_at[0] - since[0] < 0.15


def test_sys_exit_in_a_driver_has_its_reason(b):
    hand = Spoiled(VirtualClock(100.0))
    read, since = hand.read, []

    def leaving():
        if hand.begun and hand.clock.now() > hand.begun + 0.3:
            since.append(hand.clock.now())
            sys.exit(0)
        return read()

    hand.read = leaving
    loop = Loop(b, hand, FixedPlace(PLACE), Calibration.default(),
                LoopSettings(seconds=1.0, tor_max=300.0, home_speed=3.0), hand.clock)  # fmt: skip
    with pytest.raises(UserError, match="SystemExit: 0"):
        loop.run()
    assert "SystemExit" in loop.report.ended and hand.relaxed_at[0] - since[0] < 0.15


def test_a_send_that_the_watchdog_overtook_delivers_nothing(b):
    from dexsim.deploy.driver import Clock

    class Slow(FakeHand):
        def send(self, command):
            if self.begun and self.clock.now() > self.begun + 0.2 and not self.relaxed_at:
                time.sleep(0.6)
            super().send(command)

    hand = Slow(Clock(), start=0.45)
    settings = LoopSettings(seconds=3.0, tor_max=300.0, home_speed=5.0, home_error=2.0, settle=0.1, hang=0.2, late=5.0,
                            stale=5.0, overruns=1000)  # fmt: skip
    loop = Loop(b, hand, FixedPlace(PLACE), Calibration.default(), settings)
    report = loop.run()
    late = [(mode, tor) for t, _, tor, mode in hand.sent if t > hand.relaxed_at[0]]
    assert report.counts["watchdog"] == 1 and len(late) == 1
    assert late[0][0] == PASSIVE and not late[0][1].any(), "what was on its way lets go, too"


@pytest.mark.parametrize("name", ["SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGXCPU", "SIGTSTP", "SIGALRM", "SIGTTOU"])
def test_every_signal_that_would_end_or_halt_the_program_lets_go(b, name):
    number = getattr(signal, name)

    def hit(hand, now):
        if hand.begun and now > hand.begun + 0.3:
            hand.fault, hand.hit = None, now
            os.kill(os.getpid(), number)

    hand, before = Spoiled(VirtualClock(100.0)), signal.getsignal(number)
    hand.fault = hit
    with _Stop() as stop:
        report = run(b, hand)
    assert stop.status == 128 + number and "stopped by" in report.ended and hand.relaxed_at[0] - hand.hit < 0.02
    assert signal.getsignal(number) == before
