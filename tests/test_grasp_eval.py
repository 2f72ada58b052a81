"""The evaluation of the grasp on a stage: objects lie where the test says, and what the evaluation does to them is
noted."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.tasks import base_path, grasp_eval
from dexsim.tasks.grasp_eval import HOLD, PUSH_S, SETTLE, STAY_S, TURN_S
from dexsim.tasks.randomize import Sampler

N, DT = 6, 0.05
MASS = torch.linspace(0.05, 0.3, N)


class Stage:
    """What the evaluation asks of an environment. From SETTLE on, the object of each world lies `away` [N] m beside its
    place; touched [N, 5]: which fingers touch it. gravity, force: [steps, N, 3], as they were at each step."""

    def __init__(self, away: torch.Tensor, touched: torch.Tensor):
        self.num_envs, self.device, self.dt, self.max_episode_length, self.pushes = N, "cpu", DT, 10, True
        self.rng = torch.Generator().manual_seed(0)
        self.sampler = Sampler({}, self.rng, N, "cpu")
        self.objects = SimpleNamespace(mass=MASS, friction=torch.ones(N), variant=torch.zeros(N, dtype=torch.long))
        self.hand, self.unit, self.task = load_hand(), 1.0, {}
        self.opposing, self.others = torch.tensor([0]), torch.tensor([1, 2, 3, 4])
        self.fixed_command, self.outside_force, self.f_max, self.thumb_range = None, torch.zeros(N, 3), 8.0, None
        self.thumb_command = self.fixed_thumb = torch.zeros(N)
        self.fields = {"opt.gravity": torch.zeros(N, 3)}
        self.engine = SimpleNamespace(field=self.fields.__getitem__)
        self.away, self.object_pose = away, torch.zeros(N, 7)
        self.finger_force = self.tip_force = touched.float()
        self.palm_force = touched.float().sum(1)  # as much as the fingertips
        self.torque, self.gravity, self.force = torch.zeros(N, 12), [], []

    def forget_recorded(self):
        """Do nothing: it records nothing."""

    def reset_all(self):
        self.fields["opt.gravity"].copy_(torch.tensor([0.0, 0.0, -9.81]).expand(N, 3))

    def get_observations(self):
        return None

    def step(self, actions):
        self.gravity.append(self.fields["opt.gravity"].clone())
        self.force.append(self.outside_force.clone())
        if (len(self.force) - 1) * DT > SETTLE:
            self.object_pose[:, 0] = self.away
        return None, None, torch.zeros(N), {}


def play(away=0.0, touched=True) -> tuple[Stage, dict]:
    """Return one episode in every world of a stage."""
    stage = Stage(torch.as_tensor(away).expand(N), torch.as_tensor(touched).expand(N, 5))
    out, _ = grasp_eval._play(stage, lambda obs: None, False, None, "", 0, N)
    stage.gravity, stage.force = torch.stack(stage.gravity), torch.stack(stage.force)
    return stage, out


def test_the_hand_is_turned_by_90_and_by_180_degrees():
    """Gravity as the palm has it: down while it is held, across the palm after the first turn, up after the second."""
    g = play()[0].gravity / 9.81
    torch.testing.assert_close(g.norm(dim=2), torch.ones(g.shape[:2]))
    t = DT * torch.arange(len(g))
    first = SETTLE + HOLD
    second = first + TURN_S + STAY_S
    z = g[..., 2]
    assert (z[t <= first] == -1).all()
    torch.testing.assert_close(
        z[(t > first + TURN_S + 1e-6) & (t < second)].abs().max(), torch.tensor(0.0), rtol=0, atol=1e-6
    )
    torch.testing.assert_close(
        z[t > second + TURN_S + 1e-6], torch.ones(1, 1).expand(int((t > second + TURN_S + 1e-6).sum()), N)
    )
    assert (t > second + TURN_S).sum() * DT >= STAY_S - 2 * DT
    across = g[int((second - 0.5 * STAY_S) / DT), :, :2]
    assert float(torch.pdist(across).min()) > 1e-3, "each world is turned about an axis of its own"


def test_every_second_world_is_pushed_by_twice_its_weight_for_half_a_second():
    force = play()[0].force
    on = force.norm(dim=2) > 0
    t = DT * torch.arange(len(force))
    assert not on[:, 1::2].any()
    for w in range(0, N, 2):
        mine = on[:, w]
        assert int(mine.sum()) * DT == pytest.approx(PUSH_S, abs=1.01 * DT)
        assert SETTLE + 0.5 <= float(t[mine].min()) and float(t[mine].max()) <= SETTLE + HOLD - 0.5
        torch.testing.assert_close(force[mine, w].norm(dim=1), (2 * 9.81 * MASS[w]).expand(int(mine.sum())))
    assert float(torch.pdist(force[:, ::2].sum(0) / force[:, ::2].sum(0).norm(dim=1, keepdim=True)).min()) > 0.1, (
        "in random directions"
    )


def test_held_is_within_30_mm_of_where_it_settled():
    away = torch.tensor([0.0, 0.02, 0.029, 0.031, 0.05, 0.14])
    out = play(away)[1]
    inside = [True, True, True, False, False, False]
    for name in ("held", "held90", "held180"):
        assert out[name].tolist() == inside, name
    assert out["moved"].tolist() == [not x for x in inside] and not out["untouched"].any()


def test_held_is_touched_by_the_thumb_and_a_finger():
    touched = torch.zeros(N, 5, dtype=torch.bool)
    touched[0], touched[1, [0, 3]], touched[2, 0], touched[3, 1:] = True, True, True, True
    out = play(0.0, touched)[1]
    assert out["held"].tolist() == [True, True, False, False, False, False]
    assert out["untouched"].tolist() == [False, False, True, True, True, True] and not out["moved"].any()


def test_what_must_be_held_is_what_the_commanded_forces_can_carry():
    """Four fingers of 10 N at command 0.5 are 20 N: with friction 0.8 they carry a load of 8 N, and not more."""
    r = {"command": np.full(4, 0.5), "friction": np.full(4, 0.8), "load": np.array([4.0, 7.9, 8.1, 20.0])}
    assert grasp_eval.must_hold(r, 10.0, 4).tolist() == [True, True, False, False]
    r["mass"] = r["load"] / 9.81
    assert grasp_eval.can_carry(r, 10.0, 4).tolist() == [True, True, False, False]


def test_the_load_is_weight_and_push_together():
    """Up to three times the weight for those that are pushed (by twice of it), the weight itself for the others."""
    out = play()[1]
    weight = 9.81 * MASS.numpy()
    np.testing.assert_allclose(out["load"][1::2], weight[1::2], rtol=1e-5)
    ratio = out["load"][::2] / weight[::2]
    assert (ratio >= 1 - 1e-5).all() and (ratio <= 3 + 1e-5).all() and (abs(ratio - 1) > 1e-3).all()


def test_episodes_are_sorted_by_what_fingertips_carry():
    r = {
        "tips": np.array([0.1, 0.1, 0.5, 0.5, 1.0, 0.95]), "pushed": np.array([1, 0, 1, 0, 0, 0]),
        "command": np.array([0.5, 0.5, 0.5, 0.5, 0.5, 0.05]), "held": np.array([1, 1, 0, 1, 0, 0]),
        "held180": np.array([1, 0, 0, 1, 0, 0]),
    }  # fmt: skip
    rows = grasp_eval.by_share(r)
    assert rows["from"] == [0.0, 0.4, 0.8] and rows["episodes"] == [2, 2, 1]  # too weak a command does not count
    assert rows["held"] == [1.0, 1.0, 0.0] and rows["held_pushed"] == [1.0, 0.0, None]
    assert rows["held_turned_180"] == [0.5, 0.5, 0.0]


def test_what_fingertips_carry_is_measured_against_links_and_palm():
    _, out = play()
    assert np.allclose(out["tips"], 0.5)


def test_a_lift_is_gravity_of_a_carried_frame():
    """The path's acceleration, integrated, rises by LIFT and comes to rest; shaken, it returns to where it was."""
    h = 1e-4
    t = np.arange(0.0, 2.0, h) + h / 2
    for path, end in ((base_path.lifted, [0, 0, base_path.LIFT]), (base_path.shaken, [0, 0, 0])):
        v = np.cumsum([path(x) for x in t], 0) * h
        x = np.cumsum(v, 0) * h
        assert np.abs(v[-1]).max() < 1e-3 and np.abs(x[-1] - end).max() < 1e-3, path
    assert np.abs(x).max(0) == pytest.approx([2 * base_path.SHAKE, 2 * base_path.SHAKE, 0.0], abs=1e-3)


