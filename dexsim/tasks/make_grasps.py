"""Finds held poses that rotation episodes start from: `dexsim stable-grasps out=poses.npz count=2000`.

A cube (or a user's own object, any of its axes up) falls into an open hand, whose fingers close until their tips lie
against its sides. What has come to rest, lies about flat and is touched by fingertips is started again from exactly the
saved state, in a world with other mass, friction and drives, and must lie still for `HOLD` seconds. The saved set is
checked again by tests/test_rotate.py.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from dexsim import rotation
from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.hand.places import approach
from dexsim.tasks.building import UNIT_SPAN, hand_of
from dexsim.tasks.reach import Reach
from dexsim.tasks.registry import task_class
from dexsim.tasks.stable_grasps import CUBE, GraspSet, called, held_file

if TYPE_CHECKING:
    from dexsim.tasks.rotate import RotateEnv

SETTLE, HOLD = 2.0, 2.0  # s
DRIFT, TURN = 0.004, 0.10  # m, rad: how far a held cube may creep in HOLD seconds
TILT = 0.26  # rad, largest tilt of a start
TIPS = 2  # fingertips that touch a start, at least
SIZES = (0.045, 0.06)  # m, edges of cubes for a hand of UNIT_SPAN
AROUND = 0.03  # m: the cube's centre lies within it of the place where it fell
# How fingers close that do not reach the cube's sides: to the hand's cupped pose, give or take (rad, ours), those
# beside the opposing one alike.
OPPOSING, SIDEWAYS, ALIKE = 0.45, 0.15, 0.25
SPREAD = 0.15  # rad, by which those fingers differ from a common bend
CENTRE_X, CENTRE_Y = 0.0125, 0.015  # m, either side of the hand's `catch`, where the cube is let go
PLACES = 8  # of a cube that are tried: where most fingers reach its sides it is let fall
CLEARANCE = 0.01  # m, of its lowest point over the palm
ONTO = torch.tensor([[0.5**0.5, 0.0, -(0.5**0.5), 0.0], [0.5**0.5, 0.5**0.5, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
"""Rotations that bring an object's x, y, z onto the palm's normal."""
LAND, CLOSE, SPEED, LEAD = 0.4, 2.0, 1.5, 0.08  # s, s, rad/s, rad: the fingers close until their tips touch
TOUCH, PRESS = 0.03, 0.05  # N that stops a finger; rad by which it then presses on


def candidates(env: RotateEnv, n: int, sizes: tuple[float, float], rng: torch.Generator, reach: Reach) -> GraspSet:
    """Return n open hands, each with an object (cubes with edges of sizes [m]; others in turns) above its palm and the
    joint angles (`target`) that it will close to: fingertips against a cube's sides where they can, or those of a
    square block as wide as another object's narrower side, about the cupped pose where they cannot."""
    hand: Hand = env.hand
    J, sign = len(hand.joints), torch.as_tensor(hand.closing, dtype=torch.float32)
    u, common = 2 * torch.rand(n, J, generator=rng) - 1, 2 * torch.rand(n, 8, generator=rng) - 1
    target = torch.as_tensor(hand.pose("cupped"), dtype=torch.float32).repeat(n, 1)
    opened = torch.as_tensor(hand.pose("open"), dtype=torch.float32).repeat(n, 1)
    for k, finger in enumerate(hand.fingers):
        for j in finger.joints:
            if k in hand.opposing:
                target[:, j] += OPPOSING * u[:, j]
            elif j in finger.flexion:
                together = common[:, min(finger.flexion.index(j), 7)]
                target[:, j] += sign[j] * (ALIKE * together + SPREAD * u[:, j])
            else:
                target[:, j] += SIDEWAYS * u[:, j]
    edge = sizes[0] + (sizes[1] - sizes[0]) * torch.rand(n, generator=rng)
    aside = torch.tensor([CENTRE_X, CENTRE_Y]) * (2 * torch.rand(n, 2, generator=rng) - 1)
    catch = torch.as_tensor(env.places.catch, dtype=torch.float32)
    yaw = 2 * torch.pi * torch.rand(n, generator=rng)
    shape = torch.arange(n) % len(env.names)
    height, onto = edge.clone(), ONTO[2].repeat(n, 1)
    for k, variant in enumerate(env.objects.scene.variants):
        mine = torch.nonzero(shape == k)[:, 0]
        if env.names[k] != CUBE and len(mine):
            up = torch.randint(3, (len(mine),), generator=rng)
            size = torch.as_tensor(variant.shape.extents * variant.scale, dtype=torch.float32)
            height[mine], onto[mine] = size[up], ONTO[up]
            edge[mine] = torch.minimum(size[(up + 1) % 3], size[(up + 2) % 3])
    _against(reach, target, edge, aside, yaw, catch, env.unit, rng)
    limits = torch.as_tensor(hand.limits, dtype=torch.float32)
    target = torch.maximum(torch.minimum(target, limits[:, 1]), limits[:, 0])
    zero = torch.zeros(n)
    quat = torch.stack([(yaw / 2).cos(), zero, zero, (yaw / 2).sin()], 1)
    base = [hand.fingers[k].flexion[0] for k in hand.others]
    opened[:, base] = target[:, base]  # the fingers' first links stay: the cube may lie on them
    pose = torch.cat([
        catch[:2] + env.unit * aside, (catch[2] + env.unit * CLEARANCE + height / 2)[:, None],
        rotation.multiply(quat, onto),
    ], 1)  # fmt: skip
    return GraspSet(edge, opened, target, pose, shape=shape, names=env.names)


