"""Is the thumb's force in a grasp free, or given by what the other fingers press?

    python -m benchmarks.thumb [checkpoint=checkpoints/grasp.pt] [episodes=256] [worlds=64] [out=out/thumb.json]
        [any other setting of play.py]

Grasps of a policy, palm up, without pushes, on C MuJoCo. Each held for `CALM` seconds before `AT` gives
  correlations   of the thumb's force with the command and with what the other tips, the links and the palm press
  range          the least and the largest force of the thumb's tip with which the object stays at rest at the contacts
                 that it has, every other tip pressing what it does: a linear program over forces in the contacts'
                 friction cones (8 edges), once with links and palm as they may, once without them
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from scipy.optimize import linprog

from benchmarks import tools
from dexsim.cli import build
from dexsim.cli import start as start_up
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy
from dexsim.paths import CONFIGS
from dexsim.sim.scene import OBJECT_FIELDS

OWN = {"checkpoint": "checkpoints/grasp.pt", "episodes": "256", "worlds": "64", "seed": "2121", "out": "out/thumb.json"}
AT, CALM = 6.0, 1.0  # s
EDGES = 8
MOST = 40.0  # N, along one edge of a cone
NEAR = 0.030  # m the object may have moved in `CALM`


def cone(frame: np.ndarray, friction: float) -> np.ndarray:
    """Edges [EDGES, 3] of a contact's friction pyramid, each with a normal part of 1. frame [3, 3]: normal first."""
    angle = 2 * np.pi * np.arange(EDGES) / EDGES
    return frame[0] + friction * (np.cos(angle)[:, None] * frame[1] + np.sin(angle)[:, None] * frame[2])


