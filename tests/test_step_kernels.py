"""The kernels of a control step against the same in torch, term by term, on random worlds."""

from __future__ import annotations

import math

import pytest
import torch
from worlds import grasp_env

from dexsim import rotation
from dexsim.actuator.columns import INDEX
from dexsim.sim.engine import FLAG_NAN
from dexsim.tasks.grasp import CENTRE_LENGTH

N = 64


@pytest.fixture(scope="module", params=["mujoco", "warp"])
def env(request):
    env = grasp_env(worlds=N, engine=request.param)
    env.task["rewards"] |= {"torque_near": 1.0, "torque_worst": 1.0, "thumb_reach": 1.0}  # off by default
    yield env
    env.close()


def random(env, *shape: int, seed: int = 0, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=g)


def scatter(env, seed: int) -> None:
    """States, forces and commands far apart, some worlds dropped, some late in their episode."""
    g = torch.Generator().manual_seed(seed)

    def u(x: torch.Tensor, low: float, high: float) -> None:
        x.copy_(low + (high - low) * torch.rand(x.shape, generator=g))

    u(env.q, -0.5, 2.0), u(env.qd, -5, 5), u(env.torque, -1.1, 1.1), u(env.action, -1, 1), u(env.last_action, -1, 1)
    u(env.tip_force, -3.0, 1.2 * env.f_max), u(env.self_force, 0, 20), u(env.command, 0, 1), u(env.reward, -1, 1)
    u(env.thumb_command, -1, 1)
    env.tip_force.clamp_(min=0)
    u(env.clearance.distance, -0.01, 0.05), u(env.object_velocity, -1.0, 1.0), u(env.object_pose, -0.15, 0.15)
    env.episode_length_buf = torch.randint(0, 300, (N,), generator=g)


def tracking(x, command, x_max, sigma, low, high, contact):
    """command: [N, F] of each finger, below 0: the band alone."""
    band = ((x >= low * x_max) & (x <= high * x_max)).float()
    error = (x - command * x_max) / (sigma * x_max)
    gauss = torch.where(command < 0, torch.ones_like(x), torch.exp(-0.5 * error.square()))
    return (gauss * band * contact).sum(1)


def rewards(env) -> tuple[dict, dict]:
    """Return (terms, metrics) by the formulas in torch."""
    w, r, end = env.task["rewards"], env.task["reward"], env.task["termination"]
    force, contact = env.tip_force, env.tip_force > r["contact_threshold"]
    torque = env.torque[:, env.roots] * env.root_closes
    opposed, pressed = contact[:, env.opposing].any(1), contact[:, env.others]
    aside = force[:, env.others] / env.f_max - env.command[:, None]
    own, none = env.thumb_command[:, None], torch.full((N, 1), -1.0)
    shared = env.command[:, None].expand(N, env.fingers - 1)
    slack = (torque / env.tau_max)[:, env.others] - env.command[:, None]
    p = env.object_pose[:, :3]
    dropped = (p - env.reach).norm(dim=1) > env.unit * end["distance"]
    dropped |= p[:, 2] < env.unit * end["below"] + env.rise
    bands = (r["force_sigma"], r["force_low"], r["force_high"]), (r["torque_sigma"], r["torque_low"], r["torque_high"])
    near = (-env.clearance.distance.clamp(min=0) / (env.unit * r["reach_length"])).exp()
    beside = (p[:, 1] - env.beside).abs() / (env.unit * CENTRE_LENGTH)
    out = {
        "force": tracking(force, torch.cat([own, shared], 1), env.f_max, *bands[0], contact),
        "torque": tracking(torque / env.tau_max, torch.cat([none, shared], 1), 1.0, *bands[1], contact),
        "diff": (env.q[:, env.inner] * env.inner_closes).var(dim=1, unbiased=False),
        "outer": (env.q[:, env.outer] - env.q_mid[env.outer]).norm(dim=1),
        "termination": dropped.float(),
        "action": (env.action - env.last_action).square().sum(1),
        "velocity": env.qd.square().sum(1),
        "grip": opposed * pressed.float().mean(1),
        "force_near": (1 - aside.abs()).clamp(min=0).mean(1),
        "reach": near[:, env.others].mean(1),
        "thumb_reach": near[:, 0],
        "self": (env.self_force.sum(1) / env.f_max).clamp(max=5.0),
        "still": env.object_velocity[:, :3].norm(dim=1).clamp(max=1.0),
        "worst": (1 - aside.abs().amax(1)).clamp(min=0),
        "torque_near": (1 - slack.abs()).clamp(min=0).mean(1),
        "torque_worst": (1 - slack.abs().amax(1)).clamp(min=0),
        "thumb_near": (1 - (force[:, 0] / env.f_max - own[:, 0]).abs()).clamp(min=0) * (own[:, 0] >= 0),
        "centre": beside.clamp(max=2.0),
    }
    late = env.episode_length_buf * env.dt > 2.0
    displayed = {
        "task/held": (opposed & pressed.any(1)).float(),
        "task/force_error": (force[:, env.others] - env.command[:, None] * env.f_max).abs().mean(1),
        "task/fingers_touching": pressed.float().sum(1),
        "task/force_other": env.self_force.sum(1),
    }
    count = late.sum().clamp(min=1)
    return {k: w[k] * v for k, v in out.items()}, {k: (v * late).sum() / count for k, v in displayed.items()}


