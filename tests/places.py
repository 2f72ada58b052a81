"""Where two bodies are nearest, in float64, and how far a contact's place is from there.

Parallel faces and edges have no single nearest point, and nearly parallel ones have one that heights of less than
float32 resolves decide. So a place is held to all points that are nearest: those halfway between two points that face
each other along the exact normal, each on the feature of its body that is furthest along it, to `LEVEL` = 2e-8 m
(float32 resolves 4e-9 to 7e-9 m at the bodies' places, and a height is a sum of several). Where a corner or two
crossing edges are furthest this is one point; of parallel faces it is where they overlap. A ball's or a rim's one point
stays one, however slowly the distance grows beside it.

A place further than 1e-6 m from all of them is *off*, unless the pose does not say better (*ill-conditioned*: edges
that are nearly parallel, or two ways out of an overlap of one length): then the exact places of poses within one unit
in the last place of what float32 holds (7.5e-9 m, 6e-8 rad) lie further apart than that.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from dexsim.sim.collision.shapes import hull_corners
from tests import cylinder_exact

LIMIT = 1e-6
"""What a place is held to [m]."""
LEVEL = 2e-8
"""Points of a feature are as high as each other, to this [m]."""
TILT = 1e-5
"""A cylinder's cap is a plane for directions within this [rad] of its axis; for others its rim is a curve."""
MOVED, TURNED = 2.0**-27, 2.0**-24
"""A unit in the last place of a float32 between 1/16 and 1/8 (m), and of one between 1/2 and 1 (rad)."""
CHANGED = 16
"""Poses within that."""
STIFF = 1e4
"""How much more a point's sum of weights and what it faces count than its distance from the answer."""
CYLINDER, CAPSULE, SPHERE, BOX = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("CYLINDER", "CAPSULE", "SPHERE", "BOX")
)


def radius(kind: int, size: np.ndarray) -> float:
    """Return the distance of the surface from the core [m]."""
    return float(size[0]) if kind in (SPHERE, CAPSULE) else 0.0


def core(model: mujoco.MjModel, poses, k: int, i: int) -> np.ndarray:
    """Return the corners of geom k in pose i, in the world [n, 3], in m."""
    kind, size = model.geom_type[k], poses.size[i, k]
    if kind == SPHERE:
        corners = np.zeros((1, 3))
    elif kind == CAPSULE:
        corners = np.array([[0, 0, -size[1]], [0, 0, size[1]]])
    elif kind == BOX:
        corners = size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    else:
        first, count, table = hull_corners(model)
        m = poses.mesh[i, k]
        corners = table[first[m] :][: count[m]].astype(float)
    return corners @ poses.rot[i, k].T + poses.pos[i, k]


