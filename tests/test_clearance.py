"""Distance from the pads to the object: against the geometry itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dexsim.assets.objects import library
from dexsim.cli import start
from dexsim.paths import CONFIGS
from dexsim.tasks import make_env


@pytest.fixture(scope="module")
def env():
    torch.set_num_threads(1)
    cfg = start.for_train(
        ["task=grasp", "worlds=12", "device=cpu", "task.objects.train=[box,sphere,rock]"], CONFIGS
    ).cfg
    return make_env(cfg, 12, "cpu", 0, "mujoco")


def test_distance_is_that_of_the_pad_centre_to_the_surface(env):
    zero = torch.zeros(12, 12)
    for _ in range(15):
        env.step(zero)
    env.feel()
    layout = env.touch.layout
    for w in range(12):
        pos, mat = env.engine.t.xpos[w].double().numpy(), env.engine.t.xmat[w].double().numpy()
        o = env.objects.body
        shape = env.objects.scene.variants[int(env.objects.variant[w])].shape
        size = env.touch.shape_size[w].double().numpy()
        for f in range(5):
            b = env.engine.body(layout.bodies[f])
            q = mat[o].T @ (pos[b] + mat[b] @ layout.centre()[f] - pos[o])
            got = float(env.clearance.distance[w, f])
            if shape.kind == "sphere":
                assert got == pytest.approx(np.linalg.norm(q) - size[0], abs=2e-6)
            elif shape.kind == "box":
                out = np.maximum(np.abs(q) - size, 0)
                assert got == pytest.approx(np.linalg.norm(out) + min(np.max(np.abs(q) - size), 0), abs=2e-6)
            else:  # outside its grid the distance is a lower bound of the true one, close to it
                corners = size[0] * np.concatenate(library()[shape.name].hulls)
                assert 0.8 * (np.linalg.norm(q) - np.linalg.norm(corners, axis=1).max()) <= got
                assert got <= np.linalg.norm(corners - q, axis=1).min() + 1e-3


def test_reach_pays_for_near_pads_only(env):
    env.feel()
    keep = env.clearance.distance.clone()
    env.clearance.distance.fill_(0.0)
    near = env.rewards()["reach"]
    env.clearance.distance.fill_(1.0)
    far = env.rewards()["reach"]
    env.clearance.distance.copy_(keep)
    weight = env.task["rewards"]["reach"]
    assert torch.allclose(near, torch.full_like(near, weight)) and bool((far < 1e-6).all())


def test_emphasis_counts_in_training_and_not_elsewhere(env):
    rows, weight = env.train_rows, env.emphasis
    assert float(weight[rows].max()) == 1.5  # box
    env.draw_from(rows)
    even = env._chances.diff(prepend=torch.zeros(1))
    names = [env.objects.scene.variants[int(i)].shape.name for i in rows]
    share = {n: sum(float(p) for p, m in zip(even, names, strict=True) if m == n) for n in set(names)}
    assert all(abs(v - 1 / 3) < 1e-6 for v in share.values())
    env.draw_from(rows, env.emphasis)
    now = env._chances.diff(prepend=torch.zeros(1))
    box = sum(float(p) for p, m in zip(now, names, strict=True) if m == "box")
    assert box == pytest.approx(1.5 / 3.5, abs=1e-6)
