"""Calibration: known lines, rubber and taxels are found again, with honest intervals, and failures are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from dexsim.calibration import command, current, line, presses, rubber, simulate, taxels
from dexsim.calibration.file import Calibration, save
from dexsim.calibration.line import Levels
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.recording.realistic import CURRENT_PER_TORQUE, realistic
from dexsim.recording.schema import COMMANDS, DEFAULTS, EXTERNAL_FORCE, STATES, TACTILE, Recording, Series, States
from dexsim.recording.writer import write
from dexsim.tactile.reference import mooney_rivlin_force
from tests.made_hand import made_hand
from tools.assets import xhand

HAND = load_hand("xhand")

torch.set_num_threads(1)


# -- lines
# ---------------------------------------------------------------------------------------------------------------------


def levels(slope=4.0, offset=0.0, friction=0.0, noise=0.05, n=8, seed=0, top=2.0) -> Levels:
    """Return a press up a ladder and down again: force = slope * (effort -+ friction) + offset."""
    rng = np.random.default_rng(seed)
    number = np.concatenate([np.arange(1, n + 1), np.arange(n - 1, 0, -1)])
    up = np.arange(len(number)) < n
    effort = top * number / n
    force = slope * (effort + np.where(up, -friction, friction)) + offset + noise * rng.standard_normal(len(number))
    keep = force > 0
    zero = np.zeros(keep.sum())
    return Levels(effort[keep], force[keep], number[keep], up[keep], zero + 0.4, zero > 0)


def test_slope_is_found_and_its_interval_covers_it():
    hits = []
    for seed in range(60):
        f = line.fit(levels(noise=0.15, friction=0.03, seed=seed), "A", seed)
        hits.append(f.slope_low <= 4.0 <= f.slope_high)
        assert abs(f.slope - 4.0) < 0.3
    assert 0.80 <= np.mean(hits) <= 1.0, "a 95 % interval from a bootstrap over 8 levels is somewhat narrow"
    wide, tight = (line.fit(levels(noise=x), "A") for x in (0.4, 0.02))
    assert wide.slope_high - wide.slope_low > 5 * (tight.slope_high - tight.slope_low)


def test_a_clean_press_is_linear_and_held_out_error_is_the_noise():
    f = line.fit(levels(noise=0.1, seed=3), "A")
    assert f.linear and f.r2 > 0.99 and 0.05 < f.held_out < 0.2 and f.hysteresis < 0.05
    assert f.ratio == pytest.approx(4.0, rel=0.03) and f.effort_max == 2.0 and f.count == 15


@pytest.mark.parametrize("made, says", [
    (lambda: levels(friction=0.2), "dry friction"),
    (lambda: levels(offset=-1.5), "force begins at 0.3"),
    (lambda: levels(noise=1.2), "R2"),
    (lambda: levels(n=3), "only 3 levels"),
    (lambda: replace(levels(), force=levels().force**1.6), "bend"),
    (lambda: replace(levels(), force=np.minimum(levels().force, 4.0)), "no more force"),
    (lambda: replace(levels(), full=levels().force > 6), "largest count"),
    (lambda: replace(levels(), force=9 - levels().force), "force falls"),
    (lambda: replace(levels(), position=0.4 + 0.05 * levels().effort**2), None),
    (lambda: replace(levels(), position=0.4 + 0.2 * levels().effort), "turned by 0.35 rad"),
])  # fmt: skip
def test_what_is_no_line_says_why(made, says):
    f = line.fit(made(), "A")
    if says is None:
        assert f.linear, f.why
    else:
        assert not f.linear and any(says in w for w in f.why), f.why


def test_hysteresis_is_the_width_of_the_loop():
    f = line.fit(levels(friction=0.1, noise=0.0), "A")
    assert f.hysteresis == pytest.approx(2 * 4.0 * 0.1 / levels(friction=0.1, noise=0.0).force.max(), rel=0.05)


# -- presses
# ---------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pressed():
    """Return a simulated press of a second and a first joint of one finger."""
    return {j: simulate.press_recording(HAND, j) for j in ("mid_joint2", "mid_joint1")}


@pytest.mark.parametrize("joint, within", [("mid_joint1", 0.04), ("mid_joint2", 0.12)])
def test_simulated_force_over_torque_is_one_over_the_lever_arm(pressed, joint, within):
    """Statics, from the model's own Jacobian: torque = arm * force, whatever the servo does. The contact's own friction
    and the millimetres by which it lies beside the taxel count more for the short arm."""
    import mujoco

    found = presses.levels_of(pressed[joint], HAND)
    assert set(found) == {"mid_joint1", "mid_joint2"}, "the finger's joints press, and no other's"
    f = line.fit(found[joint], "N.m")
    model = xhand.hand_spec().compile()
    data = mujoco.MjData(model)
    for name, q in zip(HAND.joints, HAND.pose("open"), strict=True):
        data.qpos[model.joint(name).qposadr[0]] = q
    mujoco.mj_forward(model, data)
    ball, arms = simulate._site(HAND, HAND.joints.index(joint), 2)
    body = model.body(xhand.TIP_BODIES[2]).id
    table = xhand.taxel_table("mid")
    point = table["position"] @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
    k = int(np.linalg.norm(point - ball, axis=1).argmin())
    jac = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jac, None, point[k], body)
    normal = (ball - point[k]) / np.linalg.norm(ball - point[k])
    arm = normal @ jac[:, model.joint(joint).dofadr[0]]
    assert arm == pytest.approx(arms[xhand.JOINTS.index(joint)], rel=0.01)
    assert f.linear and f.slope == pytest.approx(1 / arm, rel=within) and f.r2 > 0.985


@pytest.mark.slow
def test_realistic_presses_give_the_current_per_torque_back(pressed, tmp_path):
    """The pseudo-real half: integer milliamperes of the opposite sign, 8-bit taxels, jitter."""
    real, sim = tmp_path / "real", tmp_path / "sim"
    for folder, change in ((real, True), (sim, False)):
        folder.mkdir()
        for k, (joint, r) in enumerate(pressed.items()):
            write(folder / f"{joint}.mcap", realistic(r, seed=k) if change else r)
    a = current.half(current.files_of(str(real), "real"), "current_A", HAND)
    b = current.half(current.files_of(str(sim), "sim"), "torque_Nm", HAND)
    joints = current.combine(a, b)
    for joint in pressed:
        c = joints[joint]["current_per_torque"]
        assert c["low"] < CURRENT_PER_TORQUE < c["high"] and c["value"] == pytest.approx(CURRENT_PER_TORQUE, rel=0.03)
        assert joints[joint]["real"]["file"] == f"{joint}.mcap", "each joint from the press made for it"
    assert joints["index_joint1"]["real"]["why"] == ["no press of it in the recordings"]
    assert joints["mid_joint1"]["alpha"]["value"] == pytest.approx(
        joints["mid_joint1"]["beta"]["value"] / CURRENT_PER_TORQUE, rel=0.05
    )


def test_a_lost_sign_is_refused_and_the_wrong_kind_named(pressed, tmp_path):
    r = realistic(pressed["mid_joint1"])
    write(tmp_path / "a.mcap", replace(r, meta=r.meta | {"effort_sign": "0"}))
    with pytest.raises(UserError, match="effort_sign"):
        current.half([tmp_path / "a.mcap"], "current_A", HAND)
    write(tmp_path / "b.mcap", r)
    with pytest.raises(UserError, match="expected torque_Nm"):
        current.half([tmp_path / "b.mcap"], "torque_Nm", HAND)
    with pytest.raises(UserError, match="no recording there"):
        current.files_of(str(tmp_path / "nothing"), "real")


def pushed(alpha=3.0, seed=0) -> Recording:
    """Return a finger pressed from outside while its commands stand still: force steps, current of two joints
    follows."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 12, 0.01)
    force = np.repeat([0, 1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1], 100).astype(float)
    effort = np.zeros((len(t), 12))
    effort[:, 8], effort[:, 9] = force / alpha, 0.4 * force / alpha
    effort += 0.004 * rng.standard_normal(effort.shape)
    touch = np.zeros((len(t), 5, 120, 3))
    touch[:, 3, 60:70, 2] = force[:, None] / 10 + 0.002 * rng.standard_normal((len(t), 10))
    q = np.full((len(t), 12), 0.3)
    meta = DEFAULTS | {
        "joint_names": ",".join(xhand.JOINTS),
        "effort_is": "current_A",
        "effort_sign": "-1",
        "tactile_unit": "N",
        "tactile_lsb": "1",
    }
    return Recording(Path("pushed.mcap"), meta, xhand.JOINTS, Series(t, q, COMMANDS),
                     States(Series(t, q, STATES), None, Series(t, -effort, STATES)), tactile=Series(t, touch, TACTILE))


