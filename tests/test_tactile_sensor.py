"""What a real sensor adds: rubber, shear, gains, noise, counts, delay."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import warp as wp
from tactile_fixtures import SPRING, flat_layout, primitives, touch

from dexsim.errors import UserError

BOX = torch.tensor([0.02, 0.02, 0.01])


def pressed_box(n: int, cfg: dict, taxels: int = 5, **kw):
    """Return a box's flat face against a small flat pad; `press(depth, time, x)` moves it and feels."""
    layout = flat_layout(half=5e-3, n=taxels)
    engine, tactile = touch(n, layout, primitives(), {**SPRING, "raw": True, **cfg}, **kw)
    tactile.shape_id[:], tactile.shape_size[:] = 0, BOX

    def press(depth: float, time: float = 0.0, x: float = 0.0, y: float = 0.0) -> None:
        engine.t.xpos[:, engine.body("object")] = torch.tensor([x, y, 0.01 - depth])
        engine.t.time[:] = time
        tactile.launch()

    return engine, tactile, press


def test_without_imperfections_measured_is_clean():
    _, tactile, press = pressed_box(2, {})
    press(1e-3)
    assert tactile.force.data_ptr() == tactile.force_clean.data_ptr()
    assert tactile.raw.data_ptr() == tactile.raw_clean.data_ptr()


def test_imperfections_leave_the_clean_outputs_alone():
    _, clean, press = pressed_box(3, {})
    press(1e-3)
    _, dirty, press = pressed_box(3, {"noise": 0.05, "gain_spread": 0.2, "dead": 0.1, "lsb": 0.1, "hysteresis": 0.3})
    press(1e-3)
    assert torch.equal(clean.force_clean, dirty.force_clean) and torch.equal(clean.raw_clean, dirty.raw_clean)
    assert torch.equal(clean.centre_clean, dirty.centre_clean)
    assert not torch.equal(dirty.force, dirty.force_clean)


def test_threshold_silences_weak_taxels_only():
    _, tactile, press = pressed_box(1, {"threshold": 0.3, "sum": "solver"})
    press(1e-3)
    assert (tactile.force == 0.0).all()  # no solver force yet
    tactile.engine.t.pair_normal[:] = 25 * 0.29
    press(1e-3)
    assert tactile.force_clean.item() == pytest.approx(7.25, rel=1e-5) and tactile.force.item() == 0.0
    tactile.engine.t.pair_normal[:] = 25 * 0.31
    press(1e-3)
    assert tactile.force.item() == pytest.approx(7.75, rel=1e-5)


def test_hysteresis_relaxes_to_the_elastic_force_and_loses_energy():
    fraction, time, dt = 0.4, 0.2, 0.01
    _, tactile, press = pressed_box(1, {"hysteresis": fraction, "hysteresis_time": time})
    f, clean = [], []
    for k in range(120):
        press(1e-3, k * dt)
        f.append(tactile.force.item())
        clean.append(tactile.force_clean.item())
    f, e = np.array(f), clean[-1]
    # a step at k = 0: state starts at 0, then follows exp(-t / time)
    t = dt * np.arange(120)
    np.testing.assert_allclose(f, e * (1 + fraction * np.exp(-t / time)), rtol=1e-4)
    # a slow and a fast cycle: work done on the rubber exceeds what it gives back; none is lost when infinitely slow
    lost = []
    for period in (0.4, 400.0):
        _, tactile, press = pressed_box(1, {"hysteresis": fraction, "hysteresis_time": time})
        steps = 200
        depth = 0.5e-3 * (1 - np.cos(2 * np.pi * np.arange(2 * steps) / steps))
        force = []
        for k, d in enumerate(depth):
            press(float(d), k * period / steps)
            force.append(tactile.force.item())
        force = np.array(force)[steps:]
        d = depth[steps:]
        lost.append(np.sum(0.5 * (force + np.roll(force, -1)) * (np.roll(d, -1) - d)))
        assert force.min() >= 0.0
    stored = 0.5 * 1e-3 * e
    assert lost[0] > 0.05 * stored and abs(lost[1]) < 0.01 * stored
    press(-1e-3, 1e4)
    assert tactile.force.item() == 0.0


