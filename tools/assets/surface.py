"""The fingertip skin as a smooth surface through the taxel lattice, and the points of the tip built from it.

Everything here works in the *sensor axes* of a pad, in metres: a = across the pad, b = along the finger,
c = out of the pad. They are the link axes of the distal body in another order: thumb pad (a, b, c) = link (x, y, z),
finger pad (a, b, c) = link (y, z, x). Origin: the distal joint. Both lattices are mirror images about a = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

COLUMNS, ROWS = 10, 12


@dataclass(frozen=True)
class PadShape:
    """What a pad is besides its lattice: axis order and the bounds of the distal link's shell (sensor axes, m)."""

    link_axes: tuple[int, int, int]  # sensor axis i is link axis link_axes[i]
    half_width: float  # of the back shell, |a|
    back: float  # lowest c of the back shell
    tip: float  # largest b
    start: float  # b at which the solid tip begins (the joint barrel lies before it)
    waist: float  # c below which the back shell takes over from the skin
    round_from: float  # b from which the back shell rounds off towards the tip


PADS = {
    "thumb": PadShape((0, 1, 2), 0.0178, -0.0151, 0.0522, 0.0105, -0.0035, 0.030),
    "finger": PadShape((1, 2, 0), 0.0085, -0.0114, 0.0437, 0.0090, -0.0012, 0.030),
}


def to_link(points: np.ndarray, pad: PadShape) -> np.ndarray:
    """Points or vectors [..., 3] from sensor axes to link axes."""
    out = np.empty_like(points)
    for sensor, link in enumerate(pad.link_axes):
        out[..., link] = points[..., sensor]
    return out


def to_sensor(points: np.ndarray, pad: PadShape) -> np.ndarray:
    """Points or vectors [..., 3] from link axes to sensor axes."""
    return np.stack([points[..., axis] for axis in pad.link_axes], axis=-1)