@pytest.mark.parametrize("seed", [0, 1])
def test_rewards_and_what_the_log_shows(env, seed):
    scatter(env, seed)
    want, displayed = rewards(env)
    got = env.rewards()
    assert set(got) == set(env.task["rewards"]) == set(want)
    for name, value in want.items():
        torch.testing.assert_close(got[name], value, rtol=1e-5, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")
        assert float(value.std()) > 0, f"{name} is the same everywhere: nothing was compared"
    metrics = env.metrics()
    assert set(metrics) == set(displayed)
    for name, value in displayed.items():
        torch.testing.assert_close(metrics[name], value, rtol=1e-5, atol=1e-6)
    dropped = env.terminated()["dropped"]
    assert torch.equal(dropped.float() * env.task["rewards"]["termination"], want["termination"])
    assert 0 < int(dropped.sum()) < N


def test_a_number_that_is_not_finite_is_not_hidden_by_a_bound(env):
    scatter(env, 0)
    for memory, terms in ((env.tip_force, ("force_near", "worst")), (env.self_force, ("self",)),
                          (env.object_velocity, ("still",)), (env.object_pose, ("centre",)),
                          (env.clearance.distance, ("reach",))):  # fmt: skip
        saved = memory.clone()
        memory[3] = float("nan")
        got = env.rewards()
        memory.copy_(saved)
        for name in terms:
            assert bool(got[name][3].isnan()) and bool(got[name][:3].isfinite().all()), name


def test_the_state_is_read(env):
    env.reset_all()
    for _ in range(30):
        env.step(random(env, N, 12, seed=1))
    t, F = env.engine.t, env.fingers
    flags = t.flags.clone()
    t.flags[2] = FLAG_NAN
    t.flags[4] = 1  # an overflow is no NaN
    env.read_state()
    t.flags.copy_(flags)
    nan = torch.zeros(N, dtype=torch.bool)
    nan[2] = True
    rot, pos = t.xmat[:, env.tip_body], t.xpos[:, env.tip_body]
    want = {
        "q": t.qpos[:, env.joint_q], "qd": t.qvel[:, env.joint_v], "torque": env.servo.torque,
        "object_pose": t.qpos[:, env.object_q], "object_velocity": t.qvel[:, env.object_v],
        "tip_force": t.pair_normal[:, :F], "finger_force": t.pair_normal[:, F : 2 * F],
        "self_force": t.pair_normal[:, 2 * F + 1 :], "palm_force": t.pair_normal[:, 2 * F],
    }  # fmt: skip
    for name, value in want.items():
        value = torch.where(nan.view(-1, *(1,) * (value.dim() - 1)), 0.0, value).float()
        assert torch.equal(getattr(env, name), value), name
        assert value.any(), name
    tips = pos + (rot @ env.tip_offset[None, :, :, None])[..., 0]
    torch.testing.assert_close(env.tips, torch.where(nan[:, None, None], 0.0, tips), rtol=0, atol=1e-7)
    assert torch.equal(env.nan, nan)


def test_nothing_is_felt_where_an_episode_begins(env):
    env.reset_all()
    for _ in range(35):
        env.step(torch.full((N, 12), 0.5))
    names = ("force", "force_clean", "force_other", "centre", "centre_clean")
    before = {name: getattr(env.touch, name).clone() for name in names}
    assert before["force"].any()
    mask = torch.arange(N) % 2 == 0
    env._clear_touch(mask)
    t = env.engine.t
    centre = t.xpos[:, env.tip_body] + (t.xmat[:, env.tip_body] @ env.pad_centre[None, :, :, None])[..., 0]
    for name in names:
        now = getattr(env.touch, name)
        assert torch.equal(now[~mask], before[name][~mask]), name
        want = centre[mask] if "centre" in name else torch.zeros_like(now[mask])
        torch.testing.assert_close(now[mask], want, rtol=0, atol=1e-7)
    env.reset_all()


@pytest.mark.parametrize("mode", ["relative", "absolute"])
def test_actions_become_targets(env, mode):
    setting = env.task["action"]
    saved = setting["mode"]
    setting["mode"] = mode
    try:
        env.target.copy_(random(env, N, 12, seed=2)), env.q.copy_(random(env, N, 12, seed=3))
        given = random(env, N, 12, seed=4, low=-2, high=2)
        given[0, 0], given[1, 1], given[2, 2] = math.nan, math.inf, -math.inf
        old, target = env.action.clone(), env.target.clone()
        env.act(given)
        a = torch.nan_to_num(given).clamp(-1, 1)
        assert torch.equal(env.action, a) and torch.equal(env.last_action, old)
        assert env.action[0, 0] == 0 and env.action[1, 1] == 1 and env.action[2, 2] == -1
        if mode == "relative":
            target = target + a * setting["scale"]
            target = torch.maximum(torch.minimum(target, env.q + env.lead()), env.q - env.lead())
        else:
            target = env.q_mid + a * env.q_half
        target = torch.maximum(torch.minimum(target, env.q_high), env.q_low)
        torch.testing.assert_close(env.target, target, rtol=0, atol=2e-7)
    finally:
        setting["mode"] = saved
        env.reset_all()


def test_a_lead_that_follows_from_the_torque_loses_none_of_it(env):
    """Targets run ahead to where the loosest drive that is drawn is at its limit, and no further."""
    assert env.task["action"]["lead"] is None, "the default"
    try:
        limit, kp = (env.servo.nominal[:, INDEX[k]] for k in ("torque_limit", "kp"))
        ahead = torch.minimum((1.05 * limit / (0.75 * kp)).float(), env.q_high - env.q_low)
        torch.testing.assert_close(env.lead(), ahead)
        limit, kp = (env.servo.params[..., INDEX[k]] for k in ("torque_limit", "kp"))
        assert (torch.minimum((limit / kp).float(), env.q_high - env.q_low) <= ahead).all()
        env.q.copy_(env.q_low.expand(N, -1)), env.target.copy_(env.q)
        for _ in range(40):
            env.act(torch.ones(N, 12))
        torch.testing.assert_close(env.target - env.q, ahead.expand(N, -1))
    finally:
        env.reset_all()


def test_who_ends_and_what_is_earned(env):
    """Rewards, ends and counts by the definition, of worlds of which some are not finite in one way or another."""
    n, inf = N, math.inf
    terms = {"a": random(env, n, seed=5), "b": random(env, n, seed=6)}
    terms["b"][1], terms["a"][2], terms["b"][2] = math.nan, inf, inf
    ends = {"x": torch.arange(n) % 5 == 0, "y": torch.arange(n) % 7 == 0}
    state, blind = torch.arange(n) == 3, torch.arange(n) == 4
    env.nan.copy_(state), env._blind[0].copy_(blind)
    env.episode_length_buf = torch.where(torch.arange(n) % 3 == 0, env.max_episode_length, 1)
    counted, env._wrong, saved = env.nan_count.clone(), None, env._wrong
    rates, reward = env._judge(ends, {k: v.clone() for k, v in terms.items()})
    bad = (torch.arange(n) >= 1) & (torch.arange(n) <= 4)
    dead = ends["x"] | ends["y"] | bad
    late = (env.episode_length_buf >= env.max_episode_length) & ~dead
    assert env._wrong.tolist() == [1, 1, 2, 1] and env._sources == ("state", "reward a", "reward b", "observations")
    assert int(env.nan_count - counted) == 4 and torch.equal(env.nan, bad)
    assert torch.equal(env.done, dead | late) and torch.equal(env.time_out, late)
    total = torch.where(bad, 0.0, terms["a"] + terms["b"])
    torch.testing.assert_close(env.reward, total, rtol=1e-6, atol=1e-7)
    assert torch.equal(rates, torch.stack([ends["x"], ends["y"], bad, late]).float())
    torch.testing.assert_close(reward.sum(0), total, rtol=1e-6, atol=1e-6)
    env._wrong = saved
    env.reset_all()


def test_a_group_of_observations_is_emptied_where_it_is_not_finite(env):
    observe = env.observe

    def spoilt(advance):
        out = observe(advance)
        out["actor"][1, 5], out["critic"][2, 0] = math.nan, math.inf
        return out

    env.observe = spoilt
    env._observe_all()
    del env.observe
    assert not env.obs["actor"][1].any() and env.obs["critic"][1].any()
    assert not env.obs["critic"][2].any() and env.obs["actor"][2].any()
    assert env._blind[0].nonzero().flatten().tolist() == [1, 2]
    env.reset_all()
    assert not env._blind.any()


def orders(env, rng: torch.Generator, mask, due_push) -> dict[str, torch.Tensor]:
    """Return a new command where mask holds and a new push where due_push does, drawn as the sampler draws."""
    c, s = env.task["command"], env.sampler
    s.rng.set_state(rng)
    value = c["low"] + (c["high"] - c["low"]) * s.uniform()
    hold = c["hold_s"][0] + (c["hold_s"][1] - c["hold_s"][0]) * s.uniform()
    size = s.draw("push.weights") * env.objects.mass * 9.81
    push = s.direction() * size[:, None]
    return {
        "command": torch.where(mask, value, env.command),
        "command_left": torch.where(mask, hold, env.command_left),
        "push_force": torch.where(due_push[:, None], push, env.push_force),
        "push_left": torch.where(due_push, s.draw("push.duration"), env.push_left),
        "push_wait": torch.where(due_push, s.draw("push.wait"), env.push_wait),
    }


@pytest.mark.parametrize("pushes", [True, False])
def test_commands_and_pushes(env, pushes):
    env.reset_all()
    env.pushes = pushes
    env.outside_force.copy_(random(env, N, 3, seed=7))
    for k in range(120):
        rng, force = env.rng.get_state(), env.outside_force.clone()
        env.command_left -= env.dt
        env.push_wait -= env.dt
        on = (env.push_wait <= 0) & pushes
        env.push_left -= env.dt * on
        over = env.push_left <= 0
        want_force = torch.where((on & ~over)[:, None], env.push_force, 0.0) + force
        want = orders(env, rng, env.command_left <= 0, over)
        for x, moved in ((env.command_left, True), (env.push_wait, True), (env.push_left, on)):
            x += env.dt * moved  # back again: the kernel does it
        env.rng.set_state(rng)
        env.before_physics()
        for name, value in want.items():
            torch.testing.assert_close(getattr(env, name), value, rtol=1e-6, atol=2e-6, msg=f"{name}, step {k}")
        applied = env.engine.t.xfrc_applied[:, env.objects.body].float()
        torch.testing.assert_close(applied[:, :3], want_force, rtol=1e-6, atol=1e-6)
        assert not applied[:, 3:].any()
    env.pushes = True
    env.outside_force.zero_()
    env.reset_all()


def test_an_episode_begins_as_drawn(env):
    """Where the object is let fall, and what the sensors know of it, from the same random numbers."""
    s, everyone = env.sampler, torch.ones(N, dtype=torch.bool)
    drawn: dict[str, list] = {}
    for kind in ("draw", "uniform", "normal"):
        original = getattr(s, kind)

        def call(*args, kind=kind, original=original):
            value = original(*args)
            drawn.setdefault(args[0] if kind == "draw" else kind, []).append(value.clone())
            return value

        setattr(s, kind, call)
    env.begin_episodes(everyone)
    for kind in ("draw", "uniform", "normal"):
        delattr(s, kind)
    (joint,), (xy,), (drop,), (tilt,) = (drawn[f"initial.{k}"] for k in ("joint", "object_xy", "drop", "tilt"))
    _, _, roll, delay, command, hold = drawn["uniform"]  # the first two: which object, the drives' intervals
    axis, push = drawn["normal"]
    t = env.engine.t
    hand = (env.pose0 + joint).clamp(env.q_low, env.q_high)
    torch.testing.assert_close(t.qpos[:, env.joint_q].float(), hand, rtol=0, atol=1e-7)
    torch.testing.assert_close(env.target, hand, rtol=0, atol=1e-7)
    place = torch.cat([env.centre0 + env.unit * xy, (env.objects.radius + env.unit * drop + env.rise)[:, None]], 1)
    across = torch.tensor([0.0, 1.0, 0.0]).expand(N, 3)
    unit = axis / axis.norm(dim=1, keepdim=True)
    turn = rotation.multiply(rotation.about(across, 2 * torch.pi * roll), env.lay[env.objects.variant])
    turn = rotation.multiply(rotation.about(unit, tilt), turn)
    pose = t.qpos[:, env.object_q].float()
    torch.testing.assert_close(pose, torch.cat([place, turn], 1), rtol=0, atol=1e-6)
    velocity = [drawn["initial.velocity_xy"][0], drawn["initial.velocity_z"][0][:, None], drawn["initial.spin"][0]]
    assert torch.equal(t.qvel[:, env.object_v].float(), torch.cat(velocity, 1)) and not t.qvel[:, env.joint_v].any()
    torch.testing.assert_close(env.first_xy, place[:, :2] + drawn["sensors.vision_xy"][0], rtol=0, atol=1e-7)
    assert torch.equal(env.z_history, env.z_seen[:, None].expand_as(env.z_history))
    torch.testing.assert_close(env.z_seen, place[:, 2], rtol=0, atol=1e-7)
    low, high = (round(x / env.dt) for x in env.task["sensors"]["vision_delay"])
    assert torch.equal(env.z_delay, (low + (high - low + 1) * delay).long().clamp(low, high))
    assert torch.equal(env.torque_bias, drawn["sensors.torque_bias"][0])
    c = env.task["command"]
    torch.testing.assert_close(env.command, c["low"] + (c["high"] - c["low"]) * command)
    torch.testing.assert_close(env.command_left, c["hold_s"][0] + (c["hold_s"][1] - c["hold_s"][0]) * hold)
    size = drawn["push.weights"][0] * env.objects.mass * 9.81
    want = push / push.norm(dim=1, keepdim=True) * size[:, None]
    torch.testing.assert_close(env.push_force, want, rtol=1e-5, atol=1e-6)
    assert torch.equal(env.push_left, drawn["push.duration"][0]) and torch.equal(env.push_wait, drawn["push.wait"][0])


def test_what_the_sensors_say(env):
    env.reset_all()
    for _ in range(5):
        env.step(random(env, N, 12, seed=8))
    size, s = env.task["sensors"], env.sampler
    history, before, rng = env.z_history.clone(), env.z_seen.clone(), env.rng.get_state()
    z, joint, torque, tip = s.normal(), s.normal(12), s.normal(12), s.normal(15)
    env.rng.set_state(rng)
    actor = env.observe(advance=True)["actor"]
    history = torch.cat([env.object_pose[:, 2:3], history[:, :-1]], 1)
    seen = history.gather(1, env.z_delay[:, None])[:, 0] + size["vision_z_noise"] * z
    assert torch.equal(env.z_history, history)
    torch.testing.assert_close(env.z_seen, seen, rtol=0, atol=1e-7)
    torch.testing.assert_close(env.vz_seen, (seen - before) / env.dt, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(actor[:, :12], env.q + size["joint_noise"] * joint, rtol=0, atol=2e-7)
    want = env.torque / env.effort + env.torque_bias + size["torque_noise"] * torque
    torch.testing.assert_close(actor[:, 12:24], want, rtol=0, atol=3e-7)
    tips = env.tips + size["tip_noise"] * tip.reshape(N, 5, 3)
    torch.testing.assert_close(actor[:, -16:-1], tips.flatten(1), rtol=0, atol=1e-7)
    history, seen = env.z_history.clone(), env.z_seen.clone()
    env.observe(advance=False)
    assert torch.equal(env.z_history, history) and torch.equal(env.z_seen, seen), "no step, no picture"
