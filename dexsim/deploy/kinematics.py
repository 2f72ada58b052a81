"""Where fingertips and pads are, from joint angles: MuJoCo's kinematics of the hand's model."""

from __future__ import annotations

import mujoco
import numpy as np

from dexsim.deploy.driver import HandState
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.hand.couplings import Couplings
from dexsim.hand.skin import tip_skins
from dexsim.tactile.layout import hand_layout


class HandKinematics:
    """Forward kinematics of one hand, palm frame, and the places of its taxels."""

    def __init__(self, hand: Hand | None = None) -> None:
        """hand: whose (the xHand)."""
        hand = hand or load_hand("xhand")
        spec = hand.spec()
        for geom in list(spec.geoms):  # poses of bodies only; masses are stated, not taken from geoms
            if not geom.contype and not geom.conaffinity:
                spec.delete(geom)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        m = self.model
        self._couplings = Couplings(m, hand.joints)
        self._joints, self._sensed = len(hand.joints), hand.sensed
        self._follower = [int(m.joint(name).qposadr[0]) for name in hand.sensed]
        bodies = [*hand.tip_bodies, *(p.body for p in hand.pads[len(hand.fingers) :])]
        self._body = np.array([m.body(b).id for b in bodies])
        self._offset = np.array([f.position for f in hand.fingers])
        layout = hand_layout(hand)
        # taxels where the simulated ones are: on the surface that is pressed
        self.taxels = np.zeros((0, 0, 3)) if layout is None else layout.lifted(tip_skins(hand)).point.copy()
        self.pad_centre = np.zeros((0, 3)) if layout is None else layout.centre()
        self.forget()

    def __call__(self, q: np.ndarray, follower: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return angles [J] rad -> (tips [F, 3] m, positions [B, 3] m and rotations [B, 3, 3] of the bodies of tips and
        skin). follower [S] rad: of measured joints without a drive; None: where the others hold them."""
        d = self.data
        self._couplings.put(d, q)
        if follower is not None:
            d.qpos[self._follower] = follower
        mujoco.mj_kinematics(self.model, d)
        position, turn = d.xpos[self._body].copy(), d.xmat[self._body].reshape(-1, 3, 3).copy()
        f = len(self._offset)
        return position[:f] + np.einsum("fij,fj->fi", turn[:f], self._offset), position, turn

    def forget(self) -> None:
        """Forget the readings before, from which a velocity would follow."""
        self._last: tuple[float, np.ndarray] | None = None
        self._speed = np.zeros(self._joints)

    def velocity(self, state: HandState) -> np.ndarray:
        """Return [J] rad/s: the firmware's, or the difference of the last two readings that were acted on."""
        if state.velocity is not None and np.isfinite(state.velocity).all():
            return np.asarray(state.velocity, float)
        q = np.asarray(state.position, float)
        if self._last is not None and state.time > self._last[0]:
            self._speed = (q - self._last[1]) / (state.time - self._last[0])
        self._last = state.time, q
        return self._speed

    def followers(self, state: HandState) -> np.ndarray:
        """Return angles [S] rad of measured joints without a drive. Raises UserError where the driver does not
        read them."""
        if not self._sensed:
            return np.zeros(0)
        if state.follower is None:
            raise UserError(f"the driver reads no angle of {', '.join(self._sensed)}, which this policy observes")
        return state.follower

    def touch(
        self, normal: np.ndarray, position: np.ndarray, rotation: np.ndarray, weighted: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return normal forces [P, T] N and the tips' poses -> (force [P] N, centre [P, 3] m in the palm frame: the
        force-weighted mean of the taxels, or the mean of those that feel anything; the pad's centre where nothing is
        felt)."""
        force = normal.sum(1)
        weight = normal if weighted else (normal > 0).astype(float)
        total = weight.sum(1)
        at = np.einsum("ft,ftk->fk", weight, self.taxels) / np.where(total > 0, total, 1.0)[:, None]
        at = np.where(total[:, None] > 0, at, self.pad_centre)
        pads = len(force)
        return force, np.einsum("fij,fj->fi", rotation[:pads], at) + position[:pads]
