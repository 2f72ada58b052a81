"""A policy bundle, read: the folder that `python -m dexsim.export` writes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dexsim.errors import UserError

FORMAT, VERSION = "dexsim-bundle", 1
POLICY, MANIFEST, GOLDEN, CONFIG = "policy.onnx", "manifest.yaml", "golden.npz", "config.yaml"
KEYS = ("format", "version", "task", "policy", "observation", "joints", "fingers", "action", "rates", "normalization",
        "calibration", "perception", "servo", "initial_pose", "golden", "versions", "trained")  # fmt: skip


@dataclass
class Bundle:
    """path: the folder; manifest: its content; session: onnxruntime's."""

    path: Path
    manifest: dict[str, Any]
    session: Any

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Actions [N, A] of observations [N, D], float32."""
        p = self.manifest["policy"]
        return self.session.run([p["output"]], {p["input"]: np.asarray(observation, np.float32)})[0]

    @property
    def config(self) -> dict[str, Any]:
        """The resolved training config."""
        return yaml.safe_load((self.path / CONFIG).read_text(encoding="utf-8"))


def load(path: str | Path) -> Bundle:
    """The bundle in a folder. Raises UserError: a file missing or changed, another version, no onnxruntime."""
    path = Path(path).expanduser()
    if not (path / MANIFEST).is_file():
        raise UserError(f"{path}: no {MANIFEST} there; python -m dexsim.export checkpoint=... out=DIR writes a bundle")
    try:
        manifest = yaml.safe_load((path / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{path / MANIFEST}: cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise UserError(f"{path / MANIFEST}: not the manifest of a policy bundle")
    if manifest.get("version") != VERSION:
        raise UserError(f"{path}: bundle version {manifest.get('version')}; this dexsim reads {VERSION}: export it again")
    missing = [k for k in KEYS if k not in manifest]
    if missing:
        raise UserError(f"{path / MANIFEST}: lacks {', '.join(missing)}")
    policy = path / POLICY
    if not policy.is_file():
        raise UserError(f"{path}: {POLICY} is missing; export the bundle again")
    if sha256(policy) != manifest["policy"]["sha256"]:
        raise UserError(f"{policy}: is not the file that {MANIFEST} names (sha256 differs): export the bundle again")
    if manifest["task"] == "rotate" and not {"task_settings", "grip"} <= set(manifest):
        raise UserError(f"{path / MANIFEST}: lacks task_settings or grip, which task=rotate needs; export the bundle again")
    return Bundle(path, manifest, session(policy))


def session(policy: Path) -> Any:
    """onnxruntime on one thread: a policy this small gains nothing from more, and a loop's time must not wander."""
    try:
        import onnxruntime
    except ImportError:
        raise UserError("onnxruntime is not installed: pip install 'dexsim[deploy]' (or pip install onnxruntime)") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(policy), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions have no common base
        raise UserError(f"{policy}: onnxruntime cannot load it: {str(error).splitlines()[0][:160]}") from None


def sha256(path: Path) -> str:
    """Hex digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
