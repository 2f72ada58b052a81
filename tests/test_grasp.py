"""The grasp task: what the policy sees, what it is paid for, when episodes end."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from worlds import grasp_cfg, grasp_env

from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.sim.engine import FLAG_NAN
from dexsim.tasks import grasp_eval, make_env, observations
from tools.assets import xhand

N = 8
QUIET = (
    "task.sensors.joint_noise=0",
    "task.sensors.torque_noise=0",
    "task.sensors.tip_noise=0",
    "task.sensors.vision_z_noise=0",
)
NO_BIAS = ("randomize.sensors.vision_xy=0", "randomize.sensors.torque_bias=0")
WIDTHS = {"joint_angle": 12, "joint_torque": 12, "object_position": 3, "object_velocity": 3, "contact_force": 5,
          "contact_centre": 15, "fingertip_position": 15, "force_command": 1}  # fmt: skip
SLICES = observations.slices([*WIDTHS.items()])


@pytest.fixture(scope="module")
def quiet():
    """Return the sensors without noise or bias, so that every slice has one right value."""
    return grasp_env(*QUIET, *NO_BIAS, worlds=N)


@pytest.fixture
def env(quiet):
    quiet.rng.manual_seed(11)
    quiet.reset_all()
    return quiet


def act(env, value: float = 0.0) -> torch.Tensor:
    a = torch.zeros(env.num_envs, 12)
    a[:, 3:] = value
    return a


# -- observations
# ------------------------------------------------------------------------------------------------------------


def test_sizes_and_layout(env):
    rows = [(name, width) for name, width, *_ in env.describe()["observations"]["actor"]]
    assert rows == [
        ("joint_angle", 12),
        ("joint_torque", 12),
        ("object_position", 3),
        ("object_velocity", 3),
        ("contact_force", 5),
        ("contact_centre", 15),
        ("fingertip_position", 15),
        ("force_command", 1),
    ]
    obs = env.get_observations()
    assert obs["actor"].shape == (N, 66)
    assert obs["critic"].shape == (N, 148)
    groups = env.describe()["observations"]
    for group in ("actor", "critic"):
        assert sum(row[1] for row in groups[group]) == obs[group].shape[1]


@pytest.mark.parametrize(
    "name, weight, said",
    [
        ("balance", 1.0, "task.rewards.balance=1.0: the task grasp has no reward of this name, .* it has action"),
        ("reach", math.nan, "task.rewards.reach=nan: must be a finite number"),
        ("reach", "much", "task.rewards.reach=much: must be a finite number"),
    ],
)
def test_a_reward_that_the_task_does_not_know_is_one_line(name, weight, said):
    cfg = grasp_cfg()
    cfg["task"]["rewards"][name] = weight
    with pytest.raises(UserError, match=said) as error:
        make_env(cfg, 2, "cpu", 0)
    assert "(dexsim.tasks.grasp)" in str(error.value) and "\n" not in str(error.value)


def test_every_reward_has_a_weight_and_words(env):
    rows = {name: words for name, _, words in env.describe()["rewards"]}
    paid = {name for name, weight in env.task["rewards"].items() if weight}
    assert set(rows) == paid and set(env.reward_words()) == set(env.rewards()) and all(rows.values())


def test_critic_paper_has_the_actors_rows():
    env = grasp_env("task.critic=paper", "tactile.others=false", worlds=2)
    obs, *_ = env.step(torch.zeros(2, 12))
    assert obs["critic"].shape == (2, 66)
    s = SLICES["joint_angle"]
    assert torch.equal(obs["critic"][:, s], env.q) and not torch.equal(obs["actor"][:, s], env.q)


def test_every_slice_holds_what_its_name_says(env):
    for _ in range(30):
        obs, *_ = env.step(act(env, 0.5))
    e = env.engine
    assert float(env.tip_force.max()) > 0.5, "the hand holds something, or the test says little"
    for group in ("actor", "critic"):
        o = {name: obs[group][:, s].double() for name, s in SLICES.items()}
        q = e.t.qpos[:, e.qpos_index(xhand.JOINTS)]
        torch.testing.assert_close(o["joint_angle"], q, rtol=0, atol=1e-6)
        torch.testing.assert_close(
            o["joint_torque"], env.servo.torque / torch.as_tensor(xhand.efforts()), rtol=0, atol=1e-6
        )
        torch.testing.assert_close(
            o["contact_force"], e.t.pair_normal[:, :5].double() / env.f_max, rtol=1e-4, atol=1e-4
        )
        sites = torch.stack([_site(env, w) for w in range(N)])
        torch.testing.assert_close(o["fingertip_position"], sites.reshape(N, 15), rtol=0, atol=1e-5)
        torch.testing.assert_close(o["force_command"][:, 0], env.command.double(), rtol=0, atol=0)
        centre = o["contact_centre"].reshape(N, 5, 3)
        assert float((centre - sites).norm(dim=-1).max()) < 0.03, "on the pad, in the tips' order"
    assert torch.equal(obs["critic"][:, SLICES["object_position"]], env.object_pose[:, :3])
    assert torch.equal(obs["critic"][:, SLICES["object_velocity"]], env.object_velocity[:, :3])


def _site(env, w: int) -> torch.Tensor:
    """Return the fingertip sites [5, 3] by C MuJoCo's kinematics of world w."""
    import mujoco

    m = env.engine.batch.get_model(w)
    d = mujoco.MjData(m)
    d.qpos[:] = env.engine.t.qpos[w]
    mujoco.mj_kinematics(m, d)
    return torch.as_tensor(np.stack([d.site(f"tip_{f}").xpos for f in xhand.FINGERS]))


