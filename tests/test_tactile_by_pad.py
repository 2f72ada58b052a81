"""Settings of single pads (`tactile.pads`): each effect against its law in NumPy, the order of them against the
diagnosis's own plant."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import warp as wp
from tactile_fixtures import primitives
from test_nosync import NoSync, _strict
from worlds import grasp_cfg, grasp_env

from dexsim.errors import UserError
from dexsim.gap.touch import plant as touch_plant
from dexsim.hand import load_hand
from dexsim.tactile import ShapeSet, Tactile, hand_layout
from dexsim.tactile import reference as ref
from dexsim.tactile.config import tactile_config
from dexsim.tactile.pads import THICKNESS, pad_configs, value_range
from dexsim.tactile.posed import PosedEngine
from dexsim.tactile.sensors import Sensors
from tools.assets import xhand

RADIUS, MIDDLE, FORCE = 0.012, 66, 3.0
INDEX, MID = 1, 2


def ball(cfg: dict, n: int = 2, **kw):
    """Return a ball at the middle of every pad of N hands, each 20 cm from the next; `press(depth, time)` moves it
    over the index's and feels."""
    layout = hand_layout(load_hand())
    pads = [f"tip_{f}" for f in xhand.FINGERS]
    engine = PosedEngine(n, [*xhand.TIP_BODIES, "object"], pads)
    tips = [xhand.tip_skin_mesh(f)[0] for f in xhand.FINGERS]
    touch = Tactile(
        engine,
        layout,
        ShapeSet(primitives()),
        "object",
        {"raw": True, "others": False, "period": 0.01, **cfg},
        pairs=pads,
        tips=tips,
        **kw,
    )
    touch.shape_id[:], touch.shape_size[:] = 1, torch.tensor([RADIUS, 0.0, 0.0])
    measured = layout.lifted(tips)

    def press(depth: float = 0.8e-3, time: float = 0.0, force: float = FORCE, pad: int = INDEX) -> None:
        engine.t.xpos[:, :5] = 10.0 * torch.arange(1, 6)[None, :, None]
        engine.t.xpos[:, pad] = 0.0
        at = measured.point[pad, MIDDLE] + measured.normal[pad, MIDDLE] * (RADIUS - depth)
        engine.t.xpos[:, 5] = torch.as_tensor(at, dtype=torch.float32)
        engine.t.pair_normal[:] = 0.0
        engine.t.pair_normal[:, pad] = force
        engine.t.time[:] = time
        touch.launch()

    def distance(depth: float = 0.8e-3, pad: int = INDEX) -> np.ndarray:
        at = measured.point[pad, MIDDLE] + measured.normal[pad, MIDDLE] * (RADIUS - depth)
        return ref.sd_sphere(measured.point[pad] - at, RADIUS)

    return touch, press, distance


def clean() -> np.ndarray:
    touch, press, _ = ball({})
    press()
    return touch.raw[0, INDEX].double().numpy().copy()


def test_crosstalk_is_the_law_of_the_diagnosis_and_keeps_the_sum():
    touch, press, _ = ball({"pads": {"index": {"crosstalk": 0.3}}})
    press()
    x = clean()
    assert (x > 0.05).sum() > 4
    mixed = Sensors(load_hand()).mixing(INDEX) @ x
    np.testing.assert_allclose(touch.raw[0, INDEX].numpy(), 0.7 * x + 0.3 * mixed, atol=1e-6)
    assert touch.force[0, INDEX].item() == pytest.approx(FORCE, rel=1e-5) and touch.force_clean[
        0, INDEX
    ].item() == pytest.approx(FORCE, rel=1e-5)
    press(pad=MID)  # no other pad has it
    other, press_other, _ = ball({})
    press_other(pad=MID)
    assert torch.equal(touch.raw[:, MID], other.raw[:, MID])


