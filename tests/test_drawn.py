"""What the randomization of a task names is drawn: every range reaches what it is for, over its whole width, in every
episode."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from worlds import task_cfg

from dexsim import rotation
from dexsim.actuator.columns import INDEX
from dexsim.tasks import make_env
from dexsim.tasks.servos import RELATIVE

N, EPISODES = 32, 8
EDGE = 0.15  # of a range: as near as its ends are met


def _pick(env) -> torch.Tensor:
    """Return which of the held poses each world began with, by its hand's joints."""
    return torch.cdist(env.engine.t.qpos[:, env.joint_q].float(), env.grasps.hand, p=1).argmin(1)


def _tilt(env) -> torch.Tensor:
    """Return angle of the object's longest axis to the palm's y."""
    longest = torch.tensor([int(v.shape.extents.argmax()) for v in env.objects.scene.variants])[env.objects.variant]
    m = rotation.to_matrix(env.engine.t.qpos[:, env.object_q[3:]])
    return m[torch.arange(N), 1, longest].abs().clamp(max=1).arccos()


def _xy(env) -> torch.Tensor:
    return env.engine.t.qpos[:, env.object_q[:2]].float()


def _extent(env) -> torch.Tensor:
    """Return largest extent of each world's object."""
    o = env.objects
    s, kind = o.size, o.kind[o.variant]
    round_ = torch.stack([2 * s[:, 0], 2 * (s[:, 0] + s[:, 1])], 1)
    of = [2 * s.amax(1), round_[:, 0], round_[:, 1], o._extent[o.variant]]
    return torch.stack(of, 1).gather(1, kind[:, None])[:, 0]


def _speed(env, columns: slice) -> torch.Tensor:
    return env.engine.t.qvel[:, env.object_v][:, columns].float()


OBJECT: dict[str, Callable] = {
    "object.mass": lambda e: e.objects.mass,
    "object.com": lambda e: e.objects.com / _extent(e)[:, None],
    "object.friction": lambda e: e.objects.friction,
    "contact.stiffness": lambda e: e.objects.stiffness,
    "contact.damping_ratio": lambda e: e.objects.damping_ratio,
}
DRAWN: dict[str, dict[str, Callable]] = {
    "grasp": OBJECT
    | {
        "initial.joint": lambda e: e.engine.t.qpos[:, e.joint_q].float() - e.pose0,
        "initial.object_xy": lambda e: _xy(e) - e.centre0,
        "initial.drop": lambda e: e.engine.t.qpos[:, e.object_q[2]].float() - e.objects.radius,
        "initial.velocity_xy": lambda e: _speed(e, slice(0, 2)),
        "initial.velocity_z": lambda e: _speed(e, slice(2, 3)),
        "initial.spin": lambda e: _speed(e, slice(3, 6)),
        "initial.tilt": _tilt,
        "sensors.vision_xy": lambda e: e.first_xy - _xy(e),
        "sensors.torque_bias": lambda e: e.torque_bias,
        "push.weights": lambda e: e.push_force.norm(dim=1) / (9.81 * e.objects.mass),
        "push.duration": lambda e: e.push_left,
        "push.wait": lambda e: e.push_wait,
    },
    "rotate": OBJECT
    | {
        "object.size": lambda e: 2 * e.objects.size[:, 0],
        "initial.target": lambda e: e.target - e.grasps.target[_pick(e)],
        "sensors.joint_bias": lambda e: e.joint_bias,
        "imu.delay": lambda e: e.imu_delay * e.dt,
        "imu.heading_rate": lambda e: e.heading_rate,
        "imu.tilt": lambda e: e.imu_tilt[:, :2],
    },
    "rotate_fingertips": OBJECT
    | {
        "object.size": lambda e: 2 * e.objects.size[:, 0],
        "initial.target": lambda e: e.target - e.grasps.target[_pick(e)],
        "sensors.joint_bias": lambda e: e.joint_bias,
        "camera.delay": lambda e: e.camera_delay * e.dt,
        "camera.tilt": lambda e: e.camera_tilt,
        "camera.offset": lambda e: e.camera_offset,
        "camera.visible": lambda e: e.visible,
        "camera.hidden": lambda e: e.hidden,
        "push.weights": lambda e: e.push_force.norm(dim=1) / (9.81 * e.objects.mass),
        "push.duration": lambda e: e.push_left,
        "push.wait": lambda e: e.push_wait,
    },
}
"""Where the draws of each range arrive, by task: values of all worlds in the range's own unit."""
UNUSED = {"rotate_fingertips": {"imu.delay", "imu.heading_rate", "imu.tilt"}}
"""Ranges that a task's base class wants named, and the task does not use."""
STEPS = {"imu.delay": 0.5, "camera.delay": 0.5}
"""Ranges that arrive in whole control periods: how far off, in periods."""
PRODUCTS = {"grasp": {"object.scale", "object.aspect"}}
"""Ranges that arrive as a product only."""