def test_the_actor_sees_the_object_as_on_hardware(env):
    """x and y held at their first values, vx = vy = 0, z some control steps old, vz its finite difference."""
    first = env.get_observations()["actor"]
    z = [env.object_pose[:, 2].clone()]
    seen = [first[:, SLICES["object_position"]][:, 2].clone()]
    start_xy = env.object_pose[:, :2].clone()
    torch.testing.assert_close(first[:, SLICES["object_position"]][:, :2], start_xy, rtol=0, atol=1e-6)
    assert not first[:, SLICES["object_velocity"]].any()
    delay = env.z_delay.clone()
    for k in range(1, 12):
        obs, _, done, _ = env.step(act(env))
        assert not done.any()
        o, v = obs["actor"][:, SLICES["object_position"]], obs["actor"][:, SLICES["object_velocity"]]
        z.append(env.object_pose[:, 2].clone())
        expect = torch.stack([z[max(k - int(delay[w]), 0)][w] for w in range(N)])
        torch.testing.assert_close(o[:, 2], expect, rtol=0, atol=1e-6)
        assert torch.equal(o[:, :2], first[:, SLICES["object_position"]][:, :2]) and not v[:, :2].any()
        torch.testing.assert_close(v[:, 2], (o[:, 2] - seen[-1]) / env.dt, rtol=0, atol=1e-4)
        seen.append(o[:, 2].clone())
    low, high = (round(x / env.dt) for x in env.task["sensors"]["vision_delay"])
    assert 1 <= low <= int(delay.min()) and int(delay.max()) <= high
    assert float((env.object_pose[:, :2] - start_xy).abs().max()) > 1e-4, "it did move"


def test_noise_is_the_actors_alone_and_as_large_as_stated():
    env = grasp_env("tactile.others=false", worlds=64)
    d = []
    for _ in range(6):
        obs, *_ = env.step(torch.zeros(64, 12))
        d.append(obs["actor"][:, SLICES["joint_angle"]] - obs["critic"][:, SLICES["joint_angle"]])
    d = torch.stack(d)
    assert float(d.std()) == pytest.approx(0.003, rel=0.05) and abs(float(d.mean())) < 3e-4
    assert float(torch.corrcoef(torch.stack([d[0].ravel(), d[1].ravel()]))[0, 1]) < 0.15, "fresh each step"
    tau = obs["actor"][:, SLICES["joint_torque"]] - obs["critic"][:, SLICES["joint_torque"]] - env.torque_bias
    assert float(tau.std()) == pytest.approx(0.01, rel=0.15)


def test_the_actor_feels_what_the_sensor_measured(env, monkeypatch):
    """The force and the centres that a sensor reports, which differ from those the critic is told."""
    for k, name in enumerate(("force", "centre", "force_clean", "centre_clean")):
        monkeypatch.setattr(env.touch, name, torch.full_like(getattr(env.touch, name), 1.0 + k))
    obs = env.observe(advance=False)
    for group, force, centre in (("actor", 1.0, 2.0), ("critic", 3.0, 4.0)):
        sensed = obs[group][:, SLICES["contact_force"]]
        torch.testing.assert_close(sensed, torch.full_like(sensed, force / env.f_max))
        assert (obs[group][:, SLICES["contact_centre"]] == centre).all(), group


