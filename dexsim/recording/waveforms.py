"""The motions of an excitation: each an offset from a centre, over time, from rest at 0 to rest at 0.

Every function takes the largest offset a [rad], the largest speed v [rad/s], the command period dt [s] and a random
generator, and returns offsets [T]. Nothing exceeds a, and nothing but `steps` exceeds v.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

Waveform = Callable[[float, float, float, np.random.Generator], np.ndarray]
PEAK = 1.875  # peak over mean speed of a minimum-jerk move


def minimum_jerk(start: np.ndarray | float, end: np.ndarray | float, seconds: float, dt: float) -> np.ndarray:
    """Return a move at rest on both ends (Flash and Hogan 1985), without its first sample."""
    n = max(2, round(seconds / dt))
    s = np.arange(1, n + 1) / n
    s = s**3 * (10 - 15 * s + 6 * s**2)
    return np.asarray(start) + np.multiply.outer(s, np.asarray(end) - np.asarray(start))


def through(points: Sequence[float], speed: float, dt: float) -> np.ndarray:
    """Return a path of straight lines between points at one speed, from 0 and back to 0."""
    out, at = [np.zeros(1)], 0.0
    for point in (*points, 0.0):
        n = max(1, round(abs(point - at) / speed / dt + 0.499))
        out.append(at + (point - at) * np.arange(1, n + 1) / n)
        at = point
    return np.concatenate(out)


def triangles(a: float, v: float, dt: float, rng: np.random.Generator) -> np.ndarray:
    """Move over the whole range in about 12 s, then a small one four times slower: friction, play, ripple."""
    slow = max(4 * a / 12.0, 0.02 * v)
    return np.concatenate([through((a, -a), min(slow, v), dt), through((0.15 * a, -0.15 * a), min(slow / 4, v), dt)])


def ladder(a: float, v: float, dt: float, rng: np.random.Generator) -> np.ndarray:
    """Return a motion there and back at ever higher speeds, then down again: friction over speed, torque-speed
    limit."""
    rungs = [f * v for f in (0.05, 0.1, 0.2, 0.4, 0.7, 0.95)]
    parts = [through((min(a, 0.6 * r), -min(a, 0.6 * r)), r, dt) for r in rungs]
    return np.concatenate([np.concatenate([p, np.zeros(round(0.2 / dt))]) for p in (*parts, parts[2], parts[0])])


def chirp(
    a: float, v: float, dt: float, rng: np.random.Generator, low: float = 0.3, high: float = 8.0, seconds: float = 12.0
) -> np.ndarray:
    """Return a sine from 0.3 to 8 Hz, smaller as it gets faster: delay, lag, inertia, elasticity."""
    t = np.arange(0, seconds, dt)
    rate = np.log(high / low) / seconds
    f = low * np.exp(rate * t)
    size = np.minimum(0.5 * a, 0.5 * v / (2 * np.pi * f)) * np.clip(np.minimum(t, t[-1] - t) / 0.4, 0, 1)
    return size * np.sin(2 * np.pi * low * (np.exp(rate * t) - 1) / rate)


def steps(a: float, v: float, dt: float, rng: np.random.Generator) -> np.ndarray:
    """Steps of four sizes up and down: delay, gains, torque limit."""
    hold = round(0.45 / dt)
    levels = [level for size in (0.1, 0.25, 0.5, 1.0) for level in (size * a, 0.0, -size * a, 0.0)]
    return np.repeat(np.array([0.0, *levels]), hold)


def holds(a: float, v: float, dt: float, rng: np.random.Generator) -> np.ndarray:
    """Stand for 2 s at six places, each reached from both sides: load, offsets, stiction, drift."""
    out, at = [np.zeros(1)], 0.0
    for level in (0.4 * a, 0.8 * a, 0.4 * a, -0.4 * a, -0.8 * a, -0.4 * a):
        out += [
            minimum_jerk(at, level, max(PEAK * abs(level - at) / (0.5 * v), 0.3), dt),
            np.full(round(2.0 / dt), level),
        ]
        at = level
    return np.concatenate([*out, minimum_jerk(at, 0.0, max(PEAK * abs(at) / (0.5 * v), 0.3), dt)])


def random_motion(a: float, v: float, dt: float, rng: np.random.Generator, seconds: float = 15.0) -> np.ndarray:
    """Moves to random places with pauses, as a task makes them."""
    out, at, t = [np.zeros(1)], 0.0, 0.0
    while t < seconds:
        level = float(rng.uniform(-a, a))
        took = max(PEAK * abs(level - at) / v, float(rng.uniform(0.2, 1.2)))
        pause = float(rng.choice([0.0, 0.0, rng.uniform(0.1, 0.8)]))
        out += [minimum_jerk(at, level, took, dt), np.full(round(pause / dt), level)]
        at, t = level, t + took + pause
    return np.concatenate([*out, minimum_jerk(at, 0.0, max(PEAK * abs(at) / v, 0.3), dt)])


KINDS: dict[str, Waveform] = {
    "triangles": triangles, "ladder": ladder, "chirp": chirp, "steps": steps, "holds": holds, "random": random_motion,
}  # fmt: skip
"""Name -> motion. "random" moves all joints at once, the others one joint of each finger."""