def test_the_hand_is_lifted_and_shaken_instead_of_turned():
    stage = Stage(torch.zeros(N), torch.ones(N, 5, dtype=torch.bool))
    stage.task = {"evaluation": {"base": "lift"}}
    out, _ = grasp_eval._play(stage, lambda obs: None, False, None, "", 0, N)
    g = torch.stack(stage.gravity)[:, 0].numpy()
    t = DT * np.arange(len(g))
    still = (t < SETTLE + HOLD) | ((t > SETTLE + HOLD + TURN_S) & (t < SETTLE + HOLD + TURN_S + STAY_S))
    assert np.allclose(g[still], [0, 0, -9.81], atol=1e-5)
    lifting = (t > SETTLE + HOLD) & (t < SETTLE + HOLD + TURN_S)
    assert g[lifting, 2].min() < -12 and g[lifting, 2].max() > -8 and np.allclose(g[lifting, :2], 0)
    shaking = t >= SETTLE + HOLD + TURN_S + STAY_S
    assert np.abs(g[shaking, :2]).max(0).min() > 5 and np.allclose(g[shaking, 2], -9.81, atol=1e-5)
    assert out["held180"].all()


def _path(folder, rows: str, head: str = "t,x,y,z") -> str:
    (folder / "path.csv").write_text(f"{head}\n{rows}\n")
    return str(folder / "path.csv")