def posed(env: Any, world: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A world's model and its state, contacts found."""
    model = copy.copy(env.engine.mjm)
    for name in OBJECT_FIELDS:
        if name.startswith("opt."):
            continue  # the palm looks up: gravity is the model's
        into = getattr(model, name)
        into[:] = env.engine.field(name)[world].cpu().numpy().reshape(into.shape)
    data = mujoco.MjData(model)
    data.qpos[:] = env.engine.t.qpos[world].double().cpu().numpy()
    mujoco.mj_fwdPosition(model, data)
    return model, data


def contacts(env: Any, model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[int | str, np.ndarray]]:
    """By contact: the tip's finger, or "rest"; wrench [EDGES, 6] of each edge on the object about its centre."""
    tips = {model.geom(g).id: k for k, g in enumerate(env.hand.tip_geoms)}
    found: list[tuple[int | str, np.ndarray]] = []
    for c in data.contact[: data.ncon]:
        of = [model.geom_bodyid[g] == env.objects.body for g in c.geom]
        if sum(of) != 1 or c.efc_address < 0:  # too far apart to press
            continue
        frame = c.frame.reshape(3, 3).copy()
        if of[0]:  # the normal points from the first geom to the second
            frame[0] *= -1
        edges = cone(frame, float(c.friction[0]))
        arm = c.pos - data.xipos[env.objects.body]
        found.append((tips.get(int(c.geom[0 if of[1] else 1]), "rest"), np.hstack([edges, np.cross(arm, edges)])))
    return found


def span(found: list, weight: float, pressed: dict[int, float], thumb: int, rest: bool) -> tuple[float, float] | None:
    """Least and largest normal force [N] of the thumb's tip at rest under a weight [N], the other tips pressing
    `pressed`; None where there is none. rest: links and palm may press."""
    used = [(k, w) for k, w in found if rest or k != "rest"]
    if not any(k == thumb for k, _ in used):
        return None
    wrench = np.concatenate([w for _, w in used])
    owner = np.repeat(np.array([str(k) for k, _ in used]), EDGES)
    length = 0.04  # m, so that moments weigh as forces
    scaled = wrench.T / np.array([1, 1, 1, length, length, length])[:, None]
    rows, right = [*scaled], [0.0, 0.0, weight, 0.0, 0.0, 0.0]
    for k, force in pressed.items():
        if not (owner == str(k)).any():
            return None
        rows.append((owner == str(k)).astype(float))
        right.append(force)
    cost = (owner == str(thumb)).astype(float)
    ends = []
    for sign in (1.0, -1.0):
        # the state is nearly at rest: a tenth of a newton is left to the solver's
        slack = np.full(len(rows), 0.1)
        a = np.array(rows)
        done = linprog(sign * cost, A_ub=np.vstack([a, -a]), b_ub=np.concatenate([right + slack, slack - right]),
                       bounds=(0, MOST))  # fmt: skip
        if not done.success:
            return None
        ends.append(float(cost @ done.x))
    return ends[0], ends[1]


@torch.inference_mode()
def play(env: Any, policy: Any, episodes: int, seed: int) -> list[dict]:
    """What each held grasp presses, and the thumb's range."""
    env.graphs = False
    env.rng.manual_seed(seed)
    env.draw_from(env.train_rows)
    env.pushes, env.max_episode_length = False, int((AT + 2) / env.dt)
    out: list[dict] = []
    done, steps, dev = 0, int(AT / env.dt), env.device
    thumb, others = int(env.hand.opposing[0]), [int(k) for k in env.hand.others]
    while done < episodes:
        env.fixed_command = torch.rand(env.num_envs, generator=env.rng, device=dev)
        env.reset_all()
        obs = env.get_observations()
        alive = torch.ones(env.num_envs, dtype=torch.bool, device=dev)
        sums = {k: 0.0 for k in ("tip", "finger", "palm")}
        count = 0
        for step in range(steps):
            obs, _, ended, _ = env.step(policy(obs))
            alive &= ~ended.bool()
            if step == steps - int(CALM / env.dt):
                place = env.object_pose[:, :3].clone()
            if step >= steps - int(CALM / env.dt):
                sums["tip"] = sums["tip"] + env.tip_force
                sums["finger"] = sums["finger"] + env.finger_force
                sums["palm"] = sums["palm"] + env.palm_force
                alive &= (env.finger_force[:, env.opposing] > 0).any(1) & (env.finger_force[:, env.others] > 0).any(1)
                count += 1
        alive &= (env.object_pose[:, :3] - place).norm(dim=1) < NEAR
        tip, finger, palm = (sums[k] / count for k in ("tip", "finger", "palm"))
        for w in torch.nonzero(alive).flatten().tolist():
            model, data = posed(env, w)
            found = contacts(env, model, data)
            now = env.tip_force[w].tolist()
            pressed = {k: now[k] for k in others if now[k] > 0.1}
            weight = 9.81 * float(env.objects.mass[w])
            out.append({
                "command": float(env.fixed_command[w]), "thumb": float(tip[w, thumb]),
                "others": float(tip[w, others].sum()), "links": float((finger[w] - tip[w]).sum()),
                "palm": float(palm[w]), "thumb_now": now[thumb], "others_now": float(sum(now[k] for k in others)),
                "whole": span(found, weight, pressed, thumb, True),
                "tips_alone": span(found, weight, pressed, thumb, False),
            })  # fmt: skip
        done += env.num_envs
        print(f"{done} episodes, {len(out)} held", flush=True)
    return out


def summary(rows: list[dict], f_max: float) -> dict:
    """Correlations and the thumb's ranges of all held grasps; `possible`: share in which there is a range; `free`: of
    those, share in which it reaches from 1 N to F_max [N]."""
    if len(rows) < 3:
        raise UserError(f"{len(rows)} grasps held: too few to say anything; more episodes=")
    x = {k: np.array([r[k] for r in rows]) for k in ("command", "thumb", "others", "links", "palm")}
    out: dict[str, Any] = {"held": len(rows), "thumb_N": np.percentile(x["thumb"], [5, 50, 95]).tolist()}
    out["correlation"] = {k: float(np.corrcoef(x["thumb"], v)[0, 1]) for k, v in x.items() if k != "thumb"}
    pressing = [r for r in rows if r["thumb_now"] > 0.1]
    out["thumb_presses"] = len(pressing) / len(rows)
    for name in ("whole", "tips_alone"):
        found = np.array([r[name] for r in pressing if r[name] is not None])
        out[name] = {
            "possible": len(found) / max(len(pressing), 1),
            "least_N": np.percentile(found[:, 0], [5, 50, 95]).tolist() if len(found) else None,
            "largest_N": np.percentile(found[:, 1], [5, 50, 95]).tolist() if len(found) else None,
        }
        out[name]["free"] = float(np.mean((found[:, 0] <= 1.0) & (found[:, 1] >= f_max))) if len(found) else None
    return out


def main(argv: list[str]) -> None:
    own, extra = tools.split(argv, OWN)
    worlds, episodes, seed = (tools.numbers(own[k], k)[0] for k in ("worlds", "episodes", "seed"))
    path = own["checkpoint"]
    begun = start_up.for_play(
        [f"checkpoint={path}", "device=cpu", f"worlds={worlds}", f"seed={seed}", "video=false", *extra], CONFIGS
    )
    env = build.build_env(begun.cfg, None, {})
    policy = load_policy(checkpoint.load(path), env, path)
    rows = play(env, policy, episodes, seed)
    found = summary(rows, env.f_max)
    out = Path(own["out"]).expanduser()
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps({"summary": found, "grasps": rows}, indent=1))
    print(json.dumps(found, indent=1))
    build.close(env)


if __name__ == "__main__":
    tools.command(main, __doc__)
