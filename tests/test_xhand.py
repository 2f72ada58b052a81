"""The xHand's driver against a strict fake of the vendor's package: one test for each thing that the package does and
that a driver must know. In virtual time, but for what only processes show."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest
import torch
from bundles import make_checkpoint
from worlds import task_cfg

from dexsim import export
from dexsim.calibration.file import Calibration
from dexsim.cli.deploy import main as command
from dexsim.deploy import bundle, simulated_hand
from dexsim.deploy.driver import PASSIVE, POSITION, Clock, HandCommand, VirtualClock
from dexsim.deploy.fake_xhand import ENCODER_JITTER, FakeXHand, Faults, LaggingHand
from dexsim.deploy.loop import Loop, LoopSettings
from dexsim.deploy.recorder import Recorder
from dexsim.deploy.vendor import VendorXHand, VendorXHands, XHandBus
from dexsim.deploy.vision import FixedPlace
from dexsim.errors import UserError
from dexsim.recording.reader import read

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def b(tmp_path_factory):
    folder = tmp_path_factory.mktemp("xhand")
    return bundle.load(export.export(str(make_checkpoint(folder / "policy.pt")), folder / "out", steps=2))


@pytest.fixture(scope="module", autouse=True)
def quick():
    """No collection of torch's whole heap before each loop."""
    from dexsim.deploy import loop

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop.gc, "collect", lambda: 0)
        yield


def driver(clock=None, hand=LaggingHand, port="auto", serial=None, side="right", hang=0.15, **faults):
    package = partial(FakeXHand, make=hand, faults=Faults(**{"outlier": 0.0} | faults))
    return VendorXHand(port, clock, package, serial, side, hang)


class Watched(Loop):
    """Remembers when the policy began and when the hand was let go; what it said."""

    began = relaxed = None

    def _begin_run(self, now):
        self.began = now
        super()._begin_run(now)

    def _let_go(self, lock=True):
        self.relaxed = self.relaxed or self.clock.now()
        super()._let_go(lock)


def run(b, hand=LaggingHand, port="auto", settings=None, **faults):
    """Make a run of the policy in virtual time: (report, loop, fake, what was said)."""
    said = []
    d = driver(VirtualClock(50.0), hand, port, **faults)
    loop = Watched(b, d, FixedPlace([0.055, 0.0, 0.04]), Calibration.default(),
                   LoopSettings(**{"seconds": 1.5, "tor_max": 300.0, "home_speed": 3.0} | (settings or {})),
                   d.clock, say=said.append)  # fmt: skip
    report = loop.run()
    return report, loop, d.body._sdk, said


def since(fake, loop, t):
    """Return the s from a fault's time until the hand was let go."""
    return loop.relaxed - (fake.zero + t)


# -- cycles and commands
# --------------------------------------------------------------------------------------------------------------------
def test_a_cycle_is_one_round_trip(b):
    report, loop, fake, _ = run(b)
    t = np.array([t for t, _ in fake.trips])
    cycles = np.diff(t[(t > loop.began - fake.zero) & (t < loop.relaxed - fake.zero)])
    assert report.ended == "done" and 0.0094 < np.median(cycles) < 0.0099 and cycles.max() < 0.012


def test_each_round_trip_brings_a_reading():
    d = driver(VirtualClock(1.0))
    d.open()
    seen, before = set(), len(d.body._sdk.trips)
    for k in range(500):
        d.send(HandCommand(np.full(12, 0.1 + 1e-4 * k), np.full(12, 300)))
        d.clock.sleep_until(d.clock.now() + 0.002)
        if (state := d.read()) is not None:
            seen.add(state.sequence)
    assert 100 <= len(seen) <= 106 and abs(len(d.body._sdk.trips) - before - len(seen)) <= 2


@pytest.mark.parametrize("start", [0.0, 0.9])
def test_homing_begins_where_the_hand_is_not_from_the_zeros_of_the_cache(b, start):
    _, _, fake, _ = run(b, partial(LaggingHand, start=start))
    mode, _, first, _ = next(c for _, c in fake.trips if c[0] == POSITION)
    assert np.abs(first[[0, 1, 2, 4, 5, 6]] - start).max() < 0.02 and mode == POSITION
    before = [c for _, c in fake.trips[: [c[0] for _, c in fake.trips].index(POSITION)]]
    assert len(before) >= 3 and not any(c[3].any() for c in before), "until then nothing drives"


