"""A hollow mesh as convex parts: CoACD (Wei et al. 2022, Approximate convex decomposition for 3D meshes with
collision-aware concavity and tree search)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from dexsim.assets.objects.geometry import mass_properties
from dexsim.errors import UserError

SEED = 0
CONVEX = 0.99  # share of its hull that a body fills to pass for convex
THRESHOLD = 0.02  # of the concavity at which a part is split no more, over the mesh's size
ITERATIONS, NODES, RESOLUTION = (
    60,
    15,
    1500,
)  # of its tree search: as good on our shapes as its defaults, 4 times faster


def available() -> bool:
    """Return whether CoACD is installed."""
    from importlib.util import find_spec

    return find_spec("coacd") is not None


def decompose(vertices: np.ndarray, faces: np.ndarray, most: int, source: object) -> list[np.ndarray]:
    """At most `most` convex parts, each its corners [V, 3], of a closed mesh, body by body. Deterministic.

    Raises UserError, naming `source`, where CoACD is not installed, or `most` has no part for each body.
    """
    if not available():
        raise UserError(
            f"mesh {source}: is hollow, and CoACD, which splits it into convex parts, is not installed: pip install"
            " coacd, or take its convex hull with object_hulls=1"
        )
    import coacd

    coacd.set_log_level("error")
    closed = [(body, filled(body)) for body in bodies(vertices, faces)]
    hollow = [body for body, share in closed if share < CONVEX]
    out = [np.unique(body.reshape(-1, 3), axis=0) for body, share in closed if share >= CONVEX]
    if hollow and len(out) + len(hollow) > most:
        raise UserError(
            f"mesh {source}: is made of {len(closed)} closed bodies, and object_hulls={most} allows no part for each:"
            f" say object_hulls={4 * len(closed)}, or join them to one surface (Blender: Boolean > Union)"
        )
    for k, body in enumerate(hollow):
        corners, sides = np.unique(body.reshape(-1, 3), axis=0, return_inverse=True)
        room = (most - len(out)) // (len(hollow) - k)
        parts = coacd.run_coacd(
            coacd.Mesh(corners, sides.reshape(-1, 3).astype(np.int32)), threshold=THRESHOLD, max_convex_hull=room,
            preprocess_mode="off", mcts_iterations=ITERATIONS, mcts_nodes=NODES, resolution=RESOLUTION, seed=SEED,
        )  # fmt: skip
        out += [np.asarray(v, float) for v, _ in parts]
    return out


def bodies(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Return triangles [T, 3, 3] of each closed body of a mesh whose bodies may touch along faces and edges.

    An edge of one body has two faces. Where bodies touch it has more, and tells nothing but which pieces of a surface
    end there: CoACD takes manifolds only.
    """
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, which, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    order = np.argsort(which, kind="stable")
    firsts = np.cumsum(counts) - counts
    two = firsts[counts == 2]
    a, b = order[two] // 3, order[two + 1] // 3
    n = len(faces)
    label = connected_components(coo_matrix((np.ones(len(a)), (a, b)), (n, n)), directed=False)[1]
    joined = [(0, 0)]
    for e in np.flatnonzero(counts > 2):
        names, passes = np.unique(label[order[firsts[e] : firsts[e] + counts[e]] // 3], return_counts=True)
        odd = names[passes % 2 == 1]  # pieces of surfaces that end here, and go on in each other
        joined += zip(odd[:-1], odd[1:], strict=True)
    i, j = np.transpose(joined)
    most = label.max() + 1
    label = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (most, most)), directed=False)[1][label]
    return [vertices[faces[label == k]] for k in np.unique(label)]


def filled(triangles: np.ndarray) -> float:
    """Return the share of its convex hull that a closed surface [T, 3, 3] fills."""
    return float(mass_properties(triangles)[0] / ConvexHull(triangles.reshape(-1, 3)).volume)