def test_presses_from_outside_are_found_without_commands():
    found = presses.levels_of(pushed(), HAND)
    assert (
        {"ring_joint1", "ring_joint2"} <= set(found) and "mid_joint1" not in found and "thumb_bend_joint" not in found
    )
    first, second = (line.fit(found[j], "A") for j in ("ring_joint1", "ring_joint2"))
    assert first.ratio == pytest.approx(3.0, rel=0.02) and second.ratio == pytest.approx(7.5, rel=0.03) and first.linear


def test_presses_in_percent_and_milliamperes_are_the_same_presses(tmp_path):
    """`units.position=percent units.effort=mA` of `dexsim calibrate`, along the hand's own ranges, of a
    joint of another name."""
    from dexsim.calibration.command import _settings

    plain = pushed()
    low, high = HAND.limits[:, 0], HAND.limits[:, 1]
    share = 100 * (plain.commands.value - low) / (high - low)
    current = Series(plain.states.effort.t, 1000 * plain.states.effort.value, STATES)
    t = plain.commands.t
    write(tmp_path / "si.mcap", plain)
    a = current_half(tmp_path / "si.mcap", None)
    ours = next(iter(a.fits))
    theirs = tuple("zeige" if j == ours else j for j in plain.joints)
    states = States(Series(t, share, STATES), None, current)
    other = replace(plain, joints=theirs, commands=Series(t, share, COMMANDS), states=states)
    write(tmp_path / "own.mcap", other)
    said = ["units.position=percent", "units.effort=mA", "meta.robot=mine", f"remap.{ours}=zeige"]
    _, reading = _settings(said, {"real": None})
    assert reading["meta"] == {"units.position": "percent", "units.effort": "mA", "robot": "mine"}
    b = current_half(tmp_path / "own.mcap", reading)
    assert a.fits and a.fits.keys() == b.fits.keys()
    for joint, fit in a.fits.items():
        assert b.fits[joint].ratio == pytest.approx(fit.ratio, rel=1e-3)