@pytest.mark.parametrize("code", [1501029, 1501030, 1501028])
def test_a_refused_command_ends_the_run_and_is_not_called_relaxed(b, code):
    report, loop, fake, said = run(b, refuse_s=1.2, refuse=code)
    assert ("too warm" if code == 1501028 else "refuses") in report.ended and str(code) in report.ended
    assert since(fake, loop, 1.2) < 0.15 and report.not_relaxed and "DANGER" in " ".join(said)


@pytest.mark.parametrize("code", [1501018, 1501019, 1501020, 1501035])
def test_codes_that_are_not_refusals_are_none(b, code):
    assert run(b, refuse_s=0.5, refuse=code)[0].ended == "done"


# -- the cache
# --------------------------------------------------------------------------------------------------------------------
def test_a_bus_that_died_behind_its_cache_is_seen(b):
    report, loop, fake, _ = run(b, freeze_s=1.3)
    assert "bus is dead" in report.ended and since(fake, loop, 1.3) < 0.15 and "dead" in report.not_relaxed


def test_the_same_of_encoders_without_jitter_shows_when_targets_move(b):
    report, loop, fake, _ = run(b, freeze_s=0.25, jitter=0.0)
    assert "no bit of the readings has changed" in report.ended and since(fake, loop, 0.25) < 0.45
    assert report.not_relaxed, "and what it says of being limp is not believed"


def test_a_resting_hand_without_jitter_is_not_taken_for_a_dead_bus(b):
    assert run(b, jitter=0.0)[0].ended == "done"


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_torn_frames_are_not_taken(b, share):
    report, loop, _, _ = run(b, torn=share)
    assert report.ended == "done"
    seen = []
    d = driver(VirtualClock(1.0), partial(LaggingHand, start=0.15), torn=share)
    d.open()
    for _ in range(200):
        d.clock.sleep_until(d.clock.now() + 0.01)
        seen.append(d.read().position)
    assert np.abs(np.stack(seen) - 0.15).max() < 0.02


def test_two_signs_of_integers(b):
    class Drawing(LaggingHand):
        def state(self, now):
            state = super().state(now)
            state.current, state.velocity = np.full(12, -536.0), np.full(12, -0.25)
            return state

    for sdk in ("0.10.3", "1.5.2"):
        d = driver(VirtualClock(1.0), Drawing, sdk=sdk)
        d.open()
        d.clock.sleep_until(d.clock.now() + 0.03)
        state = d.read()
        assert (state.current == -536).all() and state.current.dtype == np.int16
        np.testing.assert_allclose(state.velocity, -0.25)


# -- touch and CRC
# --------------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("at", [0.0, 1.2])
def test_a_dead_taxel_board_is_said_and_the_hand_plays_on(b, at):
    report, _, _, said = run(b, board=2, board_s=at)
    assert report.ended == "done" and report.counts["silent_mid"] > 50 and "mid" in " ".join(said)
    assert not [k for k in report.counts if k.startswith("silent_") and k != "silent_mid"]


def test_the_boards_that_live_are_felt_beside_a_dead_one():
    class Touched(LaggingHand):
        def state(self, now):
            state = super().state(now)
            state.tactile[:, 7, 2] = 10 + int(1e3 * now) % 5
            return state

    d = driver(VirtualClock(1.0), Touched, board=2)
    d.open()
    for _ in range(30):
        d.clock.sleep_until(d.clock.now() + 0.01)
        state = d.read()
    assert (state.tactile[[0, 1, 3, 4], 7, 2] >= 10).all() and not state.tactile[2].any()
    assert state.silent.tolist() == [False, False, True, False, False]


def test_all_boards_silent_lets_go(b):
    report, loop, fake, _ = run(b, silent_s=1.2)
    assert "no taxel board" in report.ended and 0.09 < since(fake, loop, 1.2) < 0.15 and report.limp


@pytest.mark.parametrize("share", [0.005, 0.05])
def test_crc_errors_cost_a_pause_and_no_boot_mode(b, share):
    report, _, fake, _ = run(b, crc=share, settings={"seconds": 4.0}, seed=3)
    t = np.array([t for t, _ in fake.trips])
    assert report.ended == "done" and np.diff(t).max() < 0.09
    if share > 0.01:
        assert (np.diff(t) > 0.05).sum() > 5, "it had some, and waited after each"
    assert not report.counts["error_codes"], "a tip board's code in a broken frame is no fault of the joint"


