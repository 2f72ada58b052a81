"""A fingertip's contact is a spring: its stiffness holds over mass, load and posture, on both engines."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from worlds import grasp_env

from tools.assets import xhand

N = 12
FINGER = 2  # middle
DRAG = 30.0  # N.s/m on the object, so that it stays where it was put


def _press(env, seed: int) -> dict[str, torch.Tensor]:
    """Return the objects of 30 to 500 g pressed on the middle fingertip, along its pad's normal, by weight and 0 to 4 N
    more, until at rest; the hand is locked in random postures. Friction of 2 makes contacts stick (they creep, as
    MuJoCo's friction does)."""
    g = torch.Generator().manual_seed(seed)

    def u(low, high, *shape):
        return low + (high - low) * torch.rand(N, *shape, generator=g)

    e, o = env.engine, env.objects
    names = [v.shape.name for v in env.objects.scene.variants]
    rows = torch.tensor([names.index(s) for s in ("sphere", "box", "rock", "egg")])[torch.arange(N) % 4]
    mass = torch.tensor(np.geomspace(0.03, 0.5, N)[torch.randperm(N, generator=g).numpy()], dtype=torch.float32)
    k = u(4000, 9000)
    o.write(
        torch.ones(N, dtype=torch.bool),
        rows,
        torch.full((N, 3), 1.2),
        mass,
        torch.zeros(N, 3),
        torch.full((N,), 2.0),
        k,
        torch.ones(N),
    )
    env.touch.shape_id.copy_(o.variant.to(torch.int32))
    env.touch.shape_size.copy_(o.size)
    hand = torch.zeros(N, 12)
    hand[:, [6, 7]] = u(0.0, 0.5, 2)
    hand[:, [4, 5, 8, 9, 10, 11]] = -0.1 + u(0.0, 0.1, 6)  # the neighbours lower
    hand = torch.maximum(torch.minimum(hand, env.q_high), env.q_low)
    pose = torch.zeros(N, 7)
    pose[:, 2], pose[:, 3] = 1.0, 1.0
    everyone = torch.ones(N, dtype=torch.bool)
    env.place(everyone, hand, pose, torch.zeros(N, 6))
    e.refresh()
    body = e.body(xhand.TIP_BODIES[FINGER])
    rot, at = e.t.xmat[:, body].float(), e.t.xpos[:, body].float()
    normal = rot[:, :, 0]  # a finger's pad faces +x of its link
    pad = at + (rot @ env.pad_centre[FINGER][None, :, None])[..., 0]
    pose[:, :3] = pad + normal * (o.radius + 0.002)[:, None]
    env.place(everyone, hand, pose, torch.zeros(N, 6))
    e.field("dof_armature")[:, :12] = 1e4
    e.field("dof_damping")[:, 12:15] = DRAG
    e.field("body_inertia")[:, o.body] *= 1e6  # turns too slowly to matter
    more = u(0.0, 4.0)
    e.field("opt.gravity").copy_(-9.81 * normal.to(e.t.qpos.dtype))
    e.t.xfrc_applied[:, o.body, :3] = -(more[:, None] * normal).to(e.t.qpos.dtype)
    for _ in range(60):
        e.step(10, None, env.touch.launch)
    return {"k": k, "mass": mass, "load": (mass * 9.81 + more)[:, None] * normal}


def _depth(env, w: int, twin) -> float:
    """Return the depth [m] of world w's contact of tip and object, by C MuJoCo's collision of the same state."""
    m = twin.engine.batch.get_model(w)
    d = mujoco.MjData(m)
    d.qpos[:] = env.engine.t.qpos[w]
    mujoco.mj_forward(m, d)
    tip = env.engine.geom(xhand.TIP_GEOMS[FINGER])
    found = [c.includemargin - c.dist for c in d.contact if tip in c.geom.tolist()]
    assert len(found) == 1, "one contact a tip and convex part, or stiffnesses would add"
    return found[0]


@pytest.fixture(scope="module")
def twin():
    return grasp_env(worlds=N)


@pytest.mark.parametrize("kind", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("seed", [0, 1])
def test_stiffness_holds_over_mass_load_and_posture(kind, seed, twin):
    env = twin if kind == "mujoco" else _warp()
    given = _press(env, seed)
    if env is not twin:
        for f in env.engine.field_names:
            twin.engine.field(f).copy_(env.engine.field(f).reshape(twin.engine.field(f).shape))
        twin.engine.field("body_invweight0").copy_(env.engine.field("body_invweight0"))
    e = env.engine
    v = e.t.qvel[:, 12:15].float()  # a tilted contact creeps sideways, against the scene's own damping
    assert float(v.norm(dim=1).max()) < 8e-3, v
    normal = e.t.pair_normal[:, FINGER]
    depth = torch.tensor([_depth(env, w, twin) for w in range(N)])
    assert float(depth.min()) > 3e-5 and float(depth.max()) > 6e-4
    ratio = normal / (given["k"] * depth)
    assert torch.allclose(ratio, torch.ones(N), atol=0.02), ratio
    # the tip carries all of it: the force on the tip is the load, and touch says so
    carried = e.t.pair_force[:, FINGER] + given["load"] + DRAG * v
    assert torch.allclose(e.t.pair_normal[:, 5 + FINGER], normal, rtol=1e-3), "nothing but the tip touches"
    assert bool((carried.norm(dim=1) < 0.01 * given["load"].norm(dim=1)).all()), carried
    measured = env.touch.force_clean[:, FINGER]
    assert torch.allclose(measured, normal, rtol=1e-3)
    aligned = normal / given["load"].norm(dim=1)  # friction holds the rest where the contact's normal is not the pad's
    assert float(aligned.max()) < 1.01 and float(aligned.median()) > 0.9
    lit = [f for f in range(5) if f != FINGER]
    assert not env.touch.force_clean[:, lit].any()


_held: dict = {}


def _warp():
    if "warp" not in _held:
        _held["warp"] = grasp_env(worlds=N, engine="warp")
    return _held["warp"]