def current_half(path, reading):
    """Return the fits of one recording of currents."""
    return current.half([path], "current_A", HAND, reading)


# -- rubber
# ---------------------------------------------------------------------------------------------------------------------


def test_treloars_rubber_up_to_stretch_three():
    """Treloar (1944), simple elongation: Mooney-Rivlin holds within 5 % there, with his rubber's shear modulus (about
    0.39 MPa, 4 kg/cm2 as he fits), and fails beyond."""
    table = rubber.TRELOAR_1944
    low = table[table[:, 0] <= 3.0]
    fit = rubber.fit_mooney_rivlin(*low.T)
    error = rubber.stress(low[1:, 0], fit.c10, fit.c01) / low[1:, 1] - 1
    assert np.abs(error).max() < 0.05 and fit.r2 > 0.998
    assert 0.37e6 < fit.shear_modulus < 0.44e6 and fit.c10 > 0 and fit.c01 > 0
    assert fit.held_out < 0.05 * low[-1, 1]
    far = table[table[:, 0] > 6]
    assert (np.abs(rubber.stress(far[:, 0], fit.c10, fit.c01) / far[:, 1] - 1) > 0.3).all()


def test_compression_round_trip_through_the_simulators_own_law():
    depth = np.linspace(0, 1.4e-3, 40)
    force = mooney_rivlin_force(depth, 2e-5, 2e-3, 4.0e4, 1.0e4)
    fit = rubber.fit_mooney_rivlin(*rubber.from_press(depth, force, 2e-5, 2e-3))
    assert fit.c10 == pytest.approx(4.0e4, rel=1e-6) and fit.c01 == pytest.approx(1.0e4, rel=1e-6)
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(40):
        noisy = force + 0.02 * force.max() * rng.standard_normal(len(force))
        f = rubber.fit_mooney_rivlin(*rubber.from_press(depth, noisy, 2e-5, 2e-3))
        inside += (f.c10_range[0] < 4e4 < f.c10_range[1]) + (f.c01_range[0] < 1e4 < f.c01_range[1])
        assert f.held_out > 0
    assert inside >= 68, "95 % intervals of two constants in 40 trials"


