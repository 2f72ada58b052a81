"""A control step never waits for the device: no host synchronisation, no shape that depends on data."""

from __future__ import annotations

import pytest
import torch
import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode
from worlds import grasp_env

# what makes a GPU's host wait: reading a scalar, shapes that depend on values, boolean indexing
FORBIDDEN = ("_local_scalar_dense", "nonzero", "masked_select", "item", "unique", "is_nonzero", "equal", "argwhere")


class NoSync(TorchDispatchMode):
    """Fails on every operation that would make the host wait for a CUDA device."""

    def __init__(self):
        super().__init__()
        self.calls = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = func.__name__.split(".")[0]
        self.calls += 1
        if name in FORBIDDEN:
            raise AssertionError(f"aten::{name} waits for the device")
        if name in ("index", "index_put", "index_put_"):
            for i in args[1]:
                if i is not None and i.dtype in (torch.bool, torch.uint8):
                    raise AssertionError(f"aten::{name} with a mask waits for the device: its size depends on values")
        if name in ("_to_copy", "copy_") and str(kwargs.get("device", "")) == "cpu" and not kwargs.get("non_blocking"):
            raise AssertionError("a copy to the host waits for the device")
        return func(*args, **kwargs)


@pytest.fixture(scope="module")
def env():
    env = grasp_env(worlds=8, engine="warp")
    for _ in range(3):  # kernels compiled, sequences recorded
        env.step(torch.zeros(8, 12))
    return env


def _refuse(name):
    def refuse(*args, **kwargs):
        raise AssertionError(f"{name} waits for the device")

    return refuse


def _strict(monkeypatch):
    monkeypatch.setattr(wp.array, "numpy", _refuse("wp.array.numpy"))
    monkeypatch.setattr(wp.array, "list", _refuse("wp.array.list"))
    for name in [n for n in dir(wp) if n.startswith("synchronize")]:
        monkeypatch.setattr(wp, name, _refuse(f"wp.{name}"))
    monkeypatch.setattr(torch, "tensor", _refuse("torch.tensor (a copy of Python numbers to the device)"))
    for name in ("numpy", "item", "tolist", "__bool__", "__float__", "__int__"):
        monkeypatch.setattr(torch.Tensor, name, _refuse(f"Tensor.{name}"))


def test_the_loop_never_waits(env, monkeypatch):
    actions = torch.rand(8, 12, generator=torch.Generator().manual_seed(0)) * 2 - 1
    # resets on the way
    env.episode_length_buf = torch.tensor([0, env.max_episode_length - 1, 0, 0, env.max_episode_length - 2, 0, 0, 0])
    with monkeypatch.context() as strict, NoSync() as mode:
        _strict(strict)
        for _ in range(4):
            out = env.step(actions)
    assert mode.calls > 200 and out[1].shape == (8,)


def test_final_observations_and_a_reset_of_all_do_not_wait_either(env, monkeypatch):
    env.keep_final_obs = True
    try:
        with monkeypatch.context() as strict, NoSync():
            _strict(strict)
            env.step(torch.zeros(8, 12))
            env.reset_all()
    finally:
        env.keep_final_obs = False


@pytest.mark.slow
def test_a_full_sensor_does_not_wait_either(monkeypatch):
    """Three-axis, delayed, noisy, hysteretic touch with raw taxels."""
    env = grasp_env("tactile=full", worlds=4, engine="warp")
    for _ in range(3):
        env.step(torch.zeros(4, 12))
    with monkeypatch.context() as strict, NoSync():
        _strict(strict)
        for _ in range(2):
            env.step(torch.zeros(4, 12))
        env.reset_all()


@pytest.mark.parametrize(
    "call",
    [
        lambda t: t.sum().item(),
        lambda t: bool(t.any()),
        lambda t: t[t > 0],
        lambda t: t.nonzero(),
        lambda t: t.cpu().numpy(),
        lambda t: torch.tensor([1.0, 2.0]),
        lambda t: t.masked_select(t > 0),
    ],
)
def test_the_guard_can_fail(call, monkeypatch):
    t = torch.randn(4)
    with pytest.raises(AssertionError, match="wait|host"), monkeypatch.context() as strict, NoSync():
        _strict(strict)
        call(t)


def test_the_guard_sees_warp(monkeypatch):
    a = wp.zeros(3, dtype=float, device="cpu")
    with monkeypatch.context() as strict:
        _strict(strict)
        for call in (a.numpy, wp.synchronize, wp.synchronize_device, wp.synchronize_stream):
            with pytest.raises(AssertionError):
                call()