def _against(
    reach: Reach, target: torch.Tensor, edge: torch.Tensor, aside: torch.Tensor, yaw: torch.Tensor,
    catch: torch.Tensor, unit: float, rng: torch.Generator,
) -> None:  # fmt: skip
    """Write into target [n, J] the angles of fingers that can lie against the sides of their cube. Of PLACES of it
    (aside [n, 2], yaw [n], written too) that is taken which most fingers reach, an opposing one among them."""
    hand = reach.hand
    for i in range(len(target)):
        found: dict[int, np.ndarray] = {}
        best = -1
        for k in range(PLACES):
            where = aside[i] if not k else torch.tensor([CENTRE_X, CENTRE_Y]) * (2 * torch.rand(2, generator=rng) - 1)
            turned = float(yaw[i] if not k else 2 * torch.pi * torch.rand((), generator=rng))
            centre = np.append(catch[:2] + unit * where, catch[2] + edge[i] / 2)
            rows = {f: reach.fitting(f, centre, turned, float(edge[i])) for f in range(len(hand.fingers))}
            rows = {f: r for f, r in rows.items() if len(r)}
            good = len(rows) if rows.keys() & set(hand.opposing) and rows.keys() & set(hand.others) else 0
            if good > best:
                best, found, aside[i], yaw[i] = good, rows, where, turned
        for f, r in found.items():
            row = r[int(torch.randint(len(r), (), generator=rng))]
            target[i, list(hand.fingers[f].joints)] = torch.as_tensor(reach.q[f][row], dtype=torch.float32)


def settle(env: RotateEnv, start: GraspSet) -> tuple[GraspSet, torch.Tensor]:
    """Let the cubes land, close every hand, and let it come to rest. Returns (grasps at rest, which of them are fit
    [N])."""
    begin(env, replace(start, target=start.hand))
    _play(env, LAND)
    _play(env, CLOSE, start.target)
    _play(env, SETTLE)
    end = replace(start, hand=env.q.clone(), target=env.target.clone(), pose=env.object_pose.clone())
    v, w = env.object_velocity.split(3, 1)
    still = (v.norm(dim=1) < 0.01) & (w.norm(dim=1) < 0.1) & (env.qd.abs().amax(1) < 0.2)
    flat = rotation.tilt(end.pose[:, 3:], env.axis) < TILT
    touched = (env.tip_force > 0.02).sum(1) >= TIPS
    catch = torch.as_tensor(env.places.catch, dtype=torch.float32)
    near = (end.pose[:, :2] - catch[:2]).norm(dim=1) < env.unit * AROUND
    low = torch.minimum(torch.tensor(0.005 * env.unit), 0.2 * _smallest(env)[start.shape])
    inside = near & (end.pose[:, 2] > catch[2] + low)
    return end, still & flat & touched & inside & ~env.nan


def holds(env: RotateEnv, start: GraspSet) -> torch.Tensor:
    """Return which grasps [N] stay within DRIFT and TURN for HOLD seconds under action zero, in worlds drawn anew."""
    begin(env, start)
    ok = torch.ones(len(start), dtype=torch.bool)
    for _ in range(int(round(HOLD / env.dt))):
        _play(env, env.dt)
        ok &= (env.object_pose[:, :3] - start.pose[:, :3]).norm(dim=1) < env.unit * DRIFT
        ok &= rotation.error(env.object_pose[:, 3:], start.pose[:, 3:]) < TURN
    return ok & ((env.tip_force > 0.02).sum(1) >= 1) & ~env.nan


def _smallest(env: RotateEnv) -> torch.Tensor:
    """Return smallest extent of each object [m]; of a cube, whose edges differ, as large as may be."""
    return torch.tensor([
        torch.inf if v.shape.name == CUBE else float(min(v.shape.extents)) * v.scale for v in env.objects.scene.variants
    ])  # fmt: skip


def begin(env: RotateEnv, start: GraspSet) -> None:
    """Start world i from row i of `start`."""
    env.grasps, env.in_order = start, True
    env.reset_all()


def _play(env: RotateEnv, seconds: float, towards: torch.Tensor | None = None) -> None:
    """Step physics and servo alone: no episode ends. With `towards` [N, J] every finger moves there at SPEED, at most
    LEAD ahead of its joints, until its tip touches the cube; without, the targets stay."""
    touched = torch.zeros(env.num_envs, env.fingers + 1, dtype=torch.bool)
    finger = torch.tensor([k if k >= 0 else env.fingers for k in env.hand.finger_of_joint])  # the last: of none
    press = PRESS * torch.as_tensor(approach(env.hand), dtype=torch.float32)
    for _ in range(int(round(seconds / env.dt))):
        if towards is not None:
            target = env.target + (towards - env.target).clamp(-SPEED * env.dt, SPEED * env.dt)
            target = torch.maximum(torch.minimum(target, env.q + LEAD), env.q - LEAD)
            first = torch.zeros_like(touched)
            first[:, :-1] = (env.tip_force > TOUCH) & ~touched[:, :-1]
            target = torch.where(touched[:, finger], env.target, target)
            target = torch.where(first[:, finger], env.q + press, target)
            touched |= first
            env.target.copy_(torch.maximum(torch.minimum(target, env.q_high), env.q_low))
        step(env)