def test_a_narrow_curve_is_refused():
    x = np.linspace(0.9995, 1.0008, 12)
    with pytest.raises(UserError, match="too narrow"):
        rubber.fit_mooney_rivlin(x, rubber.stress(x, 1e5, 1e5))
    with pytest.raises(UserError, match="at least 4"):
        rubber.fit_mooney_rivlin(np.array([1.0, 1.2, 1.4]), np.array([0.0, 1.0, 2.0]))


def test_linear_stiffness_and_its_loop():
    d = np.concatenate([np.linspace(0, 1e-3, 30), np.linspace(1e-3, 0, 30)])
    f = 7000 * d * np.where(np.arange(60) < 30, 1.05, 0.95)
    k = rubber.fit_linear(d, f)
    assert k.value == pytest.approx(7000, rel=0.01) and k.low < 7000 < k.high
    assert k.hysteresis == pytest.approx(0.10 * 7000 * 0.5e-3 / (1.05 * 7000 * 1e-3), rel=0.1)


# -- taxels
# ---------------------------------------------------------------------------------------------------------------------


def rolled(n=150, seed=0, gains=None, dead=(), swapped=(), lsb=0.1, noise=0.3):
    """Counts [T, 120] and load [T] N of n round presses all over a pad."""
    rng = np.random.default_rng(seed)
    c, r = np.divmod(np.arange(120), 12)
    counts, load = [], []
    for _ in range(n):
        at, width, top = rng.uniform([0, 0], [9, 11]), rng.uniform(1.0, 1.8), rng.uniform(3, 15)
        for k in range(40):
            f = top * np.sin(np.pi * k / 39) ** 2
            shape = np.exp(-((c - at[0] - 0.4 * (k / 20 - 1)) ** 2 + (r - at[1]) ** 2) / (2 * width**2))
            counts.append(f * shape / shape.sum() / lsb)
            load.append(f)
        counts += [np.zeros(120)] * 8
        load += [0.0] * 8
    x = np.array(counts) / (1.0 if gains is None else gains)
    for a, b in swapped:
        x[:, [a, b]] = x[:, [b, a]]
    x = np.maximum(np.round(x + noise * rng.standard_normal(x.shape)), 0)
    x[:, list(dead)] = 0
    return x, np.array(load)


def test_a_healthy_pad_has_no_findings():
    x, load = rolled()
    p = taxels.inspect(x, load, rows=12)
    assert not p.dead and not p.swapped and not p.unseen
    assert p.scale == pytest.approx(0.1, rel=0.05) and 0.5 < p.threshold <= 1.0
    assert p.held_out <= p.held_out_equal and p.hysteresis < 0.03
    assert rubber.read_curve("treloar")[0] == "stress"


@pytest.mark.parametrize("with_load", [True, False])
def test_dead_and_swapped_taxels_are_found_exactly(with_load):
    x, load = rolled(dead=(17, 18, 77), swapped=((5, 60), (30, 31)), seed=2)
    p = taxels.inspect(x, load if with_load else None, rows=12)
    assert p.dead == [17, 18, 77] and sorted(p.swapped) == [(5, 60), (30, 31)]


def test_gains_are_found_and_tell_held_out_loads_better():
    gains = np.exp(0.2 * np.random.default_rng(5).standard_normal(120))
    x, load = rolled(n=300, gains=gains, seed=1)
    p = taxels.inspect(x, load, rows=12)
    assert np.corrcoef(p.gain, gains)[0, 1] > 0.9 and p.held_out < p.held_out_equal


