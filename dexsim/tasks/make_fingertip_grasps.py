"""Finds poses in which fingertips alone hold a cube above the palm: `dexsim stable-grasps
hold=fingertips out=poses.npz`.

An opposing finger's pad is put on one face of the cube and at least two other fingers' pads on the opposite one, by
looking up joint angles in tables of forward kinematics; targets press with a chosen force through the Jacobian. The
cube is held still until the pads touch, let go without weight, then weighed in a random direction. What stays within
`DRIFT` and `TURN` for `HOLD` seconds, touched by fingertips alone, in worlds drawn anew three times, is kept. The saved
set is checked again by tests/test_rotate_fingertips.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
import torch

from dexsim import rotation
from dexsim.actuator.columns import INDEX
from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.tactile.layout import hand_layout, tip_layout
from dexsim.tasks.building import UNIT_SPAN, hand_of
from dexsim.tasks.make_grasps import begin, step
from dexsim.tasks.rotate import RotateEnv
from dexsim.tasks.stable_grasps import GraspSet

TABLE = 6000  # joint angles tried for each finger
TRIES = 400  # places of a cube for each that is wanted, before it is said that there are none
CENTRE = ((0.03, 0.08), (-0.03, 0.03), (0.065, 0.115))  # m, where its centre may be, of a hand of UNIT_SPAN
PITCH, YAW, ROLL = (-60.0, 15.0), (-30.0, 30.0), (-25.0, 25.0)  # degrees, of the axis from opposing to others
INSIDE, GAP, FACING = 0.006, (0.0, 0.003), 0.8  # m from the face's edges; m off the face; cosine of pad and face
FORCE = (4.0, 9.0)  # N that the opposing finger is told to press with; the others share as much
REST = (0.2, 0.6)  # rad: flexion of a finger that has no place on the cube
FIRM, WEIGHTLESS, HOLD, DRAWS = 0.5, 0.4, 1.2, 3  # s, s, s, how often
DRIFT, TURN, OTHER = 0.006, 0.15, 0.02  # m, rad that it may creep in HOLD; N on anything but fingertips
FINGERS_LEAST = 2


class Pads:
    """Tables of every finger: angles q [TABLE, j], pad centre [TABLE, 3] m and outward normal [TABLE, 3], palm
    frame; and Jacobians of a whole hand."""

    def __init__(self, hand: Hand, rng: np.random.Generator):
        self.hand, self.model = hand, hand.compiled
        self.data = mujoco.MjData(self.model)
        layout, limits, F = hand_layout(hand) or tip_layout(hand), hand.limits, len(hand.fingers)
        self.centre = layout.centre()
        self.normal = np.array([layout.normal[f][: layout.count[f]].mean(0) for f in range(F)])
        self.normal /= np.linalg.norm(self.normal, axis=1, keepdims=True)
        self.body = [self.model.body(b).id for b in hand.tip_bodies]
        every = rng.uniform(limits[:, 0], limits[:, 1], (TABLE, len(hand.joints)))
        point, normal = np.zeros((TABLE, F, 3)), np.zeros((TABLE, F, 3))
        for k, q in enumerate(every):
            self._set(q)
            for f, b in enumerate(self.body):
                turn = self.data.xmat[b].reshape(3, 3)
                point[k, f], normal[k, f] = self.data.xpos[b] + turn @ self.centre[f], turn @ self.normal[f]
        self.q = [every[:, list(f.joints)] for f in hand.fingers]
        self.point, self.out = point.swapaxes(0, 1), normal.swapaxes(0, 1)

    def _set(self, q: np.ndarray) -> None:
        self.hand.couplings.put(self.data, q)
        mujoco.mj_kinematics(self.model, self.data)

    def torque(self, q: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return joint torques [J] N m that press with force [F, 3] N (palm frame) at the pads' centres, angles q
        [J]."""
        self._set(q)
        mujoco.mj_comPos(self.model, self.data)
        jac, out = np.zeros((3, self.model.nv)), np.zeros(self.model.nv)
        for f, b in enumerate(self.body):
            at = self.data.xpos[b] + self.data.xmat[b].reshape(3, 3) @ self.centre[f]
            mujoco.mj_jac(self.model, self.data, jac, None, at, b)
            out += jac.T @ force[f]
        return self.hand.couplings.along(out, self.data.qpos)


