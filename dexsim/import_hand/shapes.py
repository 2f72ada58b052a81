"""Collision shapes that make fast contacts: a capsule or two a link, a row of capsules for the palm, and for each tip
the convex core that its rubber margin grows back to the tip."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull, HalfspaceIntersection

from dexsim.import_hand import geometry
from dexsim.import_hand.frame import Motion, Palm, palm_points
from dexsim.import_hand.tree import Tree
from dexsim.surface import Surface, of_geoms, spread

MARGIN = 0.0015
"""Rounding of a fingertip [m]: its mesh is the tip shrunk by this, its geom's `margin` adds it back (the mesh itself
then never overlaps an object, so that the collision of convex shapes stays a distance query)."""
CORNERS = 64  # of a tip's core


@dataclass
class Capsule:
    """From a to b [3] m in the body's frame, radius m."""

    body: int
    a: np.ndarray
    b: np.ndarray
    radius: float


@dataclass
class Shapes:
    """capsules: of links and palm, by body id; proxies: capsules inside the tips, for the hand's own collisions; cores
    and skins: per finger, corners [V, 3] m of the tip's core and of its hull, in the tip body's frame; error: mean and
    largest distance [m] of the links' surface from their capsules."""

    capsules: list[Capsule] = field(default_factory=list)
    proxies: list[Capsule] = field(default_factory=list)
    cores: list[np.ndarray] = field(default_factory=list)
    skins: list[np.ndarray] = field(default_factory=list)
    error: tuple[float, float] = (0.0, 0.0)


def make(m: mujoco.MjModel, tree: Tree, motions: list[Motion], palm: Palm) -> Shapes:
    """Return the shapes of a hand."""
    out = Shapes()
    off = []
    tips = {x.finger.tip: x for x in motions}
    done = set()
    for x in motions:
        way = geometry.path(m, x.finger.tip)
        for body in geometry.with_fixed(m, way[way.index(tree.palm) + 1 :]):
            geoms = [g for g in geometry.solid(m, body) if g not in x.finger.geoms]
            if body in done or not geoms:
                continue
            done.add(body)
            points = _points(of_geoms(m, geoms), 400)
            found = fit(points)
            out.capsules += [Capsule(body, a, b, r) for a, b, r in found]
            off.append(np.abs(distance(points, found)))
    for x in motions:
        points = of_geoms(m, tips[x.finger.tip].finger.geoms)[0]
        skin = points[ConvexHull(points).vertices]
        out.skins.append(skin)
        out.cores.append(core(skin))
        inside = fit(_points((skin, ConvexHull(skin).simplices), 300), most=1)
        out.proxies += [Capsule(x.finger.tip, a, b, 0.95 * r) for a, b, r in inside]
    out.capsules += palm_row(m, tree, palm)
    if off:
        every = np.concatenate(off)
        out.error = float(every.mean()), float(every.max())
    return out


def _points(of: Surface, count: int) -> np.ndarray:
    """Return points [count, 3] m spread over a surface."""
    return spread(of[0][of[1]], count, np.random.default_rng(0))[0]


def distance(points: np.ndarray, capsules: list[tuple[np.ndarray, np.ndarray, float]]) -> np.ndarray:
    """Return signed distance [P] m of points to the union of capsules."""
    best = np.full(len(points), np.inf)
    for a, b, r in capsules:
        ab = b - a
        t = np.clip((points - a) @ ab / max(ab @ ab, 1e-12), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - a - t[:, None] * ab, axis=1) - r)
    return best