@pytest.fixture(scope="module")
def pads():
    """Counts and load of the simulator's own touch, a ball pressed all over each pad: small contacts with sharp
    edges."""
    return simulate.delivered(simulate.rolled_recording(HAND, 160, seed=3, frames=18), 3)


def of_pad(r, f):
    load = r.external_force.value[:, 2]
    total = r.tactile.value[..., 2].sum(2)
    mine = (total.argmax(1) == f) | (total.max(1) <= np.percentile(total.max(1), 10))
    return r.tactile.value[mine, f, :, 2], load[mine]


@pytest.mark.slow
def test_healthy_simulated_pads_have_no_findings(pads):
    """Beyond a contact's edge a healthy taxel feels nothing, and is not called dead for it."""
    for f in range(5):
        p = taxels.inspect(*of_pad(pads, f), rows=12)
        assert not p.dead and not p.swapped and len(p.unseen) <= 5, xhand.FINGERS[f]
        assert p.scale == pytest.approx(0.1, rel=0.02) and p.held_out < 0.05 and p.hysteresis < 0.01
        assert taxels.inspect(of_pad(pads, f)[0], None, rows=12).dead == []


@pytest.mark.slow
def test_the_rehearsal_of_the_tutorial_finds_what_it_planted(tmp_path, capsys):
    """264 s of all taxels: the longest recording that dexsim makes for itself, read within the limits of any file."""
    assert command.main(["simulate_touch=true", "faults=true", f"out={tmp_path / 'o'}"], CONFIGS) == 0
    touch = yaml.safe_load((tmp_path / "o" / "calibration.yaml").read_text("utf-8"))["touch"]
    assert touch["dead"] == {"index": [42, 43, 77]} and touch["swapped"] == {"index": [[30, 66]]}


def test_faults_of_a_simulated_pad_are_found(pads):
    x, load = of_pad(pads, 1)
    rng = np.random.default_rng(0)
    gains = np.exp(0.15 * rng.standard_normal(120))
    x = np.round(x / gains)
    x[:, [20, 90]] = x[:, [90, 20]]
    x[:, [53, 54, 77]] = 0
    p = taxels.inspect(x, load, rows=12)
    assert set(p.dead) <= {53, 54, 77} and set(p.dead) | set(p.unseen) >= {53, 54, 77} and len(p.dead) >= 2, (
        "silent, and nothing else is dead"
    )
    assert p.swapped == [(20, 90)] and p.held_out < 0.95 * p.held_out_equal
    x, load = of_pad(pads, 2)  # a pad without dead taxels, whose neighbours make up for what they miss
    p = taxels.inspect(np.round(x / gains), load, rows=12)
    rest = np.setdiff1d(np.arange(120), p.unseen)
    assert np.corrcoef(p.gain[rest], gains[rest])[0, 1] > 0.7 and p.held_out < 0.5 * p.held_out_equal


def test_an_untouched_pad_says_so():
    x = (np.random.default_rng(0).random((500, 120)) < 0.01).astype(float)
    p = taxels.inspect(x, rows=12)
    assert len(p.unseen) == 120 and not p.dead and "nothing pressed it" in p.notes[0]


def test_hysteresis_of_a_pad_that_lags():
    x, load = rolled(noise=0.0, lsb=0.001)
    shifted = x * (0.9 + 0.2 * (np.gradient(load) < 0))[:, None]
    assert taxels.inspect(shifted, load, rows=12).hysteresis > 0.06 > taxels.inspect(x, load, rows=12).hysteresis


# -- the file
# ---------------------------------------------------------------------------------------------------------------------


