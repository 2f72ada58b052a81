"""`dexsim deploy check`: a person's first hour with a hand, step by step, at low current; one folder tells what it
showed."""

from __future__ import annotations

import base64
import contextlib
import html
import io
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import system, typed, yaml_text
from dexsim.calibration.file import ASSUMED_LSB
from dexsim.deploy.driver import POSITION, Clock, HandCommand, HandDriver, HandState, VirtualClock
from dexsim.deploy.readings import copied, implausible
from dexsim.errors import UserError
from dexsim.paths import CONFIGS
from dexsim.tactile.layout import hand_layout, touch_shape

USAGE = """usage: dexsim deploy check [key=value ...]

Walk through the first hour with a hand: connection, cycle times, signs and ranges joint by joint, letting go, taxels,
latency, the lowest current that moves each joint, a recorded excitation with its audit and diagnosis, and a bundle
against what was measured. Every step says what to see. Enter begins a step, s skips it, q ends; while the hand moves,
Enter (or Ctrl-C) lets go of it at once. Stand clear, keep a switch for its power within reach.

settings (key=default):
  driver=xhand        xhand, or sim
  port=auto           as of dexsim deploy; port=fake rehearses it without a hand
  serial=             the hand with this serial number
  hand_mirror=false   a left hand
  bundle=             folder of dexsim export: is the hand what this policy was trained for?
  current=100         mA, firmware limit of the first motions
  joints=             only these, by commas (default: all)
  excite_current=300  mA that no step goes beyond; what does not move at current= gets twice as much, up to this
  steps=              only these, by commas: connection, cycles, signs, limp, zero, taxels, latency, lowest, excite,
                      calibrate, bundle (default: all)
  kinds=steps,chirp   motions of the excitation (dexsim excite)
  limit=300           s that the diagnosis may take
  seed=0              of the fake
  yes=false           ask nothing (rehearsals); the fake's time then passes as fast as it can be simulated
  out=out/check       a new folder: report.html, check.json, check.mcap, excite.mcap, servo.yaml

examples:
  dexsim deploy check port=fake:press=11 excite_current=1500 yes=true out=out/rehearsal
  dexsim deploy check bundle=out/bundle
"""
KEYS = typed.defaults(USAGE)
PERIOD, STALE = 0.01, 0.12
DRIVE = {"kp": "N.m/rad", "kd": "N.m.s/rad", "torque_limit": "N.m", "no_load_speed": "rad/s", "delay": "s",
         "coulomb_friction": "N.m"}  # fmt: skip
"""Columns of a fitted drive that are held against those of training, and their units."""
SPEED = 0.5
"""rad/s of targets; s of a turn; s that a reading may be old."""
MOVED = 0.02
"""rad by which a joint counts as moved: 13 counts of its encoder."""
SHORT = 0.1
"""rad before an end of its range at which a joint counts as stopped."""
PRESSES, PRESS_S = 60, 0.3
"""Of a pad while it is calibrated; s of each."""
LEADS, HOLD = np.arange(1, 9) * 0.02, 0.5
"""rad by which the target of a joint that is held runs ahead of it; s of each."""
LATENCY_STEP, LATENCY_TRIES = 0.12, 5


@dataclass
class Step:
    """One step's result. verdict: good, look (a person has to decide), bad, skipped; figures: what was measured."""

    name: str
    title: str
    verdict: str = "good"
    text: list[str] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    picture: str = ""

    def judge(self, verdict: str, text: str) -> None:
        """Give the verdict, and say why."""
        self.verdict = verdict
        self.text.append(text)


@dataclass
class Trace:
    """What was sent and read: t [T] s, target, position, current [T, J], tactile of the last reading."""

    t: np.ndarray
    target: np.ndarray
    position: np.ndarray
    current: np.ndarray
    stamp: np.ndarray


class Stopped(Exception):
    """The hand was let go in the middle of a step, and why."""


