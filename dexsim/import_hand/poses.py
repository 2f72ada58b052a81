"""An open and a cupped pose, by search: fingertips around a ball before the palm, links clear of each other."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from scipy.optimize import least_squares

from dexsim.hand.couplings import Couplings
from dexsim.import_hand.frame import Motion, Palm, stretched, tip_at, unit
from dexsim.import_hand.tree import Tree

BALL = 0.25
"""Radius of the ball that the cupped hand holds, over the fingers' reach (a 56 mm ball for 11 cm of reach)."""
OPEN = 0.3  # of the way from stretched to cupped
TOUCH = 0.001  # m that two links may overlap before it counts
STARTS = 6
GOOD = 0.35  # of a cupped pose: no further start is tried


@dataclass
class Search:
    """Everything a search needs. m: the hand's own model (dexsim's shapes); motions' ids are those of `m`; ground: the
    palm's front [m], along its normal from its origin; passive: joints that follow; drums: by id of an actuator that
    pulls a tendon, how much of it each joint takes in."""

    m: mujoco.MjModel
    motions: list[Motion]
    thumbs: list[int]
    palm: Palm
    palm_body: int
    ground: float
    passive: set[str] = field(default_factory=set)
    drums: dict[int, dict[int, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.data = mujoco.MjData(self.m)
        self.reach = float(np.mean([x.reach for k, x in enumerate(self.motions) if k not in self.thumbs]))
        self.rest = np.clip(stretched(self.m, self.motions), self.m.jnt_range[:, 0], self.m.jnt_range[:, 1])
        self.span = np.ptp(self.m.jnt_range, axis=1)
        driven = [self.m.joint(j).name for j in range(self.m.njnt) if self.m.joint(j).name not in self.passive]
        self.couplings = Couplings(self.m, driven)
        for j, arms in self.drums.items():
            self.rest[j] = np.clip(sum(c * self.rest[k] for k, c in arms.items()), *self.m.jnt_range[j])
        self.names = [self.m.body(b).name for b in range(self.m.nbody)]

    def complete(self, q: np.ndarray) -> np.ndarray:
        """Return angles [nq] with those that follow where the others hold them."""
        return self.couplings.placed(q) if self.passive else q

    def tips(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return tips' positions and normals [F, 3] in the palm frame."""
        d = self.data
        d.qpos[:] = q
        mujoco.mj_kinematics(self.m, d)
        frame = d.xmat[self.palm_body].reshape(3, 3) @ self.palm.matrix
        origin = tip_at(d, self.palm_body, self.palm.position)
        points = np.array([tip_at(d, x.finger.tip, x.position) for x in self.motions])
        normals = np.array([d.xmat[x.finger.tip].reshape(3, 3) @ x.normal for x in self.motions])
        return (points - origin) @ frame, normals @ frame

    def overlaps(self, q: np.ndarray) -> list[tuple[str, str, float]]:
        """Return pairs of bodies that overlap in a pose, and how deep [m]."""
        d, m = self.data, self.m
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_collision(m, d)
        worst: dict[tuple[str, str], float] = {}
        bodies = np.sort(m.geom_bodyid[d.contact.geom], axis=1)
        for (a, b), dist in zip(bodies.tolist(), d.contact.dist.tolist(), strict=True):
            pair = (self.names[a], self.names[b])
            worst[pair] = max(worst.get(pair, 0.0), -dist)
        return [(a, b, depth) for (a, b), depth in worst.items() if depth > 0]


def cupped(s: Search, seed: int = 0, keep: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return the best of some searches from random starts: joint angles [nq] and how well it holds (0 would be
    perfect).

    Asked of it: every tip on the ball's surface, facing its middle; the opposing fingers' tips across from the others';
    the joints of a finger bent alike; links clear of each other and the ball clear of the palm, near it. The ball's
    place is searched too. keep [nq]: angles that a person fixed, NaN elsewhere.
    """
    m, reach = s.m, s.reach
    radius = BALL * reach
    rng = np.random.default_rng(seed)
    low, high = m.jnt_range[:, 0] + 0.01 * s.span, m.jnt_range[:, 1] - 0.01 * s.span
    free = np.ones(m.nq, bool) if keep is None else np.isnan(keep)
    bent = {j for x in s.motions for j in x.flexion}
    side = [j for x in s.motions for j in x.finger.joints if j not in bent]
    others = [k for k in range(len(s.motions)) if k not in s.thumbs]
    roots = s.tips(s.rest)[0][others]
    thumb_joints = {j for k in s.thumbs for j in s.motions[k].finger.joints}
    names = [m.joint(j).name for j in range(m.njnt)]
    side = [j for j in side if names[j] not in s.passive]

    def pose(x: np.ndarray) -> np.ndarray:
        q = x[: m.nq].copy()
        if keep is not None:
            q = np.where(free, q, keep)
        return s.complete(q)

    def residuals(x: np.ndarray) -> np.ndarray:
        q, centre = pose(x), x[m.nq :]
        tips, normals = s.tips(q)
        way = centre - tips
        off = np.linalg.norm(way, axis=1)
        direction = way / np.maximum(off, 1e-6)[:, None]
        out = [3 * (off - radius) / radius, 0.8 * (1 - np.einsum("fi,fi->f", normals, direction))]
        across = unit(direction[s.thumbs].mean(0)) @ unit(direction[others].mean(0))
        out.append(np.array([1.0 * (1 + across)]))
        for x_ in s.motions:
            curl = np.array(
                [c * (q[j] - r) / s.span[j] for j, c, r in zip(x_.flexion, x_.closes, x_.straight, strict=True)]
            )
            out.append(0.5 * (curl - curl.mean()))
            out.append(2.0 * np.minimum(curl, 0))
        if side:
            weight = np.array([0.1 if j in thumb_joints else 1.5 for j in side])
            out.append(weight * (q[side] - s.rest[side]) / s.span[side])
        height = (centre[2] - s.ground - radius) / radius
        out.append(np.array([4 * min(height - 0.05, 0.0), 0.25 * max(height, 0.0)]))
        out.append(0.15 * (centre[1:2] - roots[:, 1].mean()) / radius)
        deep = np.array(sorted((d for _, _, d in s.overlaps(q)), reverse=True)[:6])
        out += [200 * deep, np.zeros(6 - len(deep))]
        return np.concatenate(out)

    best, cost = None, np.inf
    bounds = (np.append(low, [-2 * reach] * 3), np.append(high, [2 * reach] * 3))
    for start in range(STARTS):
        q = s.rest.copy()
        for x_ in s.motions:
            amount = rng.uniform(0.2, 0.6)
            for j, c in zip(x_.flexion, x_.closes, strict=True):
                end = m.jnt_range[j, 1 if c > 0 else 0]
                q[j] += amount * (end - q[j])
        for j in thumb_joints - bent:
            q[j] = rng.uniform(low[j], high[j]) if start else 0.5 * (low[j] + high[j])
        for j, arms in s.drums.items():
            q[j] = sum(c * q[k] for k, c in arms.items())
        q = np.clip(q, low, high)
        tips = s.tips(s.complete(q))[0]
        x0 = np.append(q, np.clip(tips.mean(0), -reach, reach))
        x0 = np.clip(x0, bounds[0] + 1e-6, bounds[1] - 1e-6)
        scale = np.append(s.span, [reach] * 3)
        found = least_squares(residuals, x0, bounds=bounds, x_scale=scale, diff_step=1e-4, max_nfev=30)
        if found.cost < cost:
            best, cost = pose(found.x), float(found.cost)
        if np.sqrt(2 * cost / len(s.motions)) < GOOD:
            break
    assert best is not None  # the first start is better than none
    for share in np.linspace(1.0, 0.3, 15):  # less far, where links would overlap
        q = s.complete(np.clip(pose(s.rest + share * (best - s.rest)), m.jnt_range[:, 0], m.jnt_range[:, 1]))
        if max((d for _, _, d in s.overlaps(q)), default=0.0) <= 2 * TOUCH:
            return q, float(np.sqrt(2 * cost / len(s.motions)))
    return s.complete(np.clip(best, m.jnt_range[:, 0], m.jnt_range[:, 1])), float(np.sqrt(2 * cost / len(s.motions)))


def opened(s: Search, closed: np.ndarray) -> np.ndarray:
    """Return the cupped hand with its fingers let go: OPEN of the way from stretched, farther or nearer where links
    would overlap; bent back where stretched fingertips are nearer to each other than cupped ones, as a claw's are. An
    opposing finger stays turned as it is."""
    bent = [j for k, x in enumerate(s.motions) for j in (x.flexion if k in s.thumbs else x.finger.joints)]
    back = s.rest.copy()
    for x in s.motions:
        for j, close in zip(x.flexion, x.closes, strict=True):
            back[j] = np.clip(back[j] - 0.25 * close * s.span[j], *s.m.jnt_range[j])
    bent += list(s.drums)
    best, least, wide = closed, np.inf, gap(s, closed)
    for rest in (s.rest, back):
        for share in (OPEN, 0.4, 0.2, 0.5, 0.1, 0.6, 0.0, 0.7):
            q = closed.copy()
            q[bent] = rest[bent] + share * (closed[bent] - rest[bent])
            q = s.complete(q)
            worst = max((d for _, _, d in s.overlaps(q)), default=0.0)
            if worst <= TOUCH and gap(s, q) > wide:
                return q
            if worst < least:
                best, least = q, worst
    return best


def gap(s: Search, q: np.ndarray) -> float:
    """Return distance [m] between the opposing fingertips, their mean, and the others'."""
    tips = s.tips(q)[0]
    others = [k for k in range(len(s.motions)) if k not in s.thumbs]
    return float(np.linalg.norm(tips[s.thumbs].mean(0) - tips[others].mean(0)))


def span(s: Search, open_: np.ndarray, closed: np.ndarray) -> float:
    """Return how wide a thing [m] the hand can grasp: as wide as the fingers that press against the opposing ones are
    long (the xHand's reach 98 mm, its span is 100), but no wider than the fingertips come apart from open to cupped.

    The gap of the open pose alone says little: a LEAP opens to twice the width that its fingers reach around.
    """
    others = [k for k in range(len(s.motions)) if k not in s.thumbs]
    widest = 0.0
    for share in np.linspace(0, 1, 11):
        tips = s.tips(s.complete(open_ + share * (closed - open_)))[0]
        widest = max(widest, float(np.linalg.norm(tips[s.thumbs] - tips[others].mean(0), axis=1).max()))
    return min(s.reach, widest)


def near_the_palm(m: mujoco.MjModel, tree: Tree) -> list[tuple[str, str]]:
    """Return the palm with the nearer half of each finger's links: they turn in it, and shapes of both overlap
    there."""
    out = []
    for finger in tree.fingers:
        moving = list(dict.fromkeys(int(m.jnt_bodyid[j]) for j in finger.joints))
        near = moving[: (len(moving) + 1) // 2]
        fixed = [
            b for b in range(1, m.nbody) if not m.body_jntnum[b] and m.body_parentid[b] in near and b != finger.tip
        ]
        out += [(m.body(tree.palm).name, m.body(b).name) for b in [*near, *fixed]]
    return list(dict.fromkeys(out))


def always_overlapping(s: Search, count: int = 150, seed: int = 1) -> list[tuple[str, str]]:
    """Return pairs of bodies that overlap in most postures: drawn into each other, not in each other's way."""
    m, rng = s.m, np.random.default_rng(seed)
    times: dict[tuple[str, str], int] = {}
    for _ in range(count):
        for a, b, depth in s.overlaps(s.complete(rng.uniform(m.jnt_range[:, 0], m.jnt_range[:, 1]))):
            times[a, b] = times.get((a, b), 0) + (depth > TOUCH)
    return sorted(p for p, n in times.items() if n > 0.6 * count)


def meetings(s: Search, count: int = 1500, seed: int = 0) -> tuple[list[tuple[str, str]], int]:
    """Return pairs of bodies that could meet by their bits and never come within each other in random postures, to be
    left out; and how many pairs are kept. Pairs within a finger do not meet by their bits."""
    m, rng = s.m, np.random.default_rng(seed)
    touched: dict[tuple[str, str], int] = {}
    for _ in range(count):
        for a, b, depth in s.overlaps(s.complete(rng.uniform(m.jnt_range[:, 0], m.jnt_range[:, 1]))):
            if depth > 0.002:
                touched[a, b] = touched.get((a, b), 0) + 1
    every = set()
    excluded = {(int(e) >> 16, int(e) & 0xFFFF) for e in m.exclude_signature}
    bodies = [b for b in range(1, m.nbody) if any(m.geom_contype[g] for g in range(m.ngeom) if m.geom_bodyid[g] == b)]
    for i, one in enumerate(bodies):
        for other in bodies[i + 1 :]:
            if _can_meet(m, one, other) and not {(one, other), (other, one)} & excluded:
                every.add((m.body(one).name, m.body(other).name))
    frequent = {p for p, n in touched.items() if n >= max(2, count // 500)}
    return sorted(every - frequent), len(frequent & every)


def _can_meet(m: mujoco.MjModel, a: int, b: int) -> bool:
    for g in range(m.ngeom):
        if m.geom_bodyid[g] != a:
            continue
        for h in range(m.ngeom):
            if m.geom_bodyid[h] == b and (
                m.geom_contype[g] & m.geom_conaffinity[h] or m.geom_contype[h] & m.geom_conaffinity[g]
            ):
                return True
    return False
