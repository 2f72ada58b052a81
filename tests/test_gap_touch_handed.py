"""What a diagnosis hands on of touch and contact: tactile.yaml from findings, into the environment, out of a
checkpoint; bad files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import press_rig
import pytest
import torch
import yaml
from bundles import make_checkpoint
from worlds import grasp_cfg, grasp_env, task_cfg

from dexsim.cli import help as help_page
from dexsim.cli import start
from dexsim.errors import UserError
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.effects import PadFacts
from dexsim.gap.effects.catalogue import TOUCH_CATALOGUE
from dexsim.gap.finding import Finding
from dexsim.gap.touch import diagnosis
from dexsim.gap.touch.diagnosis import HEAD
from dexsim.gap.touch.diagnosis import save_tactile as write
from dexsim.gap.touch.judge import chord
from dexsim.paths import CONFIGS
from dexsim.recording import read
from dexsim.tactile.file import load
from tools.assets import xhand

INDEX, MID = 1, 2


def handed(findings, facts):
    return diagnosis.handed(findings, facts, xhand.FINGERS)


def diagnosed(folder, allowed=None, seconds=7.0, **planted):
    paths, model, servo = press_rig.record(folder / "rig", 3, seconds, seed=5, **planted)
    settings = Settings(paths, folder / "out", [], str(model), str(servo), next_recording=False, allowed=allowed)
    d = diagnose(settings, say=lambda _: None)
    save(d, folder / "out")
    return d, folder / "out" / "tactile.yaml"


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    """Return the diagnosis of an index finger whose touch is late, and its tactile.yaml."""
    few = {"tactile_delay", "tactile_hysteresis", "contact_stiffness"}
    return diagnosed(tmp_path_factory.mktemp("late"), few, 5.0, sensor={"delay": 0.06})


def within(drawn: torch.Tensor, p: dict) -> bool:
    """Return whether draws lie in a range and fill it."""
    wide = p["high"] - p["low"]
    return (
        float(drawn.min()) >= p["low"] - 1e-6
        and float(drawn.max()) <= p["high"] + 1e-6
        and float(drawn.max() - drawn.min()) > 0.8 * wide
    )


def test_from_a_recording_to_the_worlds_that_train(late):
    """Recording -> diagnosis -> tactile.yaml -> environment: the fitted delay is drawn from its interval, on that
    fingertip alone."""
    d, path = late
    (f,) = d.data["findings"]
    p = yaml.safe_load(path.read_text())["tactile"]["pads"]["index"]["delay"]
    for key in ("value", "low", "high"):
        assert p[key] == pytest.approx(f["parameters"]["delay"][key], rel=1e-5)
    assert p["low"] < 6 / 90 < p["high"]
    env = grasp_env(f"tactile_file={path}", worlds=64)
    delay = env.touch.by_pad.column("delay")
    assert within(delay[:, INDEX], p) and (delay[:, [0, 2, 3, 4]] == 0.0).all()
    first = delay.clone()
    env.reset_all()
    assert not torch.equal(first[:, INDEX], delay[:, INDEX])  # anew at each episode
    for _ in range(3):
        env.step(torch.zeros(64, 12))
    env.touch.check()


def test_the_sensor_that_trains_reads_what_was_recorded(late, tmp_path):
    """The same motion felt by training's own kernels: with the file's best guess the readings are those of the
    recording."""
    recorded, plain, same = (
        read(press_rig.record(tmp_path / str(k), 1, 7.0, seed=5, **settings)[0][0], audit=False).tactile.value
        * press_rig.LSB
        for k, settings in enumerate(
            ({"sensor": {"delay": 0.06}}, {}, press_rig.as_trained(yaml.safe_load(late[1].read_text())))
        )
    )
    rms = [float(np.sqrt(np.mean((x - recorded)[recorded > 0] ** 2))) for x in (plain, same)]
    assert rms[0] > 0.15 and rms[1] < 0.02, rms


def test_what_is_doubted_holds_what_was_believed(late, tmp_path):
    diagnosed, path = late[0].touch, tmp_path / "tactile.yaml"
    f = replace(diagnosed.findings[0], confidence=0.6)
    h = handed([f], diagnosed.facts)
    assert (
        write(h, path)
        and "not sure: its range holds what was believed" in path.read_text()
        and "tactile_delay on the index's pad is not sure" in h.doubts[0]
    )
    p = load(path)["tactile"]["pads"]["index"]["delay"]
    assert p["low"] == 0.0 and p["high"] == pytest.approx(f.parameters["delay"]["high"], rel=1e-5)
    drawn = grasp_env(f"tactile_file={path}", worlds=64).touch.by_pad.column("delay")[:, INDEX]
    assert within(drawn, p) and float(drawn.min()) < 0.01


@pytest.mark.slow
def test_a_checkpoint_carries_it_and_play_takes_it(late, tmp_path):
    """The content is in the run's config, so that a resume and a replay need no file; play.py lays it over any
    checkpoint."""
    _, path = late
    moved = tmp_path / "tactile.yaml"
    moved.write_text(path.read_text())
    trained = make_checkpoint(
        tmp_path / "trained.pt", f"tactile_file={moved}", "+tactile.pads.index.taxels={17: [0.4, 0.5]}"
    )
    moved.unlink()
    play = start.for_play([f"checkpoint={trained}", "device=cpu", "episodes=2"], CONFIGS)
    assert play.cfg["tactile_file"] == str(moved) and play.cfg["tactile"]["pads"]["index"]["taxels"] == {
        "17": [0.4, 0.5]
    }
    from dexsim.tasks import make_env

    env = make_env(play.cfg, 8, "cpu", 0, "mujoco")
    assert (env.touch.by_pad.column("delay")[:, INDEX] > 0.05).all()
    gain = env.touch.gain[:, INDEX, 17]
    assert float(gain.min()) >= 0.4 and float(gain.max()) <= 0.5
    plain = make_checkpoint(tmp_path / "plain.pt")
    play = start.for_play([f"checkpoint={plain}", f"tactile_file={path}", "device=cpu", "episodes=2"], CONFIGS)
    assert play.cfg["tactile"]["pads"] == load(path)["tactile"]["pads"]
    bench = start.for_play([f"checkpoint={trained}", "reality=bench", "episodes=2"], CONFIGS)
    assert "pads" not in bench.cfg["tactile"]  # another world has fingertips of its own


def test_the_simulated_hand_of_deployment_has_it_too():
    from dexsim.calibration.file import Calibration
    from dexsim.deploy.simulated_hand import SimulatedHand

    hand = SimulatedHand(grasp_cfg("+tactile.pads.index={stuck: {5: 2.0}, delay: 0.06}"), Calibration.default())
    for k in range(1, 15):
        hand.advance(0.01 * k)
    counts = hand.state(0.14).tactile
    assert counts[INDEX, 5, 2] == 20 and counts[INDEX, :5].sum() == 0 and counts[MID].sum() == 0
    hand.env.touch.check()  # the readings kept reach back far enough


def test_without_the_file_the_configuration_is_as_it_was():
    cfg = grasp_cfg()
    assert (
        cfg["tactile_file"] is None
        and cfg["tactile"]["pads"] == {}
        and cfg["randomize"]["contact"]["stiffness"] == [5500.0, 9000.0]
    )
    env = grasp_env(worlds=4)
    assert env.touch.by_pad is None and env.touch.force.data_ptr() == env.touch.force_clean.data_ptr()
    old = grasp_cfg()  # a checkpoint from before
    del old["tactile"]["pads"], old["tactile_file"]
    from dexsim.tasks import make_env

    other = make_env(old, 4, "cpu", 0, "mujoco")
    for _ in range(3):
        a, b = (e.step(torch.full((4, 12), 0.3)) for e in (env, other))
    assert torch.equal(a[0]["actor"], b[0]["actor"]) and torch.equal(a[0]["critic"], b[0]["critic"])


# -- from findings to settings
# -----------------------------------------------------------------------------------------------


def finding(effect, pad=INDEX, confidence=0.95, also=(), on=None, **parameters):
    named = {
        k: v if isinstance(v, dict) else {"value": v[0], "low": v[1], "high": v[2], "unit": ""}
        for k, v in parameters.items()
    }
    alike = [effect, *also] if also else []
    return Finding(effect, confidence, "", taxels=on or [f"{pad}:66"], indistinguishable=alike, parameters=named)


EVERY = {
    "tactile_gain": (
        finding("tactile_gain", gain=(0.7, 0.65, 0.75), taxels={"value": "all of the pad"}),
        PadFacts(common=(0.7, 0.65, 0.75)),
        {"gain": (0.7, 0.65, 0.75)},
        {},
    ),
    "tactile_stiffening": (
        finding("tactile_stiffening", c10=(1e5, 9e4, 1.1e5), c01=(2e4, 1e4, 3e4)),
        PadFacts(chord=(9000.0, 4000.0, 15000.0)),
        {"rubber": {"c10": (1e5, 9e4, 1.1e5), "c01": (2e4, 1e4, 3e4)}},
        {"contact.stiffness": (9000.0, 4000.0, 15000.0)},
    ),
    "tactile_hysteresis": (
        finding("tactile_hysteresis", fraction=(0.3, 0.2, 0.4), time_constant=(0.5, 0.4, 0.6)),
        PadFacts(),
        {"hysteresis": (0.3, 0.2, 0.4), "hysteresis_time": (0.5, 0.4, 0.6)},
        {},
    ),
    "tactile_crosstalk": (
        finding("tactile_crosstalk", fraction=(0.3, 0.2, 0.4)),
        PadFacts(),
        {"crosstalk": (0.3, 0.2, 0.4)},
        {},
    ),
    "tactile_delay": (
        finding("tactile_delay", delay=(0.03, 0.02, 0.04)),
        PadFacts(),
        {"delay": (0.03, 0.02, 0.04)},
        {},
    ),
    "thermal": (
        finding("thermal", per_degree=(-0.01, -0.012, -0.008)),
        PadFacts(warmest=20.0),
        {"gain": (0.9, 0.76, 1.0)},
        {},
    ),
    "contact_friction": (
        finding("contact_friction", mu=(0.4, 0.35, 0.45)),
        PadFacts(slid=True),
        {},
        {"object.friction": (0.4, 0.35, 0.45)},
    ),
    "contact_stiffness": (
        finding("contact_stiffness", stiffness=(4500.0, 4000.0, 5000.0)),
        PadFacts(),
        {},
        {"contact.stiffness": (4500.0, 4000.0, 5000.0)},
    ),
}
BELIEVED = {
    "gain": 1.0,
    "hysteresis": 0.0,
    "crosstalk": 0.0,
    "delay": 0.0,
    "object.friction": 0.8,
    "contact.stiffness": 7000.0,
}


def ranges(settings: dict) -> dict:
    return {
        k: (v["value"], v["low"], v["high"])
        if isinstance(v, dict) and "low" in v
        else ranges(v)
        if isinstance(v, dict)
        else v
        for k, v in settings.items()
    }


def test_every_effect_of_touch_has_a_place():
    assert set(EVERY) == {e.id for e in TOUCH_CATALOGUE}


@pytest.mark.parametrize("effect", list(EVERY))
def test_each_finding_is_a_setting_with_its_interval(effect, tmp_path):
    f, fact, pad, shared = EVERY[effect]
    h = handed([f], {"index": fact})
    got = ranges(h.tactile.get("pads", {}).get("index", {}))
    got.get("rubber", {}).pop("thickness", None)
    assert got == pad and ranges(h.randomize) == shared and not h.doubts
    assert write(h, tmp_path / "t.yaml") and load(tmp_path / "t.yaml")["tactile"].get("pads", {}) == h.tactile.get(
        "pads", {}
    )
    cfg = task_cfg(f"tactile_file={tmp_path / 't.yaml'}", task="rotate")
    assert all(cfg["randomize"][k.split(".")[0]][k.split(".")[1]] == [v[1], v[2]] for k, v in shared.items())
    if effect == "contact_friction":
        assert cfg["tactile"]["friction"] == [0.35, 0.45]
    f = replace(f, confidence=0.5)
    doubt = handed([f], {"index": fact})
    assert "is not sure" in doubt.doubts[0]
    wide = ranges(doubt.tactile.get("pads", {}).get("index", {})) | ranges(doubt.randomize)
    assert "rubber" not in wide  # between a rubber and none lies no rubber
    for key in set(wide) & set(BELIEVED):
        low, high = (pad | shared)[key][1:]
        assert wide[key][1:] == (min(low, BELIEVED[key]), max(high, BELIEVED[key]))


def test_single_taxels():
    f = finding(
        "tactile_gain",
        on=["1:3", "1:14", "1:15", "1:17", "1:33"],
        gain={
            "value": [0.0, 1.0, 1.1, 0.5, 0.0],
            "low": [0.0, 0.9, 1.0, 0.4, 0.0],
            "high": [0.05, 1.1, 1.2, 0.6, 0.05],
        },
    )
    f.parameters["taxels"] = {"value": "", "swapped": [["1:14", "1:15"]]}
    facts = {"index": PadFacts({3: 0.0, 33: 0.4})}
    pad = handed([f], facts).tactile["pads"]["index"]
    assert pad["dead"] == [3] and pad["stuck"] == {33: 0.4} and pad["swapped"] == [[14, 15]]
    assert ranges(pad["taxels"]) == {14: (1.0, 0.9, 1.1), 15: (1.1, 1.0, 1.2), 17: (0.5, 0.4, 0.6)}
    h = handed([replace(f, confidence=0.5)], facts)
    pad = h.tactile["pads"]["index"]
    assert (
        set(pad) == {"taxels"}
        and ranges(pad["taxels"])[3] == (0.0, 0.0, 1.0)
        and ranges(pad["taxels"])[17] == (0.5, 0.4, 1.0)
    )
    assert "exchanged taxels are left out" in h.doubts[0]


def test_a_set_hands_on_both_of_its_effects():
    """Without a load cell a gain and a softer contact are one factor: both are given, each beside what was believed."""
    gain = finding(
        "tactile_gain", also=("contact_stiffness",), gain=(0.6, 0.55, 0.65), taxels={"value": "all of the pad"}
    )
    soft = finding("contact_stiffness", also=("tactile_gain",), stiffness=(4200.0, 3850.0, 4550.0))
    for f, fact, guess in (
        (gain, PadFacts(common=(0.6, 0.55, 0.65)), (0.6, 7000.0)),
        (soft, PadFacts(), (1.0, 4200.0)),
    ):
        h = handed([f], {"index": fact})
        # the best guess is the one that is named
        assert ranges(h.tactile["pads"]["index"])["gain"] == pytest.approx((guess[0], 0.55, 1.0))
        assert ranges(h.randomize)["contact.stiffness"] == pytest.approx((guess[1], 3850.0, 7000.0)) and h.doubts


def test_what_a_world_has_one_of_holds_every_fingertip():
    soft, hard = (
        finding("contact_stiffness", stiffness=(4000.0, 3800.0, 4200.0)),
        finding("contact_stiffness", MID, stiffness=(5000.0, 4900.0, 5100.0)),
    )
    both = {"index": PadFacts(), "mid": PadFacts()}
    assert ranges(handed([soft, hard], both).randomize)["contact.stiffness"] == (4500.0, 3800.0, 5100.0)
    # judged, and nothing found
    assert ranges(handed([soft, hard], both | {"ring": PadFacts()}).randomize)["contact.stiffness"][1:] == (
        3800.0,
        7000.0,
    )
    assert ranges(handed([soft], {"index": PadFacts(), "ring": PadFacts(judged=False)}).randomize)["contact.stiffness"][
        1:
    ] == (3800.0, 4200.0)


def test_a_gain_that_drifts_and_is_wrong():
    gain, drift = EVERY["tactile_gain"][0], EVERY["thermal"][0]
    h = handed([gain, drift], {"index": PadFacts(common=(0.7, 0.65, 0.75), warmest=20.0)})
    assert ranges(h.tactile["pads"]["index"])["gain"] == pytest.approx((0.63, 0.65 * 0.76, 0.75))


def test_taxels_that_hardly_felt_anything_have_what_the_others_agree_on():
    f = finding("tactile_gain", on=["1:17"], gain=(0.5, 0.45, 0.55))
    pad = handed([f, EVERY["thermal"][0]], {"index": PadFacts(rest=(0.7, 0.66, 0.74), warmest=10.0)}).tactile["pads"][
        "index"
    ]
    assert ranges(pad) == {
        "gain": pytest.approx((0.665, 0.66 * 0.88, 0.74)),
        "taxels": {17: pytest.approx((0.475, 0.45 * 0.88, 0.55))},
    }


def test_chord_of_a_law():
    depth = np.linspace(1e-5, 1e-3, 400)
    value, low, high = chord(7000.0 * depth, depth)
    assert value == pytest.approx(7000.0) and low == pytest.approx(7000.0) and high == pytest.approx(7000.0)
    # slope 7e6 x depth: a tenth of the force is felt under 10 ** (-1 / 3) mm
    value, low, high = chord(7e6 * depth**2, depth)
    assert (
        high == pytest.approx(7000.0 * 0.9 ** (1 / 3), rel=0.02)
        and low == pytest.approx(7000.0 * 0.1 ** (1 / 3), rel=0.03)
        and low < value < high
    )
    assert chord(np.zeros(50), np.full(50, 1e-3)) is None


def test_nothing_found_writes_nothing(tmp_path):
    path = tmp_path / "tactile.yaml"
    assert not write(handed([], {"index": PadFacts()}), path) and not path.exists()
    assert write(handed([EVERY["tactile_delay"][0]], {}), path) and path.read_text().startswith(HEAD)


@pytest.mark.slow
@pytest.mark.parametrize(
    "planted",
    [
        {"gains": {54: 0.5, 66: 1.5}, "stuck": {80: 2.0}, "swapped": [(55, 65)]},
        {"stiffness": 4500.0},
        {"rubber": (1e5, 2e4)},
        {"gains": dict.fromkeys(range(120), 0.7) | {67: 0.0}},
    ],
    ids=["taxels", "stiffness", "rubber", "all"],
)
def test_more_round_trips(tmp_path, planted):
    _, path = diagnosed(tmp_path, **planted)
    found = load(path)
    env = grasp_env(f"tactile_file={path}", worlds=48)
    pad = found["tactile"].get("pads", {}).get("index", {})
    # one dead taxel hides that all have one gain: those that felt little have it too
    if len(planted.get("gains", ())) == 120:
        assert pad["gain"]["low"] - 0.03 < 0.7 < pad["gain"]["high"] + 0.03 and pad["taxels"][67]["value"] < 0.05
        assert within(env.touch.gain[:, INDEX, 5], pad["gain"]) and (env.touch.gain[:, MID] == 1.0).all()
    elif "gains" in planted:
        assert pad["stuck"] == {80: 2.0} and pad["swapped"] == [[55, 65]]
        for k, true in planted["gains"].items():
            gain, p = env.touch.gain[:, INDEX, k], pad["taxels"][k]
            assert (
                float(gain.min()) >= p["low"] - 1e-6
                and float(gain.max()) <= p["high"] + 1e-6
                and p["value"] == pytest.approx(true, abs=0.2)
            )
    else:
        low, high = found["randomize"]["contact.stiffness"]
        drawn = env.objects.stiffness
        assert (
            low - 1e-2 <= float(drawn.min())
            and float(drawn.max()) <= high + 1e-2
            and float(np.ptp(drawn.numpy())) > 0.8 * (high - low)
        )
    if "rubber" in planted:
        c10 = env.touch.by_pad.column("c10")
        assert (
            within(c10[:, INDEX], pad["rubber"]["c10"])
            and (c10[:, MID] == 0).all()
            and pad["rubber"]["c10"]["low"] < 1e5 < pad["rubber"]["c10"]["high"]
        )
    for _ in range(2):
        env.step(torch.zeros(48, 12))
    assert torch.isfinite(env.obs["actor"]).all()


# -- bad files
# ---------------------------------------------------------------------------------------------------------------

BAD = [
    ("tactile: {pads: {index: {delay: 2.0}}}", "tactile.pads.index.delay=2.0: must be a number; allowed: 0 to 1 s"),
    (
        "tactile: {pads: {index: {crosstalk: [0.5, 0.1]}}}",
        "tactile.pads.index.crosstalk=[0.5, 0.1]: must rise from low to high",
    ),
    (
        "tactile: {pads: {little: {gain: 0.5}}}",
        "tactile.pads.little: no such pad; pads: thumb, index, mid, ring, pinky",
    ),
    ("tactile: {pads: {index: {dead: [200]}}}", "tactile.pads.index: no taxel 200; this pad has 120"),
    ("tactile: {pads: {index: {gian: 0.5}}}", "tactile.pads.index.gian: unknown; valid ones: gain"),
    ("tactile: {delays: 0.1}", "tactile.delays: unknown; valid ones: pads, stiffness_scale"),
    (
        "randomize: {contact.stiffness: [1, 9000]}",
        "randomize.contact.stiffness=1: must be a number; allowed: 100 to 100000 N/m",
    ),
    ("randomize: {object.mass: 0.1}", "randomize.object.mass: unknown; valid ones: object.friction, contact.stiffness"),
    ("servo: {}", "servo: unknown; valid ones: tactile, randomize"),
    ("[1, 2]", "must map tactile and randomize"),
    ("tactile: [1", "cannot be read"),
    ("tactile: 3", "tactile (3): expected `object | null`"),
]


@pytest.mark.parametrize(("text", "said"), BAD)
def test_bad_files_are_one_line(tmp_path, text, said):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        grasp_cfg(f"tactile_file={path}")
    assert str(path) in str(error.value) and said in str(error.value) and "\n" not in str(error.value)


def test_a_file_that_is_not_there():
    with pytest.raises(UserError, match="tactile file 'none.yaml' does not exist; tactile_file=PATH"):
        grasp_cfg("tactile_file=none.yaml")


def test_help_names_it():
    assert "tactile_file=null" in help_page.text("train", CONFIGS)
    from dexsim.gap.command import HELP

    assert "tactile.yaml" in HELP and xhand.FINGERS[INDEX] == "index"