def test_a_new_episode_has_felt_nothing(env):
    """No reading of the episode before is seen in the first observation of the next; centres are the pads' own."""
    for _ in range(30):
        obs, *_ = env.step(act(env, 0.5))
    before = obs["actor"].clone()
    assert before[:, SLICES["contact_force"]].any()
    mask = torch.arange(N) % 2 == 0
    env.reset(mask)
    obs = env.get_observations()["actor"]
    assert not obs[mask][:, SLICES["contact_force"]].any() and not obs[mask][:, SLICES["joint_torque"]].any()
    e = env.engine
    b = [e.body(x) for x in xhand.TIP_BODIES]
    pad = torch.as_tensor(env.touch.layout.centre(), dtype=torch.float32)
    centre = e.t.xpos[:, b] + (e.t.xmat[:, b] @ pad[None, :, :, None])[..., 0]
    torch.testing.assert_close(obs[mask][:, SLICES["contact_centre"]], centre.reshape(N, 15)[mask], rtol=0, atol=1e-6)
    assert torch.equal(obs[~mask][:, SLICES["contact_force"]], before[~mask][:, SLICES["contact_force"]])


# -- rewards
# ---------------------------------------------------------------------------------------------------------------


def test_low_commands_can_earn():
    r = grasp_cfg()["task"]["reward"]
    assert r["force_low"] < 0.1 and r["torque_low"] < 0.1


@pytest.fixture
def posed(env):
    """An environment whose measured signals are set by hand, for `rewards` alone."""
    env.tip_force.zero_(), env.torque.zero_(), env.qd.zero_(), env.self_force.zero_(), env.object_velocity.zero_()
    env.object_pose[:, :3] = env.reach
    env.q.copy_(env.q_mid.expand(N, 12))
    env.action.zero_(), env.last_action.zero_()
    env.command.fill_(0.5)
    yield env
    env.reset_all()


def terms_of(env) -> dict[str, float]:
    w = env.task["rewards"]
    return {k: float(v[0] / w[k]) for k, v in env.rewards().items()}


def test_reward_terms_by_hand(posed):
    env = posed
    zero = terms_of(env)
    assert (
        zero["force"]
        == zero["torque"]
        == zero["outer"]
        == zero["action"]
        == zero["velocity"]
        == zero["termination"]
        == 0
    )
    mid = env.q_mid[[4, 6, 8, 10]].double()
    assert zero["diff"] == pytest.approx(float(((mid - mid.mean()) ** 2).mean()), abs=1e-7)

    env.q[:, [4, 6, 8, 10]] = torch.tensor([0.2, 0.4, 0.6, 1.0])
    assert terms_of(env)["diff"] == pytest.approx(np.var([0.2, 0.4, 0.6, 1.0]), rel=1e-5)
    env.q[:, 0] += 1.0  # the thumb is not in it
    assert terms_of(env)["diff"] == pytest.approx(np.var([0.2, 0.4, 0.6, 1.0]), rel=1e-5)

    env.q[:, [5, 7, 9, 11]] = env.q_mid[[5, 7, 9, 11]] + torch.tensor([0.3, 0.0, -0.4, 0.0])
    assert terms_of(env)["outer"] == pytest.approx(0.5, rel=1e-5)  # the norm (0.25 were its square)

    env.action[:, 0], env.last_action[:, 0], env.action[:, 5] = 0.5, -0.5, 0.2
    assert terms_of(env)["action"] == pytest.approx(1.0 + 0.04, rel=1e-5)

    env.qd[:, 3], env.qd[:, 7] = 2.0, -1.0
    assert terms_of(env)["velocity"] == pytest.approx(5.0, rel=1e-5)

    env.object_pose[:, 2] = -1.0
    assert terms_of(env)["termination"] == 1.0


