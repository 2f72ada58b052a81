"""The narrow phase of hulls: against C MuJoCo on random poses, warm starts, what it refuses, and its place in a physics
step."""

from __future__ import annotations

from concurrent.futures import Future

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from rig import pendulum_spec
from worlds import grasp_env

from dexsim.errors import UserError
from dexsim.sim import make_engine, warmup
from dexsim.sim.collision import unsupported
from tests import cylinder_exact
from tests import narrow_phase as bench

POSES = 768


@pytest.mark.parametrize("kind", bench.OURS)
def test_contacts_of_random_poses_are_those_of_c_mujoco(kind):
    """Surfaces from 2 mm deep to the margin apart, a tenth with faces parallel: all contacts, none too many, to 1e-7
    m, each at a nearest point."""
    out = bench.kind_of_pair(kind, POSES, "cpu", POSES, seed=3)
    assert out["places"]["off"] == out["places"]["ill"] == 0 and out["places"]["worst_m"] < 1e-6, out["places"]
    got = out["hand"]
    assert got["contacts"] > POSES / 6 and got["missed"] == got["extra"] == 0
    assert got["dist_m"]["median"] < 5e-9 and got["dist_m"]["worst"] < 1e-7, got["dist_m"]
    assert got["normal_rad"]["p99"] < 1e-5, got["normal_rad"]
    assert got["point_m"]["p99"] < 1e-7 and got["point_m"]["worst"] < 2e-6, got["point_m"]


# where the search for the depth once went wrong: a facet of many corners was torn, and a triangle turned inside out (of
# the fingertip the depth was right, and the normal that of another facet). Mesh, places, rotations, sizes.
TORN = {
    "box-fingertip": (
        "tip_thumb",
        [
            [
                [-0.01204647310078144, 0.03897923231124878, -0.04016737639904022],
                [0.0016607177676633, 0.07233263552188873, -0.048920176923274994],
            ]
        ],
        [
            [
                [
                    [-0.21759554743766785, -0.9527748823165894, 0.21183057129383087],
                    [-0.9508136510848999, 0.15789677202701569, -0.26649948954582214],
                    [0.22046664357185364, -0.25940051674842834, -0.9402690529823303],
                ],
                [
                    [0.436461865901947, -0.8113943934440613, -0.3887675106525421],
                    [0.002810132224112749, -0.4308655261993408, 0.9024117588996887],
                    [-0.8997183442115784, -0.39496082067489624, -0.1857762336730957],
                ],
            ]
        ],
        [[0.017820896580815315, 0.006803726777434349, 0.008185530081391335], [0.0, 0.0, 0.0]],
    ),
    "box-hull": (
        "crescent_0",
        [[[0.006895582191646099, 0.009498427622020245, -0.017309309914708138],
          [-0.020970543846488, -0.018284466117620468, -0.03733149915933609]]],
        [[[[0.4088357090950012, -0.8958119750022888, 0.1742822676897049],
           [0.36032333970069885, -0.01700715348124504, -0.9326724410057068],
           [0.8384631276130676, 0.4441077411174774, 0.3158288300037384]],
          [[-0.586438000202179, 0.5328113436698914, 0.6100839972496033],
           [-0.7237833142280579, -0.682832658290863, -0.09938477724790573],
           [0.363631933927536, -0.49985164403915405, 0.7860789895057678]]]],
        [[0.024540968239307404, 0.01247472781687975, 0.014412932097911835], [0.0, 0.0, 0.0]],
    ),
    "hull-hull": (
        "crescent_0",
        [[[-0.020499536767601967, -0.04343726858496666, -0.012093041092157364],
          [-0.020499536767601967, -0.01525932364165783, -0.012093041092157364]],
         [[-0.021529899910092354, -0.04887263849377632, -0.025667808949947357],
          [-0.021529899910092354, -0.0203224029392004, -0.025667808949947357]],
         [[-0.033567000180482864, -0.03139621019363403, 0.04891577735543251],
          [-0.033567000180482864, -0.0029343650676310062, 0.04891577735543251]],
         [[0.04374007508158684, 0.025577111169695854, -0.0343322791159153],
          [0.04374007508158684, 0.05328035354614258, -0.0343322791159153]]],
        np.eye(3),
        [0.0, 0.0, 0.0],
    ),
}  # fmt: skip