def test_gains_dead_stuck_and_exchanged_taxels():
    x = clean()
    a, b, c, d = (int(k) for k in np.argsort(-x)[:4])
    far = int(np.argmin(x))
    touch, press, _ = ball(
        {
            "pads": {
                "index": {
                    "gain": 0.5,
                    "taxels": {str(a): [0.4, 0.6]},
                    "dead": [b],
                    "stuck": {far: 2.0},
                    "swapped": [[c, d]],
                }
            }
        },
        n=200,
    )
    press()
    z = touch.raw[:, INDEX].double().numpy()
    share = z[:, a] / x[a]
    assert share.min() >= 0.4 - 1e-6 and share.max() <= 0.6 + 1e-6 and np.ptp(share) > 0.17  # drawn in each world
    assert (z[:, b] == 0).all() and np.allclose(z[:, far], 2.0)
    np.testing.assert_allclose(z[:, [c, d]], np.tile(0.5 * x[[d, c]], (200, 1)), rtol=1e-5)
    rest = [k for k in range(120) if k not in (a, b, c, d, far)]
    np.testing.assert_allclose(z[:, rest], np.tile(0.5 * x[rest], (200, 1)), rtol=1e-5, atol=1e-9)
    before = touch.gain.clone()
    mask = torch.zeros(200, dtype=torch.bool)
    mask[7] = True
    touch.randomize(mask)
    assert torch.equal(before[~mask], touch.gain[~mask]) and before[7, INDEX, a] != touch.gain[7, INDEX, a]
    press(-1e-3, force=0.0)
    assert np.allclose(touch.raw[:, INDEX, far].numpy(), 2.0) and touch.raw[:, INDEX].sum().item() == pytest.approx(
        400.0
    )


def test_stuck_readings_are_whole_counts_where_there_are_counts():
    touch, press, _ = ball({"lsb": 0.1, "pads": {"index": {"stuck": {5: 0.43}}}})
    press()
    assert touch.raw[0, INDEX, 5].item() == pytest.approx(0.4)


def test_hysteresis_of_one_pad_is_that_of_the_setting():
    one, press_one, _ = ball(
        {"hysteresis": 0.1, "hysteresis_time": 0.7, "pads": {"index": {"hysteresis": 0.4, "hysteresis_time": 0.2}}}
    )
    every, press_every, _ = ball({"hysteresis": 0.4, "hysteresis_time": 0.2})
    for k in range(40):
        for press in (press_one, press_every):
            press(time=0.01 * k, force=FORCE if k < 20 else 1.0)
        assert torch.allclose(one.raw[:, INDEX], every.raw[:, INDEX], rtol=1e-6)
    # what relaxes after a step, by the law: f (1 + a e^(-t / T)) at first, and from the last step on less than the
    # force
    x = np.r_[np.full(20, FORCE), np.ones(20)]
    np.testing.assert_allclose(
        one.force[0, INDEX].item(), touch_plant.relaxed(x[:, None], 0.01, 0.4, 0.2)[-1, 0], rtol=0.02
    )
    press_one(pad=MID, time=0.4)
    # the world's setting
    assert one.force[0, MID].item() == pytest.approx(FORCE * (1 + 0.1 * np.exp(-0.01 / 0.7)), rel=1e-4)
    one.reset(torch.tensor([True, False]))
    press_one(time=0.41)
    assert (
        one.force[0, INDEX].item() == pytest.approx(1.4 * FORCE, rel=1e-4) and one.force[1, INDEX].item() < 1.38 * FORCE
    )


@pytest.mark.parametrize("feel_others", [False, True])
def test_rubber_spreads_the_force_as_it_presses(feel_others):
    c10, c01 = 8e4, 2e4
    touch, press, distance = ball(
        {
            "others": feel_others,
            "feel_others": feel_others,
            "stiffness": {"hertz": 5e6},
            "pads": {"index": {"rubber": {"c10": c10, "c01": c01}}},
        }
    )
    press()
    area = hand_layout(load_hand()).area[INDEX]
    w = ref.mooney_rivlin_force(np.maximum(-distance(), 0.0), area, THICKNESS, c10, c01)
    np.testing.assert_allclose(touch.raw[0, INDEX].numpy(), FORCE * w / w.sum(), atol=2e-4)
    assert touch.force[0, INDEX].item() == pytest.approx(FORCE, rel=1e-4) and not np.allclose(
        touch.raw[0, INDEX].numpy(), clean(), atol=0.02
    )
    press(-0.2e-3)  # the physics presses, no taxel is inside: as without rubber
    plain, press_plain, _ = ball({})
    press_plain(-0.2e-3)
    assert torch.equal(touch.raw[:, INDEX], plain.raw[:, INDEX])


def test_rubber_by_springs_is_its_own_force():
    touch, press, distance = ball(
        {"sum": "spring", "law": "linear", "stiffness": {"linear": 2e8}, "pads": {"index": {"rubber": {"c10": 8e4}}}}
    )
    press()
    area = hand_layout(load_hand()).area[INDEX]
    want = ref.mooney_rivlin_force(np.maximum(-distance(), 0.0), area, THICKNESS, 8e4, 0.0)
    np.testing.assert_allclose(touch.raw[0, INDEX].numpy(), want, rtol=2e-3, atol=1e-6)


