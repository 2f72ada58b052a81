"""Finds held poses that rotation episodes start from: `dexsim stable-grasps out=poses.npz count=2000`.

A cube falls into a hand whose fingers stand at random, half bent angles. What has come to rest, lies about flat and is
touched by fingertips is started again from exactly the saved state, in a world with other mass, friction and drives,
and must lie still for `HOLD` seconds. The saved set is checked again by tests/test_rotate.py.
"""

from __future__ import annotations

import torch

from dexsim import rotation
from dexsim.assets import xhand
from dexsim.errors import UserError
from dexsim.tasks.rotate import RotateEnv
from dexsim.tasks.stable_grasps import GraspSet

SETTLE, HOLD = 2.0, 2.0  # s
DRIFT, TURN = 0.004, 0.10  # m, rad: how far a held cube may creep in HOLD seconds
TILT = 0.26  # rad, largest tilt of a start
TIPS = 2  # fingertips that touch a start, at least
MIDDLE, AROUND = (0.05, 0.002), 0.03  # m: the cube's centre lies within AROUND of MIDDLE

# Joint angles [rad], SDK order: where the fingers are while the cube falls onto the palm, and between which angles they
# close (ours). The fingers curl around the face away from the wrist, the thumb lies at the side of the index finger.
OPEN = (0.3, 0.3, 0.2, 0.0, 0.2, 0.3, 0.2, 0.3, 0.2, 0.3, 0.2, 0.3)
CLOSED = (
    (0.2, 1.0), (0.7, 1.5), (0.2, 1.4),
    (-0.15, 0.15), (0.0, 0.5), (1.6, 1.9),
    (0.0, 0.5), (1.6, 1.9), (0.0, 0.5), (1.6, 1.9), (0.0, 0.5), (1.6, 1.9),
)  # fmt: skip
FINGER_OF = [k for k, f in enumerate(xhand.FINGERS) for _ in xhand.JOINTS_OF_FINGER[f]]  # of each joint
BASE = [4, 6, 8, 10]  # first flexion joints of the four fingers
SPREAD = 0.15  # rad, by which the four fingers differ from a common bend
CENTRE_X, CENTRE_Y = (0.035, 0.06), (-0.012, 0.018)  # m, where the cube is let go
CLEARANCE = 0.01  # m, of its lowest point over the palm
LAND, CLOSE, SPEED, LEAD = 0.4, 2.0, 1.5, 0.08  # s, s, rad/s, rad: the fingers close until their tips touch
TOUCH, PRESS = 0.03, 0.05  # N that stops a finger; rad by which it then presses on


def candidates(n: int, sizes: tuple[float, float], rng: torch.Generator) -> GraspSet:
    """n open hands, each with a cube above its palm and the joint angles (`target`) that it will close to."""
    u = torch.rand(n, 12, generator=rng)
    low, high = torch.tensor(CLOSED).unbind(1)
    target = low + (high - low) * u
    for joints in (BASE, [5, 7, 9, 11]):
        target[:, joints] = target[:, joints[:1]] + SPREAD * (2 * u[:, joints] - 1)
    edge = sizes[0] + (sizes[1] - sizes[0]) * torch.rand(n, generator=rng)
    xy = torch.stack([lo + (hi - lo) * torch.rand(n, generator=rng) for lo, hi in (CENTRE_X, CENTRE_Y)], 1)
    yaw = 2 * torch.pi * torch.rand(n, generator=rng)
    zero = torch.zeros(n)
    quat = torch.stack([(yaw / 2).cos(), zero, zero, (yaw / 2).sin()], 1)
    hand = torch.tensor(OPEN).repeat(n, 1)
    hand[:, BASE] = target[:, BASE]  # the fingers' first links stay: the cube may lie on them
    pose = torch.cat([xy, (0.025 + CLEARANCE + edge / 2)[:, None], quat], 1)
    return GraspSet(edge, hand, target, pose)