# cores that touch to less than 1 um with parallel faces: once taken for torn, and answered with a way out of 8.6 mm.
# Kind, meshes (None: a box), places of A and B, half sizes of A.
TOUCHING = [
    ("box-hull", (None, "bolt_0"), [0.0454629510641098, -0.04071182757616043, -0.021482788026332855],
     [0.0454629510641098, 0.017998693510890007, -0.021482788026332855],
     [0.025783203542232513, 0.02995985373854637, 0.020201705396175385]),
    ("box-hull", (None, "bracket_0"), [-0.0025614427868276834, -0.03699260205030441, -0.025106249377131462],
     [-0.0025614427868276834, -0.03699260205030441, 0.0335448756814003],
     [0.020901987329125404, 0.013537435792386532, 0.029420696198940277]),
    ("fingertip-hull", ("tip_finger", "bolt_1"), [0.021126916632056236, -0.01765596680343151, -0.03203313797712326],
     [0.021126916632056236, 0.008219278417527676, -0.03203313797712326], [0.0, 0.0, 0.0]),
]  # fmt: skip


@pytest.mark.parametrize("case", range(len(TOUCHING)))
def test_parallel_faces_that_touch_touch(case):
    """Exactly 0.3 to 0.7 um apart."""
    kind, names, a, b, size = TOUCHING[case]
    model, _, _ = bench.scene(kind)
    ids = [model.mesh(x).id if x else -1 for x in names]
    poses = bench.Poses(np.array([[a, b]]), np.tile(np.eye(3), (1, 2, 1, 1)), np.array([ids]),
                        np.array([[size, [0.0] * 3]]))  # fmt: skip
    worlds = bench.Worlds(model, 1, "cpu", "hand")
    worlds.put(poses)
    worlds.collide()
    want, got = bench.exact(model, poses, 0)[0], worlds.found()[0][0]
    assert 0 < want < 1e-6 and abs(got - want) < 1e-7, (want, got)


@pytest.mark.parametrize("kind", TORN)
def test_facets_of_many_corners_are_not_torn(kind):
    """The depth is the exact one to 1e-8 m; it was up to 1 mm off, even with the wrong sign, where rounding had called
    triangles of one facet seen and others not."""
    model, _, _ = bench.scene(kind)
    name, *numbers = TORN[kind]
    pos, rot, size = (np.asarray(x, np.float32).astype(float) for x in numbers)
    n, mesh = len(pos), model.mesh(name).id
    poses = bench.Poses(pos, np.broadcast_to(rot, (n, 2, 3, 3)), np.full((n, 2), mesh),
                        np.broadcast_to(size, (n, 2, 3)))  # fmt: skip
    worlds = bench.Worlds(model, n, "cpu", "hand")
    worlds.put(poses)
    worlds.collide()
    for i, (dist, normal) in enumerate(zip(*worlds.found()[:2], strict=True)):
        assert abs(dist - bench.exact(model, poses, i)[0]) < 1e-8
        assert abs(bench.confirmed(model, poses[i : i + 1], normal[None])[0] + dist) < 1e-7  # along its normal, too