def test_a_code_of_a_tips_board_is_no_fault_of_the_joint(monkeypatch):
    d = driver(VirtualClock(1.0))
    d.open()
    control = type(d.body._sdk.XHandControl())
    frame = control._frame

    def coded(self, *args):
        made = frame(self, *args)
        made.finger_state[2].tipboard_err = 307
        return made

    monkeypatch.setattr(control, "_frame", coded)
    for _ in range(5):
        d.send(HandCommand(np.full(12, 0.1), np.full(12, 300)))
        d.clock.sleep_until(d.clock.now() + 0.02)
        state = d.read()
    assert not state.error.any()


def test_a_retry_at_once_would_have_started_the_boot_mode():
    """The fake is as unkind as the firmware: the old way of going on at once meets it."""
    clock = VirtualClock(0.0)
    fake = FakeXHand(clock, faults=Faults(crc=1.0, outlier=0.0))
    device = fake.XHandControl()
    device.open_serial("fake", 3_000_000)
    codes = [device.send_command(0, fake.HandCommand_t()).error_code]
    fake.faults = Faults(outlier=0.0)
    codes += [device.send_command(0, fake.HandCommand_t()).error_code for _ in range(120)]
    assert codes[0] == 1501070 and codes[1] == 1501036 and 95 < codes.count(1501036) < 105


def test_the_measured_tail_with_its_outliers_is_lived_through(b):
    report, _, fake, _ = run(b, outlier=0.01, settings={"seconds": 3.0}, seed=1)
    t = np.array([t for t, _ in fake.trips])
    assert report.ended == "done" and np.diff(t).max() > 0.11


# -- opening
# --------------------------------------------------------------------------------------------------------------------
def opened(**kw):
    d = driver(VirtualClock(1.0), **kw)
    return d, d.open()


def test_versions_and_names_are_logged_and_the_auxiliary_port_is_passed_over():
    d, info = opened(serial="FAKE0001")
    assert info["port"] == "/dev/ttyACM1" and info["serial"] == "FAKE0001" and info["side"] == "right"
    assert info["sdk"] == "1.5.2" and info["firmware"] == "1.3.9"
    with pytest.raises(UserError, match="/dev/ttyACM0 opens and lists no hand.*port=auto"):
        opened(port="/dev/ttyACM0")
    with pytest.raises(UserError, match="has hand FAKE0001, not OTHER"):
        opened(serial="OTHER")


def test_a_run_says_and_records_which_hand_it_was(b, tmp_path):
    from mcap.reader import make_reader

    d, said, path = driver(VirtualClock(50.0)), [], tmp_path / "a.mcap"
    recorder = Recorder(path, b.hand.joints, {"source": "sim"}, None, 50.0)
    settings = LoopSettings(seconds=0.2, tor_max=300.0, home_speed=3.0)
    eye = FixedPlace([0.055, 0.0, 0.04])
    Loop(b, d, eye, Calibration.default(), settings, d.clock, recorder, say=said.append).run()
    assert "serial FAKE0001" in said[0] and "sdk 1.5.2" in said[0] and "firmware 1.3.9" in said[0]
    with path.open("rb") as file:
        about = {m.name: m.metadata for m in make_reader(file).iter_metadata()}
    assert about["hand"]["serial"] == "FAKE0001" and about["hand"]["sdk"] == "1.5.2"
    assert len(read(path, audit=False).states.position) > 20


def test_a_left_hand_under_a_right_policy_is_refused():
    with pytest.raises(UserError, match="left hand, the policy is for a right one"):
        driver(VirtualClock(1.0), **{"side": "right"}).__class__(
            "auto", VirtualClock(1.0), partial(FakeXHand, faults=Faults(side="L")), None, "right"
        ).open()


def test_opening_is_tried_three_times():
    before = time.perf_counter()
    d, _ = opened(opens=4)  # two ports a try
    assert 5.0 < d.clock.now() < 7.0 and time.perf_counter() - before < 2.0
    with pytest.raises(UserError, match="does not open"):
        opened(opens=6)