def step(env: RotateEnv) -> None:
    """Step physics and servo alone, for one control step: no episode ends."""
    env.servo.send(env.target)
    env.engine.step(env.decimation, env.servo.before_each, env.touch.launch)
    env.read_state()


def _waiting(cfg: dict, n: int, sizes: tuple[float, float]) -> GraspSet:
    """Return a set for the worlds to begin with: open hands, objects well above them."""
    hand = hand_of(cfg)
    opened = torch.as_tensor(hand.pose("open"), dtype=torch.float32).repeat(n, 1)
    pose = torch.tensor([0.0, 0.0, 3 * hand.span, 1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    objects = cfg["task"]["objects"]
    names = tuple(called(name) for name in (*objects["train"], *objects["held_out"]))
    return GraspSet(torch.full((n,), float(sizes[1])), opened, opened.clone(), pose, names=names)


def ensure(
    cfg: dict, count: int = 256, worlds: int = 128, seed: int = 0, report: Callable[[str], None] = print
) -> None:
    """Ensure that the held poses of a config's hand are there: else search for them and keep them in the hand's folder.
    Raises UserError."""
    hand, objects = hand_of(cfg), cfg["task"]["objects"]
    task_class(cfg).check_objects(cfg["task"])  # type: ignore[attr-defined]  # of a task that turns objects
    own = [name for name in (*objects["train"], *objects["held_out"]) if name != CUBE]
    if own:
        raise UserError(
            f"task.initial.poses: must name a file of held poses of {', '.join(map(called, own))}, with which trials"
            f" begin: dexsim stable-grasps objects=[{','.join(own)}] hand={hand.folder} out=FILE"
        )
    file = held_file(hand)
    if file.is_file() or hand.file.held_cubes is not None:
        return
    if not os.access(file.parent, os.W_OK):
        raise UserError(
            f"hand={hand.name}: has no held poses to begin with, and {file.parent} cannot be written;"
            f" make them with dexsim stable-grasps hand={hand.folder} out=FILE and give task.initial.poses=FILE"
        )
    report(f"no held poses of hand={hand.name} yet: looking for {count}, to be kept in {file} ...")
    plain = cfg | {"hand_mirror": False, "hand_scale": 1.0, "reality": {"name": "none"}}
    one = hand.span / hand.scale / UNIT_SPAN
    poses = generate(plain, count, worlds, seed, (one * SIZES[0], one * SIZES[1]), report)
    poses.save(file)


def generate(
    cfg: dict, count: int, worlds: int, seed: int, sizes: tuple[float, float], report: Callable[[str], None] = print
) -> GraspSet:
    """`count` held poses (of several objects about as many each), made on the CPU by C MuJoCo. sizes: edges of the
    cubes [m]. Raises UserError."""
    rng = torch.Generator().manual_seed(seed)
    waiting = {"grasps": _waiting(cfg, worlds, sizes)}
    env: RotateEnv = task_class(cfg)(cfg, worlds, "cpu", seed, "mujoco", **waiting)  # type: ignore[assignment]
    reach = Reach(env.hand, np.random.default_rng(seed))
    found: list[GraspSet] = []
    kinds = len(env.names)
    share = [count // kinds + (k < count % kinds) for k in range(kinds)]
    held, tried = [0] * kinds, 0
    while any(h < s for h, s in zip(held, share, strict=True)):
        rest, fit = settle(env, candidates(env, worlds, sizes, rng, reach))
        tried += worlds
        for _ in range(2):  # two draws of mass, friction and drives
            fit &= holds(env, rest)
        for k in range(kinds):  # no more of one than its share
            mine = torch.nonzero(fit & (rest.shape == k))[:, 0][: share[k] - held[k]]
            found.append(rest[mine])
            held[k] += len(mine)
        each = ", ".join(f"{h} {name}" for h, name in zip(held, env.names, strict=True))
        report(f"{sum(held)} held of {tried} tried" + (f" ({each})" if kinds > 1 else ""))
        for k, name in enumerate(env.names):
            if held[k] < share[k] and tried // kinds >= 4096 and held[k] < tried / kinds / 2000:
                what = f"cubes of {list(sizes)} m were" if name == CUBE else f"times '{name}' was"
                fits = "give sizes=[low,high]" if name == CUBE else "an object"
                raise UserError(
                    f"hand={env.hand.name}: only {held[k]} of {tried // kinds} {what} held: look at poses.cupped,"
                    f" opposing and places.catch of its hand.yaml, or {fits} that fit{'s' * (name != CUBE)} the hand"
                )
    return GraspSet.join(found)
