"""A linkage between two joints in the gap's plant: the rotor that it turns, the friction that it carries along, the
pull at its other end."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dexsim.actuator.table import ServoTable
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.finding import Finding
from dexsim.gap.plant.case import build, dragged_by
from dexsim.gap.plant.columns import INDEX, SERIES_INDEX
from dexsim.gap.read import Run
from dexsim.gap.search.search import search_joint

ROTOR, BOB = 5e-4, 0.2 * 0.1**2
MODEL = """<mujoco><option gravity="0 0 0"/><worldbody>
<body><joint name="a" axis="0 1 0" armature="5e-4"/><geom type="sphere" size="1e-3" mass="0.2" pos="0 0 -0.1"/></body>
<body pos="1 0 0"><joint name="b" axis="0 1 0" armature="5e-4"/>
 <geom type="sphere" size="1e-3" mass="0.2" pos="0 0 -0.1"/></body>
</worldbody></mujoco>"""
RATE = 3.0  # rad/s2 of joint b


def plant(loop: str = "joint"):
    """Return the joint a's plant along a run in which it stands still and b speeds up evenly; its drive does nothing by
    itself."""
    t = np.arange(0.0, 1.0, 0.01)
    servo = {"joints": {"*": {"kp": 0.0, "kd": 0.0, "torque_limit": 1.0}}, "loop_encoder": loop}
    q = np.stack([0 * t, 0.5 * RATE * t**2], 1)
    run = Run("x", ("a", "b"), t, np.zeros((len(t), 2)), t, q, ServoTable.from_dict(servo), np.zeros(3))
    return build(mujoco.MjModel.from_xml_string(MODEL), [run])[0].plant


def moved(p, **columns) -> np.ndarray:
    params = p.base()[None].copy()
    for name, value in columns.items():
        params[..., INDEX[name]] = value
    return p.simulate(params, p.windows(None))[0][0]


def test_the_other_joint_is_known_by_rate_acceleration_and_pull():
    p = plant()
    inside = slice(200, -200)
    assert p.series[inside, SERIES_INDEX["drag_a0"]] == pytest.approx(RATE, rel=0.02)
    # its link alone, without its rotor
    assert p.series[inside, SERIES_INDEX["pull0"]] == pytest.approx(BOB * RATE, rel=0.02)


def test_a_linkage_turns_the_rotor():
    p = plant()
    t = p.t - p.t[0]
    expected = 0.5 * (ROTOR * 0.5 * RATE / (ROTOR + BOB)) * t**2
    assert moved(p, linkage=0.5)[-1] == pytest.approx(expected[-1], rel=0.05)
    assert abs(moved(p)[-1]) < 1e-3 * expected[-1]


@pytest.mark.parametrize("give", [0.0, 1e-4])
def test_dry_friction_of_the_motor_carries_the_joint_along(give):
    """A motor that cannot turn holds q - ratio * other: the joint follows at its rate."""
    p = plant()
    t = p.t - p.t[0]
    q = moved(p, linkage=0.5, coulomb_friction=5.0, presliding=give)
    assert q[-1] == pytest.approx(0.5 * 0.5 * RATE * t[-1] ** 2, rel=0.03)


def test_what_drags_is_held_back():
    p = plant()
    t = p.t - p.t[0]
    expected = -0.5 * (0.5 * BOB * RATE / (ROTOR + BOB)) * t**2
    assert moved(p, reaction=0.5)[-1] == pytest.approx(expected[-1], rel=0.05)


def test_a_loop_on_the_motor_turns_the_joint_by_the_ratio():
    p = plant("motor")
    t = p.t - p.t[0]
    stiff = moved(p, linkage=0.5, kp=2.0, kd=0.1, torque_limit=10.0)
    assert stiff[-1] == pytest.approx(0.5 * 0.5 * RATE * t[-1] ** 2, rel=0.05)
    # on the joint it holds against it
    assert abs(moved(plant(), linkage=0.5, kp=2.0, kd=0.1, torque_limit=10.0)[-1]) < 0.01


def test_the_catalogue_offers_both_ends_of_a_linkage():
    t = np.arange(0.0, 1.0, 0.01)
    q = np.stack([0.3 * np.sin(9 * t), 0.5 * RATE * t**2], 1)
    servo = ServoTable.from_dict({"joints": {"*": {"kp": 1.0, "kd": 0.01, "torque_limit": 1.0}}})
    run = Run("x", ("a", "b"), t, q.copy(), t, q, servo, np.array([0, 0, -9.81]))
    variants = EFFECTS["joint_coupling"].variants(build(mujoco.MjModel.from_xml_string(MODEL), [run])[0].scales)
    assert [v.params[0].columns[0] for v in variants] == ["coupling", "linkage", "reaction"]
    assert {v.note["from_joint"] for v in variants} == {"b"}


def test_a_linkage_is_one_finding_at_the_end_that_is_dragged():
    from types import SimpleNamespace

    from dexsim.gap.judge import conclude

    def end(joint: str, other: str, sure: float) -> Finding:
        return Finding("joint_coupling", sure, "", [joint], parameters={"from_joint": {"value": other}})

    def answer(joint: str, column: str):
        member = SimpleNamespace(
            effect=EFFECTS["joint_coupling"], variant=SimpleNamespace(params=[SimpleNamespace(columns=(column,))])
        )
        return SimpleNamespace(
            case=SimpleNamespace(joint=joint), outcome=SimpleNamespace(best=SimpleNamespace(members=[member]))
        )

    lag = Finding("lag", 0.9, "", ["b"])
    found = conclude._linkages(
        [end("a", "b", 0.99), lag, end("b", "a", 0.7)], [answer("a", "reaction"), answer("b", "linkage")]
    )
    assert [(f.effect, f.joints, f.confidence) for f in found] == [
        ("joint_coupling", ["b", "a"], 0.99),
        ("lag", ["b"], 0.9),
    ]
    chain = [end("a", "b", 0.9), end("b", "c", 0.9)]
    assert conclude._linkages(chain, []) == chain


def several(ratio: float = 0.0):
    """Return the cases of six joints side by side, a to f, that move at their own rates; a's motor is linked with f."""
    names, rates = "abcdef", (3.0, 4.1, 5.3, 6.7, 7.9, 2.3)
    bodies = "".join(
        f'<body pos="{k} 0 0"><joint name="{n}" axis="0 1 0" armature="5e-4"/>'
        '<geom type="sphere" size="1e-3" mass="0.2" pos="0 0 -0.1"/></body>'
        for k, n in enumerate(names)
    )
    spec = mujoco.MjModel.from_xml_string(f'<mujoco><option gravity="0 0 0"/><worldbody>{bodies}</worldbody></mujoco>')
    servo = {"kp": 1.0, "kd": 0.03, "torque_limit": 1.0, "coulomb_friction": 0.005}
    table = ServoTable.from_dict({"joints": {"*": servo}})
    runs = []
    for number in range(3):
        t = np.arange(0.0, 4.0, 0.01)
        q = 0.4 * np.sin(np.outer(t, np.array(rates)) + number * np.arange(6.0))
        run = Run(f"r{number}", tuple(names), t, q.copy(), t, q, table, np.array([0, 0, -9.81]))
        for _ in range(2):  # the series are those of the motion itself
            run.qs = None
            cases = build(spec, [run])
            run.q[:, 0] = moved(dragged_by(cases[0], [cases[5]]).plant, linkage=ratio, coupling_from=3)
        run.q += np.random.default_rng(number).normal(0, 3e-4, q.shape)
        run.qs = None
        runs.append(run)
    return build(spec, runs)