def test_tracking_against_hand_computed_values(posed):
    env, r = posed, posed.task["reward"]
    saved, f_max = dict(r), env.f_max
    r |= {"force_sigma": 0.25, "force_low": 0.02, "force_high": 1.3, "contact_threshold": 0.1}
    env.f_max = 8.0
    try:
        # command 4 N, sigma 2 N, band [0.16, 10.4] N; thumb: band only
        env.tip_force[0] = torch.tensor([2.0, 4.0, 6.0, 0.05, 11.0])
        env.tip_force[1] = torch.tensor([0.12, 4.0, 0.12, 4.0, 0.05])
        got = env.rewards()["force"][:2] / env.task["rewards"]["force"]
    finally:
        r |= saved
        env.f_max = f_max
    first = 1.0 + 1.0 + math.exp(-0.5 * (2 / 2) ** 2) + 0.0 + 0.0  # on target; 1 sigma off; no contact; over the band
    second = 0.0 + 1.0 + 0.0 + 1.0 + 0.0  # thumb under its band; exact; under the band; exact; no contact
    torch.testing.assert_close(got, torch.tensor([first, second]))


def test_force_and_torque_rewards_need_contact_with_the_object(posed):
    env = posed
    r = env.task["reward"]
    env.tip_force[:] = torch.tensor([1.0, 0.5, 0.5, 0.5, 0.05]) * env.f_max
    env.tip_force[:, 4] = r["contact_threshold"] / 2  # a touch under the threshold is none
    env.torque[:, [1, 4, 6, 8, 10]] = 0.5 * env.tau_max
    got = terms_of(env)
    assert got["force"] == pytest.approx(4.0, rel=1e-4) and got["torque"] == pytest.approx(4.0, rel=1e-4)
    env.torque[:, 4] = (0.5 + r["torque_sigma"]) * env.tau_max[1]
    assert terms_of(env)["torque"] == pytest.approx(3.0 + math.exp(-0.5), rel=1e-4)
    env.tip_force.zero_()
    env.self_force[:] = 0.5 * env.f_max  # squeezing two fingers does not pay
    got = terms_of(env)
    assert got["force"] == got["torque"] == got["grip"] == 0


def test_fingers_on_fingers_are_no_contact_with_the_object(env):
    """A fist with the object far away: fingers press each other, yet no force counts."""
    far = torch.zeros(N, 7)
    far[:, 0], far[:, 2], far[:, 3] = 0.05, 0.9, 1.0
    env.task["termination"]["distance"], saved = 10.0, env.task["termination"]["distance"]
    try:
        env.place(torch.ones(N, dtype=torch.bool), env.pose0.expand(N, 12), far, torch.zeros(N, 6))
        env.engine.field("opt.gravity").zero_()
        pressed = torch.zeros(N)
        for k in range(40):
            a = torch.ones(N, 12)
            a[:, 0] = 1.0 if k < 15 else 0.0
            env.step(a)
            pressed = torch.maximum(pressed, env.self_force.sum(1))
            assert not env.tip_force.any() and not env.finger_force.any()
            assert not env.touch.force_clean.any()
        reward = env.rewards()
        assert float(pressed.median()) > 0.5, "no finger touched another: the test says nothing"
        assert not reward["force"].any() and not reward["torque"].any() and not reward["grip"].any()
    finally:
        env.task["termination"]["distance"] = saved


def test_weights_scale_their_terms_and_the_sum_is_the_reward(env):
    for _ in range(25):
        _, reward, done, extras = env.step(act(env, 0.4))
    total = torch.stack(list(env.rewards().values())).sum(0)
    saved = ~done.bool()
    assert saved.any()
    torch.testing.assert_close(reward[saved], total[saved], rtol=1e-5, atol=1e-6)
    assert set(env.rewards()) == set(env.task["rewards"])


# -- the force scale
# -----------------------------------------------------------------------------------------------------------


def test_f_max_is_a_static_press_of_about_ten_newtons(env):
    from dexsim.tasks.press import fingertip_press

    assert 5.0 < env.f_max < 20.0
    servo, hand = grasp_cfg()["servo"], load_hand()
    full, half = fingertip_press(hand, servo), fingertip_press(hand, servo, drive=0.5)
    assert half == pytest.approx(full / 2, rel=0.05)  # static: proportional to torque
    assert fingertip_press(hand, servo, stiffness=20000.0) == pytest.approx(full, rel=0.05)  # and hardly of the rubber
    unknown = {name: column | {"torque_limit": "unknown"} for name, column in servo["joints"].items()}
    with pytest.raises(UserError, match="torque_limit of .* is unknown; state it"):
        fingertip_press(hand, servo | {"joints": unknown})


