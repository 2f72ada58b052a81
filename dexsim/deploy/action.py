"""From the policy's action to targets, as `HandEnv.act` does it in training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexsim.errors import UserError


@dataclass(frozen=True)
class ActionRule:
    """mode: relative (targets move by action * scale a control step, within `lead` of the measured angle) or absolute
    (the action spans the range); scale rad; lead rad, [J] or one; low, high [J] rad."""

    mode: str
    scale: float
    lead: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def target(self, action: np.ndarray, before: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return targets [J] rad from the action [J], the last targets and the measured angles q [J] rad."""
        a = np.clip(np.nan_to_num(np.asarray(action, np.float32)), -1.0, 1.0)
        if self.mode == "relative":
            target = before + a * np.float32(self.scale)
            target = np.maximum(np.minimum(target, q + self.lead), q - self.lead)
        else:
            target = 0.5 * (self.low + self.high) + a * 0.5 * (self.high - self.low)
        return np.clip(target, self.low, self.high).astype(np.float32)

    @classmethod
    def from_manifest(cls, action: dict) -> ActionRule:
        """Build it from a manifest's `action`."""
        if action["mode"] not in ("relative", "absolute"):
            raise UserError(f"manifest: action.mode={action['mode']}: must be relative or absolute")
        lead, low, high = (np.array(action[k], np.float32) for k in ("lead", "low", "high"))
        return cls(action["mode"], float(action["scale"]), lead, low, high)