def test_shear_sticks_then_slips_at_the_coulomb_cap():
    k, friction, depth = 1e8, 0.5, 1e-3
    _, tactile, press = pressed_box(1, {"shear": True, "shear_stiffness": k, "friction": friction})
    area = float(tactile.layout.area[0, 0])
    normal = 2e8 * area * depth
    press(depth)
    assert (tactile.raw3[..., :2] == 0.0).all()
    # the object moves along -x: the finger moves along +x relative to it and pulls it along +x
    press(depth, x=-0.2e-3)
    np.testing.assert_allclose(tactile.raw3[0, 0, :, 0].numpy(), k * area * 0.2e-3, rtol=1e-3)
    np.testing.assert_allclose(tactile.raw3[0, 0, :, 1].numpy(), 0.0, atol=1e-6)
    press(depth, x=-0.2e-3, y=0.1e-3)
    np.testing.assert_allclose(tactile.raw3[0, 0, :, 1].numpy(), -k * area * 0.1e-3, rtol=1e-3)
    for x in np.linspace(-0.2e-3, -4e-3, 30):  # far beyond the cap, friction * normal
        press(depth, x=float(x))
        assert (tactile.raw3[..., :2].norm(dim=-1) <= friction * tactile.raw_clean * (1 + 1e-5)).all()
    slid = tactile.raw3[0, 0, :, :2].norm(dim=-1).numpy()
    np.testing.assert_allclose(slid, friction * normal, rtol=1e-3)
    # back by twice the stuck stretch: the force turns round, since the anchor was dragged along
    press(depth, x=float(-4e-3 + 2 * friction * normal / (k * area)))
    np.testing.assert_allclose(tactile.raw3[0, 0, :, 0].numpy(), -friction * normal, rtol=1e-2)
    press(-1e-3)
    press(depth)
    assert (tactile.raw3[..., :2] == 0.0).all()


def test_shear_does_not_see_rigid_motion_of_both():
    _, tactile, press = pressed_box(1, {"shear": True})
    press(1e-3)
    angle = 0.7
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    shift = np.array([0.1, -0.2, 0.05])
    tactile.engine.place(0, "pad", shift, turn)
    tactile.engine.place(0, "object", turn @ [0, 0, 0.009] + shift, turn)
    tactile.launch()
    assert tactile.raw3[..., :2].abs().max() < 1e-3 * tactile.raw3[..., 2].max() and tactile.raw3[..., 2].min() > 0.1


def test_counts_go_round_trip_and_saturate():
    lsb = 0.1
    _, tactile, press = pressed_box(1, {"lsb": lsb, "full_scale": 12})
    for depth in (0.2e-3, 0.7e-3, 1.0e-3):
        press(depth)
        counts = tactile.raw.numpy() / lsb
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-4)
        assert np.abs(tactile.raw.numpy() - tactile.raw_clean.numpy()).max() <= 0.5 * lsb + 1e-6
        again = lsb * np.round(tactile.raw.numpy() / lsb)
        np.testing.assert_allclose(again, tactile.raw.numpy(), atol=1e-6)
    press(5e-3)
    np.testing.assert_allclose(tactile.raw.numpy(), 1.2, rtol=1e-6)


def test_gains_and_dead_taxels_have_their_distribution_and_change_with_the_episode():
    _, tactile, press = pressed_box(64, {"gain_spread": 0.1, "dead": 0.2}, taxels=15)
    press(1e-3)
    gain = (tactile.raw / tactile.raw_clean).numpy().ravel()
    dead = gain == 0.0
    assert dead.mean() == pytest.approx(0.2, abs=0.02)
    assert gain[~dead].mean() == pytest.approx(1.0, abs=0.01) and gain[~dead].std() == pytest.approx(0.1, abs=0.01)
    before = tactile.gain.clone()
    mask = torch.zeros(64, dtype=torch.bool)
    mask[3] = True
    tactile.randomize(mask)
    assert torch.equal(before[~mask], tactile.gain[~mask]) and not torch.equal(before[3], tactile.gain[3])
    assert not torch.equal(before[0], before[1])


def test_noise_is_white_with_its_standard_deviation():
    _, tactile, press = pressed_box(16, {"noise": 0.05}, taxels=9)
    out = []
    for _ in range(30):
        press(2e-3)
        out.append((tactile.raw - tactile.raw_clean).numpy().copy())
    e = np.array(out).reshape(30, -1)
    assert e.std() == pytest.approx(0.05, rel=0.03) and abs(e.mean()) < 0.002
    assert abs(np.corrcoef(e[:-1].ravel(), e[1:].ravel())[0, 1]) < 0.03
    assert abs(np.corrcoef(e[:, :-1].ravel(), e[:, 1:].ravel())[0, 1]) < 0.03


