"""Where the files that come with dexsim lie, in a checkout as in an installed wheel."""

from __future__ import annotations

from pathlib import Path

CONFIGS = Path(__file__).resolve().parent / "configs"
"""config.yaml, play.yaml, calibrate.yaml and one folder for each group of settings (task/, servo/, ...)."""
_PACKED = CONFIGS.parent / "policies"
POLICIES = _PACKED if _PACKED.is_dir() else CONFIGS.parents[1] / "checkpoints"
"""Trained policies: the wheel packs `checkpoints/` of the repository as `dexsim/policies/`."""
