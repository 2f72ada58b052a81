"""The real-time loop: reads at 100 Hz, acts at the policy's rate, and lets go of the hand when something is wrong.

Phases: HOMING (slow, at reduced current, from wherever the hand is) -> SETTLE (taxels are zeroed) -> PLACE (only where
the task starts with an object in the hand: the hand waits, then its fingers close slowly on what is held out) -> RUN
(the policy) -> RELAXED. Nothing moves before the homing, and every way out of `run` relaxes the hand.
"""

from __future__ import annotations

import gc
import sys
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dexsim.calibration.file import Calibration
from dexsim.deploy import readings
from dexsim.deploy.action import ActionRule
from dexsim.deploy.bundle import Bundle
from dexsim.deploy.driver import PASSIVE, POSITION, Clock, HandCommand, HandDriver, HandState
from dexsim.deploy.imu import OrientationSource
from dexsim.deploy.measure import ORIENTATION, POSE, for_bundle
from dexsim.deploy.measure import PLACE as WHERE
from dexsim.deploy.readings import Frozen, Lasting
from dexsim.deploy.recorder import ACTION, ERRORS, FORCE_COMMAND, GOAL, HAND, HEIGHT, OBSERVATION, TURNED, Recorder
from dexsim.deploy.safety import Guard
from dexsim.deploy.timing import Timing
from dexsim.deploy.vision import HeightSource
from dexsim.errors import UserError
from dexsim.tactile.layout import touch_shape

HOMING, SETTLE, PLACE, RUN, RELAXED = "homing", "settle", "place", "run", "relaxed"
SEEN: dict[str, float] = {ORIENTATION: 0.1, WHERE: 0.5, POSE: 0.5}
"""s that the object's last reading may be old where `LoopSettings.seen` does not say: an IMU's come a hundred a second;
a camera's thirty, and fingers hide an object for a moment."""
SPEED_OVER = 0.15
"""s over which the object's speed is taken that carries its pose on (`LoopSettings.ahead`)."""
RELAX_TRIES, RELAX_EVERY = 200, 0.005
"""How often, and s apart, the hand is told to relax where its driver fails to."""
CONFIRM = 1.0
"""s that a driver may take to say whether the hand is limp."""
LIMITS: dict[str, tuple[float, float, str]] = {
    "seconds": (0, 1e7, "s"), "home_speed": (0.01, 10, "rad/s"), "home_current": (0.01, 1, ""),
    "home_error": (0.001, 3.2, "rad"), "settle": (0, 60, "s"), "wait": (0, 3600, "s"), "grip": (0, 60, "s"),
    "read_hz": (20, 1000, "Hz"),
    "stale": (0.005, 10, "s"), "seen": (0.005, 10, "s"), "ahead": (0, 0.5, "s"),
    "noise": (0, 2, ""), "late": (0.005, 10, "s"), "overruns": (1, 1e6, ""),
    "hang": (0.02, 10, "s"),
    "speed": (0.001, 100, ""), "margin": (0, 3.2, "rad"), "tor_max": (1, 32767, "mA"), "kp": (0, 32767, ""),
    "recover_s": (0, 3600, "s"),
}  # fmt: skip
"""Lowest and highest of each of `LoopSettings`, and its unit."""


