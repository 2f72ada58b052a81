"""Places of contacts against all nearest points in float64 (`benchmarks.places`): poses where they were once off."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tests import narrow_phase as bench
from tests import places

# All of 4.4 million contacts with one nearest point whose place was more than 1e-6 m off: a facet 1e-4 rad across left
# out, a face near its corner taken for its edge or its edge for it, the prism's chord for the rim. Then crossing edges,
# a tilted facet and parallel faces, where a first mending was wrong; then overlaps whose way out through a cap is
# hardly shorter than another, which was taken (the first of these only with the sines and cosines of a GPU). Kind:
# meshes, places, rotations, sizes, how far.
FILE = Path(__file__).with_name("contact_places.json")
CASES = json.loads(FILE.read_text())


def poses_of(model: mujoco.MjModel, cases: list[dict]) -> bench.Poses:
    return bench.Poses(
        np.array([c["pos"] for c in cases]).reshape(-1, 2, 3),
        np.array([c["rot"] for c in cases]).reshape(-1, 2, 3, 3),
        np.array([[model.mesh(x).id if x else -1 for x in c["meshes"]] for c in cases]),
        np.array([c["size"] for c in cases]).reshape(-1, 2, 3),
    )


def neighbours(poses: bench.Poses, n: int) -> bench.Poses:
    """Return each pose and n more whose numbers differ from its by at most a unit in the last place of a float32:
    what another rounding makes of the first is what this one makes of some of these."""
    rng = np.random.default_rng(0)
    out = poses[np.repeat(np.arange(len(poses.pos)), n + 1)]
    for x in (out.pos, out.rot):
        near, turn = x.astype(np.float32), rng.integers(-1, 2, x.shape)
        turn[:: n + 1] = 0
        x[:] = np.where(turn == 0, near, np.nextafter(near, np.where(turn > 0, np.float32(9), np.float32(-9))))
    return out


@pytest.mark.parametrize("kind", CASES)
def test_places_that_were_off_are_nearest_points_and_so_are_those_of_poses_beside_them(kind):
    model, _, _ = bench.scene(kind)
    beside = 4
    poses = neighbours(poses_of(model, CASES[kind]), beside)
    n = len(poses.pos)
    worlds = bench.Worlds(model, n, "cpu", "hand")
    worlds.put(poses)
    worlds.collide()
    dist, _, at = worlds.found()
    for i in range(n):
        want, normal, _ = places.exact(model, poses, i)
        assert abs(dist[i] - want) < 3e-8
        off = places.error(model, poses, i, normal, at[i])
        assert off < (3e-7 if i % (beside + 1) == 0 else 1e-6), (i % (beside + 1), CASES[kind][i // (beside + 1)])


@pytest.mark.parametrize("kind", [
    pytest.param(k, marks=[] if k.endswith("-cylinder") and k[0] in "fc" else [pytest.mark.slow])
    for k in CASES if k.split("-")[1] in ("fingertip", "cylinder")
])  # fmt: skip
def test_the_measure_tells_a_place_that_is_off(kind):
    """Where the nearest point is one, the exact place is right and one 2 um beside it is not, in no direction: however
    slowly the distance grows beside a ball's or a rim's."""
    model, _, _ = bench.scene(kind)
    poses = poses_of(model, CASES[kind])
    single = 0
    for i in range(len(poses.pos)):
        dist, normal, at = places.exact(model, poses, i)
        assert places.error(model, poses, i, normal, at) < 1e-8
        if min(len(places.furthest(model, poses, k, i, (1 - 2 * k) * normal, at)) for k in (0, 1)) > 1:
            continue
        single += 1
        beside = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        beside /= np.linalg.norm(beside)
        for side in (beside, -beside, np.cross(normal, beside), -np.cross(normal, beside)):
            assert places.error(model, poses, i, normal, at + 2e-6 * side) > 1.5e-6
        answers = [np.array([x]) for x in (dist, normal, at)]
        wrong = [*answers[:2], answers[2] + 2e-6 * beside]
        held = places.judge(model, poses[i : i + 1], tuple(answers), tuple(wrong), np.array([-dist]))
        assert held["off"] == 1 and held["ill"] == held["equal"] == held["reference_off"] == 0
        named = held["poses_off"][0]  # enough to have the pose again
        again = poses_of(model, [named])
        assert all((getattr(again, k)[0] == getattr(poses, k)[i].astype(np.float32)).all() for k in ("pos", "rot"))
        assert (again.mesh[0] == poses.mesh[i]).all() and abs(named["off_m"] - 2e-6) < 5e-7
        assert places.exact(model, again, 0)[0] == pytest.approx(dist, abs=2e-8)
    assert single > 0


def test_of_parallel_faces_any_place_where_they_overlap_is_nearest_and_no_other():
    """Two boxes face to face, 1 mm apart, that overlap on 10 x 20 mm; and a box on a cylinder's cap."""
    model, _, _ = bench.scene("box-fingertip")
    model.geom_type[1] = places.BOX
    size = np.array([[[0.01, 0.02, 0.03], [0.01, 0.02, 0.03]]])
    poses = bench.Poses(np.array([[[0, 0, 0], [0.01, 0.02, 0.061]]]), np.tile(np.eye(3), (1, 2, 1, 1)),
                        np.full((1, 2), -1), size)  # fmt: skip
    up = np.array([0.0, 0.0, 1.0])
    corners = ((0.005, 0.01, 0.0), (0.0, 0.0, 0.0), (0.01, 0.02, 0.0), (-0.001, 0.01, 0.001), (0.013, 0.024, 0.005))
    for x, y, off in corners:
        assert abs(places.error(model, poses, 0, up, np.array([x, y, 0.0305])) - off) < 1e-9
    assert abs(places.error(model, poses, 0, up, np.array([0.005, 0.01, 0.0310])) - 5e-4) < 1e-9
    model.geom_type[1] = places.CYLINDER
    poses.size[0, 1] = [0.01, 0.03, 0.0]
    for x, y, off in ((0.005, 0.018, 0.0), (0.01, 0.02, 0.0), (-0.004, 0.02, 0.004)):
        assert abs(places.error(model, poses, 0, up, np.array([x, y, 0.0305])) - off) < 1e-9


def test_a_pose_that_leaves_the_place_open_is_called_so():
    """A capsule across a box's edge at 1e-3 rad: exact places of poses within float32's last place lie micrometres
    apart, and an answer no further off is counted by itself."""
    model, _, _ = bench.scene("capsule-box")
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, np.array([np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]))  # the box's edge upwards
    angle = 1e-3
    along = np.array([[0, -np.sin(angle), np.cos(angle)], [0, np.cos(angle), np.sin(angle)], [-1, 0, 0]])
    pos = np.array([[[0, 0, 0.02 * np.sqrt(2) + 0.011], [0, 0, 0]]])
    size = np.array([[[0.01, 0.02, 0], [0.03, 0.02, 0.02]]])
    poses = bench.Poses(pos, np.array([[along, turn.reshape(3, 3)]]), np.full((1, 2), -1), size)
    dist, normal, at = places.exact(model, poses, 0)
    assert abs(dist - 1e-3) < 1e-9
    answers = [np.array([x]) for x in (dist, normal, at)]
    for off, counted in ((2e-6, "ill"), (5e-3, "off")):
        wrong = (*answers[:2], answers[2] + off * along[:, 2])
        assert places.judge(model, poses, tuple(answers), wrong, np.array([-dist]))[counted] == 1