# -- ends
# ---------------------------------------------------------------------------------------------------------------------


def test_a_dropped_object_ends_the_episode_and_the_others_go_on(env):
    env.step(act(env))
    q = env.engine.t.qpos.clone()
    q[3, env.object_q[2]] = -0.2
    q[5, env.object_q[0]] = 1.0
    env.engine.t.qpos.copy_(q)
    _, reward, done, extras = env.step(act(env))
    assert done.tolist() == [0, 0, 0, 1, 0, 1, 0, 0] and not extras["time_outs"].any()
    assert reward[[3, 5]].max() < -2  # the penalty
    assert env.episode_length_buf.tolist() == [2, 2, 2, 0, 2, 0, 2, 2]
    assert bool((env.object_pose[[3, 5], 2] > 0).all()) and extras["log"]["end/dropped"] == pytest.approx(2 / N)
    assert not env.engine.t.xfrc_applied[[3, 5]].any()


def test_an_object_that_is_no_longer_held_ends_the_episode_while_learning(env, monkeypatch):
    held = torch.tensor([[1.0, 0, 0, 2.0, 0]] * N)  # by the thumb and a finger
    held[1], held[2], held[4] = torch.tensor([0, 1.0, 1.0, 1.0, 1.0]), torch.tensor([3.0, 0, 0, 0, 0]), 0.0
    lost = [False, True, True] + [False] * 5  # world 4 is too young
    env.reset_all()
    env.episode_length_buf = torch.tensor([int(2.0 / env.dt) + 1] * 4 + [int(2.0 / env.dt) - 1] * 4)
    env.finger_force.copy_(held)
    for rate, command, ends in ((1.0, None, lost), (0.0, None, [False] * N), (1.0, torch.zeros(N), [False] * N)):
        monkeypatch.setitem(env.task["termination"], "untouched", rate)
        monkeypatch.setattr(env, "fixed_command", command)  # the last: of an evaluation
        env.update()
        assert env.is_dropped().tolist() == ends
    monkeypatch.setitem(env.task["termination"], "untouched", 0.2)
    monkeypatch.setattr(env, "fixed_command", None)
    ended = 0
    for _ in range(200):
        env.update()
        ended += int(env.is_dropped().sum())
    assert abs(ended / 400 - 0.2) < 0.08  # 4 standard deviations


def test_time_out_is_flagged_apart_from_termination(env):
    env.episode_length_buf = torch.tensor([0, env.max_episode_length - 1, 0, 0, env.max_episode_length - 1, 0, 0, 0])
    env.engine.t.qpos[4, env.object_q[2]] = -0.3  # dropped in its last step: not a time-out
    _, _, done, extras = env.step(act(env))
    assert done.tolist() == [0, 1, 0, 0, 1, 0, 0, 0]
    assert extras["time_outs"].bool().tolist() == [False, True] + [False] * 6


def test_assigning_the_episode_length_keeps_its_memory(env):
    """The runner assigns random lengths; a recorded step must go on with them."""
    memory = env.episode_length_buf.data_ptr()
    env.episode_length_buf = torch.arange(N)
    assert env.episode_length_buf.data_ptr() == memory
    env.step(act(env))
    assert env.episode_length_buf.tolist() == list(range(1, N + 1))


@pytest.mark.parametrize("where", ["qpos", "qvel"])
def test_a_nan_world_is_ended_counted_and_replaced(env, where):
    env.step(act(env))
    count = int(env.nan_count)
    getattr(env.engine.t, where)[2, 14] = float("nan")
    obs, reward, done, extras = env.step(act(env))
    assert done.tolist() == [0, 0, 1, 0, 0, 0, 0, 0] and not extras["time_outs"].any()
    assert int(env.nan_count) == count + 1 and extras["log"]["end/nan"] == pytest.approx(1 / N)
    for _ in range(3):
        for group in obs.values():
            assert bool(torch.isfinite(group).all())
        assert bool(torch.isfinite(reward).all()) and all(
            bool(torch.isfinite(torch.as_tensor(v)).all()) for v in extras["log"].values()
        )
        assert not (env.engine.t.flags & FLAG_NAN).any()
        obs, reward, done, extras = env.step(act(env))
    assert not done.any()