def exact(model: mujoco.MjModel, poses, i: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return (distance in m, normal from A to B [3], place in m [3]) of pose i in float64. Where neither geom is a
    cylinder: of overlapping bodies by the nearest facet of the hull of all differences of corners (Qhull), of others
    by the nearest point of that hull (Lawson and Hanson's least distance programming)."""
    own = [radius(model.geom_type[k], poses.size[i, k]) for k in (0, 1)]
    for k in np.flatnonzero(model.geom_type == CYLINDER):
        turn = poses.rot[i, k]
        corners = (core(model, poses, 1 - k, i) - poses.pos[i, k]) @ turn
        dist, normal, at = cylinder_exact.answer(*poses.size[i, k, :2], corners)
        normal = turn @ normal * (1 - 2 * k)
        return dist - sum(own), normal, turn @ at + poses.pos[i, k] + 0.5 * (own[0] - own[1]) * normal
    a, b = (core(model, poses, k, i) for k in (0, 1))
    points = (a[:, None] - b[None]).reshape(-1, 3)
    solid = np.linalg.matrix_rank(points - points[0], tol=1e-9) == 3
    faces = ConvexHull(points).equations if solid else np.zeros((1, 4)) + [0, 0, 0, 1.0]
    if faces[:, 3].max() <= 0.0:  # unit normals outward, and minus the distance of the plane from the origin
        normal, dist = (f := faces[faces[:, 3].argmax()])[:3], float(f[3])
        high = a[a @ normal > (a @ normal).max() - 1e-9]
        low = b[b @ normal < (b @ normal).min() + 1e-9]
        pairs = (high[:, None] - low[None]).reshape(-1, 3) + dist * normal
    else:
        high, low, pairs = a, b, points
    scale = np.abs(pairs).max() or 1.0
    weight, _ = nnls(np.vstack([pairs.T / scale, np.ones(len(pairs))]), np.array([0.0, 0.0, 0.0, 1.0]))
    weight = weight.reshape(len(high), len(low)) / weight.sum()
    on_a, on_b = weight.sum(1) @ high, weight.sum(0) @ low
    if faces[:, 3].max() > 0.0:
        dist = float(np.linalg.norm(on_b - on_a))
        normal = (on_b - on_a) / dist
    return dist - sum(own), normal, 0.5 * (on_a + on_b) + 0.5 * (own[0] - own[1]) * normal


def changed(poses, i: int, n: int = CHANGED):
    """Return n poses that differ from pose i by no more than a unit in the last place; the same ones each time."""
    rng = np.random.default_rng(0)
    out = poses[np.full(n, i)]
    out.pos[:, 1] += rng.uniform(-MOVED, MOVED, (n, 3))
    turn = np.cross(rng.uniform(-TURNED, TURNED, (n, 1, 3)), np.swapaxes(out.rot[:, 1], 1, 2))
    out.rot[:, 1] += np.swapaxes(turn, 1, 2)
    return out


def furthest(model: mujoco.MjModel, poses, k: int, i: int, u: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the corners [n, 3] of what of geom k's surface in pose i is furthest along u, to `LEVEL`. Of what is so
    high of a cylinder's cap a polygon and the point nearest to `at`."""
    own = radius(model.geom_type[k], poses.size[i, k]) * u
    if model.geom_type[k] != CYLINDER:
        c = core(model, poses, k, i)
        return c[(h := c @ u) >= h.max() - LEVEL] + own
    turn, (r, half) = poses.rot[i, k], poses.size[i, k, :2]
    x, y, z = turn.T @ u
    flat = np.hypot(x, y)
    rim = np.array([[x, y]]) * r / max(flat, 1e-300)
    if flat <= TILT:
        angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        near = (turn.T @ (at - poses.pos[i, k]))[:2]
        cap = np.vstack(
            [r * np.stack([np.cos(angle), np.sin(angle)], 1), near * min(1, r / max(np.linalg.norm(near), 1e-300))]
        )
        rim = np.vstack([rim, cap[cap @ [x, y] >= r * flat - LEVEL]])
    ends = [-half, half] if 2 * half * abs(z) <= LEVEL else [np.copysign(half, z)]
    return np.array([[*xy, e] for xy in rim for e in ends]) @ turn.T + poses.pos[i, k]


def error(model: mujoco.MjModel, poses, i: int, normal: np.ndarray, at: np.ndarray) -> float:
    """Return how far [m] a place is from the nearest of those halfway between the points that face each other along the
    normal (from A to B) in pose i."""
    a, b = furthest(model, poses, 0, i, normal, at), furthest(model, poses, 1, i, -normal, at)
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    across = np.stack([side, np.cross(normal, side)]) / np.linalg.norm(side)
    n, m = len(a), len(b)
    a, b = a - at, b - at
    scale = max(np.abs(a).max(), np.abs(b).max())
    rows = np.zeros((7, n + m))
    rows[0, :n] = rows[1, n:] = STIFF
    rows[2:4, :n], rows[2:4, n:] = STIFF * across @ a.T / scale, -STIFF * across @ b.T / scale
    rows[4:, :n], rows[4:, n:] = 0.5 * a.T / scale, 0.5 * b.T / scale
    w, _ = nnls(rows, np.array([STIFF, STIFF, 0, 0, 0, 0, 0]))
    on_a, on_b = w[:n] @ a / w[:n].sum(), w[n:] @ b / w[n:].sum()
    return float(np.linalg.norm(0.5 * (on_a + on_b))) + float(np.linalg.norm(across @ (on_a - on_b)))


def errors(model: mujoco.MjModel, poses, i: int, normals: list[np.ndarray], at: np.ndarray) -> float:
    """Return the least `error` along any of the normals."""
    return min(error(model, poses, i, n, at) for n in normals)


def described(model: mujoco.MjModel, poses, i: int, got: tuple) -> dict:
    """Return the pose i as a case of tests/contact_places.json, whose numbers a float32 has exactly, and what was
    answered there: distance [m], how much more than exact that is [m], normal from A to B, place [m]."""
    dist, normal, _ = exact(model, poses, i)
    return {
        "meshes": [model.mesh(m).name if m >= 0 else None for m in poses.mesh[i]],
        **{k: [float(np.float32(v)) for v in getattr(poses, k)[i].ravel()] for k in ("pos", "rot", "size")},
        "dist": float(got[0][i]), "dist_error": float(got[0][i] - dist), "exact_normal": normal.tolist(),
        "normal": got[1][i].tolist(), "place": got[2][i].tolist(),
    }  # fmt: skip


def judge(model: mujoco.MjModel, poses, want: tuple, got: tuple, depth: np.ndarray) -> dict:
    """Return, of contacts whose place is more than 1e-6 m from C MuJoCo's (want), how many have several nearest
    points, and both are right (`equal`); how many answers are off, how many of C MuJoCo's are (`reference_off`), and
    how many of the answers are no further off than the pose is ill-conditioned (`ill`). worst [m]: of all answers.
    exact: the exact places where C MuJoCo's is off, by pose. poses_off: each answer that is off, by `described`.

    depth [n] in m: along the answers' normals. Of an overlap with two ways out of one length (to `LEVEL`) the place on
    either is right.
    """
    out: dict = {"equal": 0, "off": 0, "ill": 0, "reference_off": 0, "worst": 0.0, "exact": {}, "poses_off": []}
    separated = np.linalg.norm(want[2] - got[2], axis=1)
    near = np.isfinite(got[0])
    other = (want[0] < 0) & (np.abs(depth + want[0]) < LEVEL) & (np.linalg.norm(want[1] - got[1], axis=1) > 1e-3)
    for i in np.flatnonzero(near & (separated > LIMIT)):
        also = [got[1][i]] if other[i] else []
        mine, theirs = (errors(model, poses, i, [want[1][i], *also], x[2][i]) for x in (got, want))
        if max(mine, theirs) > LIMIT:
            _, normal, at = exact(model, poses, i)
            mine, theirs = (errors(model, poses, i, [normal, *also], x[2][i]) for x in (got, want))
            if theirs > LIMIT:
                out["reference_off"] += 1
                out["exact"][int(i)] = at
        out["worst"] = max(out["worst"], mine)
        if mine > LIMIT:
            others = changed(poses, i)
            places = np.array([at, *(exact(model, others, j)[2] for j in range(CHANGED))])
            ill = np.linalg.norm(places[:, None] - places[None], axis=-1).max() >= mine
            out["ill" if ill else "off"] += 1
            if not ill:
                reported = described(model, poses, int(i), got)
                out["poses_off"].append(reported | {"off_m": mine, "exact_place": at.tolist()})
        elif theirs <= LIMIT:
            out["equal"] += 1
    rest = separated[near & (separated <= LIMIT)]
    out["worst"] = max(out["worst"], float(rest.max(initial=0.0)))
    return out