def test_ethercat_is_tried_three_times_and_goes_to_init_before_it_is_closed():
    d = driver(VirtualClock(1.0), port="ethercat", ethercat=1, opens=2)
    assert d.open()["port"] == "eth9" and 7.0 < d.clock.now() < 8.0, "two pauses of 3 s"
    d.close()
    fake = d.body._sdk
    assert [state for _, state in fake.firmware] == [1] and fake.firmware[0][0] + 0.1 < fake.closed[-1]
    with pytest.raises(UserError, match="cap_net_raw"):
        driver(VirtualClock(1.0), port="ethercat:eth9", ethercat=1, opens=3).open()


def test_training_draws_more_noise_than_the_encoders_have():
    for task in ("grasp", "rotate"):
        assert task_cfg(task=task)["task"]["sensors"]["joint_noise"] > ENCODER_JITTER


def test_a_hand_that_is_plugged_in_again_is_found_at_its_new_port():
    d, _ = opened(unplug_s=1.0)
    while not d.problem() and d.clock.now() < 5.0:
        d.send(HandCommand(np.full(12, 0.1), np.full(12, 300)))
        d.clock.sleep_until(d.clock.now() + 0.01)
        d.read()
    assert "refuses" in d.problem()
    clock = d.body.clock
    clock.sleep_until(d.body._sdk.zero + 3.1)
    bus = XHandBus(clock, "auto", "FAKE0001", "right", lambda clock: d.body._sdk)
    assert bus.open()["port"] == "/dev/ttyACM3"


def test_without_the_package_it_is_said():
    with pytest.raises(UserError, match="xhand_controller is not installed"):
        VendorXHand("/dev/ttyACM0").open()


# -- letting go
# --------------------------------------------------------------------------------------------------------------------
Pressing = partial(LaggingHand, start=0.4, push=-0.06)
"""Somebody holds its joints away from where they are driven: what does not let go draws current."""


@pytest.mark.parametrize(
    ("limp", "says"),
    [("passive", "limp by passive mode"), ("torque", "a torque limit of 0"), ("never", "still resists")],
)
def test_letting_go_is_shown_by_what_follows(limp, says):
    d = driver(VirtualClock(1.0), Pressing, limp=limp)
    d.open()
    for _ in range(20):
        d.send(HandCommand(np.full(12, 0.4), np.full(12, 300)))
        d.clock.sleep_until(d.clock.now() + 0.01)
        state = d.read()
    assert np.abs(state.current).max() > 200
    d.relax()
    at = d.clock.now()
    while (proof := d.released()) is None and d.clock.now() < at + 2:
        d.clock.sleep_until(d.clock.now() + 0.01)
        d.read()
    assert proof[0] == (limp != "never") and says in proof[1] and d.clock.now() - at < 0.4
    mode, kp, position, limit = d.body._sdk.trips[-1][1]
    assert kp == 0 and not limit.any() and np.abs(position - d.read().position).max() < 0.02
    first = next(c for t, c in d.body._sdk.trips if t + d.body._sdk.zero >= at - 1e-6)
    assert first[0] == PASSIVE and not first[3].any()


def test_a_hand_that_resists_is_danger_in_the_loop(b):
    report, _, fake, said = run(b, Pressing, limp="never", settings={"home_error": 1.0})
    assert "still resists" in report.not_relaxed and "cut its power" in " ".join(said)
    assert not fake.trips[-1][1][3].any(), "and its torque limit stays at its lowest"


# -- processes
# --------------------------------------------------------------------------------------------------------------------
def commands(log):
    rows = [line.split() for line in log.read_text().splitlines()] if log.exists() else []
    return [(float(t), int(mode), float(limit)) for t, mode, limit in rows]


def drive(d, seconds, until=lambda: False):
    end = time.monotonic() + seconds
    while time.monotonic() < end and not until():
        d.read()
        d.send(HandCommand(np.full(12, 0.3), np.full(12, 300)))
        time.sleep(0.01)