def candidates(
    n: int, sizes: tuple[float, float], pads: Pads, rng: np.random.Generator
) -> tuple[GraspSet, torch.Tensor]:
    """Return n hands with a cube between an opposing finger and others; targets still equal the angles. Also the
    direction and share of force of each pad [n, F, 3], which sum to zero. Raises UserError for a hand that finds
    none."""
    hand = pads.hand
    rows: list[tuple[float, np.ndarray, np.ndarray]] = []
    shares: list[np.ndarray] = []
    unit, most = hand.span / UNIT_SPAN, min(FINGERS_LEAST, len(hand.others))
    tried = 0
    while len(rows) < n:
        if tried >= TRIES * n and not rows:
            raise UserError(
                f"hand={hand.name}: in {tried} places of a cube no opposing finger and {most} others reach opposite"
                " faces; give sizes=[low,high] that fit the hand, or look at opposing and tip.normal of its hand.yaml"
            )
        tried += 1
        edge = rng.uniform(*sizes)
        centre = unit * np.array([rng.uniform(*r) for r in CENTRE])
        pitch, yaw, roll = (math.radians(rng.uniform(*r)) for r in (PITCH, YAW, ROLL))
        quat = torch.tensor([1.0, 0.0, 0.0, 0.0])
        for axis, angle in (((0, 0, 1), yaw), ((0, 1, 0), -pitch), ((1, 0, 0), roll)):
            part = rotation.about(torch.tensor(axis, dtype=torch.float32), torch.tensor(angle, dtype=torch.float32))
            quat = rotation.multiply(quat, part)
        turn = rotation.to_matrix(quat).double().numpy()
        q, used = np.zeros(len(hand.joints)), []
        alone = int(rng.choice(hand.opposing)) if len(hand.opposing) > 1 else hand.opposing[0]
        for f, finger in enumerate(hand.fingers):
            side = -1.0 if f in hand.opposing else 1.0
            local = (pads.point[f] - centre) @ turn
            off = side * local[:, 0] - edge / 2
            facing = -side * (pads.out[f] @ turn[:, 0])
            fits = (
                (off > GAP[0]) & (off < GAP[1]) & (facing > FACING)
                & (np.abs(local[:, 1:]).max(1) < edge / 2 - INSIDE)
            )  # fmt: skip
            found = np.flatnonzero(fits)
            if len(found) and (f == alone or f in hand.others):
                q[list(finger.joints)] = pads.q[f][rng.choice(found)]
                used.append(f)
            else:
                bent = list(finger.flexion[-2:])
                rest = [c * REST[-len(bent) :][k] for k, c in enumerate(finger.closes[-2:])]
                q[bent] = np.clip(rest, *hand.limits[bent].T)
        others = [f for f in used if f != alone]
        if alone not in used or len(others) < most:
            continue
        share = np.zeros((len(hand.fingers), 3))
        share[alone] = turn[:, 0]
        share[others] = -turn[:, 0] / len(others)
        rows.append((edge, q, np.concatenate([centre, quat.numpy()])))
        shares.append(share)
    edges, angles, poses = (torch.as_tensor(np.array(v), dtype=torch.float32) for v in zip(*rows, strict=True))
    return GraspSet(edges, angles, angles.clone(), poses), torch.as_tensor(np.array(shares))