def test_delay_of_one_pad():
    touch, press, _ = ball({"delay": 0.01, "shear": True, "pads": {"index": {"delay": 0.03}}}, n=1)
    seen = []
    for k in range(10):
        for pad in (INDEX, MID):
            press(time=0.02 * k + 0.01 * (pad - 1), force=1.0 + k, pad=pad)
        seen.append(touch.force[0].tolist())
    # a reading every 10 ms, the pads in turn, seen after the mid's: of 30 ms ago for the index, whose turn it was; of
    # 10 ms ago for the mid, too
    seen = np.array(seen)
    np.testing.assert_allclose(seen[2:, INDEX], np.arange(2, 10), rtol=1e-5)
    assert (seen[:, MID] == 0.0).all() and touch.raw3[0, INDEX, :, 2].sum().item() == pytest.approx(9.0, rel=1e-5)
    touch.reset(torch.ones(1, dtype=torch.bool))
    press(time=1.0)
    assert (touch.force == 0.0).all()
    touch.check()


def test_a_delay_between_two_readings_lies_between_them():
    touch, press, _ = ball(
        {"lsb": 0.001, "full_scale": 20000, "threshold": 0.0005, "pads": {"index": {"delay": 0.025}}}, n=1
    )
    seen = []
    for k in range(8):
        press(time=0.01 * k, force=1.0 + k)
        seen.append(touch.force[0, INDEX].item())
    assert seen[:3] == [0.0, 0.0, 0.0]  # nothing is as old yet
    np.testing.assert_allclose(seen[3:], 1.5 + np.arange(5), atol=0.01)
    counts = touch.raw[0, INDEX].double().numpy() / 0.001
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-3)
    touch.check()
    for k in range(40):
        press(time=0.1 + 0.001 * k)  # ten times more often than told
    with pytest.raises(UserError, match="tactile.period"):
        touch.check()


@pytest.mark.slow
def test_everything_at_once_reads_as_the_plant_of_the_diagnosis(tmp_path):
    """A press rig with pads' settings, recorded in counts: the plant with the same numbers reads the same to the
    counts."""
    import press_rig
    from test_gap_touch import collected

    pads = {"index": {"gain": 0.8, "crosstalk": 0.25, "hysteresis": 0.3, "hysteresis_time": 0.4, "delay": 2 / 90}}
    paths = press_rig.record(tmp_path, 1, 5.0, seed=3, sensor={"pads": pads})
    run = collected(*paths)[0].runs[0]
    v = touch_plant.neutral() | {
        "gain": 0.8,
        "neighbours": 0.25,
        "fraction": 0.3,
        "time_constant": 0.4,
        "delay": 2 / 90,
    }
    on = run.z.max(1) > 0
    measured = run.z.max(0) > 0.3
    rms = [
        float(np.sqrt(np.mean((touch_plant.readings(run, p)[on] - run.z[on])[:, measured] ** 2)))
        for p in (v, touch_plant.neutral())
    ]
    assert rms[0] < 0.055 and rms[1] > 3 * rms[0], rms


def test_without_pads_nothing_is_there():
    """No file: the same kernels, launches, draws and readings, bit for bit."""
    cfg = {"noise": 0.02, "gain_spread": 0.1, "dead": 0.02, "delay": [0.0, 0.03], "hysteresis": 0.2, "lsb": 0.01}
    out = []
    for more in ({}, {"pads": {}}):
        touch, press, _ = ball({**cfg, **more}, n=4)
        assert touch.by_pad is None
        g = torch.Generator().manual_seed(3)
        touch.randomize(torch.ones(4, dtype=torch.bool), g)
        for k in range(5):
            press(time=0.01 * k)
        out.append((touch, [x.clone() for x in (touch.raw, touch.force, touch.centre, touch.params, g.get_state())]))
    assert all(torch.equal(a, b) for a, b in zip(out[0][1], out[1][1], strict=True))
    assert out[0][0]._m.taxel is out[1][0]._m.taxel and out[0][0]._m.report is out[1][0]._m.report
    with_pads, *_ = ball({**cfg, "pads": {"index": {"crosstalk": 0.1}}})
    # what reports is the same also then
    assert with_pads.by_pad is not None and with_pads._m.report is out[0][0]._m.report