def test_nan_actions_are_harmless(env):
    a = torch.full((N, 12), float("nan"))
    a[0] = float("inf")
    obs, reward, *_ = env.step(a)
    assert bool(torch.isfinite(obs["actor"]).all()) and bool(torch.isfinite(reward).all())
    assert bool((env.target <= env.q_high).all() and (env.target >= env.q_low).all())


# -- actions
# ---------------------------------------------------------------------------------------------------------------------


def test_relative_actions_move_the_target_within_limits_and_lead(env):
    scale, lead = env.task["action"]["scale"], env.lead()
    start, q = env.target.clone(), env.q.clone()
    a = torch.linspace(-2, 2, 12).expand(N, 12)
    env.step(a)
    expect = torch.minimum(torch.maximum(start + a.clamp(-1, 1) * scale, env.q_low), env.q_high)
    torch.testing.assert_close(env.target, torch.minimum(torch.maximum(expect, q - lead), q + lead))
    for _ in range(60):
        q = env.q.clone()
        env.step(torch.ones(N, 12))
        assert bool((env.target <= env.q_high + 1e-6).all()) and bool((env.target - q <= lead + 1e-5).all())


def test_absolute_actions_span_each_joints_range():
    env = grasp_env("task.action.mode=absolute", "tactile.others=false", worlds=2)
    limits = torch.as_tensor(xhand.joint_limits(), dtype=torch.float32)
    for value, column in ((-1.0, limits[:, 0]), (1.0, limits[:, 1]), (0.0, limits.mean(1)), (5.0, limits[:, 1])):
        env.step(torch.full((2, 12), value))
        torch.testing.assert_close(env.target, column.expand(2, 12), rtol=0, atol=1e-6)


def test_an_unknown_action_mode_is_a_user_error():
    cfg = grasp_cfg(worlds=1)
    cfg["task"]["action"]["mode"] = "velocity"
    with pytest.raises(UserError, match="task.action.mode"):
        make_env(cfg, 1, "cpu", 0, "mujoco")


# -- commands and pushes
# --------------------------------------------------------------------------------------------------------------


def test_commands_change_within_an_episode(env):
    hold = env.task["command"]["hold_s"]
    values, since, gaps = [], torch.zeros(N), []
    last = env.command.clone()
    for _ in range(300):
        env.before_physics()
        changed = env.command != last
        since += env.dt
        gaps += since[changed].tolist()
        since[changed] = 0
        values.append(env.command.clone())
        last = env.command.clone()
    values = torch.stack(values)
    assert 0 <= float(values.min()) and float(values.max()) <= 1 and float(values.std()) > 0.2
    assert min(gaps) > hold[0] - 2 * env.dt and max(gaps) < hold[1] + 2 * env.dt and len(gaps) > N


def test_pushes_have_no_favoured_direction_and_the_stated_size(env):
    """Force on the object while pushed: |F| / weight within the range, directions and duty as drawn."""
    forces, length = [], torch.zeros(N)
    weight = env.objects.mass * 9.81
    lengths = []
    for _ in range(3000):
        env.before_physics()
        f = env.engine.t.xfrc_applied[:, env.objects.body].clone()
        assert not f[:, 3:].any()
        f = f[:, :3].float()
        on = f.norm(dim=1) > 0
        lengths += length[(~on) & (length > 0)].tolist()
        length = torch.where(on, length + env.dt, torch.zeros_like(length))
        forces.append((f / weight[:, None])[on])
    low, high, _ = env.sampler.range("push.weights")
    f = torch.cat(forces)
    size = f.norm(dim=1)
    assert low <= float(size.min()) and float(size.max()) <= high + 1e-4 and float(size.max()) > 0.9 * high
    unique = torch.unique((f / size[:, None] * 1e4).round(), dim=0) / 1e4
    assert len(unique) > 200
    assert float(unique.mean(0).norm()) < 4 * (1 / len(unique)) ** 0.5, "zero mean"
    assert torch.allclose((unique.T @ unique) / len(unique), torch.eye(3) / 3, atol=0.1), "no favoured axis"
    d = env.sampler.range("push.duration")
    assert d[0] - 2 * env.dt < min(lengths) and max(lengths) < d[1] + 2 * env.dt