def test_file_round_trip_and_meaning(tmp_path):
    content = {
        "schema": 1,
        "joints": {"mid_joint1": {"current_per_torque": {"value": 2.0, "low": 1.9, "high": 2.1}, "current_max": 1.5}},
        "touch": {
            "lsb": 0.05,
            "threshold": 0.12,
            "gain": {"ring": [2.0] * 120},
            "dead": {"ring": [7]},
            "swapped": {"thumb": [[3, 4]]},
            "bias": {"thumb": [1.0] * 120},
        },
    }
    save(tmp_path / "c.yaml", content)
    c = Calibration.load(tmp_path / "c.yaml")
    amps = np.zeros(12)
    amps[6] = -1.1  # closing
    assert c.torque_norm(amps)[6] == pytest.approx(1.1 / 2.0 / 1.1)
    np.testing.assert_allclose(c.current(c.torque_norm(amps) * c.torque_max), amps, atol=1e-12)
    paper = Calibration.from_dict(content | {"normalization": "paper"})
    assert paper.torque_norm(amps)[6] == pytest.approx(1.1 / 1.5)
    counts = np.zeros((5, 120, 3))
    counts[0, 3, 2], counts[0, 10, 2], counts[3, 7, 2], counts[3, 8, 2] = 11, 2, 50, 4
    f = c.normal_force(counts)
    assert f[0, 4] == pytest.approx(0.5) and f[0, 3] == 0, "exchanged back, bias off"
    assert f[0, 10] == 0, "at the threshold it is silent"
    assert f[3, 7] == 0 and f[3, 8] == pytest.approx(0.4)
    again = Calibration.from_dict(c.to_dict())
    np.testing.assert_allclose(again.normal_force(counts), f)
    np.testing.assert_allclose(again.torque_norm(amps), c.torque_norm(amps))


@pytest.mark.parametrize(
    "change, says",
    [
        ({"jonts": {}}, "jonts"),
        ({"joints": {"elbow": {}}}, "elbow"),
        ({"joints": {"mid_joint1": {"current_max": -1}}}, "current_max"),
        ({"normalization": "x"}, "matched, paper"),
        ({"touch": {"gain": {"mid": [1, 2]}}}, "120"),
        ({"touch": {"dead": {"mid": [120]}}}, "mid: no taxel 120; a pad has 120"),
        ({"touch": {"axis_sign": [1, 2, 3]}}, "axis_sign"),
        ({"current_sign": 0}, "current_sign"),
        ({"schema": 2}, "schema"),
    ],
)
def test_bad_files_are_named(change, says):
    with pytest.raises(UserError, match=says):
        Calibration.from_dict({"schema": 1} | change, "c.yaml")


def test_what_is_assumed_is_said():
    texts = Calibration.default().assumed
    assert any("2.7 A per N.m" in t for t in texts) and any("0.1 N a count" in t for t in texts)
    unknown = {"schema": 1, "normalization": "matched", "joints": {"mid_joint1": {"torque_max": "unknown"}}}
    assert any("torque_max of mid_joint1 is unknown" in t for t in Calibration.from_dict(unknown).assumed)
    assert (Calibration.default().current_per_torque == CURRENT_PER_TORQUE).all(), "one figure in the whole package"


# -- the command
# --------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_command_fits_both_halves_and_touch(pressed, tmp_path, capsys):
    for joint, r in pressed.items():
        for name, x in (("real", realistic(r)), ("sim", r)):
            (tmp_path / name).mkdir(exist_ok=True)
            write(tmp_path / name / f"{joint}.mcap", x)
    x, load = rolled(n=60, dead=(40,))
    t = np.arange(len(x)) * 0.01
    touch = np.zeros((len(x), 5, 120, 3))
    touch[:, 1, :, 2] = x
    force = np.zeros((len(x), 6))
    force[:, 2] = load
    meta = DEFAULTS | {"joint_names": ",".join(xhand.JOINTS), "effort_is": "none"}
    q = np.zeros((len(x), 12))
    r = Recording(
        Path("t.mcap"),
        meta,
        xhand.JOINTS,
        Series(t, q, COMMANDS),
        States(Series(t, q, STATES)),
        tactile=Series(t, touch, TACTILE),
        external_force=Series(t, force, EXTERNAL_FORCE),
    )
    write(tmp_path / "touch.mcap", r)
    curve = tmp_path / "curve.csv"
    curve.write_text("stretch,stress_Pa\n" + "\n".join(f"{a},{b}" for a, b in rubber.TRELOAR_1944))
    out = tmp_path / "out"
    status = command.main(
        [
            f"real={tmp_path / 'real'}",
            f"sim={tmp_path / 'sim'}",
            f"touch={tmp_path / 'touch.mcap'}",
            f"curve={curve}",
            f"out={out}",
        ],
        CONFIGS,
    )
    said = capsys.readouterr().out
    assert (
        status == 0
        and "linear" in said
        and "dead: [40]" in said
        and "Mooney-Rivlin" in said
        and "no press of it" in said
    )
    for name in ("real.png", "sim.png", "taxels.png", "rubber.png"):
        assert (out / name).stat().st_size > 10_000
    content = yaml.safe_load((out / "calibration.yaml").read_text())
    assert content["touch"]["dead"] == {"index": [40]} and content["touch"]["rubber"]["c10"] == pytest.approx(
        1.04e5, rel=0.02
    )
    assert content["touch"]["lsb"] == pytest.approx(0.1, rel=0.06)
    c = Calibration.load(out / "calibration.yaml")
    assert c.current_per_torque[6] == pytest.approx(2.7, rel=0.03)