def test_the_exact_reference_is_exact_and_knows_where_c_mujoco_is_wrong():
    """A sphere and a box, whose distance is known in closed form; and a pose of a box and a hull that C MuJoCo calls
    0.1 mm too shallow, with a normal that points the other way."""
    model, _, _ = bench.scene("sphere-box")
    rng, n = np.random.default_rng(0), 40
    pos = rng.uniform(-0.03, 0.03, (n, 2, 3))
    pos[:, 1] = 0.0
    size = np.array([[0.008, 0, 0], [0.02, 0.015, 0.01]])
    poses = bench.Poses(
        pos, np.broadcast_to(np.eye(3), (n, 2, 3, 3)), np.full((n, 2), -1), np.broadcast_to(size, (n, 2, 3))
    )
    outside = np.abs(pos[:, 0]) - size[1]
    want = np.where((outside < 0).all(1), outside.max(1), np.linalg.norm(np.maximum(outside, 0), axis=1)) - 0.008
    got = np.array([bench.exact(model, poses, i)[0] for i in range(n)])
    assert (want < -0.008).any() and (want > 0).any()
    np.testing.assert_allclose(got, want, atol=1e-12)

    model, _, _ = bench.scene("box-hull")
    pos = [[[0.043080054223537445, -0.03510287404060364, 0.020511846989393234],
            [0.017071599140763283, -0.07310813665390015, 0.07602310180664062]]]  # fmt: skip
    rot = [[[[-0.7528394460678101, -0.17441992461681366, 0.634673535823822],
             [-0.29618942737579346, -0.7713315486907959, -0.5633111596107483],
             [0.5877963900566101, -0.6120664477348328, 0.5290274620056152]],
            [[0.9604439735412598, -0.2541716396808624, -0.11377252638339996],
             [0.18998926877975464, 0.8967856168746948, -0.3995993137359619],
             [0.20359638333320618, 0.36217719316482544, 0.9096022248268127]]]]  # fmt: skip
    size = [[[0.02610241249203682, 0.025192929431796074, 0.014351140707731247], [0.0, 0.0, 0.0]]]
    poses = bench.Poses(np.array(pos), np.array(rot), np.array([[-1, model.mesh("cylinder_0").id]]), np.array(size))
    theirs = bench.reference(model, poses)
    (dist, normal, _), wrong = bench.truth(model, poses, [theirs])
    assert wrong[0] and dist[0] < theirs[0][0] - 9e-5
    assert abs(bench.confirmed(model, poses, normal)[0] + dist[0]) < 1e-9
    assert bench.confirmed(model, poses, theirs[1])[0] > 0.1