def test_delay_is_in_seconds_and_per_world():
    _, tactile, press = pressed_box(3, {"delay": [0.0, 0.05], "period": 0.01})
    tactile.column("delay")[:] = torch.tensor([0.0, 0.02, 0.045])
    clean, seen = [], []
    for k in range(12):
        press(1e-4 * (k + 1), 0.01 * k)
        clean.append(tactile.force_clean[0].item())
        seen.append(tactile.force[:, 0].tolist())
    clean, seen = np.array([0.0] * 5 + clean), np.array(seen)
    for w, steps in enumerate((0, 2, 5)):  # 45 ms: the reading of 50 ms ago is the newest that is old enough
        np.testing.assert_allclose(seen[:, w], clean[5 - steps : 17 - steps], rtol=1e-5)
    tactile.check()
    tactile.reset(torch.tensor([False, True, False]))
    press(1e-3, 0.12)
    assert tactile.force[1].item() == 0.0 and tactile.force[0].item() > 0.0 and tactile.force[2].item() > 0.0
    for k in range(40):
        press(1e-3, 0.13 + 0.001 * k)  # ten times more often than told
    with pytest.raises(UserError, match="tactile.period"):
        tactile.check()


def test_a_range_is_drawn_per_world_within_its_bounds_and_from_the_generator():
    _, tactile, _ = pressed_box(200, {"threshold": [0.1, 0.3], "delay": 0.01})
    g = torch.Generator().manual_seed(1)
    everyone = torch.ones(200, dtype=torch.bool)
    tactile.randomize(everyone, g)
    a = tactile.column("threshold").clone()
    assert a.min() >= 0.1 and a.max() <= 0.3 and a.std() > 0.04
    tactile.randomize(everyone, torch.Generator().manual_seed(1))
    assert torch.equal(a, tactile.column("threshold")) and (tactile.column("delay") == 0.01).all()


def test_reset_forgets_one_world_only():
    _, tactile, press = pressed_box(2, {"hysteresis": 0.5, "shear": True})
    for k in range(20):
        press(1e-3, 0.05 * k, x=-1e-4 * min(k, 1))
    tactile.reset(torch.tensor([True, False]))
    press(1e-3, 1.0, x=-1e-4)
    assert (tactile.raw3[0, ..., :2] == 0.0).all() and tactile.raw3[1, ..., 0].min() > 0.0
    assert tactile.force[0].item() == pytest.approx(1.5 * tactile.force[1].item(), rel=0.01)


@pytest.mark.slow
def test_measured_force_may_include_other_fingers():
    from dexsim.tactile import Tactile, TaxelLayout
    from dexsim.tactile.posed import PosedEngine
    from dexsim.tactile.shapes import ShapeSet

    corners = np.array(np.meshgrid([-4e-3, 4e-3], [-4e-3, 4e-3], [-6e-3, 0.0])).reshape(3, -1).T
    x = np.linspace(-3.5e-3, 3.5e-3, 8)
    p = np.stack([*np.meshgrid(x, x), np.zeros((8, 8))], -1).reshape(-1, 3)
    pad = {"point": p, "normal": np.tile([0, 0, 1.0], (64, 1))}
    layout = TaxelLayout.build([{"name": "a", "body": "a", **pad}, {"name": "b", "body": "b", **pad}])
    engine = PosedEngine(1, ["a", "b", "object"])
    engine.place(0, "b", [0, 0, -0.5e-3], np.diag([1.0, -1.0, -1.0]))  # face to face, 0.5 mm of overlap
    engine.place(0, "object", [0, 0, 1.0])
    for feel in (False, True):
        cfg = {**SPRING, "feel_others": feel}
        tactile = Tactile(engine, layout, ShapeSet(primitives()), "object", cfg, tips=[corners, corners])
        tactile.shape_id[:], tactile.shape_size[:] = 0, BOX
        tactile.launch()
        want = 2e8 * 64e-6 * 0.5e-3
        np.testing.assert_allclose(tactile.force_other[0].numpy(), want, rtol=0.02)
        assert (tactile.force_clean == 0.0).all()
        np.testing.assert_allclose(tactile.force[0].numpy(), want if feel else 0.0, rtol=0.02)


def test_lanes_and_serial_report_the_same_and_replay_from_a_graph(monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    cfg = {"noise": 0.02, "gain_spread": 0.1, "lsb": 0.01, "threshold": 0.01}
    cfg |= {"hysteresis": 0.2, "shear": True, "delay": 0.01}
    out = []
    for lanes in (False, True):
        engine, tactile, press = pressed_box(4, cfg, lanes=lanes)
        press(1e-3)
        with wp.ScopedCapture(device="cpu") as capture:
            tactile.launch()
        for k in range(1, 6):
            engine.t.xpos[:, engine.body("object"), 0] = -1e-4 * k
            engine.t.time[:] = 0.02 * k
            wp.capture_launch(capture.graph)
        out.append([x.clone().numpy() for x in (tactile.force, tactile.centre, tactile.raw, tactile.raw3)])
    for a, b in zip(*out, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6)
    assert out[0][0].min() > 1.0 and np.abs(out[0][3][..., 0]).max() > 0.1
