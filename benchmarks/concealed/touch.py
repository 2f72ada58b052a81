"""A fingertip pressed by a ball, written apart from the simulator: contact, spread over the taxels, rubber, neighbours,
readings.

The ball moves on two slides (one against the pad, one along it), each a mass on a PD drive, integrated at 10 kHz. The
tip is a convex hull with a rounded edge, given as vertices; the taxels are given as points, normals, areas. Only NumPy.
SI units.
"""

from __future__ import annotations

import numpy as np

# What is true of a pad and of its drives, and the values where effects are absent.
DEFAULTS: dict[str, float] = {
    # N/m of the contact; how pressure falls off around it (own law), m
    "stiffness": 7000.0, "power": 1.9, "reach": 1.0e-3,
    "zero": 0.0, "along": 0.0, "across": 0.0,  # m: the pad is not quite where it is believed
    "gain": 1.0, "fraction": 0.0, "time_constant": 0.3, "crosstalk": 0.0, "delay": 0.0,
    # second laws (`touch_cases`): 2: half of the relaxation is eight times as fast; 2: a third of what neighbours get
    # goes on to theirs; 1: what is read is the mean over twice the delay
    "branches": 1.0, "rings": 1.0, "window": 0.0,
    "kp": 4000.0, "kd": 40.0, "mass_press": 0.1, "mass_slide": 0.2,
}  # fmt: skip
NEIGHBOUR = 4.6e-3  # m: taxels nearer than this are beside one another


