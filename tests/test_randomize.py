"""Sampling: ranges, logs, independence of worlds, bad ranges; servo parameters relative to the nominal."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dexsim.actuator import Servo
from dexsim.actuator.columns import INDEX, NAMES
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.tasks.randomize import Sampler
from dexsim.tasks.servos import RELATIVE, ServoRandomizer

N = 4096


def sampler(cfg: dict, n: int = N, seed: int = 0) -> Sampler:
    return Sampler(cfg, torch.Generator().manual_seed(seed), n, "cpu")


def test_uniform_log_and_fixed():
    s = sampler({"a": {"u": [1.0, 3.0], "log": {"log": [0.01, 1.0]}, "fixed": 2.5}})
    u, log, fixed = s.draw("a.u").double(), s.draw("a.log").double(), s.draw("a.fixed")
    tol = 4 / N**0.5
    assert 1 <= float(u.min()) and float(u.max()) <= 3 and abs(float(u.mean()) - 2) < 2 * tol * 0.29
    assert float(log.min()) >= 0.01 * (1 - 1e-6) and float(log.max()) <= 1.0 + 1e-6
    assert abs(float(log.log10().mean()) + 1) < 2 * tol * 0.29, "uniform in the logarithm"
    assert torch.equal(fixed, torch.full((N,), 2.5))


def test_draws_are_independent_by_world_and_column():
    s = sampler({"x": [0.0, 1.0]})
    a, b = s.draw("x", 3), s.draw("x", 3)
    assert a.shape == (N, 3)
    c = torch.corrcoef(torch.cat([a, b], 1).T) - torch.eye(6)
    assert float(c.abs().max()) < 5 / N**0.5
    assert abs(float(torch.corrcoef(torch.stack([a[:-1, 0], a[1:, 0]]))[0, 1])) < 5 / N**0.5


def test_directions_and_quaternions_are_uniform():
    s = sampler({})
    d, q = s.direction().double(), s.quaternion().double()
    assert torch.allclose(d.norm(dim=1), torch.ones(N, dtype=d.dtype), atol=1e-6)
    assert torch.allclose(q.norm(dim=1), torch.ones(N, dtype=q.dtype), atol=1e-6)
    assert float(d.mean(0).norm()) < 5 / N**0.5
    assert torch.allclose(d.T @ d / N, torch.eye(3, dtype=d.dtype) / 3, atol=0.03)
    assert torch.allclose(q.T @ q / N, torch.eye(4, dtype=d.dtype) / 4, atol=0.03)


@pytest.mark.parametrize(
    "value",
    [
        [1.0],
        [2.0, 1.0],
        "wide",
        [None, 1.0],
        {"log": [0.0, 1.0]},
        {"log": [-1.0, 1.0]},
        [float("nan"), 1.0],
        [0.0, float("inf")],
    ],
)
def test_a_bad_range_is_named(value):
    with pytest.raises(UserError, match="randomize.object.mass"):
        sampler({"object": {"mass": value}})


def test_unknown_and_forbidden_ranges_are_named():
    s = sampler({"object": {"mass": [-0.1, 0.3]}})
    with pytest.raises(UserError, match="randomize.object.mas is missing.*object.mass"):
        s.range("object.mas")
    with pytest.raises(UserError, match=r"randomize.object.mass=\[-0.1, 0.3\]: must lie in"):
        s.check("object.mass", 0.001, 5)


# -- servo -------------------------------------------------------------------------------------------------------------

JOINTS = ("a", "b")


class FakeServo:
    """What a ServoRandomizer needs of a servo."""

    def __init__(self, table: dict, n: int = N):
        self.table, self.joints = ServoTable.from_dict(table), JOINTS
        self.nominal = torch.as_tensor(self.table.nominal(JOINTS), dtype=torch.float32)
        self.params = self.nominal.expand(n, *self.nominal.shape).clone()
        self.queue, self.control_period = 8, 0.025
        self.features = frozenset()

    check_simulated = Servo.check_simulated


TABLE = {
    "joints": {
        "*": {"kp": 4.0, "kd": 0.1, "torque_limit": 1.1, "delay": 0.01},
        "b": {"kp": {"value": 2.0, "low": 1.8, "high": 2.6}},
    }
}


def test_factors_and_additions_are_of_the_nominal():
    servo = FakeServo(TABLE)
    r = ServoRandomizer(servo, sampler({"servo": {"kp": [0.5, 1.5], "delay": [0.0, 0.02], "deadband": [0.0, 0.01]}}))
    everyone = torch.ones(N, dtype=torch.bool)
    for _ in range(20):  # never compounds
        r.draw(everyone)
    p = servo.params
    for name, joint, low, high in (
        ("kp", 0, 2.0, 6.0),
        ("delay", 0, 0.01, 0.03),
        ("delay", 1, 0.01, 0.03),
        ("deadband", 0, 0.0, 0.01),
        ("kp", 1, 1.8, 2.6),
    ):  # b's kp was fitted: its own interval counts
        x = p[:, joint, INDEX[name]]
        width = high - low
        assert (
            low - 1e-6 <= float(x.min()) < low + 0.02 * width and high - 0.02 * width < float(x.max()) <= high + 1e-6
        ), (name, joint)
    others = [INDEX[n] for n in NAMES if n not in ("kp", "delay", "deadband")]
    assert torch.equal(p[..., others], servo.nominal[:, others].expand(N, 2, len(others))), (
        "absent limits stay infinite, no NaN"
    )
    assert {"kp", "torque_limit"} <= set(RELATIVE) and "delay" not in RELATIVE


def test_only_masked_worlds_get_new_drives():
    servo = FakeServo(TABLE)
    r = ServoRandomizer(servo, sampler({"servo": {"kp": [0.5, 1.5]}}))
    r.draw(torch.ones(N, dtype=torch.bool))
    before = servo.params.clone()
    mask = torch.arange(N) % 2 == 0
    r.draw(mask)
    assert torch.equal(servo.params[~mask], before[~mask])
    assert bool((servo.params[mask][:, 0, INDEX["kp"]] != before[mask][:, 0, INDEX["kp"]]).double().mean() > 0.99)


@pytest.mark.parametrize("cfg, word", [
    ({"kp": [-0.5, 1.0]}, "servo.kp"), ({"delay": [-0.05, 0.0]}, "servo.delay"), ({"delay": [0.0, 0.2]}, "servo.delay"),
    ({"deadband": [0.0, 2.0]}, "servo.deadband"), ({"slop": [0.0, 0.1]}, "slop"),
    ({"backlash": [0.0, 0.1]}, "not simulated here"), ({"efficiency": [0.5, 3.0]}, "efficiency"),
])  # fmt: skip
def test_values_that_a_servo_cannot_have_are_refused(cfg, word):
    with pytest.raises(UserError, match=word):
        ServoRandomizer(FakeServo(TABLE), sampler({"servo": cfg}))


def test_a_given_seed_gives_the_same_numbers():
    a, b, c = (sampler({"x": [0.0, 1.0]}, seed=s).draw("x", 2) for s in (1, 1, 2))
    assert torch.equal(a, b) and not torch.equal(a, c)
    assert np.isfinite(a.numpy()).all()


def test_drawn_together_is_what_is_drawn_one_by_one():
    """The same ranges, shapes and narrowing; the first time under a name, the very same numbers."""
    cfg = {"a": {"u": [1.0, 3.0], "log": {"log": [0.01, 1.0]}, "fixed": 2.5}}

    def ask(s: Sampler) -> list[torch.Tensor]:
        return [
            s.draw("a.u"),
            s.uniform(2),
            s.draw("a.log", 3),
            s.normal(2, 2),
            s.draw("a.fixed"),
            s.draw("a.u", 2, 3),
            s.uniform(),
        ]

    s, alone = sampler(cfg), sampler(cfg)
    with s.drawn_ahead("episode"):
        for a, b in zip(ask(s), ask(alone), strict=True):
            assert torch.equal(a, b)
    s.width.fill_(0.5)
    alone.width.fill_(0.5)
    with s.drawn_ahead("episode"):
        got = ask(s)
    for a, b in zip(got, ask(alone), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        tolerance = 6 * float(b.double().std()) / a.numel() ** 0.5 + 1e-6
        assert abs(float(a.double().mean() - b.double().mean())) < tolerance
        assert abs(float(a.double().std() - b.double().std())) < tolerance
        assert float(a.min()) == pytest.approx(
            float(b.min()), abs=6 * tolerance + 0.5 * (a.dim() == 3 and a.shape[1:] == (2, 2))
        )
    assert 1.5 <= float(got[0].min()) and float(got[0].max()) <= 2.5, "a curriculum narrows it"
    assert float(got[1].min()) < 0.01 and float(got[1].max()) > 0.99, "and leaves what has no range alone"
    columns = torch.cat([x.reshape(N, -1) for x in got if float(x.std()) > 0], 1)
    c = torch.corrcoef(columns.T) - torch.eye(columns.shape[1])
    assert float(c.abs().max()) < 6 / N**0.5
    with s.drawn_ahead("episode"):
        again = ask(s)
    assert not torch.equal(again[0], got[0])


def test_something_else_than_planned_is_drawn_too():
    s = sampler({"x": [1.0, 2.0], "y": [5.0, 6.0]})
    with s.drawn_ahead("episode"):
        s.draw("x"), s.draw("y")
    with s.drawn_ahead("episode"):
        y, x, z = s.draw("y"), s.draw("x", 4), s.draw("y")
    assert x.shape == (N, 4) and 1 <= float(x.min()) and float(x.max()) <= 2
    assert all(v.shape == (N,) and 5 <= float(v.min()) and float(v.max()) <= 6 for v in (y, z))
    assert not torch.equal(y, z)
    assert s.draw("x").shape == (N,), "and outside"
