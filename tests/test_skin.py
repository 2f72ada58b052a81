"""Touch on palm and links: where its taxels lie, and that links feel what the physics presses them with."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial import cKDTree

from dexsim.cli import start
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.hand.skin import geom_points, link_skins, tip_skins
from dexsim.import_hand import command, skin
from dexsim.import_hand.importing import Settings, import_hand
from dexsim.paths import CONFIGS
from dexsim.tactile import ShapeSet, Tactile, TaxelLayout, hand_layout
from dexsim.tactile.posed import PosedEngine
from dexsim.tactile.reference import distance as distance_of
from dexsim.tactile.shapes import bake_convex
from dexsim.tasks import make_env
from dexsim.tasks.building import contact_pairs, pad_pairs, self_pairs
from tests import hands
from tests.made_hand import made_hand
from tests.tactile_fixtures import primitives, random_rotation
from tools.assets.presses import spread


@pytest.fixture(scope="module")
def hand():
    return load_hand("xhand_skin")


def feeling(hand, layout: TaxelLayout, worlds: int, lanes: bool | None = None, **cfg) -> tuple[PosedEngine, Tactile]:
    """Return given poses and forces of a hand's links, and touch on them, as the tasks have it."""
    names = [name for name, _ in pad_pairs(hand)]
    bodies = ["world", *(b for b, _ in link_skins(hand)), "object"]
    engine = PosedEngine(worlds, bodies, list(dict.fromkeys([*names, *self_pairs(hand)])))
    touch = Tactile(
        engine, layout, ShapeSet(primitives()), "object", {"raw": True, "feel_others": True, **cfg}, pairs=names,
        tips=tip_skins(hand), links=link_skins(hand), selves=self_pairs(hand), lanes=lanes,
    )  # fmt: skip
    return engine, touch


def drop_in(engine: PosedEngine, touch: Tactile, seed: int, forces: bool = True) -> None:
    """Links at random near one another, a ball among them, random forces."""
    rng = np.random.default_rng(seed)
    for w in range(engine.n):
        for body in engine.bodies:
            engine.place(w, body, rng.uniform(-0.03, 0.03, 3), random_rotation(rng))
    touch.shape_id[:], touch.shape_size[:] = 1, torch.tensor([0.02, 0.0, 0.0])
    given = rng.uniform(0, 10, (engine.n, len(engine.pairs))) * (rng.random((engine.n, len(engine.pairs))) < 0.7)
    engine.t.pair_normal[:] = torch.as_tensor(given, dtype=torch.float32)


def test_the_first_pads_are_the_xhands_own(hand):
    plain, whole = hand_layout(load_hand("xhand")), hand_layout(hand)
    assert whole.names[:5] == plain.names and plain.pads == 5 and int(plain.count.sum()) == 600
    for field in ("point", "normal", "tx", "ty", "area"):
        np.testing.assert_array_equal(getattr(whole, field)[:5], getattr(plain, field))
    assert whole.rows == (12,) * 5 + (0,) * 10 and int(whole.count.sum()) == 800
    pairs = contact_pairs(load_hand("xhand"), "right_hand_link")
    assert [p.name for p in contact_pairs(hand, "right_hand_link")][: len(pairs)] == [p.name for p in pairs]