def test_a_joint_further_off_takes_the_place_of_the_last():
    cases = several()
    a, f = cases[0], cases[5]
    assert a.scales.others == ("b", "c", "d", "e")
    far = dragged_by(a, [f])
    assert far.scales.others == ("b", "c", "d", "f") and a.scales.others[3] == "e"
    column = lambda case, name: case.plant.series[:, SERIES_INDEX[name]]  # noqa: E731
    assert np.array_equal(column(far, "drag2"), column(a, "drag2"))
    # as the plant of another joint, that knows f among its nearest, has it
    near = dragged_by(cases[1], [cases[4], f])
    for name in ("drag3", "drag_v3", "drag_a3", "pull3"):
        assert np.array_equal(column(far, name), column(near, name)) and not np.array_equal(
            column(far, name), column(a, name)
        )
    run = slice(0, 400)
    assert far.regimes["_drag3"][run] == pytest.approx(f.plant.q[run] - f.plant.q[0])
    e = cases[4]
    again = dragged_by(a, [e])  # e once more, from its own plant, from finer samples
    for name in ("drag3", "drag_v3", "drag_a3", "pull3"):
        change, size = (np.quantile(np.abs(x), 0.95) for x in (column(again, name) - column(a, name), column(a, name)))
        assert change < 0.1 * size, name


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.4, 0.0])
def test_a_linkage_with_a_joint_further_off_is_found(ratio):
    from types import SimpleNamespace

    from dexsim.gap.compute import TimeLimit
    from dexsim.gap.diagnosis import Drives
    from dexsim.gap.search.search import JointSearch

    drives = object.__new__(Drives)
    settings = SimpleNamespace(allowed={"joint_coupling"}, seed=0, device="cpu")
    drives.w = SimpleNamespace(settings=settings, limit=TimeLimit(None), progress=None)
    drives.cases, drives.unknown_controllers = several(ratio), set()
    drives.parts, drives.fold_groups = SimpleNamespace(train=[0, 1, 2], span_train=None), [0, 1, 2]
    drives._left, drives.late = 1, {}
    search = drives._begun(0, lambda _: None)
    assert isinstance(search, JointSearch)
    first = search_joint(search)
    assert not first.best.members
    answers = [(search, first)] + [(drives._begun(k, lambda _: None), None) for k in range(1, 6)]
    drives._dragged_from_afar(answers)
    found = answers[0][1]
    if not ratio:
        assert answers[0] == (search, first) and drives.cases[0].scales.others[3] == "e"
        return
    (member,) = found.best.members
    assert member.variant.note["from_joint"] == "f" and drives.cases[0] is answers[0][0].case
    assert float(found.best.fit.x[0]) == pytest.approx(ratio, rel=0.1)


