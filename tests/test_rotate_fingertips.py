"""The rotation by fingertips: starts, goals, what the actor knows, camera, pushes, what touches. CPU, C MuJoCo."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from dexsim import rotation
from dexsim.cli import start
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tactile.layout import hand_layout
from dexsim.tasks import make_env
from dexsim.tasks.make_fingertip_grasps import DRIFT, OTHER, TURN
from dexsim.tasks.patches import Patches
from dexsim.tasks.rotate_fingertips import PALMS
from dexsim.tasks.stable_grasps import FINGERTIPS, GraspSet

torch.set_num_threads(1)
CHECKPOINT = Path(__file__).parents[1] / "checkpoints" / "rotate_fingertips.pt"
STILL = ("randomize.push.weights=0",)
CLEAR = (
    "task.sensors.camera_rotation=0", "task.sensors.camera_position=0", "randomize.camera.tilt=0",
    "randomize.camera.offset=0",
)  # fmt: skip


def make(*overrides: str, worlds: int = 8, seed: int = 0):
    argv = ["task=rotate_fingertips", "device=cpu", f"worlds={worlds}", "sim.threads=1", *overrides]
    return make_env(start.for_train(argv, CONFIGS).cfg, worlds, "cpu", seed, "mujoco")


@pytest.fixture(scope="module")
def env():
    return make()


def play(env, seconds: float):
    for _ in range(round(seconds / env.dt)):
        obs = env.step(torch.zeros(env.num_envs, 12))[0]
    return obs


# -- starts ------------------------------------------------------------------------------------------------------------


def test_starts_are_held_by_fingertips_whatever_the_palm():
    """Among 24 starts, each in a world of its own with its palm up, sideways or down, at least 20 hold for a second."""
    env = make(*STILL, worlds=24)
    env.in_order = True
    env.grasps = env.grasps[torch.arange(0, len(env.grasps), len(env.grasps) // 24)[:24]]
    env.reset_all()
    held = torch.ones(24, dtype=torch.bool)
    for _ in range(round(1.0 / env.dt)):
        env.step(torch.zeros(24, 12))
        held &= (env.object_pose[:, :3] - env.home).norm(dim=1) < DRIFT
        held &= rotation.error(env.object_pose[:, 3:], env.first) < TURN
        held &= (env.other_force < OTHER) & (env.tip_force[:, 0] > 0.05)
    assert set(env.palm.tolist()) == {0, 1, 2}
    assert int(held.sum()) >= 20


def test_the_set_covers_the_sizes():
    edge = GraspSet.load(FINGERTIPS).edge.numpy()
    counts = np.histogram(edge, [0.04, 0.045, 0.05, 0.055, 0.06, 0.0651])[0]
    assert len(edge) == counts.sum() and counts.min() > 100


@pytest.mark.parametrize(("palm", "down"), [("up", -1.0), ("side", 0.0), ("down", 1.0)])
def test_the_palm_looks_where_it_is_told(palm, down):
    env = make(f"task.palm=[{palm}]", worlds=4)
    g = env.engine.field("opt.gravity")
    assert torch.allclose(g.norm(dim=1), torch.full((4,), 9.81, dtype=g.dtype), atol=1e-5)
    assert torch.allclose(g[:, 2] / 9.81, torch.full((4,), down, dtype=g.dtype), atol=1e-6)
    assert (env.palm == PALMS.index(palm)).all()
    assert torch.allclose(env.obs["actor"][:, -3:], g.float() / 9.81, atol=1e-6)


# -- goals -------------------------------------------------------------------------------------------------------------


def test_goals_turn_about_every_axis_both_ways_and_stay_in_reach():
    env = make(worlds=256)
    last, seen = env.first.clone(), set()
    for _ in range(12):
        env.goal.copy_(last)
        goal = env.next_goal(env.object_pose[:, 3:])
        assert torch.allclose(rotation.error(last, goal), torch.full((256,), math.radians(20)), atol=1e-3)
        assert (rotation.error(env.first, goal) <= math.radians(30.2)).all()
        step = rotation.multiply(goal, rotation.conjugate(last))[:, 1:]
        axis = step.abs().argmax(1)
        sign = step.gather(1, axis[:, None])[:, 0].sign()
        assert torch.allclose(step.abs().amax(1), step.norm(dim=1), atol=1e-3)  # about one of the palm's axes
        seen |= set(zip(axis.tolist(), sign.tolist(), strict=True))
        last = goal
    assert len(seen) == 6


def test_a_goal_that_is_not_reached_is_replaced_in_training_only():
    env = make("task.goal.patience=0.5", *STILL, worlds=4)
    before = env.goal.clone()
    play(env, 0.4)
    assert torch.equal(env.goal, before)
    play(env, 0.2)
    assert (rotation.error(env.goal, before) > 0.1).all() and (env.successes == 0).sum() > 2  # one may be reached
    env.end_curriculum()
    before = env.goal.clone()
    play(env, 0.7)
    assert torch.equal(env.goal, before)


# -- what the actor knows
# ------------------------------------------------------------------------------------------------


def test_the_actor_does_not_know_size_mass_or_friction(env):
    """Its observation of one state does not change with them; the critic's does."""
    env.reset_all()
    play(env, 0.1)
    state = env.rng.get_state()
    before = {k: v.clone() for k, v in env.observe(advance=False).items()}
    o = env.objects
    saved = [v.clone() for v in (o.size, o.mass, o.friction, o.com)]
    for v in (o.size, o.mass, o.friction, o.com):
        v.mul_(1.7).add_(0.01)
    env.rng.set_state(state)
    after = env.observe(advance=False)
    for v, old in zip((o.size, o.mass, o.friction, o.com), saved, strict=True):
        v.copy_(old)
    assert torch.equal(before["actor"], after["actor"])
    assert not torch.equal(before["critic"], after["critic"])