@pytest.fixture(scope="module", params=["grasp", "rotate", "rotate_fingertips"])
def drawn(request):
    """(task, environment, {range: values of all episodes})."""
    task = request.param
    env = make_env(task_cfg(task=task, worlds=N), N, "cpu", 0, "mujoco")
    where = dict(DRAWN[task])
    for name in env.sampler.ranges:
        if name.startswith("servo."):
            column = name.removeprefix("servo.")
            where[name] = lambda e, c=column: _of_nominal(e, c)
    if task == "grasp":
        where["product"] = _scaled
    values: dict[str, list] = {name: [] for name in where}
    for _ in range(EPISODES):
        env.begin_episodes(torch.ones(N, dtype=torch.bool))
        for name, of in where.items():
            values[name].append(of(env).flatten().double())
    yield task, env, {name: torch.cat(v) for name, v in values.items()}
    env.close()


def _of_nominal(env, column: str) -> torch.Tensor:
    """Return a drive's column against its nominal: times, or added to it."""
    c = INDEX[column]
    now, nominal = env.servo.params[..., c], env.servo.nominal[:, c]
    return now / nominal if column in RELATIVE else now - nominal


def _scaled(env) -> torch.Tensor:
    """Sizes of the boxes among the objects over the box's own."""
    o = env.objects
    boxes = o.kind[o.variant] == 0
    return (o.size / o._base_size[o.variant])[boxes]


def covers(values: torch.Tensor, low: float, high: float, slack: float = 0.0) -> None:
    """Check that values lie in [low, high] and come near both ends."""
    width = high - low
    assert width > 0, "a fixed value shows nothing"
    near = EDGE * width + slack
    assert low - 1e-3 * width - slack <= float(values.min()) <= low + near
    assert high - near <= float(values.max()) <= high + 1e-3 * width + slack


def test_every_range_is_drawn_over_its_whole_width(drawn):
    task, env, values = drawn
    named = set(values) - {"product"} | PRODUCTS.get(task, set()) | UNUSED.get(task, set())
    assert named == set(env.sampler.ranges), "a range without a line in DRAWN, or a line without a range"
    for name, x in values.items():
        if name == "product":
            low, high = (
                env.sampler.range("object.scale")[k] * env.sampler.range("object.aspect")[k] for k in (0, 1)
            )
        else:
            low, high, _ = env.sampler.range(name)
        try:
            covers(x, low, high, STEPS.get(name, 0.0) * env.dt)
        except AssertionError as error:
            raise AssertionError(
                f"{task}: {name} in [{low:g}, {high:g}]: {float(x.min()):g} to {float(x.max()):g}"
            ) from error


def test_worlds_do_not_share_their_draws(drawn):
    _, env, values = drawn
    for name, x in values.items():
        if name not in STEPS:
            assert len(x.unique()) > 0.5 * len(x), name


def test_what_is_drawn_of_contacts_and_mass_is_what_the_physics_has(drawn):
    _, env, _ = drawn
    o, e = env.objects, env.engine
    torch.testing.assert_close(e.field("body_mass")[:, o.body].float(), o.mass)
    tips = e.field("geom_friction")[:, o.tips, 0].float()
    torch.testing.assert_close(tips, o.friction[:, None].expand_as(tips))
    soft = e.field("geom_solref")[:, o.tips, 0]
    assert len(soft[:, 0].unique()) == N, "contacts of another stiffness and damping in each world"