@pytest.mark.slow
def test_another_hand_is_calibrated_from_its_own_presses(tmp_path, capsys):
    """Three fingers, a thumb last, another lattice: force over torque is one over the lever arm, taxels are told."""
    folder = made_hand(tmp_path / "made")
    hand = load_hand(folder, mirror=True)
    finger = hand.fingers[hand.others[0]]
    joint = hand.joints[finger.flexion[-1]]
    arguments = [f"hand={folder}", "hand_mirror=true", "simulate=true", f"joints={joint}", "levels=5"]
    assert command.main([*arguments, f"out={tmp_path / 'o'}"], CONFIGS) == 0
    content = yaml.safe_load((tmp_path / "o" / "calibration.yaml").read_text())
    _, arms = simulate._site(hand, finger.flexion[-1], hand.others[0])
    assert content["robot"] == hand.robot and content["joints"][joint]["sim"]["linear"]
    slope = content["joints"][joint]["sim"]["slope"]["value"]
    assert slope == pytest.approx(1 / abs(arms[finger.flexion[-1]]), rel=0.15)
    assert Calibration.load(tmp_path / "o" / "calibration.yaml", hand=hand).hand.robot == hand.robot
    rolled = simulate.delivered(simulate.rolled_recording(hand, 45, seed=1, frames=18), 1)
    write(tmp_path / "rolled.mcap", rolled)
    assert command.main([*arguments[:2], f"touch={tmp_path / 'rolled.mcap'}", f"out={tmp_path / 't'}"], CONFIGS) == 0
    touch = yaml.safe_load((tmp_path / "t" / "calibration.yaml").read_text())["touch"]
    assert touch["lsb"] == pytest.approx(0.1, rel=0.05) and set(touch["gain"]) == set(hand.finger_names)
    with pytest.raises(UserError, match=r"/tactile has 3 pads of .* hand=xhand has 5 of 120"):
        command.main([f"touch={tmp_path / 'rolled.mcap'}", f"out={tmp_path / 'x'}"], CONFIGS)
    with pytest.raises(UserError, match="has no touch pads"):
        bare = made_hand(tmp_path / "bare", pads=False)
        command.main([f"hand={bare}", "simulate=true", f"out={tmp_path / 'x'}"], CONFIGS)
    assert not (tmp_path / "x" / "calibration.yaml").exists()


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["rael=x"], "did you mean real"),
        (["real=nowhere"], "real=nowhere"),
        (["simulate=maybe"], "true or false"),
        (["levels=2", "simulate=true"], "levels=2"),
        (["out=x"], "say what to calibrate"),
        (["normalization=z"], "matched or paper"),
    ],
)
def test_command_errors_are_one_line(arguments, says, tmp_path):
    with pytest.raises(UserError, match=says) as caught:
        command.main(
            [*arguments, *([] if any(a.startswith("out=") for a in arguments) else [f"out={tmp_path}"])], CONFIGS
        )
    assert "\n" not in str(caught.value)


def test_help_lists_every_setting(capsys):
    assert command.main(["--help"], CONFIGS) == 0
    said = capsys.readouterr().out
    assert all(f"{key}=" in said for key in yaml.safe_load((CONFIGS / "calibrate.yaml").read_text()))
