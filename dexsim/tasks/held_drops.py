"""Where objects are let fall into a hand: drops about a place, and the place around which most are held."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from dexsim.tasks.grasp import GraspEnv

AROUND = 0.016  # m, standard deviation of what counts as around a place, of a hand of UNIT_SPAN: objects fall 24 apart
COMMAND = (0.2, 1.0)  # of the force: below, nothing need be held
CATCH, TURN, STAY = 2.0, 1.0, 0.5  # s, to catch and hold, to be turned upside down, to be held so
RATE, WAIT = 0.5, 0.35  # of the largest action, s: how fast the policies close, and how long they wait for the object
FINE = 0.002  # m, between the places that are compared


Policy = Callable[[Mapping], torch.Tensor]


@dataclass(frozen=True)
class Drops:
    """Of K drops. place [K, 2] m, palm frame, over it the object was let fall; held [K] whether it was held."""

    place: np.ndarray
    held: np.ndarray

    def best(self, unit: float, start: np.ndarray) -> np.ndarray:
        """Return the place [2] m around which the largest share was held: of several that differ by less than its
        standard error, the nearest to `start` [2] m.

        Shares are means over the drops weighted by a Gaussian of AROUND times unit, in which one more that fell speaks
        against every place, so that few drops say little; their standard error sqrt(p (1 - p) sum(w^2)) / sum(w).
        """
        low, high = self.place.min(0), self.place.max(0)
        axes = (np.arange(a, b + FINE, FINE) for a, b in zip(low, high, strict=True))
        places = np.vstack([start, np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)])
        squared = ((places[:, None] - self.place) ** 2).sum(2)
        weight = np.exp(-squared / (2 * (unit * AROUND) ** 2))
        total = weight.sum(1) + 1.0
        share = weight @ self.held / total
        top = share.argmax()
        error = np.sqrt(share[top] * (1 - share[top]) * (weight[top] ** 2).sum()) / total[top]
        alike = np.flatnonzero(share >= share[top] - error)
        return places[alike[((places[alike] - start) ** 2).sum(1).argmin()]]

    def __add__(self, more: Drops) -> Drops:
        """Return both together."""
        return Drops(np.vstack([self.place, more.place]), np.append(self.held, more.held))


def scattered(centre: np.ndarray, half: float, count: int, seed: int) -> torch.Tensor:
    """Places [count, 2] m, spread evenly over a square about `centre` [2] m, `half` m to each side (Sobol's sequence,
    scrambled by seed)."""
    share = torch.quasirandom.SobolEngine(2, scramble=True, seed=seed).draw(count)
    return torch.as_tensor(centre, dtype=torch.float32) + half * (2 * share - 1)


def cupping(env: GraspEnv) -> Policy:
    """Return a policy without learning: every joint goes from the open pose to the cupped one and as far again, until
    its torque reaches 0.1 + 0.6 F_cmd of its maximum. What `GraspEnv.scripted_policy` turns thumb and fingers straight
    at each other for, this does as the hand's maker, or the import, means it to close."""
    opened, cupped = (torch.as_tensor(env.hand.pose(name), dtype=torch.float32) for name in ("open", "cupped"))
    goal = torch.maximum(torch.minimum(2 * cupped - opened, env.q_high), env.q_low)
    scale = env.task["action"]["scale"]

    def policy(obs: Mapping) -> torch.Tensor:
        light = (env.torque / env.effort).abs() < (0.1 + 0.6 * env.command)[:, None]
        late = env.episode_length_buf * env.dt >= WAIT
        return ((goal - env.target) / scale).clamp(-RATE, RATE) * (light & late[:, None])

    return policy


def drop(env: GraspEnv, place: torch.Tensor) -> Drops:
    """Let objects fall over places [K, 2] m (K a multiple of the worlds of `env`), have them caught and pressed, in
    half of the worlds by `GraspEnv.scripted_policy`, in half by `cupping`, and turn the hand upside down about a random
    axis of its palm. Held is what an opposing finger and another touch at the end."""
    n, dt = env.num_envs, env.dt
    length, env.max_episode_length = env.max_episode_length, 10**9
    env.pushes = False
    down, everywhere = torch.tensor([0.0, 0.0, -1.0]).expand(n, 3), torch.ones(n, dtype=torch.bool)
    first = (torch.arange(n) < n // 2)[:, None]
    held = []
    for over in place.split(n):
        low, high = COMMAND
        env.fixed_command = low + (high - low) * torch.rand(n, generator=env.rng)
        angle = 2 * torch.pi * torch.rand(n, generator=env.rng)
        aside = torch.stack([angle.cos(), angle.sin(), torch.zeros(n)], 1)  # to which gravity turns
        one, other = env.scripted_policy(RATE, WAIT), cupping(env)
        env.reset_all()
        env.begun.pose[:, :2] = over
        env.first_xy.copy_(over)
        env.place(everywhere, env.begun.hand, env.begun.pose, env.begun.velocity)
        env.engine.refresh()
        env.read_state()
        obs, alive = env.get_observations(), everywhere.clone()
        for k in range(int(round((CATCH + TURN + STAY) / dt))):
            turned = math.pi * min(max((k * dt - CATCH) / TURN, 0.0), 1.0)
            env.engine.field("opt.gravity").copy_(9.81 * (math.cos(turned) * down + math.sin(turned) * aside))
            obs, _, done, _ = env.step(torch.where(first, one(obs), other(obs)))
            alive &= ~done.bool()
        touches = env.finger_force > 0
        held.append((alive & touches[:, env.opposing].any(1) & touches[:, env.others].any(1)).numpy())
    env.fixed_command, env.pushes, env.max_episode_length = None, True, length
    return Drops(place.double().numpy(), np.concatenate(held))