class Session:
    """A hand under a person's eyes: moves slowly, watches currents, heat and readings, lets go at any key.

    limit [mA]: of the firmware. asks: whether a person is there to press a key.
    """

    def __init__(self, driver: HandDriver, hand: Any, clock: Clock, recorder: Any = None, asks: bool = False):
        self.driver, self.hand, self.clock, self.recorder, self.asks = driver, hand, clock, recorder, asks
        self.J, self.taxels = len(hand.joints), touch_shape(hand)
        self.low, self.high = hand.limits.T
        self.state: HandState | None = None
        self.target: np.ndarray | None = None
        self._fresh_at = clock.now()

    def read(self) -> bool:
        """Return whether there is a new reading; raises Stopped where none can be had or the driver cannot go on."""
        now, state = self.clock.now(), self.driver.read()
        why = getattr(self.driver, "problem", str)()
        new = state is not None and (self.state is None or state.sequence != self.state.sequence)
        if new and not why:
            assert state is not None
            why = implausible(state, now, self.hand, self.taxels) or ""
            self.state, self._fresh_at = copied(state), now
            if self.recorder is not None:
                r = self.recorder
                r.put("state", now, state.position, state.velocity, 1e-3 * state.current.astype(float), state.time)
                if state.tactile.size:
                    r.put("tactile", now, state.tactile)
        if not why and now - self._fresh_at > STALE + (2.0 if self.state is None else 0.0):
            why = f"no new reading for {1e3 * (now - self._fresh_at):.0f} ms"
        if not why and self.state is not None and (self.state.temperature > 70).any():
            why = "a motor is over 70 degC"
        if not why and self.asks and system.key_pressed():
            why = "a key was pressed"
        if why:
            self.relax()
            raise Stopped(why)
        return new

    def relax(self) -> tuple[bool, str]:
        """Let go; whether the hand is limp, and by what that is known."""
        self.target = None
        with contextlib.suppress(UserError):
            self.driver.relax()
        released, limit = getattr(self.driver, "released", None), self.clock.now() + 1.0
        if released is None:
            return True, "let go; the driver cannot tell whether it is limp"
        while (proof := released()) is None and self.clock.now() < limit:
            self.clock.sleep_until(self.clock.now() + PERIOD)
            self.driver.read()
        return proof or (False, "the hand has not said that it let go")

    @property
    def newest(self) -> HandState:
        """The newest reading, once there is one."""
        assert self.state is not None
        return self.state

    def watch(self, seconds: float, period: float = PERIOD) -> Trace:
        """Read every `period` s, and send nothing."""
        return self._turns(seconds, None, 0.0, period=period)

    def move(
        self, goal: Callable[[float], np.ndarray], seconds: float, current: Any, speed: float = SPEED
    ) -> Trace:
        """Follow goal(t) [J] rad, t s since now, no faster than `speed` rad/s, within the joints' range; current: mA,
        one or [J]."""
        return self._turns(seconds, goal, current, speed)

    def _turns(
        self, seconds: float, goal: Callable[[float], np.ndarray] | None, current: Any, speed: float = SPEED,
        period: float = PERIOD,
    ) -> Trace:  # fmt: skip
        begun = due = self.clock.now()
        while self.state is None:
            self.read()
            self.clock.sleep_until(self.clock.now() + PERIOD)
        if self.target is None:
            self.target = np.clip(self.state.position.astype(float), self.low, self.high)
        rows: list[tuple] = []
        over = 0
        while (now := self.clock.now()) < begun + seconds or not rows:
            new = self.read()
            if goal is not None:
                step = speed * PERIOD
                wanted = np.clip(goal(now - begun), self.low, self.high)
                self.target = self.target + np.clip(wanted - self.target, -step, step)
                self.driver.send(HandCommand(self.target, np.zeros(self.J) + current, mode=POSITION))
                if self.recorder is not None:
                    self.recorder.put("command", now, self.target.astype(np.float32))
            over = over + 1 if goal is not None and (np.abs(self.state.current) > 1.5 * current + 30).any() else 0
            if over > 100:
                self.relax()
                raise Stopped("a motor draws half as much again as its limit, for a second")
            if new:
                s = self.state
                rows.append((now - begun, self.target.copy(), s.position, s.current, s.time - begun))
            due = max(due + period, self.clock.now())
            self.clock.sleep_until(due)
        return Trace(*(np.array(x, float) for x in zip(*rows, strict=True)))