def triangle_distance(p: np.ndarray, tri: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance [n] from points p [n, 3] to the nearest of triangles tri [m, 3, 3], and the nearest point [n,
    3]."""
    a, ab, ac = tri[:, 0], tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]
    normal = np.cross(ab, ac)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    best, where = np.full(len(p), np.inf), np.zeros((len(p), 3))
    for i in range(len(tri)):
        d = p - a[i]
        flat = d - (d @ normal[i])[:, None] * normal[i]
        m = np.array([[ab[i] @ ab[i], ab[i] @ ac[i]], [ab[i] @ ac[i], ac[i] @ ac[i]]])
        uv = np.linalg.solve(m, np.stack([flat @ ab[i], flat @ ac[i]]))
        inside = (uv[0] >= 0) & (uv[1] >= 0) & (uv.sum(0) <= 1)
        q = a[i] + flat
        for s, e in ((0, 1), (1, 2), (2, 0)):
            u = tri[i, e] - tri[i, s]
            k = np.clip((p - tri[i, s]) @ u / (u @ u), 0, 1)
            edge = tri[i, s] + k[:, None] * u
            nearer = ~inside & (((p - edge) ** 2).sum(1) < ((p - q) ** 2).sum(1) + 1e-15)
            first = ~inside & (s == 0)
            q = np.where((nearer | first)[:, None], edge, q)
        distance = np.linalg.norm(p - q, axis=1)
        closer = distance < best
        best, where = np.where(closer, distance, best), np.where(closer[:, None], q, where)
    return best, where


class Pad:
    """triangles [m, 3, 3] m of the tip's hull, margin m by which it is rounded, points, normals [K, 3], areas [K] of
    the taxels; start [3]: the ball's centre at joints 0; press, slide [3]: unit directions of the joints; radius m of
    the ball; gravity [3]. One frame."""

    def __init__(self, triangles, margin, points, normals, areas, start, press, slide, radius, gravity):
        self.triangles, self.margin, self.points, self.normals, self.areas = triangles, margin, points, normals, areas
        self.start, self.press, self.slide, self.radius, self.gravity = start, press, slide, radius, gravity
        d = np.linalg.norm(points[:, None] - points[None], axis=-1)
        near = (d < NEIGHBOUR) & (d > 0)
        # what goes to each neighbour, of what each taxel gives away
        self.beside = near / np.maximum(near.sum(0, keepdims=True), 1)
        # depth over the two joints, once on a grid: the contact is quasi-static
        self.grid_press, self.grid_slide = np.linspace(-1e-3, 6e-3, 71), np.linspace(-6e-3, 6e-3, 25)
        centre = start + self.grid_press[:, None, None] * press + self.grid_slide[None, :, None] * slide
        gap = triangle_distance(centre.reshape(-1, 3), triangles)[0] - margin - radius
        self.gap = gap.reshape(len(self.grid_press), len(self.grid_slide))

    def depth(self, press: np.ndarray, slide: np.ndarray) -> np.ndarray:
        """Return the depth m of the ball in the tip (negative: apart), bilinear on the grid."""
        x = np.clip(
            (press - self.grid_press[0]) / (self.grid_press[1] - self.grid_press[0]), 0, len(self.grid_press) - 1.001
        )
        y = np.clip(
            (slide - self.grid_slide[0]) / (self.grid_slide[1] - self.grid_slide[0]), 0, len(self.grid_slide) - 1.001
        )
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        u, v = x - i, y - j
        g = self.gap
        return -((1 - u) * ((1 - v) * g[i, j] + v * g[i, j + 1]) + u * ((1 - v) * g[i + 1, j] + v * g[i + 1, j + 1]))


def move(pad: Pad, p: dict[str, float], command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions [2, M] m of (slide, press) and the contact's force [M] N every millisecond. command [2, M]:
    targets."""
    q, v = command[:, 0].copy(), np.zeros(2)
    mass = np.array([p["mass_slide"], p["mass_press"]])
    pull = mass * np.array([pad.gravity @ pad.slide, pad.gravity @ pad.press])
    out, force = np.empty_like(command), np.empty(command.shape[1])
    for k in range(command.shape[1]):
        out[:, k] = q
        f = p["stiffness"] * max(float(pad.depth(np.array(q[1]), np.array(q[0]))) + p["zero"], 0.0)
        force[k] = f
        stiff = p["stiffness"] if f > 0 else 0.0
        at = q[1]
        for _ in range(10):
            push = np.array([0.0, -(f + stiff * (q[1] - at)) if f > 0 else 0.0])
            v = v + 1e-4 * (p["kp"] * (command[:, k] - q) - p["kd"] * v + push + pull) / mass
            q = q + 1e-4 * v
    return out, force


def readings(pad: Pad, p: dict[str, float], q: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return [M, K] N that the taxels read every millisecond, before noise and counts."""
    across = np.cross(pad.press, pad.slide)
    centre = (
        pad.start
        + q[1][:, None] * pad.press
        + q[0][:, None] * pad.slide
        + p["along"] * pad.slide
        + p["across"] * across
    )
    d = np.linalg.norm(pad.points[None] - centre[:, None], axis=-1) - pad.radius - p["zero"]
    level = np.maximum(d.min(1) + p["reach"], 0.0)
    w = pad.areas * np.maximum(level[:, None] - d, 0.0) ** p["power"]
    x = np.where(force[:, None] > 0, w / np.maximum(w.sum(1, keepdims=True), 1e-30), 0.0) * force[:, None]
    if p["fraction"]:  # Maxwell branches beside the spring
        x = np.maximum(x + relaxing(p, x), 0.0)
    if p["crosstalk"]:
        given = p["crosstalk"] * x @ pad.beside.T
        if p["rings"] > 1:
            given = 2 / 3 * given + 1 / 3 * given @ pad.beside.T
        x = (1 - p["crosstalk"]) * x + given
    x = p["gain"] * x
    late = p["delay"] / 1e-3
    if p["window"] and late:
        now = np.arange(len(x))
        total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(0.5 * (x[1:] + x[:-1]), 0)])
        before = np.maximum(2 * late - now, 0)[:, None] * x[0]
        return (total - _at(total, now - 2 * late) + before) / (2 * late)
    return _at(x, np.arange(len(x)) - late)


def relaxing(p: dict[str, float], x: np.ndarray) -> np.ndarray:
    """Return [M, K] what the branches add to forces x [M, K] of every millisecond: their fraction of what x has not
    held long enough for them to let go."""
    if p["branches"] > 1:
        half = p | {"fraction": p["fraction"] / 2, "branches": 1.0}
        return relaxing(half, x) + relaxing(half | {"time_constant": p["time_constant"] / 8}, x)
    a, state, y = np.exp(-1e-3 / p["time_constant"]), np.zeros(x.shape[1]), np.empty_like(x)
    for k in range(len(x)):
        state = a * state + (1 - a) * x[k]
        y[k] = p["fraction"] * (x[k] - state)
    return y


def _at(x: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return x [M, K] at fractional samples, the first before it begins."""
    at = np.maximum(at, 0)
    i = np.minimum(np.floor(at).astype(int), len(x) - 2)
    return x[i] * (1 - (at - i))[:, None] + x[i + 1] * (at - i)[:, None]