@dataclass(frozen=True)
class LoopSettings:
    """seconds of policy; command: what the policy is told (`measure.commanded`); home: whether to home first (False
    only for replays).

    home_speed rad/s, of the joint that has farthest to go; home_current: share of the current limit while homing;
    home_error rad: allowed at its end; settle s. wait s: how long the hand then waits for the object, where the task
    starts with one in the hand; grip s: how long its fingers take to close on it. read_hz; stale s: relaxes when the
    last good reading is older than this (one that cannot be true is none), or when for 0.1 s every second reading has
    an error code, the hand refuses what is sent or the policy's actions are not finite; seen s: so does what was last
    seen of the object (default: `SEEN`); late s: so does a turn that is later than this; overruns: so do as many turns
    in a row that end more than a reading period after they were due; hang s: so does a loop that does not turn at all
    (seen by a thread of its own, and by the process that holds the bus). ahead s: by which the object's pose is carried
    on at its last speed, for a camera that is slower than the one in training; noise: over the noise that the policy
    was trained with, added to its actions (0: none; some policies freeze without it on a real hand). speed: targets'
    largest, over the joints' no-load speeds; margin rad kept free at the joint limits. tor_max mA: the firmware's
    current limit, [J] or one; kp: its gain.
    recover: after letting go, home again once readings have been good for recover_s; else the run ends.
    """

    seconds: float = 10.0
    command: float | tuple[float, ...] | None = None
    home: bool = True
    home_speed: float = 0.5
    home_current: float = 0.5
    home_error: float = 0.2
    settle: float = 0.5
    wait: float = 3.0
    grip: float = 1.0
    read_hz: float = 100.0
    stale: float = 0.12
    seen: float | None = None
    ahead: float = 0.0
    noise: float = 0.0
    late: float = 0.1
    overruns: int = 10
    hang: float = 0.15
    speed: float = 0.6
    margin: float = 0.0
    tor_max: float | tuple[float, ...] | None = None
    kp: int = 100
    recover: bool = False
    recover_s: float = 1.0

    def check(self) -> None:
        """Raise UserError for a setting outside `LIMITS`."""
        for name, (low, high, unit) in LIMITS.items():
            value = getattr(self, name)
            if value is None:
                continue
            numbers = np.atleast_1d(np.asarray(value, float))
            if not ((numbers >= low) & (numbers <= high)).all() or (name != "tor_max" and numbers.size != 1):
                raise UserError(f"{name}={value}: must lie in [{low:g}, {high:g}]{' ' * bool(unit)}{unit}")


@dataclass
class Report:
    """What a run was: how it ended (`done`, or why the hand was relaxed), counts, timing; observations, actions and
    targets of every act if kept. not_relaxed: what the driver said when the hand could not be relaxed, else empty.
    limp: by what it is known that the hand is limp; empty where the driver cannot tell."""

    ended: str = ""
    not_relaxed: str = ""
    limp: str = ""
    acts: int = 0
    counts: Counter = field(default_factory=Counter)
    timing: Timing = field(default_factory=Timing)
    observations: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    targets: list[np.ndarray] = field(default_factory=list)
    forces: list[np.ndarray] = field(default_factory=list)


