"""Held poses that rotation episodes start from: `python -m dexsim.tasks.stable_grasps out=poses.npz count=2000`.

A cube falls into a hand whose fingers stand at random, half bent angles. What has come to rest, lies about flat and is
touched by fingertips is started again from exactly the saved state, in a world with other mass, friction and drives,
and must lie still for `HOLD` seconds. The saved set is checked again by tests/test_rotate.py.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

from dexsim.assets import xhand
from dexsim.errors import UserError

DEFAULT = Path(__file__).parents[1] / "assets" / "grasps" / "cube.npz"
SETTLE, HOLD = 2.0, 2.0  # s
DRIFT, TURN = 0.004, 0.10  # m, rad: how far a held cube may creep in HOLD seconds
TILT = 0.26  # rad, largest tilt of a start
TIPS = 2  # fingertips that touch a start, at least
MIDDLE, AROUND = (0.05, 0.002), 0.03  # m: the cube's centre lies within AROUND of MIDDLE


@dataclass
class GraspSet:
    """K held poses. edge [K] m; hand [K, 12] rad, the joint angles; target [K, 12] rad, what the servos are sent; pose
    [K, 7], the cube (x y z m, quaternion w x y z), palm frame. Tensors, float32."""

    edge: torch.Tensor
    hand: torch.Tensor
    target: torch.Tensor
    pose: torch.Tensor

    @classmethod
    def load(cls, path: str | Path | None) -> GraspSet:
        """Read a file that this module wrote; None: the one that comes with dexsim. Raises UserError."""
        path = DEFAULT if path is None else Path(path).expanduser()
        try:
            with np.load(path) as data:
                return cls(**{f.name: torch.as_tensor(data[f.name], dtype=torch.float32) for f in fields(cls)})
        except (OSError, KeyError, ValueError) as error:
            raise UserError(f"held poses {path}: cannot read them ({error}); make them with "
                            "python -m dexsim.tasks.stable_grasps out=PATH") from None

    def save(self, path: Path) -> None:
        """Write an npz file of float32 arrays."""
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, **{k: v.cpu().numpy().astype(np.float32) for k, v in vars(self).items()})

    def within(self, low: float, high: float) -> GraspSet:
        """The poses of cubes with edges in [low, high] m. Raises UserError when there are none."""
        keep = (self.edge >= low - 1e-6) & (self.edge <= high + 1e-6)
        if not bool(keep.any()):
            raise UserError(f"randomize.object.size=[{low}, {high}]: no held poses of that size; the set has "
                            f"{self.edge.min():.3f} to {self.edge.max():.3f} m")
        return self[keep]

    def to(self, device: str) -> GraspSet:
        """The same on a device."""
        return GraspSet(*(v.to(device) for v in vars(self).values()))

    def __getitem__(self, rows: torch.Tensor) -> GraspSet:
        return GraspSet(*(v[rows] for v in vars(self).values()))

    def __len__(self) -> int:
        return len(self.edge)

    @staticmethod
    def join(parts: list[GraspSet]) -> GraspSet:
        """All poses of several sets."""
        return GraspSet(*(torch.cat([vars(p)[f.name] for p in parts]) for f in fields(GraspSet)))


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
    """Let the cubes land, close every hand, and let it come to rest. Returns (grasps at rest, which of them are fit [N])."""
    from dexsim.tasks import rotation

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
    from dexsim.tasks import rotation

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
    from dexsim.tasks.rotate import RotateEnv

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


def main(argv: list[str]) -> int:
    """`out=PATH count=2000 worlds=256 seed=0 sizes=[0.045,0.06]`, and any setting of task=rotate."""
    import yaml

    from dexsim.cli import start
    from dexsim.cli.build import quiet_warp

    if any(a in ("-h", "--help", "help") for a in argv):
        print(f"{__doc__}\nSettings: {main.__doc__}")
        return 0
    own = {"out": str(DEFAULT), "count": 2000, "worlds": 256, "seed": 0, "sizes": [0.045, 0.06]}
    rest = []
    for text in argv:
        key, eq, value = text.partition("=")
        if eq and key in own:
            own[key] = yaml.safe_load(value)
        else:
            rest.append(text)
    sizes = own["sizes"]
    if not (isinstance(sizes, list) and len(sizes) == 2 and 0.02 <= sizes[0] <= sizes[1] <= 0.1):
        raise UserError(f"sizes={sizes}: must be [low, high] edges within [0.02, 0.1] m")
    for key in ("count", "worlds"):
        if not (isinstance(own[key], int) and own[key] >= 1):
            raise UserError(f"{key}={own[key]}: must be a whole number from 1 up")
    configs = Path(__file__).parents[2] / "configs"
    begun = start.for_train(["task=rotate", "device=cpu", f"worlds={own['worlds']}", *rest], configs)
    if begun is None:
        return 0
    torch.set_num_threads(1)
    quiet_warp("cpu")
    grasps = generate(begun.cfg, own["count"], own["worlds"], own["seed"], tuple(sizes))
    grasps.save(Path(str(own["out"])).expanduser())
    print(f"{len(grasps)} held poses, cubes of {1000 * grasps.edge.min():.0f}-{1000 * grasps.edge.max():.0f} mm: {own['out']}")
    return 0


if __name__ == "__main__":
    from dexsim.cli.ending import guard

    sys.exit(guard(main, sys.argv[1:]))