def test_the_hand_is_carried_along_a_path_of_ones_own(tmp_path):
    """x = 0.1 (1 - cos t), tilted steadily about y: gravity of the frame is what a calculator gives."""
    t = np.linspace(0.0, 2 * np.pi, 200)
    rows = "\n".join(f"{s:.9f},{0.1 * (1 - np.cos(s)):.9f},0,0,0,{0.2 * s:.9f},0" for s in t)
    setting = _path(tmp_path, rows, "t,x,y,z,rx,ry,rz")
    gravity, seconds = base_path.along(tmp_path / "path.csv")
    for at in (1.0, 2.5, 4.0):
        a = np.array([-0.1 * np.cos(at), 0.0, -9.81])  # the world's gravity less the path's acceleration
        c, s = np.cos(0.2 * at), np.sin(0.2 * at)
        np.testing.assert_allclose(gravity(at), [c * a[0] - s * a[2], 0.0, s * a[0] + c * a[2]], atol=2e-3)
    stage = Stage(torch.zeros(N), torch.ones(N, 5, dtype=torch.bool))
    stage.task = {"evaluation": {"base": setting}}
    grasp_eval._play(stage, lambda obs: None, False, None, "", 0, N)
    g = torch.stack(stage.gravity)[:, 0].numpy()
    assert len(g) == pytest.approx((SETTLE + HOLD + seconds) / DT, abs=1)
    assert not np.allclose(g[-1], [0, 0, -9.81], atol=1)
    np.testing.assert_allclose(np.linalg.norm(g[-1]), 9.81, atol=0.15)
    assert np.allclose(g[DT * np.arange(len(g)) < SETTLE + HOLD], [0, 0, -9.81], atol=1e-5)


@pytest.mark.parametrize("rows, head, said", [
    ("0,0,0,0\n1,0,0,0\n2,0,0,0", "t,x,y,z", "3 rows; at least 4"),
    ("0,0,0\n1,0,0", "t,x,y", "columns t, x, y; must be t,x,y,z"),
    ("0,0,0,0\n1,0,0,up\n2,0,0,0\n3,0,0,0", "t,x,y,z", "line 3: z is 'up', must be a finite number"),
    ("0,0,0,0\n1,0,0,0\n1,0,0,0\n3,0,0,0", "t,x,y,z", "column t must begin at 0, grow"),
    ("0,0,0,0\n1,0,0,300\n2,0,0,300\n3,0,0,300", "t,x,y,z", "m/s2 at t = .* allowed 100"),
    ("0,0,0,0,0,0,0\n1,0,0,0,0,3,0\n2,0,0,0,0,0,0\n3,0,0,0,0,0,0", "t,x,y,z,rx,ry,rz", "rad/s at t = .* allowed 2.5"),
])  # fmt: skip
def test_a_path_that_is_none_is_refused(tmp_path, rows, head, said):
    with pytest.raises(UserError, match=said):
        base_path.of(_path(tmp_path, rows, head))
    with pytest.raises(UserError, match="must be turn, lift, or a path"):
        base_path.of("jump")
    with pytest.raises(UserError, match="does not exist"):
        base_path.of(str(tmp_path / "none.csv"))