class Loop:
    """One bundle on one hand. See `LoopSettings` and `run`."""

    # There from the first reading on: the newest that could be true, and what the phase needs, times in s
    state: HandState
    _began: float
    _home_s: float
    _from: np.ndarray
    _rest: list[np.ndarray]
    _seen: np.ndarray | None
    _seen_at: float | None
    _unseen: str | None
    _poses: list[tuple[float, np.ndarray]]
    _action: np.ndarray

    def __init__(
        self, bundle: Bundle, driver: HandDriver, eye: HeightSource | OrientationSource | None,
        calibration: Calibration, settings: LoopSettings = LoopSettings(), clock: Clock | None = None,
        recorder: Recorder | None = None, keep: bool = False, say: Callable[[str], None] | None = None,
    ):  # fmt: skip
        """Check the bundle against the driver. eye: what sees the object, as `measure.needs` of the bundle's task has
        it (None: nothing has to). say: told what a person beside the hand has to do."""
        m, self.settings = bundle.manifest, settings
        settings.check()
        self.bundle, self.driver, self.eye, self.clock = bundle, driver, eye, clock or Clock()
        self.recorder, self.keep, self.report, self.say = recorder, keep, Report(), say or (lambda text: None)
        self.period, self.read_period = float(m["rates"]["policy_period_s"]), 1.0 / settings.read_hz
        self.rule = ActionRule.from_manifest(m["action"])
        self.home = np.array(m["initial_pose"], float)
        self.grip = np.array(m["grip"]["target"], float) if m.get("grip") else None
        self.calibration = calibration
        self.measure = for_bundle(bundle, calibration)
        self._command = self.measure.commanded(settings.command)
        wanted = self.measure.needs
        if wanted is not None and not hasattr(eye, wanted):
            raise UserError(
                f"bundle {bundle.path}: its policy needs the object's {wanted}, and nothing here sees it"
                " (dexsim/deploy/vision.py, imu.py)"
            )
        tor_max = 1e3 * calibration.current_max if settings.tor_max is None else settings.tor_max
        J = len(bundle.hand.joints)
        if np.size(tor_max) not in (1, J):
            raise UserError(f"tor_max={tor_max}: must be one number, or one for each of {J} joints")
        if calibration.hand.joints != bundle.hand.joints:
            raise UserError(f"calibration is of {calibration.hand.name}, bundle {bundle.path} of {bundle.hand.name}")
        self.tor_max = np.clip(np.broadcast_to(np.asarray(tor_max, float), (J,)), 1, 32767)
        self._taxels = touch_shape(bundle.hand)
        self.guard = Guard(
            self.rule.low + settings.margin, self.rule.high - settings.margin,
            settings.speed * np.array(m["action"]["speed_limit_rad_s"]), self.tor_max, calibration.current_sign,
            tuple(m["joints"]),
        )  # fmt: skip
        spread = m["action"].get("std")
        if settings.noise and spread is None:
            raise UserError(f"noise={settings.noise:g}: bundle {bundle.path} does not say how much; export it again")
        self._noise = settings.noise * np.array(spread, float) if settings.noise else None
        self._rng = np.random.default_rng(0)
        self.home = np.clip(self.home, self.guard.low, self.guard.high)
        self.target: np.ndarray | None = None
        self.phase = HOMING if settings.home else RUN
        self.why = ""
        self.stop = threading.Event()  # set it to end the run
        self._beat: float | None = None
        self._lock = threading.Lock()
        self._tripped: str | None = None
        self._sequence: int | None = None  # of the last reading that the driver gave, taken or not
        self._has_touch = False  # the first reading had taxels
        self._wrong: str | None = None  # why readings since the last good one were not taken
        self._given: HandState | None = None  # the driver's own object of the last reading
        self._sent: HandCommand | None = None
        self._broken: str | None = None  # what a driver may not do
        self._coded, self._refused, self._nonsense = Lasting(), Lasting(), Lasting()
        self._frozen = Frozen()
        self._seen_limit = settings.seen if settings.seen is not None else SEEN.get(self.measure.needs or "", 0.5)

    # -- the run
    def run(self) -> Report:
        """Go home, run the policy for `seconds`, relax. Ctrl-C, an error and every watchdog relax the hand
        first."""
        c = self.clock
        interval = sys.getswitchinterval()
        try:
            info = self.driver.open()
        except BaseException:
            self._close_recording()
            raise
        gc.collect()
        gc.freeze()
        gc.disable()  # a collection takes milliseconds; the loop makes no cycles
        sys.setswitchinterval(5e-4)  # the recorder gives way sooner
        watch = None
        try:
            if type(c) is Clock:
                watch = threading.Thread(target=self._watch, name="watchdog", daemon=True)
                self._beat = c.now()
                watch.start()
            if isinstance(info, dict) and info:
                self.say("hand     " + ", ".join(f"{k} {x}" for k, x in info.items() if x))
                if self.recorder is not None:
                    self.recorder.put(HAND, c.now(), {k: str(x) for k, x in info.items()})
            self._first_reading()
            self._turns()
            self.report.ended = self.report.ended or "done"
        except KeyboardInterrupt as error:
            self.report.ended = str(error) or "stopped by Ctrl-C"
            self.report.counts["interrupted"] += 1
        except SystemExit as error:
            self.report.ended = f"failed: SystemExit: {error.code}, raised inside the run"
            raise UserError(self.report.ended) from None
        except Exception as error:
            self.report.ended = f"failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
            raise
        finally:
            try:
                _to_its_end(lambda: self._relax(self.report.ended or "the loop failed"))
                _to_its_end(self._confirm)
            finally:
                _to_its_end(lambda: self._shut(interval, watch))
        if getattr(self.measure, "goals", 0):
            self.report.counts["goals_reached"] += self.measure.goals
        return self.report

    def _shut(self, interval: float, watch: threading.Thread | None) -> None:
        """Undo what the run had changed, and complete its recording."""
        self.stop.set()
        gc.enable()
        gc.unfreeze()
        sys.setswitchinterval(interval)
        if watch is not None:
            watch.join(1.0)
        self._close_recording()
        self.report.counts.update(self.guard.counts)
        self.guard.counts.clear()

    def _close_recording(self) -> None:
        if self.recorder is not None:
            self.recorder.close()  # says in its `error` what went wrong, and raises nothing
            if self.recorder.dropped:
                self.report.counts["not_recorded"] = self.recorder.dropped

    def _first_reading(self) -> None:
        limit, hand = self.clock.now() + 2.0, self.bundle.hand
        while True:
            state, now = self.driver.read(), self.clock.now()
            wrong = "there is none" if state is None else readings.implausible(state, now, hand, self._taxels)
            if state is not None and wrong is None and now - state.time > self.settings.stale:
                wrong = f"it is {1e3 * (now - state.time):.0f} ms old"
            if state is not None and wrong is None:
                break
            if now > limit:
                raise UserError(
                    f"{self.driver.name}: no good reading of the hand within 2 s ({wrong}); check power, cable and bus"
                )
            self._beat = now
            self.clock.sleep_until(now + self.read_period)
        if (why := readings.bad_sequence(state.sequence, None)) is not None:
            raise UserError(f"{self.driver.name}: {why}")
        self.state, self._sequence, self._good_at, self._checked = readings.copied(state), state.sequence, now, now
        self._has_touch = np.size(state.tactile) > 0
        self.target = np.asarray(state.position, float).copy()
        if self.settings.home:
            self._begin_homing(self.clock.now())
        else:
            self.target = np.asarray(state.position, np.float32).copy()
            self._begin_run(self.clock.now())

    def _turns(self) -> None:
        """Take turns of the loop, each when a reading or an action is due."""
        c, s, timing = self.clock, self.settings, self.report.timing
        read_at = act_at = c.now()
        good_since, in_a_row = None, 0
        while not self.stop.is_set():
            due = min(read_at, act_at)
            c.sleep_until(due)
            now = c.now()
            self._beat = now
            timing.start(now - due)
            act = act_at <= now + 1e-9
            if read_at <= now + 1e-9:
                self._read(now)
                read_at += self.read_period
            problem = self._tripped or self._problem(now, now - due)
            if problem and self.phase != RELAXED:
                self._relax(problem)
                self.report.ended = problem
                if not s.recover:
                    timing.end()
                    return
            if act:
                act_at += self.period
                if self.phase == RUN and now - self._began > s.seconds - 1e-9:
                    timing.end()
                    return
                self._act(now)
            timing.end()
            after = c.now()
            if after - due > self.read_period and type(c) is Clock:
                timing.overruns += 1
                in_a_row += 1
                if in_a_row >= s.overruns and self.phase != RELAXED:
                    self._tripped = f"{in_a_row} turns in a row ended more than a reading period late"
                # what was missed is left out, not made up for in a burst
                read_at += max(0.0, np.ceil((after - read_at) / self.read_period)) * self.read_period
                act_at += max(0.0, np.floor((after - act_at) / self.period)) * self.period
            else:
                in_a_row = 0
            if self.phase == RELAXED:
                good_since = None if problem else (good_since if good_since is not None else now)
                self._tripped = None
                if good_since is not None and now - good_since > s.recover_s:
                    good_since = None
                    self.report.counts["recovered"] += 1
                    self.report.ended = ""
                    self._begin_homing(now)

    def _problem(self, now: float, late: float) -> str | None:
        """Return what forbids going on: an old reading, or none that can be true; error codes, actions that are no
        numbers; a late turn; too much current or heat."""
        s = self.settings
        why = self._broken or getattr(self.driver, "problem", str)()
        if why:
            return why
        age = now - min(self.state.time, self._good_at)  # a stamp may be wrong; when it came is known
        if age > s.stale:
            why = f": the readings since cannot be true, {self._wrong}" if self._wrong else ""
            return f"the hand's state is {1e3 * age:.0f} ms old, allowed {1e3 * s.stale:.0f}{why}"
        for lasting, what in (
            (self._coded, "{} for {:.0f} ms"), (self._refused, "{} for {:.0f} ms"),
            (self._nonsense, "the policy's actions are not finite for {1:.0f} ms"),
        ):  # fmt: skip
            if lasting.since is not None and now - lasting.since > min(s.stale, 0.1):
                return what.format(lasting.what, 1e3 * (now - lasting.since))
        if (frozen := self._frozen.problem(now, self.target, self.state, self.tor_max)) is not None:
            j, long = frozen
            return (
                f"no bit of the readings has changed for {1e3 * long:.0f} ms, while the target of"
                f" {self.bundle.hand.joints[j]} moved and it drew no current: the bus is dead, or the driver repeats"
                " itself"
            )
        if self.phase == RUN and self.measure.needs is not None:
            seen_at = self._began if self._seen_at is None else self._seen_at
            limit = s.stale if self._seen_at is None else self._seen_limit + self.period  # looked for once a period
            if now - seen_at > limit:
                why = f" ({self._unseen})" if self._unseen else ""
                never = (
                    "was never seen"
                    if self._seen_at is None
                    else f"was seen {1e3 * (now - seen_at):.0f} ms ago, allowed {1e3 * limit:.0f}"
                )
                return f"the object {never}{why}"
        if late > s.late:
            return f"the loop woke {1e3 * late:.0f} ms late, allowed {1e3 * s.late:.0f}"
        elapsed, self._checked = min(now - self._checked, s.stale), now
        return self.guard.must_relax(self.state.current, self.state.temperature, elapsed)

    # -- parts of a turn
    def _read(self, now: float) -> None:
        if not self._take(now):
            # a driver at about our rate gives the same one twice now and then; `stale` is what matters
            self.report.counts["no_new_reading"] += 1

    def _take(self, now: float) -> bool:
        """Return the newest state becomes ours if it can be true; whether it is a new one. Recorded once."""
        given = self.driver.read()
        if self._given is not None and (name := readings.overwritten(self._given, self.state)) is not None:
            self._broken = f"{self.driver.name}: changed the {name} of a reading that it had given; it must give copies"
        if given is None:
            return False
        if (wrong := readings.bad_sequence(given.sequence, self._sequence)) is not None:
            self._broken = f"{self.driver.name}: {wrong}"
            return False
        if given.sequence == self._sequence:
            return False
        state, self._given, self._sequence = readings.copied(given), None, given.sequence
        self._wrong = readings.implausible(state, now, self.bundle.hand, self._taxels, self._has_touch)
        if self._wrong is not None:
            self.report.counts["bad_readings"] += 1
            return False
        self._given = given
        self.state, self.fresh_for, self._good_at = state, self.fresh_for + 1, now
        if self.recorder is not None:
            r = self.recorder
            r.put("state", now, state.position, state.velocity, 1e-3 * np.asarray(state.current, float), state.time,
                  state.follower)  # fmt: skip
            if np.size(state.tactile):
                r.put("tactile", now, state.tactile)
            if self.fresh_for % 100 == 1:
                r.put("temperature", now, state.temperature)
            if np.any(state.error):
                r.put(ERRORS, now, state.error)
        coded = np.asarray(state.error) != 0
        j = int(np.argmax(coded))
        self.report.counts.update({"error_codes": int(coded.any())} if coded.any() else {})
        self._coded.note(bool(coded.any()), now, f"{self.bundle.hand.joints[j]} reports error code {state.error[j]}")
        for i in np.flatnonzero(state.silent) if state.silent is not None else ():
            name = self.bundle.hand.pads[i].name
            if not self.report.counts[f"silent_{name}"]:
                self.say(f"the taxels of {name} give nothing: they count as untouched, and the run goes on")
            self.report.counts[f"silent_{name}"] += 1
        self._frozen.note(now, state, self.target)
        return True

    fresh_for = 0
    _warned = False

    def _act(self, now: float) -> None:
        if self.phase == HOMING:
            share = min(1.0, (now - self._began) / self._home_s)
            self._send(now, self._from + _smooth(share) * (self.home - self._from), self.settings.home_current)
            if share >= 1.0:
                self.phase, self._began, self._rest = SETTLE, now, []
        elif self.phase == SETTLE:
            self._rest.append(np.asarray(self.state.tactile, float)[..., 2])
            if now - self._began < self.settings.settle:
                self._send(now, self.home, 1.0)
                return
            self._end_homing()
            if self.grip is None:
                self._begin_run(now)
                self._policy(now)
            else:
                self.phase, self._began, self._held_out = PLACE, now, False
                self.say(f"hold the object out to the hand: the fingers close on it in {self.settings.wait:g} s")
                self._send(now, self.home, 1.0)
        elif self.phase == PLACE:
            self._place(now)
        elif self.phase == RUN:
            self._policy(now)

    def _place(self, now: float) -> None:
        """Wait at home for the object, close the fingers slowly, begin."""
        since = now - self._began - self.settings.wait
        if since < 0:
            return self._send(now, self.home, 1.0)
        if not self._held_out:
            self._held_out = True
            present = getattr(self.driver, "present", None)
            if present is not None:
                present()
        share = min(1.0, since / max(self.settings.grip, 1e-6))
        self._send(now, self.home + _smooth(share) * (self.grip - self.home), 1.0)
        if share >= 1.0:
            self._begin_run(now)

    def _look(self, now: float) -> bool:
        """Return the newest of what is seen of the object, if it can be true; False where nothing was seen yet."""
        if self.measure.needs is None:
            self._seen, self._seen_at = None, now
            return True
        # `__init__` has looked that the eye sees what the measure needs
        seen = getattr(self.eye, self.measure.needs)(now)
        self._unseen = "there is no reading"
        if seen is not None:
            self._unseen = readings.bad_stamp(seen[1], now) or readings.bad_seen(self.measure.needs, seen[0])
        if seen is None or self._unseen is not None:
            self.report.counts["object_not_seen"] += 1
            return self._seen_at is not None
        self._seen, self._seen_at = self._carried(np.asarray(seen[0], float), float(seen[1])), min(float(seen[1]), now)
        return True

    def _carried(self, pose: np.ndarray, stamp: float) -> np.ndarray:
        """Return what is seen at its stamp [s], `ahead` later at its mean speed over `SPEED_OVER`: between two readings
        in a row the noise would be carried on with it."""
        if not self._poses or stamp != self._poses[-1][0]:
            self._poses = [(t, x) for t, x in self._poses if stamp - SPEED_OVER < t < stamp] + [(stamp, pose)]
        (t0, before), (t1, last) = self._poses[0], self._poses[-1]
        if not self.settings.ahead or t1 - t0 < 0.2 * SPEED_OVER:
            return pose
        before = -before if len(pose) == 4 and before @ last < 0 else before  # the nearer of a rotation's two signs
        pose = last + (last - before) * (self.settings.ahead / (t1 - t0))
        return pose / np.linalg.norm(pose) if len(pose) == 4 else pose

    def _policy(self, now: float) -> None:
        self._take(now)  # actions come between readings: act on what there is now
        assert self.target is not None  # since the first reading
        if not self._look(now) or self._seen_at is None:
            return self._send(now, self.target, 1.0)
        if now - self._seen_at > self._seen_limit:
            return None  # the next turn lets go
        state = self.state
        observation, touch = self.measure.observe(state, self._seen, self._command, self.target, self._action)
        action = self.bundle.act(observation)[0]
        if self._noise is not None:
            action = (action + self._noise * self._rng.standard_normal(len(action))).astype(np.float32)
        nonsense = not np.isfinite(action).all()
        self._nonsense.note(nonsense, now)
        if nonsense:
            self.report.counts["actions_not_finite"] += 1
        target = self.rule.target(action, self.target, np.asarray(state.position, np.float32))
        self._send(now, target, 1.0)
        self._action = action
        self.report.acts += 1
        if self.recorder is not None:
            r = self.recorder
            r.put(OBSERVATION, now, observation[0])
            r.put(ACTION, now, action)
            if getattr(self.measure, "goal", None) is not None:
                r.put(TURNED, now, np.asarray(self._seen, np.float32))
                r.put(GOAL, now, self.measure.goal[0].numpy())
            elif self.measure.needs == WHERE:
                r.put(FORCE_COMMAND, now, self._command[0])
                r.put(HEIGHT, now, np.asarray(self._seen, np.float32))
        if self.keep:
            self.report.observations.append(observation[0])
            self.report.actions.append(action)
            self.report.targets.append(self.target.copy())
            self.report.forces.append(touch)

    def _send(self, now: float, target: np.ndarray, current_share: float) -> None:
        """Limit, remember, send, record."""
        assert self.target is not None  # since the first reading
        safe = self.guard.apply(
            target, self.target, np.asarray(self.state.position, float), np.asarray(self.state.current, float),
            self.period,
        )  # fmt: skip
        self.target = safe.astype(np.float32)
        with self._lock:  # the watchdog relaxes from its own thread
            if self._tripped is None:
                self._sent = HandCommand(
                    self.target, np.round(self.tor_max * current_share), kp=self.settings.kp, mode=POSITION
                )
                answer = readings.refused(self.driver.send(self._sent))
                self._refused.note(bool(answer), now, f"{self.driver.name} refuses what is sent: {answer}")
                if self._tripped is not None:  # the watchdog came in between: its word is the last
                    self.driver.relax()
        if self.recorder is not None:
            self.recorder.put("command", now, self.target)

    # -- phases
    def _begin_homing(self, now: float) -> None:
        self.phase, self._began = HOMING, now
        self._broken, self._coded, self._refused, self._frozen = None, Lasting(), Lasting(), Frozen()
        self._from = np.asarray(self.state.position, float).copy()
        self.target = self._from.astype(np.float32)
        # the peak of a minimum-jerk path is 15/8 of its mean speed
        self._home_s = max(0.5, 1.875 * float(np.abs(self.home - self._from).max()) / self.settings.home_speed)

    def _end_homing(self) -> None:
        """Check that the hand is at home, and take what the taxels say now as zero."""
        error = np.abs(np.asarray(self.state.position, float) - self.home)
        if error.max() > self.settings.home_error:
            j = int(error.argmax())
            raise UserError(
                f"homing: {self.bundle.hand.joints[j]} is {error[j]:.2f} rad from its home {self.home[j]:.2f} rad,"
                f" allowed {self.settings.home_error:g}; free the hand, or check its zero and the current limit"
            )
        rest = np.mean(self._rest, 0)
        if rest.size and rest.sum() > 0:
            self.report.counts["taxels_zeroed"] = int((rest > 0.5).sum())
            self.calibration.bias = self.calibration.bias + np.where(rest > 0.5, rest - self.calibration.bias, 0.0)

    def _begin_run(self, now: float) -> None:
        self.phase, self._began = RUN, now
        self.measure.reset()
        self.bundle.begin()
        self._unseen, self._nonsense = None, Lasting()
        self._poses = []
        self._seen, self._seen_at, self._action = None, None, np.zeros(len(self.rule.low), np.float32)
        started = getattr(self.driver, "started", None)
        if started is not None:
            started()

    def _relax(self, why: str) -> None:
        if self.phase != RELAXED:
            self.phase, self.why = RELAXED, why
            self.report.counts["relaxed"] += 1
        self._let_go()

    def _let_go(self, lock: bool = True) -> None:
        """Tell the driver to relax until it does; an interrupt in the middle changes nothing. Between tries the passive
        mode is sent, which a driver whose relaxing fails may still pass on."""
        for _ in range(RELAX_TRIES):
            held = False
            try:
                held = lock and self._lock.acquire(timeout=0.02)  # whoever holds it longer hangs
                self.driver.relax()
                self.report.not_relaxed = ""
                return
            except BaseException as error:  # Ctrl-C too: nothing comes before the hand
                self.report.counts["relax_failed"] += 1
                what = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
                self.report.not_relaxed = f"{what}{' '.join(str(error).split())[:300]}"
                self._warn()
            finally:
                if held:
                    self._lock.release()
            try:
                self.driver.send(
                    HandCommand(np.zeros_like(self.tor_max) if self.target is None else self.target,
                                np.zeros_like(self.tor_max), kp=0, mode=PASSIVE)
                )
                self.clock.sleep_until(self.clock.now() + RELAX_EVERY)
            except BaseException:
                continue

    def _confirm(self) -> None:
        """Wait, for a second at most, until a driver that can tell says whether the hand is limp; return what it
        says."""
        released, limit = getattr(self.driver, "released", None), self.clock.now() + CONFIRM
        while released is not None and not self.report.not_relaxed:
            self.driver.read()
            proof = released()
            if proof is not None or self.clock.now() > limit:
                ok, text = proof or (False, f"the hand has not said within {CONFIRM:g} s that it let go")
                self.report.limp, self.report.not_relaxed = (text, "") if ok else ("", text)
                break
            self.clock.sleep_until(self.clock.now() + RELAX_EVERY)
        if self.report.not_relaxed:
            self._warn()

    def _warn(self) -> None:
        """Say once, and at once, that the hand may still drive."""
        if not self._warned:
            self._warned = True
            self.say(f"DANGER   the hand may still drive: cut its power ({self.report.not_relaxed})")

    def _watch(self) -> None:
        """Relax the hand when the loop itself hangs, in a driver's call, say: the watchdog's thread."""
        limit = self.settings.hang
        while not self.stop.wait(min(0.02, limit / 4)):
            assert self._beat is not None  # before this thread began
            silent = self.clock.now() - self._beat
            if silent > limit and self._tripped is None and self.phase != RELAXED:
                self._tripped = f"the loop did not turn for {1e3 * silent:.0f} ms, allowed {1e3 * limit:.0f}"
                self.report.counts["watchdog"] += 1
                if (sent := self._sent) is not None:  # one that hangs in the driver delivers nothing any more
                    sent.mode, sent.kp, sent.tor_max = PASSIVE, 0, np.zeros_like(self.tor_max)
                self._let_go(lock=False)  # whoever holds it hangs


def _to_its_end(work: Callable[[], None]) -> None:
    """Work that may be done twice, begun again where Ctrl-C or another signal breaks it off."""
    for _ in range(RELAX_TRIES):
        try:
            return work()
        except KeyboardInterrupt:
            continue


def _smooth(share: float) -> float:
    """Return minimum jerk from 0 to 1."""
    return share**3 * (10 - 15 * share + 6 * share**2)