@pytest.mark.slow
def test_the_package_lives_in_a_process_of_its_own_and_a_silent_loop_is_let_go_of(tmp_path):
    log = tmp_path / "log"
    d = driver(Clock(), Pressing, hang=0.3, log=str(log))
    d.open()
    try:
        drive(d, 0.3)
        assert d._process.pid != os.getpid() and not d.problem()
        last = time.monotonic()
        time.sleep(0.8)  # the loop hangs
        first = next(t for t, mode, _ in commands(log) if t > last and mode == PASSIVE)
        assert 0.2 < first - last < 0.5 and "loop was silent" in d.problem()
        d.send(HandCommand(np.full(12, 0.3), np.full(12, 300)))  # what the loop still has in hand drives no more
        time.sleep(0.1)
        assert all(mode == PASSIVE or not limit for t, mode, limit in commands(log) if t > first)
        d.relax()
        drive(d, 0.2)
        assert not d.problem() and commands(log)[-1][1:] == (POSITION, 300), "after it has let go itself, it may again"
    finally:
        d.close()
    assert commands(log)[-1][2] == 0


@pytest.mark.slow
def test_an_abort_of_the_package_is_said_at_once(tmp_path):
    d = driver(Clock(), abort_s=1.0, hang=2.0)
    d.open()
    died = []
    drive(d, 10.0, lambda: not d._process.is_alive() and (died.append(time.monotonic()) or True))
    assert "SIGABRT" in d.problem() and "nobody holds the bus" in d.problem() and "cut its power" in d.problem()
    assert time.monotonic() - died[0] < 0.15
    with pytest.raises(UserError, match="nobody holds the bus"):
        d.relax()
    d.close()  # the hand is there again: a new process lets go of it