def press(env: RotateEnv, pads: Pads, q: torch.Tensor, share: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
    """Return targets [N, J] that press with force [N] N from angles q [N, J]."""
    torque = np.array([pads.torque(a.double().numpy(), (f * s).numpy())
                       for a, s, f in zip(q, share, force.double(), strict=True)])  # fmt: skip
    kp = env.servo.params[..., INDEX["kp"]].float()
    if env.cfg["servo"].get("drive") == "voltage":  # duty per rad
        kp = kp * env.servo.params[..., INDEX["torque_limit"]].float()
    target = q + torch.as_tensor(torque, dtype=torch.float32) / kp
    return torch.maximum(torch.minimum(target, env.q_high), env.q_low)


def settle(
    env: RotateEnv, pads: Pads, start: GraspSet, share: torch.Tensor, force: torch.Tensor
) -> tuple[GraspSet, torch.Tensor]:
    """Close every hand on its cube and let go of it without weight: (grasps, which are fit [N])."""
    begin(env, start)
    env.engine.field("opt.gravity").zero_()
    target = press(env, pads, start.hand, share, force)
    for _ in range(round(FIRM / env.dt)):
        env.target.copy_(target)
        step(env)
        env.engine.t.qpos[:, env.object_q] = start.pose.to(env.engine.t.qpos.dtype)
        env.engine.t.qvel[:, env.object_v] = 0.0
    target = press(env, pads, env.q.clone(), share, force)
    for _ in range(round(WEIGHTLESS / env.dt)):
        env.target.copy_(target)
        step(env)
    end = GraspSet(start.edge, env.q.clone(), target, env.object_pose.clone())
    v, w = env.object_velocity.split(3, 1)
    still = (v.norm(dim=1) < 0.02) & (w.norm(dim=1) < 0.3) & (env.qd.abs().amax(1) < 0.3)
    near = (end.pose[:, :3] - start.pose[:, :3]).norm(dim=1) < 0.01 * env.unit
    return end, still & near & _by_fingertips(env)


def holds(env: RotateEnv, start: GraspSet, rng: torch.Generator) -> torch.Tensor:
    """Return which grasps [N] stay within DRIFT and TURN for HOLD seconds under their targets, in worlds drawn anew,
    each weighed in a direction of its own."""
    begin(env, start)
    down = torch.randn(len(start), 3, generator=rng)
    gravity = env.engine.field("opt.gravity")
    gravity.copy_((9.81 * down / down.norm(dim=1, keepdim=True)).to(gravity.dtype))
    ok = torch.ones(len(start), dtype=torch.bool)
    for _ in range(round(HOLD / env.dt)):
        env.target.copy_(start.target)
        step(env)
        ok &= (env.object_pose[:, :3] - start.pose[:, :3]).norm(dim=1) < env.unit * DRIFT
        ok &= rotation.error(env.object_pose[:, 3:], start.pose[:, 3:]) < TURN
        ok &= _by_fingertips(env)
    return ok


def _by_fingertips(env: RotateEnv) -> torch.Tensor:
    other = (env.finger_force - env.tip_force).clamp(min=0).sum(1) + env.palm_force
    opposing, others = (env.tip_force[:, list(f)].sum(1) > 0.05 for f in (env.hand.opposing, env.hand.others))
    return opposing & others & (other < OTHER) & ~env.nan


def generate(
    cfg: dict, count: int, worlds: int, seed: int, sizes: tuple[float, float], report: Callable[[str], None] = print
) -> GraspSet:
    """Generate at least `count` poses held by fingertips alone, on the CPU by C MuJoCo."""
    rng, draw = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    pads = Pads(hand_of(cfg), rng)
    first = candidates(worlds, sizes, pads, rng)
    # physics and drives alone: nothing is observed, and nothing paid (the fingertip task has a reward more)
    cfg = {**cfg, "task": {**cfg["task"], "perception": "imu", "observations": {}, "rewards": {}}}
    env = RotateEnv(cfg, worlds, "cpu", seed, "mujoco", grasps=first[0])
    found: list[GraspSet] = []
    total = tried = 0
    while total < count:
        start, share = candidates(worlds, sizes, pads, rng) if tried else first
        force = FORCE[0] + (FORCE[1] - FORCE[0]) * torch.rand(worlds, generator=draw)
        rest, fit = settle(env, pads, start, share, force)
        tried += worlds
        settled = int(fit.sum())
        for _ in range(DRAWS):
            fit &= holds(env, rest, draw)
        found.append(rest[fit])
        total += int(fit.sum())
        report(f"{total} held of {tried} tried ({settled} of the last {worlds} settled)")
        if tried >= 4096 and total < tried / 2000:
            raise UserError(f"only {total} of {tried} candidates held: sizes={list(sizes)} do not fit this hand")
    return GraspSet.join(found)[torch.arange(count)]