def test_rows_lose_what_they_say():
    whole = make(worlds=2).obs["actor"].shape[1]
    assert make("task.observe.orientation=none", worlds=2).obs["actor"].shape[1] == whole - 6 - 3 - 1
    assert make("task.observe.contact_force=false", worlds=2).obs["actor"].shape[1] == whole - 5
    no_touch = ("task.observe.contact_force=false", "task.observe.contact_centre=false")
    assert make(*no_touch, worlds=2).obs["actor"].shape[1] == whole - 20
    env = make(worlds=2)
    for group, rows in env.describe()["observations"].items():
        assert sum(r[1] for r in rows) == env.obs[group].shape[1], group


# -- the camera --------------------------------------------------------------------------------------------------------


def test_the_pose_is_late_by_its_delay():
    env = make(*CLEAR, *STILL, "randomize.camera.delay=0.084", "randomize.camera.visible=1000", worlds=2)
    poses = [env.object_pose.clone()]
    for _ in range(8):
        env.object_velocity.zero_()
        env.step(0.3 * torch.ones(2, 12))
        poses.append(env.object_pose.clone())
    assert torch.allclose(env.old, torch.full((2,), 0.084))
    assert (poses[-3][:, :3] - poses[-1][:, :3]).norm(dim=1).min() > 1e-5  # the cube does move
    assert torch.allclose(env.seen_position, poses[-3][:, :3], atol=1e-7)
    assert (rotation.error(env.seen, poses[-3][:, 3:]) < 1e-4).all()


def test_a_hidden_pose_stays_as_it_was_and_ages():
    env = make(*STILL, "randomize.camera.delay=0.042", "randomize.camera.visible=0.21", "randomize.camera.hidden=0.42",
               worlds=2)  # fmt: skip
    ages, seen = [], []
    for _ in range(30):
        env.step(torch.zeros(2, 12))
        ages.append(env.old[0].item())
        seen.append(env.seen[0].clone())
    hidden = [k for k in range(1, 30) if ages[k] > 0.05]
    assert 0.5 < len(hidden) / 29 < 0.8  # 0.42 of 0.63 s
    assert max(ages) == pytest.approx(0.042 + 0.42, abs=0.05)
    for k in range(1, 30):
        assert torch.equal(seen[k], seen[k - 1]) == (k in hidden)


# -- pushes and touches ------------------------------------------------------------------------------------------------


def test_pushes_come_and_are_as_strong_as_they_say():
    env = make(
        "randomize.push.weights=[1.0,1.5]", "randomize.push.wait=[0.1,0.3]", "randomize.push.duration=0.126", worlds=4
    )
    on = []
    for _ in range(40):
        env.step(torch.zeros(4, 12))
        force = env.engine.t.xfrc_applied[:, env.objects.body, :3].norm(dim=1).float() / (9.81 * env.objects.mass)
        assert ((force == 0) | ((force > 0.999) & (force < 1.501))).all()
        on.append(force > 0)
    share = torch.stack(on).float().mean()
    assert 0.2 < share < 0.6