DRIVE = """
import sys, time
from functools import partial
import numpy as np
from dexsim.deploy.driver import Clock, HandCommand
from dexsim.deploy.fake_xhand import FakeXHand, Faults, LaggingHand
from dexsim.deploy.vendor import VendorXHand
if __name__ == "__main__":
    hand = partial(LaggingHand, start=0.4, push=-0.06)
    d = VendorXHand("auto", Clock(), partial(FakeXHand, make=hand, faults=Faults(log=sys.argv[1])), hang=0.3)
    d.open()
    while True:
        d.read()
        d.send(HandCommand(np.full(12, 0.3), np.full(12, 300)))
        time.sleep(0.01)
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", ["SIGKILL", "SIGSTOP"])
def test_a_loop_that_is_killed_or_stopped_leaves_a_hand_that_is_let_go(tmp_path, how):
    log, script = tmp_path / "log", tmp_path / "drive.py"
    script.write_text(DRIVE)
    p = subprocess.Popen([sys.executable, str(script), str(log)])
    try:
        limit = time.monotonic() + 60
        while len(commands(log)) < 60 and time.monotonic() < limit:
            time.sleep(0.05)
        at = time.monotonic()
        p.send_signal(getattr(signal, how))
        time.sleep(1.0)
        first = next(t for t, mode, _ in commands(log) if t > at and mode == PASSIVE)
        assert first - at < 0.6 and commands(log)[-1][2] == 0
        if how == "SIGKILL":
            size = log.stat().st_size
            time.sleep(0.5)
            assert log.stat().st_size == size, "and its process has ended"
    finally:
        p.kill()
        p.wait()


# -- two hands on a bus
# --------------------------------------------------------------------------------------------------------------------
def two(clock=None, sides=("right", "left"), serials=(None, None), hang=0.15, **faults):
    package = partial(FakeXHand, faults=Faults(**{"outlier": 0.0, "second": "FAKE0002"} | faults))
    return VendorXHands(serials, sides, "auto", clock or VirtualClock(1.0), package, hang)


def turn(d, seconds, goals):
    """Return the newest states, after both hands were told their goals [rad] (None: nothing) for a while."""
    seen = []
    end = d.clock.now() + seconds
    while d.clock.now() < end:
        for hand, goal in zip(d.hands, goals, strict=True):
            if goal is not None:
                hand.send(HandCommand(np.full(12, goal), np.full(12, 300)))
        d.clock.sleep_until(d.clock.now() + 0.005)
        seen.append([hand.read() for hand in d.hands])
    return seen


def test_two_hands_on_a_bus_are_driven_in_turn_at_half_the_rate():
    d = two()
    info = d.hands[0].open()
    assert d.hands[1].open() is info and info["serial"] == "FAKE0001, FAKE0002" and info["side"] == "right, left"
    seen = turn(d, 2.0, (0.1, 0.15))
    fake = d.body.hands[0]._sdk
    rates = [len([t for t, _ in trips if t > 1.0]) / (fake.time - 1.0) for trips in fake.by_hand]
    assert rates == pytest.approx([52.3, 52.3], abs=1.5), "9.6 ms a round trip, 19.1 ms for both"
    assert len({s[0].sequence for s in seen if s[0] is not None}) / 2.0 == pytest.approx(52, abs=2)
    for state, goal in zip(seen[-1], (0.1, 0.15), strict=True):
        assert np.abs(state.position - goal).max() < 0.02 and state.tactile.shape == (5, 120, 3)


def test_one_of_two_hands_is_let_go_and_the_other_driven_on():
    d = two()
    d.hands[0].open()
    turn(d, 0.5, (0.1, 0.15))
    d.hands[0].relax()
    turn(d, 0.5, (None, 0.12))
    fake = d.body.hands[0]._sdk
    assert d.hands[0].released()[0] and "right hand" in d.hands[0].released()[1]
    assert fake.by_hand[0][-1][1][0] == PASSIVE and not fake.by_hand[0][-1][1][3].any()
    assert fake.by_hand[1][-1][1][0] == POSITION and fake.by_hand[1][-1][1][3].all()
    d.hands[1].relax()
    turn(d, 0.5, (None, None))
    assert all(trips[-1][1][0] == PASSIVE for trips in fake.by_hand)


def test_two_hands_are_told_by_serial_number_and_side():
    d = two(sides=(None, None), serials=("FAKE0002", "FAKE0001"))
    assert d.open()["side"] == "left, right"
    d = two(sides=("left", "right"))
    assert d.open()["serial"] == "FAKE0002, FAKE0001"
    with pytest.raises(UserError, match="no second hand.*has hand FAKE0001, not OTHER"):
        two(sides=(None, None), serials=("FAKE0002", "OTHER")).open()
    only = VendorXHand("auto", VirtualClock(1.0), partial(FakeXHand, faults=Faults(second="FAKE0002")), side="left")
    assert only.open()["serial"] == "FAKE0002"


def test_a_crc_error_of_one_hand_rests_the_bus_of_both():
    d = two(crc=0.05, seed=3)
    d.open()
    turn(d, 4.0, (0.1, 0.1))
    at = np.sort([t for trips in d.body.hands[0]._sdk.by_hand for t, _ in trips])
    assert 0.05 < np.diff(at).max() < 0.12 and (np.diff(at) > 0.05).sum() > 5 and not d.problem()


def test_two_hands_are_let_go_by_their_process_where_the_loop_is_silent(tmp_path):
    log = tmp_path / "log"
    d = two(Clock(), hang=0.3, log=str(log))
    d.hands[0].open()
    try:
        turn(d, 0.5, (0.3, 0.3))
        last = time.monotonic()
        time.sleep(0.8)
        first = next(t for t, mode, _ in commands(log) if t > last and mode == PASSIVE)
        assert first - last < 0.6 and all(limit == 0 for t, _, limit in commands(log) if t > first + 0.03)
    finally:
        d.close()


@pytest.fixture(scope="module")
def other(b, tmp_path_factory):
    """The same bundle, for a left hand."""
    folder = tmp_path_factory.mktemp("xhand") / "left"
    shutil.copytree(b.path, folder)
    manifest = folder / "manifest.yaml"
    manifest.write_text(manifest.read_text().replace("mirror: false", "mirror: true"))
    return folder


@pytest.mark.slow
def test_the_command_runs_two_policies_on_two_hands_of_a_bus(b, other, tmp_path, monkeypatch, capsys):
    """In real time, each in a thread."""
    fake = lambda config, calibration, text, **_: partial(FakeXHand, faults=Faults.parse(text))  # noqa: E731
    monkeypatch.setattr(simulated_hand, "fake_package", fake)
    patient = ["late=2", "stale=1", "overruns=1000", "hang=3", "home_speed=3", "tor_max=300", "seconds=1"]
    settings = [f"bundle={b.path}", f"second={other}", "driver=xhand", "port=fake", f"record={tmp_path / 'a.mcap'}"]
    with pytest.raises(UserError, match="nothing sees the object"):
        command([*settings, "place=0.055 0 0.04"])
    places = ["place=0.055 0 0.04", "second_place=0.055 0 0.04"]
    assert command([*settings, *places, *patient]) == 0
    said = capsys.readouterr().out
    for side in ("right", "left"):
        assert f"the {side} hand is relaxed (" in said
    assert said.count("ended    done") == 2 and "FAKE0001, FAKE0002" in said
    for name in ("a.mcap", "a_second.mcap"):
        assert len(read(tmp_path / name, audit=False).states.position) > 30
    with pytest.raises(UserError, match="second=DIR names none"):
        command([settings[0], "second_serial=A"])


# -- a package that somebody else has written
# --------------------------------------------------------------------------------------------------------------------
OTHERS = os.path.join(os.path.dirname(__file__), "another_package")


def with_another(b, monkeypatch, posture=0.3, seconds=1.5, **faults):
    """Make a run in virtual time on the second fake: (report, module, s by the clock at which the port was opened)."""
    monkeypatch.syspath_prepend(OTHERS)
    from xhand_controller import xhand_control as package

    clock = VirtualClock(50.0)
    monkeypatch.setattr(package, "now", clock.now)
    monkeypatch.setattr(package, "sleep", lambda s: clock.sleep_until(clock.now() + s))
    monkeypatch.setattr(package, "faults", faults)
    monkeypatch.setattr(package, "posture", posture)
    package.log.clear()
    settings = LoopSettings(seconds=seconds, tor_max=300.0, home_speed=3.0)
    driver = VendorXHand("auto", clock, lambda _: package, side="right")
    loop = Watched(b, driver, FixedPlace([0.055, 0.0, 0.04]), Calibration.default(), settings, clock)
    return loop.run(), package, loop


def test_another_package_is_driven_at_its_own_rate_from_where_the_hand_stands(b, monkeypatch):
    report, package, loop = with_another(b, monkeypatch, posture=0.9)
    t, mode, target, _ = np.array(package.log).T
    run = (t > loop.began) & (t < loop.relaxed)
    assert report.ended == "done" and not report.not_relaxed and np.diff(t[run]).mean() < 0.0102
    assert abs(target[mode == POSITION][0] - 0.9) < 0.02 and package.log[-1][1] == PASSIVE


@pytest.mark.parametrize(("fault", "ended", "within"), [
    ({"crc": 1.2}, "done", None), ({"dead_board": 0.0}, "done", None), ({"dead_board": 1.2}, "done", None),
    ({"mute": 1.2}, "no taxel board", 0.15), ({"refused": 1.2}, "refuses", 0.15),
    ({"stuck": 0.3}, "no bit of the readings has changed", 0.45),
])  # fmt: skip
def test_faults_of_another_package(b, monkeypatch, fault, ended, within):
    report, package, loop = with_another(b, monkeypatch, **fault)
    assert ended in report.ended
    if within is not None:
        assert loop.relaxed - (50.0 + next(iter(fault.values()))) < within
    if "crc" in fault:
        t = np.array([t for t, *_ in package.log])
        assert 0.05 < np.diff(t).max() < 0.1, "one pause, and no boot mode"
    if "dead_board" in fault:
        assert report.counts["silent_index"] > 50 and not report.counts["silent_mid"]
    assert bool(report.not_relaxed) == (ended not in ("done", "no taxel board"))


@pytest.mark.slow
@pytest.mark.parametrize("faults", ["crc=5", "cable=6"])
def test_another_package_behind_the_command(b, tmp_path, faults):
    """In real time, in the driver's own process."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([OTHERS, *sys.path]), "XHAND_FAULTS": faults}
    done = subprocess.run(
        [sys.executable, "-m", "dexsim", "deploy", f"bundle={b.path}", "driver=xhand", "place=0.055 0 0.04",
         "record=none", "seconds=5", "home_speed=3", "late=1", "stale=1", "hang=2", "overruns=1000"],
        env=env, capture_output=True, text=True, cwd=tmp_path)  # fmt: skip
    assert "serial 012R3202601010001" in done.stdout and "sdk 1.4.3" in done.stdout, done.stderr
    said = "[xhand] port opened" in done.stdout + done.stderr
    assert said == (faults == "cable=6"), "what the package prints is not the loop's output, but for its last words"
    if faults[0] == "c" and "cable" not in faults:
        assert done.returncode == 0 and "ended    done" in done.stdout
    else:
        assert "SIGABRT" in done.stdout and "cut its power" in done.stdout + done.stderr and done.returncode
