"""Shapes that are generated, and the least and largest force of a thumb."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from benchmarks import thumb, unseen_shapes
from dexsim.errors import UserError


def test_shapes_are_closed_convex_within_their_sizes_and_the_seeds_own(tmp_path):
    made = [unseen_shapes.generate(seed, 6, tmp_path / name) for seed, name in ((3, "a"), (3, "b"), (4, "c"))]
    meshes = [[trimesh.load(p) for p in paths] for paths in made]
    for mesh in meshes[0]:
        assert mesh.is_watertight and mesh.volume == pytest.approx(mesh.convex_hull.volume, rel=1e-3)
        longest, shortest = mesh.extents.max(), mesh.extents.min()
        assert 0.0745 < longest < 0.0905 and shortest > 0.54 * longest
    extents = [np.array([m.extents for m in part]) for part in meshes]
    assert np.array_equal(extents[0], extents[1]) and not np.allclose(extents[0], extents[2], atol=1e-3)


def test_their_seed_is_of_the_checkpoint(tmp_path):
    a, b = tmp_path / "a.pt", tmp_path / "b.pt"
    a.write_bytes(b"one"), b.write_bytes(b"two")
    assert unseen_shapes.seed_of(a) != unseen_shapes.seed_of(b)
    with pytest.raises(UserError, match="c.pt"):
        unseen_shapes.seed_of(tmp_path / "c.pt")


def contact(at: list[float], normal: list[float], friction: float = 0.5) -> np.ndarray:
    """Wrenches about the origin, where the centre of mass is."""
    n = np.array(normal, float)
    t = np.cross(n, [0.0, 0.0, 1.0] if abs(n[2]) < 0.9 else [1.0, 0.0, 0.0])
    edges = thumb.cone(np.stack([n, t, np.cross(n, t)]), friction)
    return np.hstack([edges, np.cross(at, edges)])


def test_between_two_tips_the_thumb_presses_as_the_other_does():
    found = [(0, contact([-0.03, 0, 0], [1, 0, 0])), (1, contact([0.03, 0, 0], [-1, 0, 0]))]
    low, high = thumb.span(found, 1.0, {1: 5.0}, 0, False)
    assert low == pytest.approx(5.0, abs=0.3) and high == pytest.approx(5.0, abs=0.3)
    assert thumb.span(found, 9.0, {1: 5.0}, 0, False) is None  # friction of 0.5 carries 5 N at most


def test_a_palm_below_frees_it_as_far_as_friction_goes():
    found = [(0, contact([-0.03, 0, 0], [1, 0, 0])), (1, contact([0.03, 0, 0], [-1, 0, 0]))]
    # three points of a palm, which can be pressed on by friction alone
    found += [("rest", contact([x, y, -0.03], [0, 0, 1])) for x, y in ((0.03, 0.02), (-0.03, 0.02), (0, -0.03))]
    low, high = thumb.span(found, 4.0, {1: 5.0}, 0, True)
    assert low < 4.0 and high > 6.0
    assert thumb.span(found[1:], 4.0, {1: 5.0}, 0, True) is None  # no thumb
