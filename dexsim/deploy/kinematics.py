"""Where fingertips and pads are, from joint angles: MuJoCo's kinematics of the committed hand model."""

from __future__ import annotations

import mujoco
import numpy as np

from dexsim.assets import xhand
from dexsim.tactile.layout import xhand_layout


class HandKinematics:
    """Forward kinematics of one hand, palm frame, and the places of its taxels."""

    def __init__(self) -> None:
        spec = xhand.hand_spec()
        for geom in list(spec.geoms):  # poses of bodies only; masses are stated, not taken from geoms
            if not geom.contype and not geom.conaffinity:
                spec.delete(geom)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        m = self.model
        self._q = np.array([m.joint(j).qposadr[0] for j in xhand.JOINTS])
        self._body = np.array([m.body(b).id for b in xhand.TIP_BODIES])
        self._site = np.array([m.site(s).id for s in xhand.TIP_SITES])
        layout = xhand_layout()
        # taxels where the simulated ones are: on the surface that is pressed
        self.taxels = layout.lifted([xhand.tip_skin_mesh(f)[0] for f in xhand.FINGERS]).point.copy()
        self.pad_centre = layout.centre()

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Angles [12] rad -> (tips [5, 3] m, positions [5, 3] m and rotations [5, 3, 3] of the pads' bodies)."""
        d = self.data
        d.qpos[self._q] = q
        mujoco.mj_kinematics(self.model, d)
        return d.site_xpos[self._site].copy(), d.xpos[self._body].copy(), d.xmat[self._body].reshape(5, 3, 3).copy()

    def touch(
        self, normal: np.ndarray, position: np.ndarray, rotation: np.ndarray, weighted: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """Normal forces [5, 120] N and the pads' poses -> (force [5] N, centre [5, 3] m in the palm frame: the
        force-weighted mean of the taxels, or the mean of those that feel anything; the pad's centre where nothing is
        felt)."""
        force = normal.sum(1)
        weight = normal if weighted else (normal > 0).astype(float)
        total = weight.sum(1)
        at = np.einsum("ft,ftk->fk", weight, self.taxels) / np.where(total > 0, total, 1.0)[:, None]
        at = np.where(total[:, None] > 0, at, self.pad_centre)
        return force, np.einsum("fij,fj->fi", rotation, at) + position
