"""What a servo.yaml says of its drives beyond the usual columns: unknown ones are fitted, a dragging joint is the one
it names."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from test_gap import SERVO, motion, plant_run

from dexsim.actuator.table import ServoTable
from dexsim.gap import demo
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.judge import conclude
from dexsim.gap.judge.handed_on import servo_changes
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX, SERIES_INDEX
from dexsim.gap.read import Run, conditions
from dexsim.gap.search.fit import intervals
from dexsim.gap.search.scan import narrowed
from dexsim.gap.search.search import JointSearch

RUNS = (0, 1, 3)


def searched(unknown: tuple[str, ...], changes: dict[str, float], **more):
    """Return the search of a joint whose servo.yaml says `unknown` of some columns, on motions with others."""
    runs = [
        plant_run(
            f"run{k}",
            k,
            4.2,
            changes,
            seed=k,
            servo={"loop_encoder": "motor"} | {n: "unknown" for n in unknown},
            **more,
        )
        for k in RUNS
    ]
    for r in runs:
        r.smooth()
    case = build(mujoco.MjModel.from_xml_string(demo.MODEL), runs)[0]
    return JointSearch(case, list(range(len(runs))), None, conditions(runs))


@pytest.mark.parametrize(
    ("name", "true", "effect"),
    [
        pytest.param("softness", 0.2, "compliance", marks=pytest.mark.slow),
        pytest.param("backlash", 0.05, "backlash", marks=pytest.mark.slow),
        ("thermal_torque", -0.006, "thermal"),
        ("speed_lag", 0.03, "lag"),
        pytest.param("load_friction", 0.2, "load_friction", marks=pytest.mark.slow),
    ],
)
def test_an_unknown_column_is_fitted_with_every_hypothesis_and_handed_on(name, true, effect):
    search = searched((name,), {name: true}, temperature=name.startswith("thermal"))
    param = next(p for p in search.all_nuisances if p.columns == (name,))
    assert param.nuisance and param.low < true < param.high
    none = search.start()
    assert none.fit.loss < 2.5, "the motions are followed without any effect"
    value = dict(zip([p.key for p in none.fit.params], none.fit.x, strict=True))[name]
    assert value == pytest.approx(true, rel=0.15)
    named = EFFECTS[effect]
    variants = named.variants(search.case.scales)
    labels = [v.label for v in variants if narrowed(search, named, v) is not None]
    mine = [v.label for v in variants if (name,) == v.params[0].columns]
    assert mine and not set(mine) & set(labels), "what is fitted anyway is not named as well"
    table = ServoTable.from_dict({"joints": {"*": SERVO}})
    servo_changes(table, search.case, none, intervals(none.fit, search.blocks), ["joint"])
    assert table.value("joint", name).value == pytest.approx(value, rel=1e-6)
    assert conclude.not_fitted([search.case]) == []


def test_a_column_that_says_nothing_alone_is_taken_as_absent_and_said():
    search = searched(("torque_ripple", "sag"), {})
    assert not {"torque_ripple", "sag"} & {c for p in search.all_nuisances for c in p.columns}
    said = conclude.not_fitted([search.case])
    assert len(said) == 2 and all("taken as absent" in x for x in said)
    ripple = EFFECTS["torque_ripple"]
    variants = [narrowed(search, ripple, v) for v in ripple.variants(search.case.scales)]
    assert any(v is not None for v in variants), "it is still looked for"


def test_the_joint_that_drags_is_the_one_the_servo_names():
    """Three pendulums side by side; the third is said to drag the first."""
    bodies = "".join(
        f"""<body name="link{k}" pos="0 {0.4 * k} 0">
 <joint name="j{k}" type="hinge" axis="0 1 0" armature="4e-4" range="-2.5 2.5"/>
      <geom type="sphere" size="0.012" pos="0 0 -0.1" mass="0.15" contype="0" conaffinity="0"/></body>"""
        for k in range(3)
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><compiler angle='radian'/><worldbody>{bodies}</worldbody></mujoco>"
    )
    names = ("j0", "j1", "j2")
    t_cmd = motion(0, 4.0)[0]
    cmd = np.stack([motion(k, 4.0, seed=k)[1] for k in (0, 1, 3)], 1)
    t = np.arange(0.0, 3.9, 0.01)
    q = np.stack([np.interp(t, t_cmd, c) for c in cmd.T], 1)

    def case(joints: dict, order=(0, 1, 2)):
        table = ServoTable.from_dict({"joints": {"*": SERVO, **joints}})
        pick = list(order)
        run = Run(
            "a",
            tuple(names[k] for k in pick),
            t_cmd,
            cmd[:, pick],
            t,
            q[:, pick],
            table,
            np.array([0, 0, -9.81]),
            counted=names,
        )
        run.smooth()
        return build(model, [run])[pick.index(0)]

    dragged, free = case({"j0": {"coupling": 0.3, "coupling_from": 2}}), case({})
    assert dragged.scales.others == ("j2", "j1") and free.scales.others == ("j1", "j2")
    base = dragged.plant.base()[0]
    assert base[INDEX["coupling"]] == 0.3 and base[INDEX["coupling_from"]] == 0
    windows = dragged.plant.windows(None)
    a, b = (x.plant.simulate(x.plant.base()[None], x.plant.windows(None))[0][0] for x in (dragged, free))
    motion_of_j2 = q[:, 2] - q[0, 2]
    slope = np.polyfit(motion_of_j2[windows.sample_row], a - b, 1)[0]
    assert slope == pytest.approx(0.3, abs=0.06)
    short = case({"j0": {"coupling": 0.3, "coupling_from": 2}}, order=(0, 1))  # the joint that drags was not recorded
    assert short.plant.base()[0][INDEX["coupling"]] == 0


def test_what_other_joints_draw_follows_their_commands_between_samples():
    """A target that jumps between two samples of a joint loads the supply from its own time on."""
    bodies = "".join(
        f"""<body pos="0 {0.4 * k} 0"><joint name="j{k}" type="hinge" axis="0 1 0" armature="4e-4" range="-2.5 2.5"/>
      <geom type="sphere" size="0.012" pos="0 0 -0.1" mass="0.15" contype="0" conaffinity="0"/></body>"""
        for k in range(2)
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><compiler angle='radian'/><worldbody>{bodies}</worldbody></mujoco>"
    )
    t_cmd = np.r_[0.0, 1.004]
    cmd = np.array([[0.0, 0.0], [0.0, 0.2]])
    t = np.arange(0.0, 2.0, 0.02)
    q = np.stack([0.2 * np.sin(t), np.zeros(len(t))], 1)
    run = Run(
        "a", ("j0", "j1"), t_cmd, cmd, t, q, ServoTable.from_dict({"joints": {"*": SERVO}}), np.array([0, 0, -9.81])
    )
    run.smooth()
    run.fine = (t, run.qs, run.vs, run.as_)
    plant = build(model, [run])[0].plant
    drawn = plant.series[:, SERIES_INDEX["others_torque"]]
    at = plant.dt * np.arange(len(drawn))
    assert np.abs(drawn[at < 1.0]).max() < 1e-9 and np.allclose(drawn[at > 1.007], 2.0 * 0.2, rtol=1e-6)


def test_a_plant_in_shorter_steps_is_the_same_joint():
    runs = [plant_run(f"run{k}", k, 4.0, {"coulomb_friction": 0.05}, seed=k) for k in RUNS]
    for r in runs:
        r.smooth()
    plant = build(mujoco.MjModel.from_xml_string(demo.MODEL), runs)[0].plant
    fine = plant.refined(4)
    a, b = plant.windows(None), fine.windows(None)
    assert (
        fine.dt == pytest.approx(plant.dt / 4)
        and np.array_equal(a.sample_row, b.sample_row)
        and np.array_equal(a.sample_window, b.sample_window)
    )
    for r, (g, h) in enumerate(zip(a.window[:, 0], b.window[:, 0], strict=True)):
        k = a.window[r, 1] - 2
        assert np.allclose(plant.series[g : g + k], fine.series[h : h + 4 * k : 4], atol=1e-12)
        assert b.window_t[r] == a.window_t[r]
    params = plant.base()[None].copy()
    params[:, :, INDEX["coulomb_friction"]] = 0.05
    q, p = (x.simulate(params, w)[0][0] for x, w in ((plant, a), (fine, b)))
    assert 0 < np.abs(q - p).max() < 3e-3 and np.sqrt(np.mean((q - p) ** 2)) < 3e-4