def fit(points: np.ndarray, most: int = 2) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Fit one capsule (a, b, radius) along the longest axis of points on a surface, least squares; two side by side
    where the surface is broad (half as broad again as it is thick) and two lie closer to it."""
    middle = points.mean(0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    local = (points - middle) @ axes.T
    low, high = np.quantile(local, 0.02, axis=0), np.quantile(local, 0.98, axis=0)
    size = high - low
    one = [_fitted(points, middle, axes[0], local[:, 0], 0.5 * np.sqrt(max(size[1] * size[2], 1e-12)))]
    if most < 2 or size[1] < 1.5 * max(size[2], 1e-6) or size[0] < 1.2 * size[1] * 0.5:
        return one
    two = []
    for side in (-1, 1):
        part = points[side * local[:, 1] >= -0.1 * size[1]]
        around = middle + axes[1] * side * 0.25 * size[1]
        two.append(_fitted(part, around, axes[0], (part - middle) @ axes[0], 0.5 * max(size[2], 0.35 * size[1])))
    return two if np.abs(distance(points, two)).mean() < 0.75 * np.abs(distance(points, one)).mean() else one


def _fitted(
    points: np.ndarray, middle: np.ndarray, axis: np.ndarray, along: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray, float]:
    low, high = np.quantile(along, 0.02) + radius, np.quantile(along, 0.98) - radius
    if high - low < 1e-3:
        low = high = 0.5 * (low + high)
    start = np.concatenate([middle + axis * low, middle + axis * (high + 1e-4), [radius]])
    most = 0.75 * np.linalg.norm(np.ptp(points, axis=0))

    def off(x: np.ndarray) -> np.ndarray:
        return 1e3 * distance(points, [(x[:3], x[3:6], x[6])])

    bounds = (np.append(start[:6] - most, 0.3 * radius), np.append(start[:6] + most, 1.6 * radius + 1e-4))
    x = least_squares(off, start, bounds=bounds, loss="soft_l1", max_nfev=25).x
    return x[:3], x[3:6], float(x[6])


def core(skin: np.ndarray, margin: float = MARGIN, most: int = CORNERS) -> np.ndarray:
    """Return corners [<= most, 3] of the hull `skin` moved in by `margin`, chosen one by one: always the one farthest
    outside. A hull too thin for the margin is moved in by a third of its thickness."""
    hull = ConvexHull(skin)
    planes = np.unique(hull.equations.round(9), axis=0)
    middle = skin[hull.vertices].mean(0)
    depth = -(planes[:, :3] @ middle + planes[:, 3]).max()
    planes = planes + [0, 0, 0, min(margin, depth / 3)]
    points = HalfspaceIntersection(planes, middle).intersections
    points = np.unique(points[np.isfinite(points).all(axis=1)].round(8), axis=0)
    if len(points) <= most:
        return points[ConvexHull(points).vertices]
    chosen = sorted(
        {int(i) for d in np.vstack([np.eye(3), [[1, 1, 1]]]) for i in ((points @ d).argmin(), (points @ d).argmax())}
    )
    while len(chosen) < 4 or np.linalg.matrix_rank(points[chosen] - points[chosen[0]], tol=1e-5) < 3:
        chosen.append(int(np.random.default_rng(len(chosen)).integers(len(points))))
    while len(chosen) < most:
        have = ConvexHull(points[chosen])
        outside = (points @ have.equations[:, :3].T + have.equations[:, 3]).max(axis=1)
        if outside.max() < 5e-6:
            break
        chosen.append(int(outside.argmax()))
    out = points[chosen]
    return out[ConvexHull(out).vertices]


def palm_row(m: mujoco.MjModel, tree: Tree, palm: Palm) -> list[Capsule]:
    """Return capsules side by side along the palm's forward axis whose fronts follow the side of the palm that objects
    touch; its back has none. Each strip's length and height come from the foremost points in it."""
    points = palm_points(m, tree.palm, 6000)
    if len(points) < 4:
        return []
    local = (points - palm.position) @ palm.matrix
    low, high = np.quantile(local, 0.01, axis=0), np.quantile(local, 0.99, axis=0)
    width = high[1] - low[1]
    depth = max(high[2] - low[2], 1e-3)
    radius = float(np.clip(0.45 * depth, 0.003, max(0.16 * width, 0.003)))
    count = int(np.clip(np.ceil(width / (1.7 * radius)), 1, 6))
    radius = max(radius, width / (2.0 * count))
    out = []
    for y in np.linspace(low[1] + radius, high[1] - radius, count) if count > 1 else [0.5 * (low[1] + high[1])]:
        strip = local[np.abs(local[:, 1] - y) < max(radius, 1e-3)]
        if len(strip) < 8:
            continue
        cells = np.floor((strip[:, 0] - low[0]) / radius).astype(int)
        front = np.array(
            [[strip[cells == c, 0].mean(), np.quantile(strip[cells == c, 2], 0.95)] for c in np.unique(cells)]
        )
        if len(front) > 2 and np.ptp(front[:, 0]) > radius:
            slope = np.polyfit(front[:, 0], front[:, 1], 1)
            if abs(slope[0]) > 0.6:  # steeper than a palm is: an edge, not a face
                slope = np.array([0.0, np.median(front[:, 1])])
        else:
            slope = np.array([0.0, front[:, 1].max()])
        ends = []
        first, last = np.quantile(strip[:, 0], [0.01, 0.99])
        for x in (first + radius, last - radius) if last - first > 2.2 * radius else [0.5 * (first + last)] * 2:
            ends.append(palm.position + palm.matrix @ np.array([x, y, slope @ [x, 1.0] - radius]))
        out.append(Capsule(tree.palm, ends[0], ends[1], radius))
    return out
