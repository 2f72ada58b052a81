"""A hollow mesh as convex parts: CoACD (Wei et al. 2022, Approximate convex decomposition for 3D meshes with
collision-aware concavity and tree search)."""

from __future__ import annotations

import numpy as np

from dexsim.errors import UserError

SEED = 0
THRESHOLD = 0.02  # of the concavity at which a part is split no more, over the mesh's size
ITERATIONS, NODES, RESOLUTION = (
    60,
    15,
    1500,
)  # of its tree search: as good on our shapes as its defaults, 4 times faster


def available() -> bool:
    """Whether CoACD is installed."""
    from importlib.util import find_spec

    return find_spec("coacd") is not None


def decompose(vertices: np.ndarray, faces: np.ndarray, most: int, source: object) -> list[np.ndarray]:
    """At most `most` convex parts, each its corners [V, 3], of a closed mesh. Deterministic.

    Raises UserError, naming `source`, where CoACD is not installed.
    """
    if not available():
        raise UserError(
            f"mesh {source}: is hollow, and CoACD, which splits it into convex parts, is not installed: pip install"
            " coacd, or take its convex hull with object_hulls=1"
        )
    import coacd

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(np.asarray(vertices, float), np.asarray(faces, np.int32)), threshold=THRESHOLD, max_convex_hull=most,
        preprocess_mode="off", mcts_iterations=ITERATIONS, mcts_nodes=NODES, resolution=RESOLUTION, seed=SEED,
    )  # fmt: skip
    return [np.asarray(v, float) for v, _ in parts]