def test_a_force_and_a_turned_hand_move_the_object_as_the_evaluation_means_it(env):
    """An object that touches nothing gains (gravity + force / mass) dt, whichever way gravity has been turned."""
    env.pushes = False
    try:
        gravity = torch.tensor([[0.0, 6.0, 7.0], [0.0, 0.0, 9.81]]).repeat(N // 2, 1)
        env.outside_force.copy_(2 * 9.81 * env.objects.mass[:, None] * torch.tensor([0.6, -0.8, 0.0]))
        env.engine.field("opt.gravity").copy_(gravity)
        before = env.object_velocity[:, :3].clone()
        env.step(act(env))
        assert not env.finger_force.any() and not env.palm_force.any()
        gained = (gravity + env.outside_force / env.objects.mass[:, None]) * env.dt
        torch.testing.assert_close(env.object_velocity[:, :3] - before, gained, rtol=0.01, atol=0.005)
    finally:
        env.pushes = True
        env.outside_force.zero_()


def test_pushes_can_be_turned_off(env):
    env.pushes = False
    try:
        for _ in range(200):
            env.before_physics()
            assert not env.engine.t.xfrc_applied.any()
    finally:
        env.pushes = True


# -- the same again
# ---------------------------------------------------------------------------------------------------------------------


def rollout(env, steps: int = 40, seed: int = 5) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    out = []
    for _ in range(steps):
        obs, reward, done, _ = env.step(torch.rand(env.num_envs, 12, generator=g) * 2 - 1)
        out.append(torch.cat([obs["actor"], obs["critic"], reward[:, None], done[:, None]], 1))
    return torch.stack(out)


def test_the_same_seed_gives_the_same_rollout():
    a, b = (rollout(grasp_env("tactile.others=false", worlds=4, seed=3)) for _ in range(2))
    assert torch.equal(a, b)
    assert not torch.equal(a, rollout(grasp_env("sim.threads=1", "tactile.others=false", worlds=4, seed=4)))


def test_state_dict_round_trip(env):
    env.step(act(env, 0.3))
    env.nan_count += 2
    state = {k: v.clone() for k, v in env.state_dict().items()}
    env.load_state_dict(state)
    first = rollout(env, 10)
    assert int(env.nan_count) == int(state["nan_count"])
    env.load_state_dict(state)
    assert torch.equal(first, rollout(env, 10))
    env.nan_count.zero_()


def test_a_rollout_under_inference_mode_comes_first():
    """Training collects under inference mode; whoever steps later must not be stopped by tensors made there."""
    env = grasp_env("tactile.others=false", worlds=2)
    with torch.inference_mode():
        env.step(torch.zeros(2, 12))
    env.step(torch.zeros(2, 12))


def test_final_observations_are_those_before_the_reset(env):
    env.keep_final_obs = True
    try:
        env.step(act(env))
        env.episode_length_buf = torch.full((N,), env.max_episode_length - 1)
        obs, _, done, extras = env.step(act(env))
        assert done.all()
        z = SLICES["object_position"].start + 2
        assert not torch.equal(extras["final_obs"]["critic"][:, z], obs["critic"][:, z])
        assert torch.equal(obs["critic"][:, z], env.object_pose[:, 2])
    finally:
        env.keep_final_obs = False


# -- bad settings
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change, word", [
    (("randomize", "object", "mass", [-0.1, 0.3]), "object.mass"),
    (("randomize", "servo", "delay", [0.0, 0.4]), "delay"),
    (("randomize", "servo", "kp", [-1.0, 1.0]), "kp"),
    (("randomize", "servo", "slop", [0.0, 0.1]), "slop"),
    (("sim", "control_period", 0.0123), "control_period"),
    (("task", "command", "low", 0.9), None),
    (("task", "command", "high", 1.5), "command"),
    (("task", "contact", "impedance", 1.0), "impedance"),
    (("task", "critic", "oracle"), "task.critic"),
    (("task", "termination", "untouched", -1.0), "termination.untouched"),
    (("task", "command", "zero", -0.1), "command.zero"),
    (("task", "objects", "train", ["cube"]), "cube"),
    (("task", "objects", "held_out", []), "held_out"),
])  # fmt: skip
def test_impossible_settings_are_user_errors(change, word):
    cfg = grasp_cfg("tactile.others=false", worlds=1)
    *path, value = change
    node = cfg
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    if word is None:
        make_env(cfg, 1, "cpu", 0, "mujoco")
        return
    with pytest.raises(UserError, match=word):
        make_env(cfg, 1, "cpu", 0, "mujoco")