def test_the_other_end_of_a_linkage_is_asked_for_it():
    """What drags a joint feels it: it is searched again with that joint among those that it knows, if something was
    found in it and it does not know it."""
    from types import SimpleNamespace

    from dexsim.gap.diagnosis import Drives

    def outcome(*others: str) -> SimpleNamespace:
        effect = SimpleNamespace(couples=True)
        note = [SimpleNamespace(effect=effect, variant=SimpleNamespace(note={"from_joint": o})) for o in others]
        return SimpleNamespace(best=SimpleNamespace(members=note or (SimpleNamespace(effect=SimpleNamespace()),)))

    drives = object.__new__(Drives)
    drives.cases = several()
    assert drives.cases[5].scales.others == ("a", "b", "c", "d")
    searches: list[dict] = []
    drives._search_with = lambda answers, cases: searches.append(cases)
    found = [outcome("f"), None, outcome("f", "d", "z"), outcome(), outcome("f", "b"), outcome()]
    answers = [(SimpleNamespace(case=c), x) for c, x in zip(drives.cases, found, strict=True)]
    drives._search_draggers(answers, [0, 2, 4])
    (ends,) = searches
    assert list(ends) == [5] and ends[5].scales.others == ("a", "b", "c", "e")
    answers[5] = answers[5][0], SimpleNamespace(best=SimpleNamespace(members=()))  # nothing there to be explained
    drives._search_draggers(answers, [4])
    assert searches[1] == {}