class Hour:
    """The steps, over a `Session`. Each fills its `Step`."""

    def __init__(self, session: Session, info: dict[str, str], given: dict[str, Any], out: Path, say: Callable):
        self.s, self.info, self.given, self.out, self.say = session, info, given, out, say
        self.hand = session.hand
        chosen = [j for j in given["joints"].split(",") if j] or list(self.hand.joints)
        unknown = [j for j in chosen if j not in self.hand.joints]
        if unknown:
            raise UserError(f"joints={unknown[0]}: must be of {', '.join(self.hand.joints)}")
        self.joints = [self.hand.joints.index(j) for j in chosen]
        self.amps = np.full(session.J, float(given["current"]))  # mA that each joint needs to move
        self.most = float(given["excite_current"])
        self.middle = np.clip(0.35 * (self.hand.limits.sum(1)), *self.hand.limits.T)
        self.found: dict[str, Step] = {}

    @contextlib.contextmanager
    def recorded(self, name: str) -> Iterator[None]:
        """Record into a file of its own."""
        self.s.recorder, whole = self.given["recorder"](name), self.s.recorder
        try:
            yield
        finally:
            self.s.recorder.close(120.0)
            self.s.recorder = whole

    def connection(self, step: Step) -> None:
        """See: the serial number is your hand's."""
        step.text = [f"{k}: {v}" for k, v in self.info.items() if v]
        step.figures = dict(self.info)

    def cycles(self, step: Step) -> None:
        """See: nothing moves; you may move the fingers by hand."""
        t = self.s.watch(5.0, 0.25 * PERIOD)
        gaps = 1e3 * np.diff(t.stamp)
        rate = 1e3 / gaps.mean()
        noise = np.std(np.diff(t.position, axis=0), 0) / 2**0.5
        step.figures = {"rate_Hz": rate, "median_ms": float(np.median(gaps)), "p99_ms": float(np.percentile(gaps, 99)),
                        "largest_ms": float(gaps.max()), "jitter_rad": float(np.median(noise))}  # fmt: skip
        step.text = [
            f"{rate:.0f} readings a second; between two {np.median(gaps):.1f} ms, 99 % within"
            f" {np.percentile(gaps, 99):.1f} ms, the longest {gaps.max():.1f} ms",
            f"encoders at rest: {np.median(noise):.4f} rad (training draws task.sensors.joint_noise=0.003)",
        ]
        if rate < 80 or gaps.max() > 110:
            step.judge("look", "slower than the 9.6 ms a cycle that others measure: is another program on the port?")
        step.picture = _picture(lambda ax: (ax.hist(gaps, bins=40), ax.set_xlabel("ms between readings")))

    def signs(self, step: Step) -> None:
        """See: one joint after the other closes a little, opens, and goes to both ends of its range; nothing
        strains."""
        self.s.move(_still(self.middle), 4.0, self.amps)
        rows: dict[str, Any] = {}
        for j in self.joints:
            low, high = self.hand.limits[j]
            reach = 0.6 * min(self.middle[j] - low, high - self.middle[j])
            goal = self.middle.copy()
            took = reach / SPEED + 0.4
            up, down = goal.copy(), goal.copy()
            up[j], down[j] = goal[j] + reach, goal[j] - reach
            while True:  # at the lowest current first; what does not move at it gets twice as much
                a = self.s.move(_still(up), took, self.amps)
                c = self.s.move(_still(down), 2 * took, self.amps)
                if a.position[-1, j] - c.position[-1, j] > reach or self.amps[j] >= self.most:
                    break
                self.amps[j] = min(2 * self.amps[j], self.most)
                self.s.move(_still(goal), took, self.amps)
            self.s.move(_still(goal), took, self.amps)
            moving = np.abs(np.gradient(a.target[:, j])) > 1e-4
            push = float(np.median(a.current[moving, j])) if moving.any() else 0.0
            span = a.position[-1, j] - c.position[-1, j]
            name = self.hand.joints[j]
            good = span > reach
            ends = [float(c.position[-1, j]), float(a.position[-1, j])]
            for k, end in enumerate((low, high) if good else ()):  # as far as it goes, from the middle
                to, far = goal.copy(), abs(end - goal[j]) / SPEED
                to[j] = end
                ends[k] = float(self.s.move(_still(to), far + 0.6, self.amps).position[-1, j])
                self.s.move(_still(goal), far + 0.2, self.amps)
            rows[name] = {"moved_rad": float(span), "of_rad": float(2 * reach), "current_closing_mA": push,
                          "limit_mA": float(self.amps[j]), "reached_rad": ends}  # fmt: skip
            if not good:
                step.verdict = "bad"
                why = "the wrong way" if span < -0.5 * reach else f"{abs(span):.2f} of {2 * reach:.2f} rad"
                step.text.append(f"{name} went {why}: is it free, and its order in the hand's file right?")
        step.text = step.text or [f"all {len(rows)} joints follow their targets, the right way"]
        short = []
        for n, r in rows.items():
            at = self.hand.limits[self.hand.joints.index(n)]
            if np.abs(at - r["reached_rad"]).max() > SHORT:
                a, z = r["reached_rad"]
                short.append(f"{n} {a:.2f} to {z:.2f} of {at[0]:.2f} to {at[1]:.2f} rad")
        if short and step.verdict == "good":
            step.verdict = "look"
        step.text.append(f"short of their range: {'; '.join(short)}" if short else "all reach both ends of their range")
        more = {n: f"{r['limit_mA']:.0f} mA" for n, r in rows.items() if r["limit_mA"] > float(self.given["current"])}
        if more:
            step.text.append("needed more than current=: " + ", ".join(f"{n} {x}" for n, x in more.items()))
        step.figures = rows

    def limp(self, step: Step) -> None:
        """See: once the hand is let go, press its fingers gently: they give way."""
        self.s.move(_still(self.middle), 1.0, self.amps)
        ok, text = self.s.relax()
        t = self.s.watch(4.0)
        load, moved = float(np.abs(t.current).max()), float(np.ptp(t.position, axis=0).max())
        step.text = [text, f"in 4 s after: the largest current {load:.0f} mA, joints moved by up to {moved:.2f} rad"]
        step.figures = {"confirmed": ok, "current_mA": load, "moved_rad": moved}
        if not ok or load > 30:
            step.judge("bad", "it still resists: do not run a policy before you know how to cut its power at once")
        elif moved < MOVED:
            step.judge("look", "nobody moved a finger: that it gives way is not shown")

    def zero(self, step: Step) -> None:
        """See: nothing touches the fingertips."""
        if not self.s.taxels[0]:
            return step.judge("skipped", "this hand feels nothing")
        frames, silent = [], np.zeros(self.s.taxels[0], bool)
        for _ in range(50):
            self.s.watch(2 * PERIOD)
            frames.append(self.s.newest.tactile.astype(float))
            silent |= False if self.s.newest.silent is None else self.s.newest.silent
        bias = np.mean(frames, 0)[..., 2]
        names = self.hand.finger_names
        step.figures = {n: {"largest_counts": float(bias[f].max()), "taxels_not_zero": int((bias[f] > 0.5).sum()),
                            "silent": bool(silent[f])} for f, n in enumerate(names)}  # fmt: skip
        np.save(self.out / "taxel_zero.npy", bias.astype(np.float32))
        step.text = [f"{n}: {v['taxels_not_zero']} taxels are not at zero, the largest {v['largest_counts']:.0f} counts"
                     for n, v in step.figures.items()]  # fmt: skip
        if silent.any():
            step.judge("look", "boards that say nothing: " + ", ".join(np.array(names)[silent]))

    def taxels(self, step: Step) -> None:
        """See: press the corner that is named with a pin, until the next finger is named."""
        if hand_layout(self.hand) is None:
            return step.judge("skipped", "this hand feels nothing")
        # a pad's index is column * 12 + row
        guesses = {11: "as in our layout", 119: "columns are mirrored", 0: "rows are mirrored",
                   108: "rows and columns are mirrored", 110: "counted row by row"}  # fmt: skip
        press = getattr(self.s.driver, "press", None)
        for f, name in enumerate(self.hand.finger_names):
            self.say(f"  press the corner of the {name}'s pad that is nearest the tip, on the side of its first column")
            if press is not None:
                press(f)
            best = np.zeros(self.s.taxels[1])
            for _ in range(800 if self.s.asks else 100):
                self.s.watch(PERIOD)
                best = np.maximum(best, self.s.newest.tactile[f, :, 2])
                if best.max() > 20 and self.s.newest.tactile[f, :, 2].max() < 5:
                    break
            if best.max() < 5:
                step.judge("look", f"{name}: nobody pressed it")
                continue
            k = int(best.argmax())
            column, row = divmod(k, 12)
            corner = min(guesses, key=lambda g: abs(g // 12 - column) + abs(g % 12 - row))
            step.figures[name] = {"index": k, "counts": float(best.max()), "guess": guesses[corner]}
            step.text.append(f"{name}: index {k} (row {row}, column {column}) felt most: {guesses[corner]}")
            if corner != 11:
                step.verdict = "bad"

    def latency(self, step: Step) -> None:
        """See: single joints twitch by a few degrees."""
        found = latency(self.s, self.middle, self.joints, self.amps)
        if not found["ms"]:
            return step.judge("bad", "no joint moved at this current; raise current=")
        step.figures = found
        all_ms = [x for row in step.figures["ms"].values() for x in row]
        step.text = [f"{np.median(all_ms):.0f} ms from a command until the reading that shows motion (median of"
                     f" {len(all_ms)} steps; {min(all_ms):.0f} to {max(all_ms):.0f} ms)"]  # fmt: skip

    def lowest(self, step: Step) -> None:
        """See: each joint begins to move a little, by itself, as its current limit rises."""
        rows = {}
        for j in self.joints:
            self.s.move(_still(self.middle), 1.0, self.amps)
            at, goal = float(self.s.newest.position[j]), self.middle.copy()
            goal[j] = np.clip(at + 0.3, *self.hand.limits[j]) if at < self.hand.limits[j].mean() else at - 0.3
            found = None
            for limit in np.arange(10.0, self.most + 1, 10.0):
                t = self.s.move(_still(goal), 0.12, np.where(np.arange(self.s.J) == j, limit, self.amps), 3.0)
                if abs(t.position[-1, j] - at) > MOVED:
                    found = float(limit)
                    break
            rows[self.hand.joints[j]] = found
        still = [n for n, x in rows.items() if x is None]
        step.figures = {"mA": rows}
        over = f"over {self.most:g}"
        step.text = [f"{n}: {over if x is None else format(x, 'g')} mA" for n, x in rows.items()]
        if still:
            step.judge("bad", f"{', '.join(still)} did not move at all: blocked, or switched off?")

    def excite(self, step: Step) -> None:
        """See: the whole hand moves for a minute; keep objects and hands away."""
        from dexsim.recording.excitation import Limits, plan
        from dexsim.recording.mechanism import mechanism

        most = self.most
        self.s.relax()
        m = mechanism(hand=self.hand)
        names = [self.hand.joints[j] for j in self.joints]
        p = plan(m, names, self.given["kinds"].split(","), 0, 100.0, Limits(current=1e-3 * most))
        order = [m.joints.index(j) for j in self.hand.joints]
        value = p.value[:, order]
        self.s.move(_still(value[0]), 4.0, most)
        with self.recorded("excite.mcap"):
            self.s.move(lambda t: value[min(int(t * 100), len(value) - 1)], float(p.t[-1]), most, speed=20.0)
        self.s.relax()
        audit = _dexsim("audit", str(self.out / "excite.mcap"))
        (self.out / "audit.txt").write_text(audit.stdout, "utf-8")
        folder = self.out / "diagnosis"
        self.say("  diagnosing; a few minutes")
        servo = _dexsim("diagnose", f"recordings=[{self.out / 'excite.mcap'}]", f"out={folder}", "next=false",
                        f"joints=[{','.join(names)}]", f"limit={self.given['limit']}", "replay=none")  # fmt: skip
        step.figures = {"seconds": float(p.t[-1]), "audit": audit.returncode, "diagnosis": servo.returncode}
        step.text = [f"{p.t[-1]:.0f} s of {self.given['kinds']} in excite.mcap; audit.txt says what is wrong with it"]
        if servo.returncode == 0 and (folder / "servo.yaml").is_file():
            (self.out / "servo.yaml").write_bytes((folder / "servo.yaml").read_bytes())
            step.text.append("servo.yaml holds the drives that the diagnosis fitted; diagnosis/report.html says why")
        else:
            step.judge("look", f"the diagnosis ended: {(servo.stderr or servo.stdout).strip().splitlines()[-1:]}")

    def calibrate(self, step: Step) -> None:
        """See: press the pad that is named all over with something blunt, as hard as you would hold a cup; then hold
        something hard to the fingertip that is named, which presses it harder and harder."""
        names = self.hand.finger_names
        if hand_layout(self.hand) is None:
            return step.judge("skipped", "this hand feels nothing")
        press = getattr(self.s.driver, "press", None)
        with self.recorded("touch.mcap"):
            for f, name in enumerate(names):
                self.say(f"  press the {name}'s pad all over")
                for _ in range(PRESSES):
                    if press is not None:
                        press(f)
                    self.s.watch(PRESS_S)
        joints = [self.hand.joints[j] for j in self.joints if self.hand.finger_of_joint[j] >= 0]
        self._presses(joints)
        done = _dexsim("calibrate", f"touch={self.out / 'touch.mcap'}", f"real={self.out / 'press.mcap'}",
                       "simulate=true", f"joints={','.join(joints)}", f"meta.tactile_lsb={ASSUMED_LSB}",
                       f"out={self.out / 'calibration'}",
                       f"hand_mirror={str(self.hand.mirror).lower()}")  # fmt: skip
        said = [line[9:] for line in done.stdout.splitlines() if line.startswith("touch    ")]
        if done.returncode:
            step.figures = {"status": done.returncode}
            return step.judge("look", f"not calibrated: {(done.stderr.strip() or done.stdout)[-300:]}")
        file = self.out / "calibration" / "calibration.yaml"
        entries = yaml_text.load(file, "calibration").get("joints", {})
        ratios = {n: entries.get(n, {}).get("current_per_torque", {}).get("value") for n in joints}
        step.figures = {"status": 0, "pads": dict(x.split(": ", 1) for x in said), "A_per_Nm": ratios}
        known = ", ".join(f"{n} {x:.2f}" for n, x in ratios.items() if x) or "of no joint"
        step.text = [*said, f"A per N.m: {known}, if a count is {ASSUMED_LSB:g} N (a scale tells that);"
                     " calibration/calibration.yaml, for deploy and export calibration="]  # fmt: skip
        if any("0 dead; 0 swapped pairs; 0 not pressed" not in x for x in said) or not all(ratios.values()):
            step.verdict = "look"

    def _presses(self, joints: Sequence[str]) -> None:
        """Record in press.mcap joints that press against what is held to their fingertip, at rising currents."""
        block = getattr(self.s.driver, "block", lambda joint: None)
        with self.recorded("press.mcap"):
            for name in joints:
                j = self.hand.joints.index(name)
                self.say(f"  hold something hard to the fingertip that {name} moves, so that it cannot close")
                self.s.move(_still(self.middle), 3.0 if self.s.asks else 1.0, self.amps)
                block(j)
                for lead in LEADS:
                    goal = self.middle.copy()
                    goal[j] = self.s.newest.position[j] + lead
                    self.s.move(_still(goal), HOLD, self.most, speed=3.0)
                block(-1)
                self.s.move(_still(self.middle), 0.5, self.amps)

    def bundle(self, step: Step) -> None:
        """See: nothing moves."""
        from dexsim.deploy import bundle as bundles
        from dexsim.deploy.simulated_hand import SimulatedXHand

        if not self.given["bundle"]:
            return step.judge("skipped", "say which policy: bundle=DIR")
        b, clock = bundles.load(self.given["bundle"]), VirtualClock()
        trained = SimulatedXHand(b.config, b.calibration, clock, grip=b.manifest.get("grip"))
        trained.open()
        for amps in (self.amps, self.most, 4 * self.most):  # its friction is a guess: the lowest that moves it
            there = latency(Session(trained, b.hand, clock), self.middle, self.joints, amps)
            if len(there["ms"]) == len(self.joints):
                break
        here = {k: x for n in ("cycles", "latency") if n in self.found for k, x in self.found[n].figures.items()}
        more = b.config.get("randomize", {}).get("servo", {}).get("delay", 0.0)
        reach = 1e3 * (max(more) if isinstance(more, list) else float(more))
        if not here.get("ms") or not there["ms"]:
            return step.judge("look", "latency was not measured: nothing to compare")
        ms = [float(np.median([x for r in f["ms"].values() for x in r])) for f in (here, there)]
        rise = [float(np.median([x for r in f["rise_ms"].values() for x in r] or [np.nan])) for f in (here, there)]
        step.figures = {"latency_ms": ms[0], "trained_ms": ms[1], "trained_up_to_ms": ms[1] + reach,
                        "rise_ms": rise[0], "trained_rise_ms": rise[1]}  # fmt: skip
        slow = ms[0] > ms[1] + reach + 5
        word = "slower than" if slow else "within" if ms[0] >= ms[1] - 15 else "faster than"
        step.text = [f"your hand is {word} what this policy was trained for: {ms[0]:.0f} ms for {ms[1]:.0f}"
                     f" (drawn up to {ms[1] + reach:.0f}) from command to motion"]  # fmt: skip
        stiff = rise[0] > 1.5 * rise[1] or rise[0] < 0.67 * rise[1]
        step.text.append(f"a step of {LATENCY_STEP} rad is half done {rise[0]:.0f} ms after it begins, in training"
                         f" {rise[1]:.0f} ms: {'its gains are others' if stiff else 'gains as trained'}")  # fmt: skip
        others, table = self._drives(b)
        step.figures["drives"] = table
        step.text += others or (["the fitted drives lie within what training drew"] if table else
                                ["gains and limits were not fitted: take the step excite too"])  # fmt: skip
        here_a = self.found["calibrate"].figures.get("A_per_Nm", {}) if "calibrate" in self.found else {}
        theirs = dict(zip(b.hand.joints, map(float, b.calibration.current_per_torque), strict=True))
        off = [f"{n} {x:.2f} for {theirs[n]:.2f}" for n, x in here_a.items() if x and abs(x / theirs[n] - 1) > 0.2]
        step.figures["A_per_Nm"] = {n: [x, theirs[n]] for n, x in here_a.items() if x}
        if off:
            step.text.append(f"A per N.m is not what the bundle takes ({'; '.join(off)}): export it with calibration=")
        reached = self.found["signs"].figures if "signs" in self.found else {}
        low, high = (dict(zip(b.hand.joints, b.manifest["action"][k], strict=True)) for k in ("low", "high"))
        short = [f"{n} {r['reached_rad'][0]:.2f} to {r['reached_rad'][1]:.2f} rad for {low[n]:.2f} to {high[n]:.2f}"
                 for n, r in reached.items() if r["reached_rad"][0] > low[n] + SHORT
                 or r["reached_rad"][1] < high[n] - SHORT]  # fmt: skip
        if short:
            step.text.append(f"the policy's targets go farther than the hand: {'; '.join(short)}")
        noise, quiet = here.get("jitter_rad"), b.config["task"].get("sensors", {}).get("joint_noise", 0.0)
        if noise is not None:
            step.text.append(f"encoders at rest {noise:.4f} rad, in training {quiet:g}")
        if slow or stiff or others or short or off or (noise or 0.0) > quiet:
            step.judge("look", "train with servo_file=servo.yaml, which holds what was measured here")

    def _drives(self, b: Any) -> tuple[list[str], dict[str, Any]]:
        """Return what the fitted drives have outside of what training drew, in words, by joint and column."""
        from dexsim.actuator.table import ServoTable
        from dexsim.tasks.servos import RELATIVE

        if not (self.out / "servo.yaml").is_file():
            return [], {}
        fitted, trained = ServoTable.load(self.out / "servo.yaml"), ServoTable.from_dict(b.config["servo"])
        drawn = b.config.get("randomize", {}).get("servo") or {}
        words: list[str] = []
        rows: dict[str, Any] = {}
        for joint in fitted.fitted or ():
            for column, unit in DRIVE.items():
                here, there = fitted.value(joint, column), trained.value(joint, column)
                range_ = drawn.get(column, 1.0 if column in RELATIVE else 0.0)
                range_ = range_["log"] if isinstance(range_, dict) else np.broadcast_to(range_, 2)
                if here.value is None or there.value is None or not np.isfinite([here.value, there.value]).all():
                    continue  # not known, or without a limit
                low, high = (there.value * r if column in RELATIVE else there.value + r for r in map(float, range_))
                rows.setdefault(joint, {})[column] = {"here": here.value, "low": here.low, "high": here.high,
                                                      "trained": [low, high]}  # fmt: skip
                if here.low > high or here.high < low:
                    words.append(f"{joint}: {column} is {here.value:.3g} {unit}, training drew {low:.3g} to {high:.3g}")
        return words, rows


STEPS = {
    "connection": "Connection and versions", "cycles": "Cycle times and their tail",
    "signs": "Signs and ranges, joint by joint", "limp": "Does letting go make it limp?", "zero": "Zero of touch",
    "taxels": "Which taxel is which", "latency": "From command to motion",
    "lowest": "The lowest current that moves each joint", "excite": "A recorded excitation, its audit and diagnosis",
    "calibrate": "Taxels and currents under load", "bundle": "Is the hand what this policy was trained for?",
}  # fmt: skip
"""The steps in their order, by the title of each in the report."""


def latency(s: Session, middle: np.ndarray, joints: Sequence[int], current: Any) -> dict[str, Any]:
    """Steps of single joints to and fro: {"ms": joint: [ms from command to motion], "rise_ms": joint: [ms from there to
    half of the step]}. A joint moves where it has left the spread of its encoder by three times."""
    out: dict[str, Any] = {"ms": {}, "rise_ms": {}}
    s.move(_still(middle), 2.0, current)
    for j in joints:
        goal, ms, rise = middle.copy(), [], []
        for k in range(LATENCY_TRIES):
            before = goal.copy()
            rest = s.move(_still(before), 0.4, current)
            at = rest.position[-10:, j].mean()
            quiet = max(0.004, 4 * float(rest.position[-20:, j].std()))
            sign = 1.0 if k % 2 == 0 else -1.0
            goal[j] += sign * LATENCY_STEP
            after = goal.copy()
            t = s.move(_still(after), 0.4, current, speed=100.0)
            went = sign * (t.position[:, j] - at)
            if went.max() > max(quiet, 0.25 * LATENCY_STEP):
                begun = t.stamp[np.argmax(went > quiet)]
                ms.append(1e3 * float(begun))
                rise.append(1e3 * float(t.stamp[np.argmax(went > 0.5 * went.max())] - begun))
        if ms:
            out["ms"][s.hand.joints[j]], out["rise_ms"][s.hand.joints[j]] = ms, rise
    return out


def main(argv: Sequence[str]) -> int:
    """Walk through the steps; returns 0 where all are well, 1 where one is not or was stopped. Raises UserError."""
    if argv and argv[0] in ("-h", "--help", "help"):
        print(USAGE, end="")
        return 0
    given: dict[str, Any] = KEYS | typed.settings(argv, KEYS)
    for key, low, high in (("current", 10, 2000), ("excite_current", 10, 4000), ("limit", 10, 36000)):
        typed.number(key, given[key], low, high)
    for key in ("yes", "hand_mirror"):
        typed.truth(key, given[key])
    names = [n for n in given["steps"].split(",") if n] or list(STEPS)
    if unknown := [n for n in names if n not in STEPS]:
        raise UserError(f"steps={unknown[0]}: must be of {', '.join(STEPS)}")
    from dexsim import files, outputs
    from dexsim.hand import load_hand
    from dexsim.sim.quiet import quiet_warp

    hand = load_hand("xhand", given["hand_mirror"] == "true")
    # nobody to wait for, and no hand: its time passes as fast as this machine simulates it, however loaded that is
    clock = VirtualClock() if given["yes"] == "true" and not _real(given) else Clock()
    if not _real(given):
        quiet_warp("cpu")
    driver = make_driver(given, hand, clock)
    out = files.place(given["out"])
    if (out / "check.json").exists():
        raise UserError(f"out={out}: holds an earlier check; choose another folder")
    out.mkdir(parents=True, exist_ok=True)
    outputs.new(out / "check.mcap", "out=")
    return walk(driver, hand, clock, names, given, out, lambda text: print(text, flush=True))


def make_driver(given: dict[str, Any], hand: Any, clock: Clock | None = None) -> HandDriver:
    """Return the driver that the settings name. Raises UserError."""
    from dexsim.calibration.file import Calibration
    from dexsim.cli import settings
    from dexsim.deploy.fake_xhand import Faults
    from dexsim.deploy.simulated_hand import SimulatedXHand, faked
    from dexsim.deploy.vendor import VendorXHand

    kind, faults = given["port"].partition(":")[::2]
    typed.one_of("driver", given["driver"], ("xhand", "sim"))
    if given["driver"] == "xhand" and kind != "fake":
        return VendorXHand(given["port"], clock, serial=given["serial"] or None, side=hand.handedness)
    Faults.parse(faults)
    config = settings.resolve(settings.from_files(CONFIGS, {})) | hand.identity
    config["task"]["initial"]["object_xy"] = [0.5, 0.5]  # m: nothing is in the fingers' way
    calibration = Calibration.default(hand=hand)
    if given["driver"] == "xhand":
        return faked(config, calibration, faults, hang=1.0, clock=clock, seed=int(given["seed"]))
    return SimulatedXHand(config, calibration, clock, hang=1.0)


def walk(
    driver: HandDriver, hand: Any, clock: Clock, names: Sequence[str], given: dict[str, Any], out: Path, say: Callable
) -> int:
    """Return the steps with their questions, and the folder; see `main`."""
    asks = given["yes"] != "true" and sys.stdin is not None and sys.stdin.isatty()
    say("opening the hand ...")
    info = driver.open()
    zero = clock.now()
    given["recorder"] = lambda name: _recorder(out / name, hand, clock, given)
    recorder = given["recorder"]("check.mcap")
    session = Session(driver, hand, clock, recorder, asks)
    hour = Hour(session, info, given, out, say)
    stopped = ""
    try:
        for number, name in enumerate(names, 1):
            work = getattr(hour, name)
            say(f"\n{number}/{len(names)}  {name}: {' '.join((work.__doc__ or '').split())}")
            if asks:
                answer = input("      Enter begins, s skips, q ends: ").strip().lower()
                if answer == "q":
                    stopped = "ended by q"
                    break
                if answer == "s":
                    hour.found[name] = Step(name, name, "skipped")
                    continue
            step = Step(name, STEPS[name])
            try:
                work(step)
                hour.found[name] = step
                session.relax()  # nobody turns the loop while a person reads, or a motion is planned
            except Stopped as why:
                hour.found[name] = step = Step(name, name, "bad", [f"let go: {why}"])
                stopped = f"step {name}: {why}"
            for text in step.text:
                say(f"      {text}")
            if stopped:
                break
    except KeyboardInterrupt:
        stopped = "stopped by Ctrl-C"
    finally:
        session.asks = False
        ok, text = session.relax()
        recorder.close(120.0)
        _write(out, hour.found, info, stopped, text, clock.now() - zero)
        driver.close()
    say(f"\n{'the hand is let go: ' if ok else 'DANGER: '}{text}")
    say(f"{out / 'report.html'}")
    return int(bool(stopped) or not ok or any(s.verdict == "bad" for s in hour.found.values()))


def _recorder(path: Path, hand: Any, clock: Clock, given: dict[str, Any]) -> Any:
    from dexsim.deploy.recorder import Recorder

    meta = {"source": "real" if _real(given) else "sim", "robot": hand.robot,
            "effort_is": "current_A", "effort_sign": "-1", "tactile_unit": "count", "tactile_layout": hand.robot,
            "notes": "first hour"}  # fmt: skip
    return Recorder(path, hand.joints, meta, None, clock.now(), most=200_000)


def _real(given: dict[str, Any]) -> bool:
    return bool(given["driver"] == "xhand" and given["port"].partition(":")[0] != "fake")


def _still(goal: np.ndarray) -> Callable[[float], np.ndarray]:
    """Return the same targets [J] rad at all times."""
    return lambda t: goal


def _dexsim(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-X", "utf8", "-m", "dexsim", *arguments], capture_output=True,
                          encoding="utf-8")  # fmt: skip


def _picture(draw: Callable) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 2.4), layout="constrained")
    draw(figure.add_subplot())
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return base64.b64encode(data.getvalue()).decode()