def test_play_prints_the_papers_columns_of_the_grasp():
    """Ranges and correlations of held episodes, of forces and torques that follow the command exactly or not at all."""
    n = 200
    command = np.linspace(0.1, 1.0, n)
    r = {
        "command": command,
        "mass": np.full(n, 0.05),
        "friction": np.full(n, 1.0),
        "load": np.full(n, 0.5),
        "pushed": np.zeros(n),
        "held": np.ones(n),
        "held90": np.ones(n),
        "held180": np.ones(n),
        "force": command[:, None] * [1.0, 2, 2, 2, 2],
        "alive": np.ones(n),
        "torque": np.tile(np.where(np.arange(n) % 2, 0.2, 0.4)[:, None], 12),
        "moved": np.zeros(n),
        "untouched": np.zeros(n),
    }
    stage = SimpleNamespace(f_max=2.0, hand=load_hand(), task={}, thumb_range=None)
    metrics = grasp_eval._metrics(r, r, stage)
    (title, header, rows), (_, _, intervals) = grasp_eval._papers_columns(metrics)
    assert "paper's columns" in title and header[0] == "contact forces N" and len(rows) == 1
    low, high = (float(x) for x in rows[0][0].split(" .. "))
    assert low == pytest.approx(9 * np.quantile(command, 0.05), abs=0.01) and high == pytest.approx(
        9 * np.quantile(command, 0.95), abs=0.01
    )
    assert rows[0][1:3] == ("0.2 .. 0.4", "1.000") and abs(float(rows[0][3])) < 0.05
    assert [i[0] for i in intervals] == [
        "hold_rate",
        "hold_rate_pushed",
        "hold_rate_kept_out_shapes",
        "force_command_correlation",
        "torque_command_correlation",
    ]
    thumb, *others = grasp_eval._by_finger(r, stage)  # presses with twice what is said, F_max is 2 N
    assert thumb[:2] == ("thumb", "none: a band") and all(x[1:4] == ("the command", "1.00", "0.00") for x in others)
    stage.thumb_range = [0.0, 1.0]
    thumb = grasp_eval._by_finger(r | {"thumb_command": 1 - command}, stage)[0]
    assert thumb[1:3] == ("its own", "-1.00")
    assert float(thumb[3]) == pytest.approx(np.abs(3 * command - 2).mean(), abs=0.01)
    nothing = r | {"held": np.zeros(n)}
    assert grasp_eval._papers_columns(grasp_eval._metrics(nothing, nothing, stage))[0][2] == [("-", "-", "-", "-")]


def test_the_grasps_intervals_are_those_of_theory():
    """A share of 300 in 400 by its standard error, one of 40 in 40 by Wilson's formula; a correlation of 0.6 in 400
    samples by Fisher's z."""
    rng = np.random.default_rng(3)
    low, high = grasp_eval._rate_interval(np.arange(500) % 4 != 0, np.arange(500) < 400)
    half = 1.96 * (0.75 * 0.25 / 400) ** 0.5
    assert low == pytest.approx(0.75 - half, abs=0.01) and high == pytest.approx(0.75 + half, abs=0.01)
    always, never = (grasp_eval._rate_interval(np.full(40, x), np.full(40, True)) for x in (True, False))
    width = 1.96**2 / (40 + 1.96**2)  # z^2 / (n + z^2)
    assert always == pytest.approx([1 - width, 1.0], abs=1e-4) and never == pytest.approx([0.0, width], abs=1e-4)
    a, noise = rng.normal(size=(2, 400))
    b = 0.6 * a + 0.8 * noise
    r = np.corrcoef(a, b)[0, 1]
    theory = np.tanh(np.arctanh(r) + np.array([-1.96, 1.96]) / 397**0.5)
    assert grasp_eval._corr_interval(a, b) == pytest.approx(theory, abs=0.015)
    assert grasp_eval._rate_interval(a > 0, a > 9) is None and grasp_eval._corr_interval(a, 0 * a) is None
