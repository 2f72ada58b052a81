"""Fingers of the ergoCub humanoid hand, driven open loop (github.com/icub-tech-iit/ergocub-software, BSD-3-Clause): one
tendon-driven joint a run.

Each run as an npz: t [s], pwm_set and pwm_read [% of full duty], theta_deg [deg, 0 is a stop]. Only ratios of torque,
inertia and friction show in a motion without a load cell: inertias are in units of an assumed one (`INERTIA`), torques
with it. The host turned the duty round where the finger passed a threshold, which a free run of the whole would not
know: each run is cut into clips of whole cycles of `CLIP` s and more, each of them free from its first sample.

Kept out, chosen by name before anything was looked at: of the runs of a finger in the order of their names every third,
beginning with the third; of each run alone every fourth clip, beginning with the fourth. (First it was the last quarter
of the clips; of the first run that was tried, middle1, that was one clip at a duty that no other clip has.)

For 10 to 34 s at the begin of four of the middle finger's runs the motor was off: nothing was read back of the duty
that was set, and the controller gave none. Those stretches are left out before clips are cut and counted; that was seen
in the duties alone, when the four runs could not be explained.

What drives the finger is the duty that was set. It is read back within 10 ms, but not everywhere: at the open stop the
drive gave none though one was set (42 % of `output`), and one reversal each of `rinky` and `middle1` reached it 0.06 to
0.2 s after the host had logged it. There, where the two differ for `SETTLES` s, what was read back drove it. The rule
is one of the duties alone; that there was something to look for was seen in a clip of `rinky` that is kept out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import grey_opening

from benchmarks.real.common import Converted, rig, save
from dexsim.errors import UserError

FINGERS = {
    "middle": ("middle", "middle1", "middle3", "middle4", "middle5", "middle6", "output"),
    "ring_little": ("rinky", "rinky1", "rinky3"),
    "thumb": ("thumb1",),
}
EVERY = 4  # of some 930 samples a second: the finger turns by less than half a step of its encoder between them
CLIP = 2.0  # s
BEFORE = 1.0  # s of duty before a clip
OFF = 0.1  # s without duty where one was set: longer than any that was read late
UNLIKE, SETTLES = 0.05, 0.06  # of the full duty, s: by so much, for so long, what is read back is not what was set
KEPT = 4  # every so many of a run's clips is kept out
CLOSES = -1.0  # sign of the duty that turns the joint to larger angles (0 is the open stop)
INERTIA = 1e-3  # kg.m2 about the joint, the motor's reflected: assumed, it only sets the unit
PER_DUTY = 1e-3 / np.pi  # duty per rad of the loop that stands for none: a finger's whole turn is 0.03 % of the duty
MODEL = f"""<mujoco model="ergocub_finger">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="finger">
      <joint name="joint" type="hinge" axis="0 1 0" range="0 1.6" armature="{0.9 * INERTIA}"/>
      <geom name="link" type="sphere" size="0.005" pos="0 0 0.05" mass="{0.1 * INERTIA / 0.05**2}"
        contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
# Nothing is known of the drive but that duty makes torque less back-EMF; Coulomb and viscous friction are fitted with
# everything.
SERVO = {
    "drive": "voltage",
    "joints": {
        "*": {
            "kp": float(PER_DUTY),
            "kd": 0.0,
            "torque_limit": {"value": 0.05, "low": 0.005, "high": 0.5},
            "no_load_speed": {"value": 6.0, "low": 1.5, "high": 60.0},
            "coulomb_friction": "unknown",
            "viscous_friction": "unknown",
            # the position comes from another board, 20 times a second; how old it is then nobody says, and after a
            # reversal of the duty it goes on for two readings (in what is fitted as in the rest)
            "delay": {"value": 0.1, "low": 0.0, "high": 0.2},
        }
    },
}


def held_out(finger: str) -> tuple[str, ...]:
    """Runs of a finger that are kept out of the fit."""
    return FINGERS[finger][2::3]


def convert(data: Path, out: Path) -> Converted:
    """Convert all runs; groups: clips by run, in the order of time. The duty that was given is a command (as a target
    far off, through a gain that makes a duty of it); what was read back is the duty topic."""
    names = [n for runs in FINGERS.values() for n in runs]
    absent = [n for n in names if not (data / f"{n}.npz").is_file()]
    if absent:
        raise UserError(
            f"{data}: no {', '.join(f'{n}.npz' for n in absent)}; give the folder of the fingers' runs as npz"
        )
    model, servo = rig(out, "finger", MODEL, SERVO)
    made = {}
    for name in names:
        read = CLOSES * np.load(data / f"{name}.npz")["pwm_read"] / 100.0
        t, duty, q, clips = cycles(data / f"{name}.npz")
        made[name] = []
        for k, (a, b) in enumerate(clips):
            # what was asked for before still acts when the clip begins
            early = int(np.searchsorted(t, t[a] - BEFORE))
            changed = early + np.flatnonzero(np.r_[True, np.diff(duty[early:b]) != 0])
            keep = slice(a, b, EVERY)
            made[name].append(
                save(
                    out / f"{name}_{k:02d}.mcap",
                    ("joint",),
                    t[changed],
                    (duty / PER_DUTY)[changed, None],
                    t[keep],
                    q[keep, None],
                    duty=read[keep, None] if np.ptp(read) > 0 else None,
                    robot="ergocub_finger",
                    gravity="0 0 0",
                )
            )
    return Converted([p for clips in made.values() for p in clips], model, servo, groups=made)


