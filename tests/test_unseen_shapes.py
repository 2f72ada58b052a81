"""Shapes that `benchmarks.unseen_shapes` generates."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from benchmarks import unseen_shapes
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
