"""Evaluation of the grasp task: does the hand hold, under pushes and upside down, and does it press as commanded?

One episode (seconds): the object is dropped at 0; at `SETTLE` its place in the palm frame is noted; for `HOLD` seconds
it must stay within `RADIUS` of that place, touched at every control step by an opposing finger and another. In every
second episode a push of twice the object's weight acts for half a second within the hold, in a random direction. Then
the hand is turned by 90 and by 180 degrees about a random axis of the palm plane: gravity turns in the palm frame,
slowly enough that the turn itself adds nothing. With task.evaluation.base=lift the hand is lifted and then shaken
instead, the palm up, with a .csv file it is carried along a path (`tasks/base_path.py`).

The command is constant in an episode, uniform in [0, 1] over episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dexsim import intervals
from dexsim.errors import UserError
from dexsim.hand.places import approach
from dexsim.tasks import base_path, observations
from dexsim.tasks.evaluation import Film, batches

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from dexsim.tasks.grasp import GraspEnv

Policy = Callable[..., torch.Tensor]  # a TensorDict of observations -> actions [N, J]
Progress = Callable[[int, int, str], object]  # episodes done, of how many, what is played

SETTLE, HOLD, RADIUS = 2.0, 5.0, 0.030  # s, s, m of a hand of UNIT_SPAN
PUSH_WEIGHTS, PUSH_S = 2.0, 0.5
TURN_S, STAY_S = 0.75, 1.0  # together base_path.STAGES
BINS = 10
SHARE_S = 0.5  # s before the hold, over which it is measured what carries the object
SHARES = 5
RESAMPLES = 1000  # of the bootstrap


@torch.inference_mode()
def evaluate(env: GraspEnv, policy: Policy, episodes: int, seed: int, progress: Progress | None = None) -> dict:
    """Play `episodes` episodes, `env.num_envs` at a time, half as many again on shapes that were never trained on.

    policy: TensorDict of observations -> actions [N, J]. Returns {"metrics", "tables", "frames", "plots"}.
    """
    ahead, env.draws_ahead = env.draws_ahead, False
    env.rng.manual_seed(seed)
    torch.manual_seed(seed)
    trained = _play_all(env, policy, episodes, env.train_rows, progress, "trained shapes")
    held_out = _play_all(env, policy, max(episodes // 2, 1), env.held_rows, progress, "kept-out shapes")
    env.draws_ahead = ahead
    metrics = _metrics(trained, held_out, env)
    metrics["hold_rate_by_object"] = _by_object(trained, env) | _by_object(held_out, env)
    metrics["by_fingertip_share"] = by_share(trained)
    plots = [("force_command", partial(_force_plot, r=trained, env=env)),
             ("hold_by_command", partial(_hold_plot, r=trained))]  # fmt: skip
    return {
        "metrics": metrics,
        "tables": [*_papers_columns(metrics), *_tables(trained, held_out, env)],
        "frames": trained["frames"],
        "plots": plots,
    }


def _play_all(
    env: GraspEnv, policy: Policy, episodes: int, rows: torch.Tensor, progress: Progress | None, label: str
) -> dict:
    rows_before = (env._rows, env._chances)
    env.draw_from(rows)
    found, frames = batches(lambda k: _play(env, policy, not k, progress, label, k, episodes), env.num_envs, episodes)
    env._rows, env._chances = rows_before
    return found | {"frames": frames}


def _play(
    env: GraspEnv, policy: Policy, keep_frames: bool, progress: Progress | None, label: str, done: int, episodes: int
) -> tuple[dict, dict | None]:
    """Return one episode in every world, and its frames."""
    n, dev, dt, base = env.num_envs, env.device, env.dt, _base(env)
    steps = int(round((SETTLE + HOLD + sum(base.stages)) / dt))
    training_length, env.max_episode_length = env.max_episode_length, steps + 2
    env.pushes = False
    env.fixed_command = torch.rand(n, generator=env.rng, device=dev)
    if env.thumb_range is not None:
        low, high = env.thumb_range
        env.fixed_thumb = low + (high - low) * torch.rand(n, generator=env.rng, device=dev)
    env.forget_recorded()  # commands, pushes and objects are not those that a recording holds
    env.reset_all()
    obs = env.get_observations()
    pushed = torch.arange(n, device=dev) % 2 == 0
    direction = env.sampler.direction()
    push_at = SETTLE + 0.5 + (HOLD - 1.0 - PUSH_S) * env.sampler.uniform()
    angle = 2 * torch.pi * env.sampler.uniform()
    axis = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)  # in the palm plane
    down = torch.tensor([0.0, 0.0, -1.0], device=dev).expand(n, 3)
    command, mass, friction, shape = (
        x.clone() for x in (env.fixed_command, env.objects.mass, env.objects.friction, env.objects.variant)
    )
    thumb_command = env.thumb_command.clone()
    alive = torch.ones(n, dtype=torch.bool, device=dev)
    held, held90, held180 = (torch.zeros(n, dtype=torch.bool, device=dev) for _ in range(3))
    place = torch.zeros(n, 3, device=dev)
    by_tips, by_all = torch.zeros(n, device=dev), torch.zeros(n, device=dev)  # forces that press on the object
    moved, untouched = torch.zeros_like(alive), torch.zeros_like(alive)  # what went wrong within the hold
    force, torque, samples = torch.zeros_like(env.tip_force), torch.zeros_like(env.torque), torch.zeros(n, device=dev)
    shot = Film(env, steps * dt if keep_frames else 0.0)
    push_force = (PUSH_WEIGHTS * 9.81 * mass)[:, None] * direction
    # |m (g + a_push)|, the push where it is drawn to act: what the fingers must carry
    load = (9.81 * mass[:, None] * down + push_force * pushed[:, None]).norm(dim=1)
    for k in range(steps):
        t = k * dt
        pushing = pushed & (t >= push_at) & (t < push_at + PUSH_S)
        env.outside_force.copy_(torch.where(pushing[:, None], push_force, torch.zeros_like(push_force)))
        turned = 9.81 * _turned(down, axis, _angle(t))
        env.engine.field("opt.gravity").copy_(turned if base.gravity is None else _carried(base, down, t))
        obs, _, dones, _ = env.step(policy(obs))
        alive &= ~dones.bool()
        p = env.object_pose[:, :3]
        if k == int(round(SETTLE / dt)):
            place.copy_(p)
            held = alive.clone()
        if SETTLE - SHARE_S < t <= SETTLE:
            by_tips += env.tip_force.sum(1)
            by_all += env.finger_force.sum(1) + env.palm_force
        if t > SETTLE:
            touches = env.finger_force > 0
            touched = touches[:, env.opposing].any(1) & touches[:, env.others].any(1)
            near = (p - place).norm(dim=1) <= env.unit * RADIUS
            good = alive & touched & near
            if t <= SETTLE + HOLD:
                held &= good
                moved |= alive & ~near
                untouched |= alive & ~touched
                calm = (~pushing).float()
                force += env.tip_force * calm[:, None]
                torque += env.torque * calm[:, None]
                samples += calm
            else:
                # turned: still near the place it settled in
                if k == int(round((SETTLE + HOLD) / dt)) + 1:
                    held90, held180 = held.clone(), held.clone()
                if t <= SETTLE + HOLD + base.stages[0]:
                    held90 &= good
                held180 &= good
        shot.add(force=env.tip_force, push=env.outside_force, gravity=env.engine.field("opt.gravity"))
        if progress is not None and k % 10 == 0:
            progress(done + min(n, episodes - done) * k // steps, episodes, f"{label}, {t:.1f} s")
    env.outside_force.zero_()
    env.fixed_command, env.fixed_thumb, env.pushes, env.max_episode_length = None, None, True, training_length
    env.forget_recorded()
    samples = samples.clamp(min=1)
    out = {
        "command": command, "mass": mass, "friction": friction, "shape": shape, "pushed": pushed, "held": held,
        "held90": held90,
        "held180": held180, "load": load, "force": force / samples[:, None], "torque": torque / samples[:, None],
        "thumb_command": thumb_command,
        "alive": alive, "moved": moved, "untouched": untouched, "tips": by_tips / by_all.clamp(min=1e-6),
    }  # fmt: skip
    out = {k: v.cpu().numpy() for k, v in out.items()}
    frames = shot.frames(full=1.2 * env.f_max)
    if frames is not None:
        names = _objects(out, env)
        frames["label"] = [f"{name}, {1000 * m:.0f} g, friction {mu:.1f}" for name, m, mu in
                           zip(names, out["mass"], out["friction"], strict=True)][: len(shot.worlds)]  # fmt: skip
        for row, command in zip(frames["overlay"], env.commanded_force().cpu().numpy(), strict=False):
            row["command"] = np.broadcast_to(command, (steps, len(command)))
    return out, frames


def _angle(t: float) -> float:
    """Return angle [rad] by which the hand is turned at time t."""
    first = SETTLE + HOLD
    second = first + TURN_S + STAY_S
    return np.pi / 2 * (np.clip((t - first) / TURN_S, 0, 1) + np.clip((t - second) / TURN_S, 0, 1))


def _base(env: GraspEnv) -> base_path.Base:
    """Return what the base goes through after the hold; checkpoints from before cannot say."""
    return base_path.of((env.task.get("evaluation") or {}).get("base", "turn"))


def _carried(base: base_path.Base, down: torch.Tensor, t: float) -> torch.Tensor:
    """Return gravity [N, 3] m/s2 of a hand whose base moves after the hold."""
    assert base.gravity is not None  # it is turned instead
    g = base.gravity(t - SETTLE - HOLD) if t > SETTLE + HOLD else base_path.GRAVITY
    return torch.as_tensor(g, dtype=down.dtype, device=down.device).expand_as(down)


def _turned(v: torch.Tensor, axis: torch.Tensor, angle: float) -> torch.Tensor:
    """Return v [N, 3] rotated about unit axes [N, 3] (Rodrigues)."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return v * c + torch.linalg.cross(axis, v) * s + axis * (axis * v).sum(1, keepdim=True) * (1 - c)