def _write(out: Path, found: dict[str, Step], info: dict, stopped: str, released: str, seconds: float) -> None:
    """check.json and report.html."""
    rows = {n: {"verdict": s.verdict, "text": s.text, "figures": s.figures} for n, s in found.items()}
    data = {"hand": info, "steps": rows, "stopped": stopped, "let_go": released, "seconds": round(seconds, 1)}
    (out / "check.json").write_text(json.dumps(data, indent=1, default=str), encoding="utf-8")
    colour = {"good": "#2a7", "look": "#c80", "bad": "#c33", "skipped": "#888"}
    parts = []
    for s in found.values():
        items = "".join(f"<li>{html.escape(t)}</li>" for t in s.text)
        image = f'<img alt="" src="data:image/png;base64,{s.picture}">' if s.picture else ""
        parts.append(f'<h2><span style="color:{colour[s.verdict]}">{s.verdict}</span> {html.escape(s.title)}</h2>'
                     f"<ul>{items}</ul>{image}")  # fmt: skip
    page = f"""<!doctype html><meta charset="utf-8"><title>First hour with a hand</title>
<style>body{{font:16px/1.5 system-ui;max-width:46rem;margin:2rem auto;padding:0 1rem}}h2{{font-size:1.1rem}}
img{{max-width:100%}}</style>
<h1>First hour with a hand</h1>
<p>{html.escape(" ".join(info.get(k, "") for k in ("serial", "side")))}, {time.strftime("%Y-%m-%d %H:%M")},
{seconds:.0f} s. {html.escape(f"Stopped: {stopped}." if stopped else "All chosen steps were taken.")} At the end:
{html.escape(released)}.</p>
{"".join(parts)}
<p>All readings and commands: check.mcap, excite.mcap (dexsim audit, dexsim diagnose). Figures: check.json.</p>
"""
    (out / "report.html").write_text(page, encoding="utf-8")