class Lattice:
    """Bicubic surface through a [10, 12, 3] lattice (sensor axes, m); exact at the lattice points.

    Its parameters are mean chord lengths along columns and rows, because the pitch varies by a factor of four and
    index parameters would overshoot at the pad's edges.
    """

    def __init__(self, points: np.ndarray):
        self.points = points
        self.u = _chord(points, 0)
        self.v = _chord(points, 1)
        self._spline = [RectBivariateSpline(self.u, self.v, points[..., i], s=0) for i in range(3)]

    def position(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.stack([s.ev(u, v) for s in self._spline], axis=-1)

    def normal(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return unit outward normals [..., 3]: d/du (across) x d/dv (along), which points out of the pad."""
        n = np.cross(*self._tangents(u, v))
        return n / np.linalg.norm(n, axis=-1, keepdims=True)

    def regular(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return where the two tangents are at least 11 degrees apart, so that the normal is well defined [...] bool.

        The thumb lattice's last row runs into its first and last column almost in one line.
        """
        du, dv = self._tangents(u, v)
        cross = np.linalg.norm(np.cross(du, dv), axis=-1)
        return cross > 0.2 * np.linalg.norm(du, axis=-1) * np.linalg.norm(dv, axis=-1)

    def _tangents(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        du = np.stack([s.ev(u, v, dx=1) for s in self._spline], axis=-1)
        dv = np.stack([s.ev(u, v, dy=1) for s in self._spline], axis=-1)
        return du, dv

    def grid(self, nu: int, nv: int) -> tuple[np.ndarray, np.ndarray]:
        """Return parameters [nu, nv] of a fine grid that contains the lattice lines' ends and is mirror symmetric."""
        u = np.linspace(self.u[0], self.u[-1], nu)
        v = np.linspace(self.v[0], self.v[-1], nv)
        return np.meshgrid(u, v, indexing="ij")

    def taxel_normals(self) -> np.ndarray:
        """Return unit outward normals [10, 12, 3]; the mean of the adjoining facets' where the spline's is ill
        defined."""
        at = np.meshgrid(self.u, self.v, indexing="ij")
        p = self.points
        facet = np.cross(p[1:, 1:] - p[:-1, :-1], p[:-1, 1:] - p[1:, :-1])
        mean = np.zeros_like(p)
        for i in (0, 1):
            for j in (0, 1):
                mean[i : i + facet.shape[0], j : j + facet.shape[1]] += facet
        mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
        return np.where(self.regular(*at)[..., None], self.normal(*at), mean)

    def taxel_areas(self) -> np.ndarray:
        """Return area of the lattice cell of each taxel [10, 12] m^2: a quarter of every adjoining facet, cut at
        mid-lines."""
        p = self.points
        nc, nr = p.shape[:2]
        fine = np.empty((2 * nc - 1, 2 * nr - 1, 3))
        fine[::2, ::2] = p
        fine[1::2, ::2] = (p[1:] + p[:-1]) / 2
        fine[:, 1::2] = (fine[:, 2::2] + fine[:, :-2:2]) / 2
        a, b, c, d = fine[:-1, :-1], fine[1:, :-1], fine[1:, 1:], fine[:-1, 1:]
        corners = [np.cross(b - a, c - a), np.cross(c - a, d - a), np.cross(b - a, d - a), np.cross(c - b, d - b)]
        cell = sum(np.linalg.norm(x, axis=-1) for x in corners) / 4  # mean of the two ways to cut a facet
        area = np.zeros((nc, nr))
        for i in range(2 * nc - 2):
            for j in range(2 * nr - 2):
                area[(i + 1) // 2, (j + 1) // 2] += cell[i, j]
        return area


def _chord(points: np.ndarray, axis: int) -> np.ndarray:
    step = np.linalg.norm(np.diff(points, axis=axis), axis=-1).mean(axis=1 - axis)
    return np.concatenate([[0.0], np.cumsum(step)])


def tip_points(lattice: Lattice, pad: PadShape, nu: int = 37, nv: int = 45,
               under: float = -2e-5) -> tuple[np.ndarray, np.ndarray]:
    """Return dense points on the distal fingertip: (skin [n, 3], rest [m, 3]) in sensor axes.

    The skin is the lattice surface. The rest (a skirt towards the joint, and the back shell) is ours: as wide and
    deep as the link's bounds, rounded, and kept under the tangent planes of the skin so that the hull of both
    follows the skin; `under` is how far below those planes (m, slightly negative: roundoff).
    """
    u, v = lattice.grid(nu, nv)
    skin = lattice.position(u, v)
    normal = lattice.normal(u, v)
    regular = lattice.regular(u, v).ravel()
    planes = normal.reshape(-1, 3)[regular]
    offset = np.einsum("ij,ij->i", planes, skin.reshape(-1, 3)[regular])

    # Before the first row the solid slopes down to the joint barrel, so that no sharp rim stands there.
    slope = np.array([0.0, -0.25, 1.0]) / np.hypot(1.0, 0.25)
    planes = np.concatenate([planes, slope[None]])
    offset = np.append(offset, (skin.reshape(-1, 3) @ slope).max())

    b1, p = pad.round_from, 2.6
    depth = pad.waist - pad.back

    def rounded(x: np.ndarray) -> np.ndarray:
        """Tell whether points are within the link's rounded bounds."""
        ok = (x[:, 1] >= pad.start - 1e-9) & (x[:, 1] <= pad.tip)
        low = np.clip(pad.waist - x[:, 2], 0, None) / depth
        end = np.clip(x[:, 1] - b1, 0, None) / (pad.tip + 0.0005 - b1)
        return ok & ((np.abs(x[:, 0]) / pad.half_width) ** p + low**p + end**p <= 1.0)

    # Cast rays from the middle: around the cross-section at stations along b, then over the rounded end.
    mid_c = pad.waist / 2 + 0.001
    begin, way = [], []
    angles = np.linspace(-np.pi / 2, 1.5 * np.pi, 49)[:-1]
    for b in np.linspace(pad.start, b1, 9):
        begin += [(0.0, b, mid_c)] * len(angles)
        way += [(np.cos(t), 0.0, np.sin(t)) for t in angles]
    for tilt in np.linspace(0.12, np.pi / 2, 12):
        begin += [(0.0, b1, mid_c)] * len(angles)
        way += [(np.cos(t) * np.cos(tilt), np.sin(tilt), np.sin(t) * np.cos(tilt)) for t in angles]
    starts, rays = np.array(begin), np.array(way)
    # Under the tangent planes a ray ends where it meets the first of them; the rounded bounds are found by bisection.
    room, climb = offset[None, :] - under - starts @ planes.T, rays @ planes.T
    first = np.where(climb > 0.0, room / np.where(climb > 0.0, climb, 1.0), np.inf).min(axis=1)
    lo, hi = np.zeros(len(rays)), np.full(len(rays), 0.06)
    for _ in range(40):
        mid = (lo + hi) / 2
        ok = (mid <= first) & rounded(starts + rays * mid[:, None])
        lo, hi = np.where(ok, mid, lo), np.where(ok, hi, mid)
    rest = starts + rays * lo[:, None]
    return skin.reshape(-1, 3), rest
