"""How far each pad is from the object: what a finger that does not touch would need to know, for rewards."""

from __future__ import annotations

import torch
import warp as wp

from dexsim.tactile.kernel import Pads
from dexsim.tactile.sdf import Shapes, distance
from dexsim.tactile.tactile import Tactile


@wp.kernel(enable_backward=False)
def clearance_kernel(
    xpos: wp.array2d(dtype=wp.vec3), xmat: wp.array2d(dtype=wp.mat33), pads: Pads, shapes: Shapes,
    body: wp.array(dtype=int),
    shape_id: wp.array2d(dtype=int), shape_size: wp.array2d(dtype=wp.vec3), out: wp.array2d(dtype=float)
):  # fmt: skip
    w, f = wp.tid()
    pad, o = pads.body[f], body[0]
    p = xpos[w, pad] + xmat[w, pad] * pads.centre[f]
    if shape_id[w, 0] >= 0:
        out[w, f] = distance(shapes, shape_id[w, 0], shape_size[w, 0], wp.transpose(xmat[w, o]) * (p - xpos[w, o]))


class Clearance:
    """Signed distance from the centre of each pad to the surface of the (first) object of `touch`.

    Out: `distance` [N, F] in m, negative inside, 1 m where a world has no object; refreshed by `launch`, which only
    launches and so can be recorded in a graph. Exact for primitives, trilinear on grids (`dexsim.tactile.sdf`).
    """

    def __init__(self, touch: Tactile):
        self.touch = touch
        self._out = wp.full((touch.engine.n, touch.layout.pads), 1.0, dtype=float, device=touch.device)
        self.distance: torch.Tensor = wp.to_torch(self._out)

    def launch(self) -> None:
        t, a = self.touch, self.touch._a
        state = t.engine.wp
        wp.launch(
            clearance_kernel,
            dim=self._out.shape,
            device=t.device,
            inputs=[state.xpos, state.xmat, t._pads, t.shapes.wp, a.object_body, a.shape_id, a.shape_size, self._out],
        )