def must_hold(r: dict, f_max: float, fingers: int) -> np.ndarray:
    """Return episodes [E] whose commanded forces can carry the load: sum_i F_cmd F_max >= 2 |m (g + a_push)| / mu,
    summed over the fingers beside the opposing one, a_push in its drawn direction (zero in episodes without a push)."""
    return fingers * r["command"] * f_max >= 2 * r["load"] / r["friction"]


def can_carry(r: dict, f_max: float, fingers: int) -> np.ndarray:
    """Return episodes [E] whose commanded forces can carry the object's weight alone: sum_i F_cmd F_max >= 2 m g /
    mu."""
    return fingers * r["command"] * f_max >= 2 * r["mass"] * 9.81 / r["friction"]


def _rate(ok: np.ndarray, among: np.ndarray) -> float | None:
    return float(ok[among].mean()) if among.any() else None


def _corr(a: np.ndarray, b: np.ndarray) -> float | None:
    return float(np.corrcoef(a, b)[0, 1]) if len(a) > 2 and a.std() > 1e-9 and b.std() > 1e-9 else None


def _metrics(r: dict, k: dict, env: GraspEnv) -> dict:
    f_max, others = env.f_max, list(env.hand.others)
    n = len(others)
    able, able_k = must_hold(r, f_max, n), must_hold(k, f_max, n)
    pushed, firm = r["pushed"].astype(bool), r["command"] >= 0.1
    carried = can_carry(r, f_max, n)
    held = r["held"].astype(bool)
    total, torque = _of(r["force"], others).sum(1), _flexing(r, env)
    rates = {
        "hold_rate": (r, ~pushed & firm), "hold_rate_pushed": (r, pushed & able),
        "hold_rate_kept_out_shapes": (k, k["pushed"].astype(bool) & able_k),
        "hold_rate_kept_out_shapes_unpushed": (k, ~k["pushed"].astype(bool) & (k["command"] >= 0.1)),
    }  # fmt: skip
    out: dict[str, Any] = {
        "episodes": int(len(held)), "episodes_kept_out": int(len(k["held"])),
        **{name: _rate(part["held"], among) for name, (part, among) in rates.items()},
        "hold_rate_all": float(held.mean()),
        **dict(zip(_base(env).held, (_rate(r["held90"], carried), _rate(r["held180"], carried)), strict=True)),
        "force_command_correlation": _corr(r["command"][held], total[held]),
        "force_max_N": float(f_max),
        # why episodes were not held: they overlap; dropped includes the turned part
        "share_moved": float(r["moved"].mean()), "share_untouched": float(r["untouched"].mean()),
        "share_dropped": float(1 - r["alive"].mean()),
    }  # fmt: skip
    for i, name in enumerate(env.hand.finger_names):
        out[f"force_command_correlation_{name}"] = _corr(r["command"][held], r["force"][held, i])
    if env.thumb_range is not None and held.any():
        own, pressed = r["thumb_command"][held], r["force"][held][:, list(env.hand.opposing)].mean(1)
        out["thumb_own_command_correlation"] = _corr(own, pressed)
        out["thumb_own_command_error_N"] = float(np.abs(pressed - own * f_max).mean())
    if held.sum() > 2:
        slope, offset = np.polyfit(r["command"][held] * n * f_max, total[held], 1)
        out["force_slope"], out["force_offset_N"] = float(slope), float(offset)
        out["force_error_N"] = float(np.abs(_of(r["force"][held], others) - r["command"][held, None] * f_max).mean())
        out["contact_force_range_N"] = [float(x) for x in np.percentile(r["force"][held].sum(1), [5, 95])]
        out["joint_torque_range_Nm"] = [float(x) for x in np.percentile(torque[held].mean(1), [5, 95])]
        out["torque_command_correlation"] = _corr(r["command"][held], torque[held].sum(1))
        out["by_command"] = _by_command(r, held, torque)
        out["force_command_correlation_interval"] = _corr_interval(r["command"][held], total[held])
        out["torque_command_correlation_interval"] = _corr_interval(r["command"][held], torque[held].sum(1))
    return out | {f"{name}_interval": _rate_interval(part["held"], among) for name, (part, among) in rates.items()}