def cycles(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[int, int]]]:
    """Times [s], duty as given (positive towards larger angles, 0 where the motor was off), angles [rad] [n] of a run,
    and the first and last samples (exclusive) of its clips."""
    raw = np.load(path)
    t, q = raw["t"].astype(float), np.radians(raw["theta_deg"].astype(float))
    duty, read = (CLOSES * raw[k].astype(float) / 100.0 for k in ("pwm_set", "pwm_read"))
    given = np.where(refused(t, duty, read), read, duty)
    on = driven(t, raw["pwm_set"], raw["pwm_read"], raw["pid_out"])
    clips = [(a + i, a + k) for a, b in on for i, k in _clips(t[a:b], duty[a:b], q[a:b])]
    ran = np.zeros(len(t), bool)
    for a, b in on:
        ran[a:b] = True
    return t, np.where(ran, given, 0.0), q, [(a, b) for a, b in clips if t[b - 1] - t[a] >= 0.9 * CLIP]


def refused(t: np.ndarray, set_: np.ndarray, read: np.ndarray) -> np.ndarray:
    """Return [n] whether the drive gives another duty than is set: where what is read back (1 is full) differs by
    more than `UNLIKE` for `SETTLES` s or longer, by which it has followed. Nowhere where nothing is read back."""
    if np.ptp(read) == 0:
        return np.zeros(len(t), bool)
    samples = max(int(round(SETTLES / float(np.median(np.diff(t))))), 1)
    return grey_opening(np.abs(read - set_), samples) > UNLIKE


def driven(t: np.ndarray, set_: np.ndarray, read: np.ndarray, given: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last samples (exclusive) of the stretches in which the motor was on: but for those longer
    than `OFF` in which a duty was set, and none was given nor read back."""
    off = (np.abs(read) < 1) & (np.abs(given) < 1) & (set_ != 0)
    edges = np.flatnonzero(np.diff(np.r_[0, off.astype(int), 0]))
    cut = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if t[min(b, len(t) - 1)] - t[a] > OFF]
    ends = [0, *(int(x) for pair in cut for x in pair), len(t)]
    return [(a, b) for a, b in zip(ends[::2], ends[1::2], strict=True) if b - a > 1]


def _clips(t: np.ndarray, duty: np.ndarray, q: np.ndarray) -> list[tuple[int, int]]:
    """Samples at which clips begin and end: where the duty turns positive; all in one where the encoder says
    nothing."""
    turns = np.flatnonzero((duty[1:] > 0) & (duty[:-1] <= 0)) + 1
    if np.ptp(q) == 0 or len(turns) < 2:
        return [(0, len(t))]
    out, begin = [], turns[0]
    for k in turns[1:]:
        if t[k] - t[begin] >= CLIP:
            out.append((int(begin), int(k)))
            begin = k
    return out or [(int(turns[0]), len(t))]


def repeat_noise(data: Path, name: str) -> float:
    """Return what strokes at one duty differ by from one to the next, each from where it began [rad, rms over root
    2]; NaN where none repeats."""
    raw = np.load(data / f"{name}.npz")
    t, duty, q = raw["t"], raw["pwm_set"], np.radians(raw["theta_deg"])
    edges = np.r_[0, np.flatnonzero(np.diff(duty) != 0) + 1, len(t)]
    on = driven(t, duty, raw["pwm_read"], raw["pid_out"])
    last: dict[float, np.ndarray] = {}
    squares = []
    for a, b in zip(edges[1:-2], edges[2:-1], strict=True):  # neither the first nor the last, which are cut
        if t[b - 1] - t[a] < 0.05 or not any(i < a and b < k for i, k in on):
            continue
        even = np.arange(t[a], t[b - 1], 0.005)
        stroke = np.interp(even, t[a:b], q[a:b]) - q[a]
        other = last.get(float(duty[a]))
        if other is not None:
            n = min(len(other), len(stroke))
            squares.append((stroke[:n] - other[:n]) ** 2)
        last[float(duty[a])] = stroke
    return float(np.sqrt(np.concatenate(squares).mean() / 2)) if squares else float("nan")