# where a place was once 3 to 4 um off, with the distance right: the next corner brought a centre 12 mm away nearer by
# less than float32 tells. Mesh, places, rotations, size of A.
FLAT = {
    "sphere-fingertip": (
        "tip_thumb",
        [[-0.02088705077767372, -0.023671405389904976, -0.0448291078209877],
         [-0.021392477676272392, 0.0032774389255791903, -0.0623711496591568]],
        [[[-0.7052889466285706, 0.0756104588508606, 0.7048762440681458],
          [0.6674337387084961, -0.2643258273601532, 0.696178138256073],
          [0.23895536363124847, 0.9614650011062622, 0.13596111536026]],
         [[0.8194438815116882, 0.5508135557174683, 0.15848083794116974],
          [0.44624727964401245, -0.7866449356079102, 0.42667680978775024],
          [0.3596875071525574, -0.27891606092453003, -0.8904104232788086]]],
        [0.013402342796325684, 0.015418602153658867, 0.01560952328145504],
    ),
    "capsule-fingertip": (
        "tip_finger",
        [[-0.0183721911162138, -0.008382412604987621, 0.022854741662740707],
         [-0.04062390699982643, -0.004320773761719465, 0.0036472685169428587]],
        [[[0.756815493106842, 0.6470217108726501, 0.09269977360963821],
          [0.531035840511322, -0.6913430094718933, 0.4899446666240692],
          [0.3810921609401703, -0.32157081365585327, -0.8668107986450195]],
         [[0.5029009580612183, -0.3024684190750122, 0.809693455696106],
          [-0.8586295247077942, -0.06727989763021469, 0.5081621408462524],
          [-0.09922689944505692, -0.9507819414138794, -0.29354342818260193]]],
        [0.009592199698090553, 0.01891968958079815, 0.018645672127604485],
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FLAT)
def test_the_place_on_a_facet_is_right_where_the_distance_no_longer_tells(kind):
    model, _, _ = bench.scene(kind)
    name, pos, rot, size = FLAT[kind]
    poses = bench.Poses(np.array([pos]), np.array([rot]), np.array([[-1, model.mesh(name).id]]),
                        np.array([[size, [0.0] * 3]]))  # fmt: skip
    worlds = bench.Worlds(model, 1, "cpu", "hand")
    worlds.put(poses)
    worlds.collide()
    assert np.linalg.norm(worlds.found()[2] - bench.reference(model, poses)[2]) < 5e-8


# a way out over the rim, of which the prism's was 0.03 rad off: once 4 um too deep. Mesh of A, places, rotations,
# sizes.
OVER_RIM = {
    "fingertip-cylinder": (
        "tip_finger",
        [[0.024709098041057587, 0.007857004180550575, -0.009864677675068378],
         [0.020519662648439407, 0.03822968527674675, -0.014289066195487976]],
        [[[0.872961163520813, -0.26739439368247986, 0.4079693853855133],
          [-0.4820147454738617, -0.6011857986450195, 0.6373675465583801],
          [0.07483690977096558, -0.7530443668365479, -0.6536999344825745]],
         [[0.3845754861831665, 0.376815527677536, -0.8426812887191772],
          [-0.346643328666687, 0.9050290584564209, 0.24649707973003387],
          [0.8555349707603455, 0.1973131000995636, 0.478672593832016]]],
        [[0.0, 0.0, 0.0], [0.016337860375642776, 0.011509537696838379, 0.0]],
    ),
    "box-cylinder": (
        None,
        [[0.01997954584658146, 0.03923625126481056, 0.031940359622240067],
         [0.01101347990334034, 0.07872407138347626, 0.020061036571860313]],
        [[[-0.036717094480991364, -0.9960775971412659, -0.08050656318664551],
          [0.6329566240310669, -0.08552148938179016, 0.7694491147994995],
          [-0.7733160853385925, -0.022705230861902237, 0.6336140036582947]],
         [[0.7199376821517944, -0.15072733163833618, -0.6774739623069763],
          [-0.23765932023525238, 0.8635798096656799, -0.4446886479854584],
          [0.6520795822143555, 0.4811561107635498, 0.5859018564224243]]],
        [[0.012696358375251293, 0.020218543708324432, 0.018430793657898903],
         [0.009981504641473293, 0.02531452663242817, 0.0]],
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", OVER_RIM)
def test_the_way_out_over_a_rim_is_the_round_one(kind):
    model, _, _ = bench.scene(kind)
    name, *numbers = OVER_RIM[kind]
    pos, rot, size = (np.array([x]) for x in numbers)
    poses = bench.Poses(pos, rot, np.array([[model.mesh(name).id if name else -1, -1]]), size)
    worlds = bench.Worlds(model, 1, "cpu", "hand")
    worlds.put(poses)
    worlds.collide()
    dist, normal, _ = worlds.found()
    want = bench.exact(model, poses, 0)
    assert abs(dist[0] - want[0]) < 1e-8 and np.linalg.norm(normal[0] - want[1]) < 1e-6


def test_the_exact_reference_of_cylinders():
    """In closed form: a box whose corner is nearest to the rim, one with an edge ahead of the side, and one above a
    cap; the last two apart and overlapping."""
    box = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.01
    dist, normal, at = cylinder_exact.answer(0.02, 0.03, box + [0.035, 0.0, 0.045])
    np.testing.assert_allclose(at[[0, 2]], [0.0225, 0.0325], atol=1e-12)
    assert abs(dist - np.hypot(0.005, 0.005)) < 1e-12
    np.testing.assert_allclose(normal, [np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-6)
    turn = np.array([[np.sqrt(0.5), -np.sqrt(0.5), 0], [np.sqrt(0.5), np.sqrt(0.5), 0], [0, 0, 1]])  # an edge ahead
    reach = 0.01 * np.sqrt(2)
    for gap in (1e-3, -1e-3):
        dist, normal, at = cylinder_exact.answer(0.02, 0.03, box @ turn.T + [0.02 + gap + reach, 0.0, 0.0])
        assert abs(dist - gap) < 1e-12 and abs(normal[0] - 1) < 1e-12
        np.testing.assert_allclose(at[:2], [0.02 + gap / 2, 0.0], atol=1e-9)
        dist, normal, _ = cylinder_exact.answer(0.02, 0.03, box @ turn.T + [0.003, 0.0, 0.04 + gap])
        assert abs(dist - gap) < 1e-12 and abs(normal[2] - 1) < 1e-12


@pytest.fixture(scope="module", params=["capsule-hull", "box-hull", "hull-hull", "fingertip-cylinder"])
def two_poses(request):
    """Return the poses, and the same a step later: 1 mm and 0.03 rad further."""
    model, a, b = bench.scene(request.param)
    rng = np.random.default_rng(5)
    before = bench.draw(model, request.param, a, b, POSES, rng)
    after = before[np.arange(POSES)]
    after.pos = before.pos + np.stack([np.zeros((POSES, 3)), 1e-3 * rng.normal(size=(POSES, 3))], 1)
    turn = np.empty((POSES, 9))
    for i in range(POSES):
        q = np.r_[1.0, 0.015 * rng.normal(size=3)]
        mujoco.mju_quat2Mat(turn[i], q / np.linalg.norm(q))
    after.rot = np.stack([before.rot[:, 0], turn.reshape(-1, 3, 3) @ before.rot[:, 1]], 1)
    return bench.Worlds(model, POSES, "cpu", "hand"), before, after


def test_what_was_nearest_before_does_not_decide_what_is_nearest_now(two_poses):
    """Begun at the last step's corners, at corners of other worlds' bodies, or at none: the same contacts."""
    worlds, before, after = two_poses
    found = {}
    for start in ("none", "before", "others"):
        worlds.put(before)
        worlds.collide()
        saved = worlds.narrow.simplex.numpy().copy()  # on a CPU that is no copy by itself
        worlds.put(after)
        if start != "none":
            worlds.narrow.simplex.assign(saved if start == "before" else np.roll(saved, 7, axis=0))
        worlds.collide()
        found[start] = worlds.found()
    cold = found["none"]
    assert np.isfinite(cold[0]).sum() > POSES / 8
    for start in ("before", "others"):
        dist, normal, _ = found[start]
        with np.errstate(invalid="ignore"):
            error = np.abs(dist - cold[0])
        # a contact or not, by rounding
        edge = np.abs(np.where(np.isfinite(cold[0]), cold[0], dist) - bench.MARGIN) < 1e-7
        assert ((np.isfinite(dist) == np.isfinite(cold[0])) | edge).all(), start
        both = np.isfinite(dist) & np.isfinite(cold[0])
        assert error[both].max() < 1e-7, start
        assert np.percentile(np.linalg.norm(normal - cold[1], axis=1)[both], 98) < 1e-5, start


def test_corners_of_another_mesh_are_forgotten(two_poses):
    worlds, before, _ = two_poses
    worlds.put(before)
    worlds.collide()
    want = worlds.found()[0]
    # no hull of the library has so many
    worlds.narrow.simplex.fill_(wp.vec3i(60 | (60 << 16), 61 | (61 << 16), 62 | (62 << 16)))
    worlds.collide()
    got = worlds.found()[0]
    near = np.isfinite(want) & np.isfinite(got)
    assert near.sum() >= np.isfinite(want).sum() - 1 and np.abs(want[near] - got[near]).max() < 1e-7


@pytest.fixture(scope="module")
def grasping():
    """Return a hand of each setting, the same worlds: (hand, mujoco); that of `hand` has closed."""
    hand, mujoco_warp = (
        grasp_env("task.objects.baked_scales=[1.25]", f"sim.collision={c}", worlds=9, engine="warp")
        for c in ("hand", "mujoco")
    )
    action = torch.zeros(9, hand.num_actions)
    action[:, 4:], action[:, :3] = 0.5, 0.4
    for k in range(40):
        hand.step(action if k > 12 else 0 * action)
    return hand, mujoco_warp


@pytest.mark.slow
def test_both_settings_make_the_same_contacts_of_a_hand(grasping):
    """All that a contact holds: parameters bitwise, places to what MuJoCo-Warp's own search is exact to."""
    hand, mujoco_warp = grasping
    assert hand.engine.narrow is not None and mujoco_warp.engine.narrow is None
    hand.engine.physics_step()
    theirs, ours = mujoco_warp.engine, hand.engine
    for name in ours._fields:
        theirs.field(name).copy_(ours.field(name))
    theirs.set_state(torch.ones(9, dtype=torch.bool), ours.t.qpos, ours.t.qvel)
    ours.physics_step(), theirs.physics_step()
    tables = []
    for e in (ours, theirs):
        n, c = int(e.d.nacon.numpy()[0]), e.d.contact
        geom, world, pos = c.geom.numpy()[:n], c.worldid.numpy()[:n], c.pos.numpy()[:n]
        order = np.lexsort((pos[:, 0].round(4), geom[:, 1], geom[:, 0], world))
        names = (
            "worldid",
            "geom",
            "dim",
            "includemargin",
            "friction",
            "solref",
            "solreffriction",
            "solimp",
            "type",
            "geomcollisionid",
            "dist",
            "pos",
            "frame",
        )
        tables.append({f: getattr(c, f).numpy()[:n][order] for f in names})
    a, b = tables
    assert len(a["dist"]) == len(b["dist"]) > 30
    for name in a:
        limit = {"dist": 1e-5, "pos": 1e-4, "frame": 0.2}.get(name, 0.0)
        assert np.abs(a[name].astype(float) - b[name]).max() <= limit, name
    assert np.median(np.abs(a["dist"] - b["dist"])) < 1e-7


def test_a_reset_forgets_the_corners_of_its_worlds_only(grasping):
    hand = grasping[0]
    simplex = torch.from_numpy(hand.engine.narrow.simplex.numpy()).clone()
    assert bool((simplex[0] >= 0).any()) and bool((simplex[1] >= 0).any())
    mask = torch.arange(9) == 1
    hand.engine.set_state(mask, hand.engine.t.qpos.clone(), hand.engine.t.qvel.clone())
    after = torch.from_numpy(hand.engine.narrow.simplex.numpy())
    assert bool((after[1] == -1).all()) and torch.equal(after[0], simplex[0])


def test_kernels_of_a_step_are_listed_and_compiled_alone_with_the_same_bits(grasping):
    e = grasping[0].engine
    state = e.t.qpos.clone(), e.t.qvel.clone()

    def stepped() -> torch.Tensor:
        e.set_state(torch.ones(9, dtype=torch.bool), *state)
        e._one_step()
        return torch.cat([e.t.qpos, e.t.qvel, e.t.pair_normal], dim=1)

    before = stepped().clone()
    alone = {module for module, _ in warmup.listed(e._one_step)}
    assert {kernel.module for kernel, _ in _launched(e._one_step)} <= alone
    assert torch.equal(stepped(), before) and bool((before[:, -len(e.pairs) :] > 0).any())
    assert all(len(module.kernels) == 1 for module in alone if module.name.startswith("mujoco_warp."))
    assert warmup.begin(e._one_step, "cpu") == 0


def test_what_is_needed_first_is_waited_for_alone(grasping, monkeypatch):
    e = grasping[0].engine
    begun = {key: Future() for key in warmup.listed(e._one_step)}
    monkeypatch.setattr(warmup, "_begun", begun)
    first = warmup.listed(e._positions)
    for key in first:
        begun[key].set_result(None)
    rest = len(begun) - len(first)
    warmup.finish(e._positions)
    assert first and len(begun) == rest > 10
    for future in begun.values():
        future.set_exception(RuntimeError("nvrtc"))
    with pytest.raises(RuntimeError, match="nvrtc"):
        warmup.finish()


def _launched(program) -> list:
    from warp._src import context

    seen, launch = [], context.launch

    def spy(kernel, dim, *args, **kwargs):
        seen.append((kernel, dim))
        return launch(kernel, dim, *args, **kwargs)

    saved = wp.launch
    wp.launch = context.launch = spy
    try:
        program()
    finally:
        wp.launch, context.launch = saved, launch
    return [(k, d) for k, d in seen if np.prod(d) and not k.is_generic]


# -- what it refuses
# --------------------------------------------------------------------------------------------------------------


def test_settings_that_do_not_exist_or_cannot_be_served():
    with pytest.raises(UserError, match="sim.collision='both'"):
        make_engine(pendulum_spec(), 1, "cpu", "mujoco", collision="both")
    with pytest.raises(UserError, match="one contact a pair"):
        make_engine(pendulum_spec(), 1, "cpu", "warp", collision="hand")
    assert make_engine(pendulum_spec(), 1, "cpu", "warp").narrow is None


@pytest.mark.parametrize(
    "edit, word",
    [
        (lambda s: None, None),
        (
            lambda s: s.add_sensor(
                type=mujoco.mjtSensor.mjSENS_GEOMDIST,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname="a",
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname="b",
                cutoff=1.0,
            ),
            "sensor",
        ),
        (lambda s: setattr(s.option, "disableflags", 0), "multiccd"),
    ],
)
def test_what_a_model_asks_for_is_served_or_the_reason_said(edit, word):
    spec = mujoco.MjSpec()
    for name in ("a", "b"):
        spec.worldbody.add_body(name=name, pos=[0.1 * (name == "a"), 0, 0]).add_geom(name=name, size=[0.01, 0, 0])
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    edit(spec)
    why = unsupported(spec.compile())
    assert why is None if word is None else word in why


def test_another_mujoco_warp_is_not_guessed_at(monkeypatch):
    import mujoco_warp

    monkeypatch.setattr(mujoco_warp, "__version__", "4.0.1")
    spec = pendulum_spec()
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    assert "4.0.1 is installed" in unsupported(spec.compile())