@pytest.mark.slow
@pytest.mark.parametrize("cfg", [{}, {"law": "linear"}])
@pytest.mark.parametrize("lanes", [False, True])
def test_pads_of_a_link_sum_to_what_the_physics_presses_it_with(hand, cfg, lanes, monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    engine, touch = feeling(hand, hand_layout(hand), 4, lanes, **cfg)
    drop_in(engine, touch, 3)
    touch.launch()
    for names, sensed in (([n for n, _ in pad_pairs(hand)], touch.force_clean), (self_pairs(hand), touch.force_other)):
        for name in set(names):
            mine = [k for k, n in enumerate(names) if n == name]
            given = engine.t.pair_normal[:, engine.pair(name)]
            torch.testing.assert_close(sensed[:, mine].sum(1), given, rtol=1e-5, atol=1e-5)
    both = touch.force_clean + touch.force_other
    torch.testing.assert_close(touch.raw_clean.sum(-1), both, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(touch.force, both, rtol=1e-5, atol=1e-5)  # as the sensor measures it


@pytest.mark.slow
def test_taxels_share_a_link_by_their_distance_whichever_pad_they_are_in(hand):
    """Of the palm's four pads as if they were one, and of the hand itself by the nearest link."""
    layout = hand_layout(hand)
    engine, touch = feeling(hand, layout, 6, feel_others=False)
    drop_in(engine, touch, 8)
    touch.launch()
    palm = [k for k, b in enumerate(layout.bodies) if b == "right_hand_link"]
    assert len(palm) == 4
    xpos, xmat = engine.t.xpos.double().numpy(), engine.t.xmat.double().numpy()
    b, o = engine.body("right_hand_link"), engine.body("object")
    for w in range(6):
        points = np.concatenate([layout.point[k, : layout.count[k]] for k in palm]) @ xmat[w, b].T + xpos[w, b]
        area = np.concatenate([layout.area[k, : layout.count[k]] for k in palm])
        d = distance_of("sphere", np.array([0.02, 0, 0]), (points - xpos[w, o]) @ xmat[w, o])
        given = float(engine.t.pair_normal[w, engine.pair("link_right_hand_link")])
        got = np.concatenate([touch.raw_clean[w, k, : layout.count[k]].numpy() for k in palm])
        np.testing.assert_allclose(got, spread(given, d, area, touch.cfg.reach), atol=2e-3 * max(given, 1))
    engine, touch = feeling(hand, layout, 3)
    drop_in(engine, touch, 9)
    touch.shape_id[:] = -1  # nothing but the hand
    touch.launch()
    b, grids = engine.body("right_hand_mid_link1"), [(n, bake_convex(x)) for n, x in link_skins(hand)]
    k = layout.names.index("mid_1")
    for w in range(3):
        points = layout.point[k, :20] @ xmat_of(engine, w, b).T + engine.t.xpos[w, b].double().numpy()
        d = np.full(20, np.inf)
        for name, grid in grids:
            if name != "right_hand_mid_link1":
                g = engine.body(name)
                q = (points - engine.t.xpos[w, g].double().numpy()) @ xmat_of(engine, w, g)
                d = np.minimum(d, distance_of("grid", np.ones(3), q, grid))
        given = float(engine.t.pair_normal[w, engine.pair("hand_right_hand_mid_link1")])
        want = spread(given, d, layout.area[k, :20], touch.cfg.reach)
        np.testing.assert_allclose(touch.raw_clean[w, k, :20].numpy(), want, atol=0.05 * max(given, 1))


def xmat_of(engine: PosedEngine, world: int, body: int) -> np.ndarray:
    return engine.t.xmat[world, body].double().numpy()


def test_readings_do_not_change_when_all_is_turned(hand):
    out = []
    turn, shift = random_rotation(np.random.default_rng(1)), np.array([0.3, -0.2, 0.1])
    layout = hand_layout(hand)
    for move in (False, True):
        engine, touch = feeling(hand, layout, 3)
        drop_in(engine, touch, 5)
        if move:
            r = torch.as_tensor(turn, dtype=torch.float32)
            engine.t.xpos[:] = engine.t.xpos @ r.T + torch.as_tensor(shift, dtype=torch.float32)
            engine.t.xmat[:] = r @ engine.t.xmat
        touch.launch()
        back = (touch.centre_clean.numpy() - shift) @ turn if move else touch.centre_clean.numpy()
        out.append((touch.raw_clean.clone().numpy(), back.copy()))
    np.testing.assert_allclose(out[0][0], out[1][0], atol=5e-3)
    np.testing.assert_allclose(out[0][1], out[1][1], atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("requested", ["hull:100/3", "hull:6mm", "a_2:25:all", "hull:40,links:30:all"])
def test_taxels_lie_evenly_on_the_links_surface(requested, tmp_path):
    made_hand(tmp_path)
    hand = load_hand(tmp_path)
    pads = skin.lay(hand, requested.replace("hull", "palm"))
    wishes = skin.wishes(requested)
    total = sum(len(p.point) for _, p in pads.values())
    if "mm" not in requested:
        assert total == {"hull:100/3": 100, "a_2:25:all": 25, "hull:40,links:30:all": 130}[requested]
    for body in {b for b, _ in pads.values()}:
        own = [p for b, p in pads.values() if b == body]
        point, normal = (np.concatenate([getattr(p, k) for p in own]) for k in ("point", "normal"))
        area = np.concatenate([p.area for p in own])
        geoms = hand.links[body]
        corners = geom_points(hand, geoms)
        box = body == "hull"
        off = np.abs(signed(hand, geoms[0], point, corners, box))
        assert off.max() < 2e-4  # of the facets that stand for a capsule
        out = signed(hand, geoms[0], point + 1e-3 * normal, corners, box)
        assert out.min() > 3e-4  # outward
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-9)
        spacing = np.sqrt(area.sum() / len(point))
        near = cKDTree(point).query(point, 2)[0][:, 1]
        assert near.min() > 0.45 * spacing and near.max() < 1.7 * spacing
        if wishes[0].spacing and body == "hull":
            assert spacing == pytest.approx(wishes[0].spacing, rel=0.05)
        if box and "all" not in requested.split(",")[0]:
            assert (normal @ skin.directions(hand, body)[0] > 0).all()
            top = 0.076 * 0.084
            assert 0.75 * top < area.sum() < 1.05 * top  # what fingers stand on is not shown
        if len(own) > 1:
            assert min(len(p.point) for p in own) > 15


def signed(hand, geom: str, points: np.ndarray, corners: np.ndarray, box: bool) -> np.ndarray:
    """Return signed distances of a capsule or box in its body's frame."""
    g = hand.compiled.geom(geom)
    turn = np.zeros(9)
    import mujoco

    mujoco.mju_quat2Mat(turn, g.quat)
    q = (points - g.pos) @ turn.reshape(3, 3)
    return distance_of("box" if box else "capsule", np.asarray(g.size), q)


@pytest.mark.slow
def test_two_thousand_taxels_feel(tmp_path, monkeypatch):
    """By a GPU's kernel: more of a link than its registers hold."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    made_hand(tmp_path)
    done = skin.add(tmp_path, "palm:1400/4,links:150")
    layout = hand_layout(done)
    assert int(layout.count[3:].sum()) == 1400 + 3 * 150 and layout.pads == 3 + 4 + 3
    engine, touch = feeling(done, layout, 2, True)
    drop_in(engine, touch, 4)
    touch.launch()
    torch.testing.assert_close(touch.raw_clean.sum(-1), touch.force_clean + touch.force_other, rtol=1e-4, atol=1e-4)
    given = engine.t.pair_normal[:, engine.pair("link_hull")]
    torch.testing.assert_close(touch.force_clean[:, 3:7].sum(1), given, rtol=1e-4, atol=1e-4)


def test_a_hand_keeps_its_skin_and_another_replaces_it(tmp_path):
    made_hand(tmp_path)
    first = skin.add(tmp_path, "palm:30/2,a_2:10")
    assert [p.name for p in first.pads] == [*first.finger_names, "palm_a", "palm_b", "a_2"]
    again = skin.add(tmp_path, "a_2:12")
    assert [p.name for p in again.pads[3:]] == ["a_2"] and not list(tmp_path.glob("skin_palm*"))
    assert again.file.source["skin"] == "a_2:12"
    other = hand_layout(load_hand(tmp_path, mirror=True, scale=2.0))
    own = hand_layout(again)
    np.testing.assert_allclose(other.point[3], 2 * own.point[3] * [1, -1, 1])
    np.testing.assert_allclose(np.cross(other.tx[3, :12], other.ty[3, :12]), other.normal[3, :12], atol=2e-6)


@pytest.mark.parametrize(
    ("requested", "said"),
    [
        ("palm", "skin=palm: must be LINK:TAXELS"),
        ("palm:0", "skin=palm:0=0: must be"),
        ("palm:90x", "skin=palm:90x=90x: must be"),
        ("palm:0.1mm", "skin=palm:0.1mm=0.1: must"),
        ("pulm:20", "skin=pulm: no link of made .* did you mean palm"),
        ("palm:20,palm:30", "palm is asked for twice"),
        ("palm:20/30", "20 taxels in 30 pads"),
        ("palm:1500/3,links:400:all", "2700 taxels, at most 2000"),
    ],
)
def test_what_cannot_be_laid_is_one_line(requested, said, tmp_path):
    made_hand(tmp_path)
    before = sorted(p.name for p in tmp_path.iterdir())
    with pytest.raises(UserError, match=said) as caught:
        skin.add(tmp_path, requested)
    assert "\n" not in str(caught.value) and sorted(p.name for p in tmp_path.iterdir()) == before


def test_entries_that_do_not_fit_the_hand_are_one_line(tmp_path):
    entry = {"name": "back", "body": "hull", "taxels": "finger.csv"}
    for k, (change, pads, said) in enumerate(
        (
            ({"body": "hall"}, True, r"skin.back.body \(hall\): no link .* did you mean hull"),
            ({"name": "a"}, True, "skin and fingers: 'a' twice"),
            ({}, False, "skin: needs pads on the fingertips"),
            ({"taxels": "none.csv"}, True, "none.csv does not exist"),
        )
    ):
        with pytest.raises(UserError, match=said) as caught:
            hand_layout(load_hand(made_hand(tmp_path / str(k), pads=pads, skin=[entry | change])))
        assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_the_command_makes_another_hand_and_leaves_nothing_where_it_fails(tmp_path, capsys):
    made_hand(tmp_path / "made")
    out = tmp_path / "with_skin"
    with pytest.raises(UserError, match="no link"):
        command.main(["skin", str(tmp_path / "made"), "skin=tail:20", f"out={out}"])
    assert not out.exists()
    assert command.main(["skin", str(tmp_path / "made"), "skin=palm:20", f"out={out}", "picture=false"]) == 0
    said = capsys.readouterr().out
    assert "20 taxels" in said and load_hand(out).name == "with_skin" and not load_hand(tmp_path / "made").file.skin
    with pytest.raises(UserError, match="comes with dexsim"):
        command.main(["skin", "xhand", "skin=palm:20"])


@pytest.mark.slow
def test_an_import_lays_skin_and_a_later_one_keeps_it(tmp_path):
    """As `skin=` says it the first time, as the command says it later; words of hand.yaml stay."""
    robot, out = hands.write(tmp_path / "robot"), tmp_path / "claw"
    settings = Settings(pads=(4, 3), drops=0, skin="palm:30/2,links:8")
    import_hand(robot, out, settings, picture=False)
    first = load_hand(out)
    assert first.file.source["skin"] == settings.skin and len(first.pads) == 4 + 2 + 5
    skin.add(out, "palm:12")
    assert "# guess" in (out / "hand.yaml").read_text() and [p.name for p in load_hand(out).pads[4:]] == ["palm"]
    again = import_hand(robot, out, Settings(pads=(4, 3), drops=0), picture=False)
    assert [p.name for p in load_hand(out).pads[4:]] == ["palm"] and not again.carried and not again.corrected
    with pytest.raises(UserError, match="skin=palm:12: needs pads on the fingertips"):
        import_hand(robot, tmp_path / "bare", Settings(pads=None, drops=0, skin="palm:12"), picture=False)
    assert not (tmp_path / "bare").exists()


@pytest.mark.slow
def test_a_grasp_is_felt_whole(hand):
    """In simulation: what palm and links carry is felt with what fingertips do, and the hand itself where it meets
    itself; each link's pads add up to the solver's force."""
    torch.set_num_threads(1)
    given = ["task=grasp", "hand=xhand_skin", "worlds=16", "device=cpu", "task.objects.train=[box,sphere]"]
    env = make_env(start.for_train(given, CONFIGS).cfg, 16, "cpu", 0, "mujoco")
    rows = {name: width for name, width, _ in env.describe()["observations"]["actor"]}
    assert env.pads == 15 and rows["contact_force"] == 15 and rows["contact_centre"] == 45
    cupped = torch.tensor(hand.pose("cupped"), dtype=torch.float32)
    across = cupped.clone()
    across[:3] = torch.tensor(hand.limits[:3, 1])  # the thumb, into the fingers
    most = torch.zeros(16), torch.zeros(16)
    for k in range(80):
        env.step((3 * ((across if k < 40 else cupped) - env.q)).clamp(-1, 1))
        env.feel()
        touch, pair = env.touch, env.engine.t.pair_normal
        sensed = touch.force_clean.sum(1)
        whole = env.engine.t.pair_normal[:, 5:11].sum(1)  # fingers and palm
        torch.testing.assert_close(sensed, whole, rtol=1e-4, atol=1e-3)
        objects = [name for name, _ in pad_pairs(hand)]
        for names, force in ((objects, touch.force_clean), (self_pairs(hand), touch.force_other)):
            for name in set(names):
                mine = [k for k, n in enumerate(names) if n == name]
                torch.testing.assert_close(force[:, mine].sum(1), pair[:, env.engine.pair(name)], rtol=1e-4, atol=1e-4)
        most = torch.maximum(most[0], sensed - touch.force_clean[:, :5].sum(1)), torch.maximum(
            most[1], touch.force_other.sum(1))  # fmt: skip
    assert (most[0] > 1.0).any() and (most[1] > 0.1).any()