def _rate_interval(ok: np.ndarray, among: np.ndarray) -> list[float] | None:
    """Return 95 % of `_rate` (Wilson's)."""
    return list(intervals.share(int(ok[among].sum()), int(among.sum()))) if among.any() else None


def _corr_interval(a: np.ndarray, b: np.ndarray) -> list[float] | None:
    """Return 95 % bootstrap over episodes of `_corr`."""
    if _corr(a, b) is None:
        return None
    return intervals.bootstrap((a, b), _correlations, 0, RESAMPLES).tolist()


def _correlations(a: np.ndarray, b: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return Pearson's correlation along an axis; 0 where one does not vary."""
    a, b = (x - x.mean(axis, keepdims=True) for x in (a, b))
    spread = np.sqrt((a**2).sum(axis) * (b**2).sum(axis))
    return (a * b).sum(axis) / np.maximum(spread, 1e-12)


def _by_object(r: dict, env: GraspEnv) -> dict[str, float | None]:
    """Share of unpushed episodes held, command >= 0.1, by object."""
    names = _objects(r, env)
    among = ~r["pushed"].astype(bool) & (r["command"] >= 0.1)
    return {str(name): _rate(r["held"], among & (names == name)) for name in np.unique(names)}


def _objects(r: dict, env: GraspEnv) -> np.ndarray:
    """Return the name of each episode's object [E]."""
    return np.array([env.objects.scene.variants[int(v)].shape.name for v in r["shape"]])


def by_share(r: dict) -> dict:
    """Return episodes by the share of the normal contact force on the object that fingertips have just before the hold
    (the rest is links' and palm's), in fifths: their number, shares held of those without and with a push, and of all
    those still held with the hand turned by 180 degrees. Commands below 0.1 do not count; empty fifths are left out."""
    bins = _bins(np.asarray(r["tips"]), SHARES)
    pushed, firm = r["pushed"].astype(bool), r["command"] >= 0.1
    parts = [(b, m) for b in range(SHARES) if (m := firm & (bins == b)).any()]
    return {
        "from": [b / SHARES for b, _ in parts], "to": [(b + 1) / SHARES for b, _ in parts],
        "episodes": [int(m.sum()) for _, m in parts],
        "held": [_rate(r["held"], m & ~pushed) for _, m in parts],
        "held_pushed": [_rate(r["held"], m & pushed) for _, m in parts],
        "held_turned_180": [_rate(r["held180"], m) for _, m in parts],
    }  # fmt: skip


def _bins(x: np.ndarray, count: int) -> np.ndarray:
    """Return which of so many equal parts of [0, 1] each number lies in."""
    return np.minimum((x * count).astype(int), count - 1)


def _of(x: np.ndarray, columns: list[int]) -> np.ndarray:
    """Return columns of x, row by row in memory, so that sums do not depend on how they were picked."""
    return np.ascontiguousarray(x[:, columns])


def _flexing(r: dict, env: GraspEnv) -> np.ndarray:
    """Return torque [E, K] N.m, closing, of the first flexion joint of each finger beside the opposing ones."""
    joints = [env.hand.fingers[k].flexion[0] for k in env.hand.others]
    return r["torque"][:, joints] * env.hand.closing[joints].astype(np.float32)


def _by_command(r: dict, held: np.ndarray, torque: np.ndarray) -> dict:
    """Return held episodes in tenths of the command: its mean, the contact force of all fingers [N] (mean, 5 and 95
    percentile) and the torque [E, K] of the flexion joints [N.m], their mean; empty tenths left out."""
    bins, total, torque = _bins(r["command"], BINS), r["force"].sum(1), torque.mean(1)
    parts = [m for b in range(BINS) if (m := held & (bins == b)).any()]
    return {
        "command": [float(r["command"][m].mean()) for m in parts],
        "force_N": [float(total[m].mean()) for m in parts],
        "force_range_N": [[float(x) for x in np.percentile(total[m], [5, 95])] for m in parts],
        "torque_Nm": [float(torque[m].mean()) for m in parts],
    }


def _papers_columns(metrics: dict) -> list[tuple[str, tuple, list]]:
    """Return what the paper's table of rewards says, of held episodes, and the intervals of what is judged."""

    def ends(name: str, digits: int = 3) -> str:
        pair = metrics.get(name)
        return "-" if pair is None else f"{pair[0]:.{digits}g} .. {pair[1]:.{digits}g}"

    def value(name: str) -> str:
        return "-" if metrics.get(name) is None else f"{metrics[name]:.3f}"

    said = ("hold_rate", "hold_rate_pushed", "hold_rate_kept_out_shapes", "force_command_correlation",
            "torque_command_correlation")  # fmt: skip
    held = (ends("contact_force_range_N"), ends("joint_torque_range_Nm"), value(said[3]), value(said[4]))
    return [
        ("Held episodes, 5 to 95 % (the paper's columns; correlations with the command)",
         ("contact forces N", "joint torque N m", "force and command", "torque and command"), [held]),
        ("95 % intervals (of rates Wilson's, of correlations by bootstrap over episodes)",
         ("quantity", "value", "interval"), [(n, value(n), ends(f"{n}_interval", 4)) for n in said]),
    ]  # fmt: skip


def _tables(r: dict, k: dict, env: GraspEnv) -> list:
    f_max, others = env.f_max, list(env.hand.others)
    n, names_of = len(others), [env.hand.finger_names[i] for i in others]
    bins, pushed, held = _bins(r["command"], BINS), r["pushed"].astype(bool), r["held"].astype(bool)
    rows: list[tuple] = []
    for b in range(BINS):
        m = bins == b
        if not m.any():
            continue
        h = m & held
        got = r["force"][h][:, others]
        off = np.abs(got - r["command"][h, None] * f_max)
        force, error = (got.sum(1).mean(), off.mean()) if h.any() else (np.nan, np.nan)
        rows.append((f"{b / BINS:.1f}-{(b + 1) / BINS:.1f}", int(m.sum()), _pct(held, m & ~pushed),
                     _pct(held, m & pushed), f"{n * f_max * (b + 0.5) / BINS:.1f}", f"{force:.1f}",
                     f"{error:.2f}"))  # fmt: skip
    able, grid = must_hold(r, f_max, n), []
    for light, heavy in pairwise((0.03, 0.065, 0.14, 0.31)):
        line = [f"{1000 * light:.0f}-{1000 * min(heavy, 0.3):.0f} g"]
        for c, d in pairwise((0.4, 0.67, 0.93, 1.21)):
            among = (r["mass"] >= light) & (r["mass"] < heavy) & (r["friction"] >= c) & (r["friction"] < d)
            line.append(_pct(held, able & among))
        grid.append(tuple(line))
    by_shape: list[tuple] = []
    for part, label in ((r, ""), (k, " (kept out)")):
        able, p = must_hold(part, f_max, n), part["pushed"].astype(bool)
        names = _objects(part, env)
        for name in dict.fromkeys(names.tolist()):
            m = names == name
            h = m & part["held"].astype(bool)
            missing = [f"{100 * (part['force'][h, i] < 0.1).mean():.0f}" if h.any() else "-" for i in others]
            both = _pct(part["held"], m & ~p & (part["command"] >= 0.1)), _pct(part["held"], m & p & able)
            by_shape.append((name + label, int(m.sum()), *both, *missing))
    return [
        ("Force by finger, held episodes", ("finger", "told by", "correlation", "error N", "N, told below 0.03"),
         _by_finger(r, env)),
        ("Hold and force by command",
         ("F_cmd", "episodes", "held %", "held pushed %", f"asked N ({n} fingers)", "got N", "error N/finger"), rows),
        ("Held % by mass and friction (where the command can carry the load)",
         ("mass", "mu 0.4-0.67", "mu 0.67-0.93", "mu 0.93-1.2"), grid),
        ("Held % by object, and % of held episodes in which a finger does not touch",
         ("object", "episodes", "held %", "held pushed %", *names_of), by_shape),
    ]  # fmt: skip


def _by_finger(r: dict, env: GraspEnv) -> list[tuple]:
    """Return a row a finger: whose command it follows, how its force correlates with it, mean error [N], mean force [N]
    at commands below 0.03."""
    h, rows = r["held"].astype(bool), []
    for i, name in enumerate(env.hand.finger_names):
        own = i in env.hand.opposing and env.thumb_range is not None
        command, force = r["thumb_command" if own else "command"][h], r["force"][h, i]
        said = "its own" if own else "the command" if i in env.hand.others else "none: a band"
        off, low = np.abs(force - command * env.f_max), force[command < 0.03]
        numbers = (_corr(command, force), off.mean() if h.any() else None, low.mean() if low.size else None)
        rows.append((name, said, *("-" if x is None else f"{x:.2f}" for x in numbers)))
    return rows


def _pct(ok: np.ndarray, among: np.ndarray) -> str:
    return f"{100 * ok[among].mean():.1f}" if among.any() else "-"


def _force_plot(ax: Axes, r: dict, env: GraspEnv) -> None:
    held = r["held"].astype(bool)
    c = r["command"][held]
    for i in env.hand.others:
        ax.scatter(c, r["force"][held, i], s=4, alpha=0.4, label=env.hand.finger_names[i])
    ax.set_xlabel("force command")
    ax.set_ylabel("contact force of a finger [N]")
    ax.set_title("Measured force over command, held episodes")
    ax.legend(markerscale=3)


def _hold_plot(ax: Axes, r: dict) -> None:
    bins = _bins(r["command"], BINS)
    pushed, held = r["pushed"].astype(bool), r["held"].astype(bool)
    x = (np.arange(BINS) + 0.5) / BINS
    for label, sel, shift in (("unpushed", ~pushed, -0.02), ("pushed", pushed, 0.02)):
        y = [100 * held[sel & (bins == b)].mean() if (sel & (bins == b)).any() else np.nan for b in range(BINS)]
        ax.bar(x + shift, y, width=0.035, label=label)
    ax.set_xlabel("force command")
    ax.set_ylabel("held [%]")
    ax.set_ylim(0, 100)
    ax.set_title("Held through 5 s")
    ax.legend()


def scripted(env: GraspEnv, rate: float, wait: float) -> Callable[[Mapping], torch.Tensor]:
    """Return a policy without learning, from the actor's observation alone: open for `wait` seconds of an episode, then
    close thumb and fingers at `rate` (of the largest action), each joint until its torque reaches 0.1 + 0.6 F_cmd
    of its maximum. A floor for what is learned, and a check that the physics can hold anything at all."""
    if env.task["action"]["mode"] != "relative":
        raise UserError(f"policy=scripted: moves by task.action.mode=relative, not {env.task['action']['mode']}")
    table = env.describe()["observations"]["actor"]
    start = {name: part.start for name, part in observations.slices(table).items()}
    torque, vz, command = start["joint_torque"], start["object_velocity"] + 2, start["force_command"]
    way, closing = approach(env.hand), np.zeros(env.num_actions)
    for k in env.hand.others:
        turned = list(env.hand.fingers[k].flexion[:2])
        closing[turned] = rate * way[turned]
    for k in env.hand.opposing:
        finger = env.hand.fingers[k]
        for j in finger.joints:
            closing[j] = (0.8 if j in finger.flexion else 1.0) * rate * way[j]
    step = torch.as_tensor(closing, dtype=torch.float32, device=env.device)
    age = torch.zeros(env.num_envs, device=env.device)

    def policy(obs: Mapping) -> torch.Tensor:
        x = obs["actor"]
        # a finite difference of a noisy height is exactly zero only where an episode has just begun
        age.copy_(torch.where(x[:, vz] == 0, torch.zeros_like(age), age + env.dt))
        light = x[:, torque : torque + env.num_actions].abs() < (0.1 + 0.6 * x[:, command])[:, None]
        return step * (light & (age >= wait)[:, None])

    return policy