@pytest.mark.slow
def test_recorded_sequences_replay_and_lanes_agree(monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    cfg = {
        "shear": True,
        "lsb": 0.01,
        "pads": {
            "index": {
                "gain": [0.5, 0.9],
                "crosstalk": [0.1, 0.3],
                "hysteresis": 0.3,
                "delay": 0.02,
                "stuck": {5: 1.0},
                "swapped": [[66, 67]],
                "dead": [78],
                "rubber": {"c10": 8e4},
            }
        },
    }
    out = []
    for lanes in (False, True):
        torch.manual_seed(0)
        touch, press, _ = ball(cfg, n=2, lanes=lanes)
        press()
        with wp.ScopedCapture(device="cpu") as capture:
            touch.launch()
        for k in range(1, 6):
            touch.engine.t.time[:] = 0.01 * k
            touch.engine.t.pair_normal[:, INDEX] = FORCE + k
            wp.capture_launch(capture.graph)
        out.append([x.clone().numpy() for x in (touch.force, touch.centre, touch.raw, touch.raw3)])
    for a, b in zip(*out, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=0.011)  # one count
    assert out[0][0][:, INDEX].min() > 1.0


PADS = (
    "+tactile.pads.index={gain:[0.5,0.9],crosstalk:[0.1,0.3],hysteresis:0.3,delay:[0.0,0.04],stuck:{5:1.0},"
    "swapped:[[66,67]],dead:[78],rubber:{c10:8e4},taxels:{40:[0.2,0.4]}}"
)


@pytest.mark.slow
def test_a_control_step_with_pads_does_not_wait(monkeypatch):
    env = grasp_env(PADS, worlds=4, engine="warp")
    for _ in range(3):
        env.step(torch.zeros(4, 12))
    with monkeypatch.context() as strict, NoSync():
        _strict(strict)
        for _ in range(2):
            env.step(torch.zeros(4, 12))
        env.reset_all()
    gain = env.touch.by_pad.column("gain")
    assert ((gain[:, INDEX] >= 0.5) & (gain[:, INDEX] <= 0.9)).all() and (gain[:, MID] == 1.0).all()
    first = gain.clone()
    env.reset_all()
    assert not torch.equal(first[:, INDEX], gain[:, INDEX])


@pytest.mark.parametrize(("pads", "said"), [
    ({"index": {"delay": 2.0}}, r"tactile.pads.index.delay=2.0: must be a number; allowed: 0 to 1 s"),
    ({"index": {"dealy": 0.1}}, r"tactile.pads.index.dealy: unknown; valid ones: gain"),
    ({"index": {"gain": [0.9, 0.5]}}, r"tactile.pads.index.gain=\[0.9, 0.5\]: must rise from low to high"),
    ({"index": {"gain": {"value": 0.5, "low": 0.6}}}, r"gain=\[0.6, 0.5, 0.5\]: must rise"),
    ({"index": {"gain": {"low": 0.6}}}, r"tactile.pads.index.gain \(.*: object missing required field `value`"),
    ({"index": {"crosstalk": "much"}}, r"crosstalk=much: must be a number; allowed: 0 to 1"),
    ({"index": {"crosstalk": float("nan")}}, r"tactile.pads.index.crosstalk \(nan\): expected a number"),
    ({"index": {"taxels": {"a": 1.0}}}, r"taxels: 'a' is no taxel"),
    ({"index": {"dead": 3}}, r"tactile.pads.index.dead \(3\): expected `array`"),
    ({"index": {"swapped": [[1, 2], [2, 3]]}}, r"taxel 2 is exchanged twice"),
    ({"index": {"rubber": {"c01": 0.0}}}, r"the lowest c10 \+ c01 must be positive"),
    ({"index": 3}, r"tactile.pads.index \(3\): expected `object`"),
    ([], r"tactile.pads \(\[\]\): expected `object`"),
])  # fmt: skip
def test_bad_settings_of_pads(pads, said):
    with pytest.raises(UserError, match=said):
        tactile_config({"pads": pads})


@pytest.mark.parametrize(("pads", "said"), [
    ({"little": {"gain": 0.5}}, "tactile.pads.little: no such pad; pads: thumb, index"),
    ({"index": {"dead": [120]}}, "tactile.pads.index: no taxel 120; this pad has 120, counted from 0"),
])  # fmt: skip
def test_pads_and_taxels_that_the_hand_lacks(pads, said):
    with pytest.raises(UserError, match=said):
        ball({"pads": pads})


def test_crosstalk_needs_a_lattice():
    from tactile_fixtures import flat_layout, touch

    with pytest.raises(UserError, match="which taxels lie beside one another is not known"):
        touch(1, flat_layout(n=5), primitives(), {"pads": {"flat": {"crosstalk": 0.1}}})


def test_numbers_may_be_text_as_yaml_reads_them():
    assert value_range("x", {"value": "1e-3", "low": 0}, "s", 0.0, 1.0) == (0.0, 1e-3)
    assert pad_configs({"index": {"taxels": {"17": "0.5"}}})["index"].taxels == {17: (0.5, 0.5)}
    assert grasp_cfg()["tactile"]["pads"] == {}