def settle(env, start: GraspSet) -> tuple[GraspSet, torch.Tensor]:
    """Let the cubes land, close every hand, and let it come to rest. Returns (grasps at rest, which of them are fit
    [N])."""
    _begin(env, GraspSet(start.edge, start.hand, start.hand, start.pose))
    _play(env, LAND)
    _play(env, CLOSE, start.target)
    _play(env, SETTLE)
    end = GraspSet(start.edge, env.q.clone(), env.target.clone(), env.object_pose.clone())
    v, w = env.object_velocity.split(3, 1)
    still = (v.norm(dim=1) < 0.01) & (w.norm(dim=1) < 0.1) & (env.qd.abs().amax(1) < 0.2)
    flat = rotation.tilt(end.pose[:, 3:], env.axis) < TILT
    touched = (env.tip_force > 0.02).sum(1) >= TIPS
    inside = (end.pose[:, 2] > 0.03) & (end.pose[:, :2] - torch.tensor(MIDDLE)).norm(dim=1).lt(AROUND)
    return end, still & flat & touched & inside & ~env.nan


def holds(env, start: GraspSet) -> torch.Tensor:
    """Which grasps [N] stay within DRIFT and TURN for HOLD seconds under action zero, in worlds drawn anew."""
    _begin(env, start)
    ok = torch.ones(len(start), dtype=torch.bool)
    for _ in range(int(round(HOLD / env.dt))):
        _play(env, env.dt)
        ok &= (env.object_pose[:, :3] - start.pose[:, :3]).norm(dim=1) < DRIFT
        ok &= rotation.error(env.object_pose[:, 3:], start.pose[:, 3:]) < TURN
    return ok & ((env.tip_force > 0.02).sum(1) >= 1) & ~env.nan


def _begin(env, start: GraspSet) -> None:
    """Start world i from row i of `start`."""
    env.grasps, env.in_order = start, True
    env.reset_all()


def _play(env, seconds: float, towards: torch.Tensor | None = None) -> None:
    """Physics and servo alone: no episode ends. With `towards` [N, 12] every finger moves there at SPEED, at most LEAD
    ahead of its joints, until its tip touches the cube; without, the targets stay."""
    touched = torch.zeros(env.num_envs, 5, dtype=torch.bool)
    for _ in range(int(round(seconds / env.dt))):
        if towards is not None:
            target = env.target + (towards - env.target).clamp(-SPEED * env.dt, SPEED * env.dt)
            target = torch.maximum(torch.minimum(target, env.q + LEAD), env.q - LEAD)
            first = (env.tip_force > TOUCH) & ~touched
            target = torch.where(touched[:, FINGER_OF], env.target, target)
            target = torch.where(first[:, FINGER_OF], env.q + PRESS, target)
            touched |= first
            env.target.copy_(torch.maximum(torch.minimum(target, env.q_high), env.q_low))
        env.servo.send(env.target)
        env.engine.step(env.decimation, env.servo.before_each, env.touch.launch)
        env.read_state()


def generate(cfg: dict, count: int, worlds: int, seed: int, sizes: tuple[float, float], report=print) -> GraspSet:
    """At least `count` held poses, made on the CPU by C MuJoCo."""
    rng = torch.Generator().manual_seed(seed)
    first = candidates(worlds, sizes, rng)
    env = RotateEnv(cfg, worlds, "cpu", seed, "mujoco", grasps=first)
    found: list[GraspSet] = []
    total = tried = 0
    while total < count:
        rest, fit = settle(env, candidates(worlds, sizes, rng) if tried else first)
        tried += worlds
        for _ in range(2):  # two draws of mass, friction and drives
            fit &= holds(env, rest)
        found.append(rest[fit])
        total += int(fit.sum())
        report(f"{total} held of {tried} tried")
        if tried >= 4096 and total < tried / 2000:
            raise UserError(f"only {total} of {tried} candidates held: sizes={list(sizes)} do not fit this hand")
    return GraspSet.join(found)[torch.arange(count)]