def test_what_rests_on_the_palm_is_counted_and_ends():
    env = make(*STILL, "task.palm=[up]", "randomize.object.size=[0.049,0.051]", worlds=2)
    pose = env.engine.t.qpos[:, env.object_q].float().clone()
    pose[0] = torch.tensor([0.0, 0.0, 0.051, 1.0, 0.0, 0.0, 0.0])  # on the palm; the hand opens
    hand = env.q.clone()
    hand[0] = 0.05
    env.home.copy_(pose[:, :3])
    env.place(torch.tensor([True, False]), hand, pose, torch.zeros(2, 6))
    touched = ended = 0
    for _ in range(20):
        dones = env.step(torch.zeros(2, 12))[2]
        touched += int(env.trial_counts()["other_steps"][0])
        if dones[0]:
            ended = 1
            break
    assert touched and ended and env.tipped[0] and env.end_names[int(env.ended_by()[0])] == "leaned"
    assert not env.tipped[1]


def test_an_evaluation_keeps_its_trials():
    env = make("task.evaluation.cap_s=0.5", worlds=6)
    m = env.evaluate(lambda obs: torch.zeros(6, 12), episodes=6, seed=3)["metrics"]
    assert m["episodes"] == len(m["trials"]) == 6 and set(m["ends"]) == {"dropped", "leaned", "nan", "capped"}
    for successes, seconds, end, palm, edge, mass, friction, other in m["trials"]:
        assert 0 <= other <= seconds
        assert successes >= 0 and 0 < seconds <= 0.51 and end in m["ends"] and palm in PALMS
        assert 0.04 <= edge <= 0.065 and 0.03 <= mass <= 0.25 and 0.3 <= friction <= 1.2
    assert 0 <= m["touched_by_others"] <= 1


@pytest.mark.slow
def test_a_trials_facts_are_of_its_own_episode():
    """Whatever ends begins anew at once, with another palm, mass and friction: a trial keeps those it was played in."""
    env = make("task.evaluation.cap_s=1.5", worlds=12)
    first: dict = {}

    def let_go(obs):
        first.update({} if first else {k: v.clone() for k, v in env.trial_facts().items()})
        return -torch.ones(12, 12)

    trials = env.evaluate(let_go, episodes=12, seed=3)["metrics"]["trials"]
    over = [i for i, t in enumerate(trials) if t[2] != "capped"]
    assert len(over) >= 6 and any(env.palm[i] != first["palm"][i] for i in over)
    assert (env.objects.mass[over] != first["mass"][over]).all()
    for i, (_, _, _, palm, edge, mass, friction, _) in enumerate(trials):
        assert PALMS.index(palm) == first["palm"][i]
        assert [edge, mass, friction] == pytest.approx(
            [float(first[k][i]) for k in ("edge", "mass", "friction")], abs=6e-4
        )


# -- fewer taxels ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 5, 24, 120])
def test_patches_keep_the_force_and_lose_the_place(count):
    layout = hand_layout(load_hand())
    p = Patches(layout, count, "cpu")
    assert (p.member.sum(2).sum(1) == torch.as_tensor(layout.count)).all()  # every taxel in one patch
    assert (p.member.sum(1) > 0).all()  # none is empty
    raw = torch.zeros(2, 5, 120)
    raw[0, 2, 7] = 3.0
    force, centre = p.read(raw)
    assert force[0, 2] == 3.0 and force.sum() == 3.0
    off = np.linalg.norm(centre[0, 2].numpy() - layout.point[2, 7])
    assert (off < 1e-6) == (count == 120) and off < 0.02
    assert torch.allclose(centre[1], torch.as_tensor(layout.centre(), dtype=torch.float32))


def test_bits_say_only_whether():
    p = Patches(hand_layout(load_hand()), "bits", "cpu")
    raw = torch.zeros(1, 5, 120)
    raw[0, 1, :4] = 2.5
    force, centre = p.read(raw)
    assert force[0].tolist() == [0, 1, 0, 0, 0]
    assert torch.allclose(centre[0], p.centre)


# -- wrong settings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("setting", [
    "task.palm=[]", "task.palm=[up,left]", "task.goal.axes=[w]", "task.goal.reach=15", "task.goal.reach=200",
    "task.goal.patience=0", "task.termination.lean_s=-1", "task.observe.taxels=0", "task.observe.taxels=some",
    "randomize.camera.delay=2", "randomize.push.weights=-1", "task.perception=imu", "task.mode=table",
])  # fmt: skip
def test_bad_settings_are_named(setting):
    with pytest.raises(UserError, match=setting.partition("=")[0].replace("randomize.", "")):
        make(setting, worlds=2)


def test_the_included_policy_is_not_exported_to_a_loop_without_a_camera(tmp_path):
    from dexsim.export import export

    with pytest.raises(UserError, match="camera and arm are not read by the deployed loop"):
        export(str(CHECKPOINT), tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()
