"""A policy bundle, read: the folder that `dexsim export` writes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import files, guard, yaml_text
from dexsim.calibration.file import Calibration
from dexsim.deploy import manifests
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.hand.load import FILE as HAND_FILE
from dexsim.hand.load import known

FORMAT, VERSION = manifests.FORMAT, manifests.VERSION
POLICY, MANIFEST, GOLDEN, CONFIG = "policy.onnx", "manifest.yaml", "golden.npz", "config.yaml"
TERMS = "observation.onnx"
"""The observation of a task of declared terms, from signals."""
HAND = "hand"
"""Folder of a bundle with the hand that it is for, where that does not come with dexsim."""


@dataclass
class Bundle:
    """path: the folder; manifest: its content; session: onnxruntime's; hand: whose."""

    path: Path
    manifest: dict[str, Any]
    session: Any
    hand: Hand

    def __post_init__(self) -> None:
        self._carried: dict[str, np.ndarray] = {}

    @property
    def recurrent(self) -> bool:
        """Whether the policy remembers from step to step."""
        return bool(self.manifest["policy"].get("state"))

    def begin(self) -> None:
        """Begin an episode: a recurrent policy forgets."""
        self._carried = {}

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions [N, A] of observations [N, D], float32; of a recurrent policy N is 1, and the next follows
        this."""
        p = self.manifest["policy"]
        action, self._carried = _act(self.session, p, observation, self._carried or _blank(p))
        return action

    @property
    def calibration(self) -> Calibration:
        """What currents and taxel counts of the hand mean, as the manifest says. Raises UserError."""
        known, torques = self.manifest["calibration"], self.manifest["normalization"]["tau_max"]
        return Calibration.from_dict(known, f"{self.path}: calibration", torques, self.hand)

    @property
    def config(self) -> dict[str, Any]:
        """The resolved training config, with the bundle's own hand. Raises UserError where there is none."""
        return _mapping(self.path / CONFIG) | self.hand.identity


def load(path: str | Path) -> Bundle:
    """Return the bundle in a folder. Raises UserError: a file missing or changed, a manifest of the wrong types or
    beyond the hand's limits, another version, a network that does not fit it or reads other files, no onnxruntime."""
    path = Path(path).expanduser()
    if not (path / MANIFEST).is_file():
        raise UserError(f"{path}: no {MANIFEST} there; dexsim export checkpoint=... out=DIR writes a bundle")
    manifest = _mapping(path / MANIFEST)
    which = manifests.hand_entry(manifest, path / MANIFEST)
    hand = _hand(which, path)
    manifests.check(manifest, path / MANIFEST, hand)
    policy = path / POLICY
    data = _network(policy, manifest["policy"]["sha256"])
    guard.call(_tried, data, policy, manifest["policy"], what=f"{policy}", size=len(data), wanted=False)
    return Bundle(path, manifest, session(data, policy), hand)


def network(file: Path, digest: str) -> Any:
    """Return onnxruntime's session of another of a bundle's networks. Raises UserError as `load` does."""
    data = _network(file, digest)
    guard.call(session, data, file, what=f"{file}", size=len(data), wanted=False)
    return session(data, file)


def _network(file: Path, digest: str) -> bytes:
    """Return the bytes of a network. Raises UserError: missing, too large, not the one that the manifest names."""
    if not file.exists():
        raise UserError(f"{file.parent}: {file.name} is missing; export the bundle again")
    files.check(file, "network")
    data = file.read_bytes()
    if hashlib.sha256(data).hexdigest() != digest:
        raise UserError(f"{file}: is not the file that {MANIFEST} names (sha256 differs): export the bundle again")
    return data


def _hand(which: manifests.HandEntry, path: Path) -> Hand:
    """Return the hand of a bundle in folder `path`: one that comes with dexsim, or the bundle's own. A name is no path:
    a manifest cannot have other folders of this machine read."""
    file, own = path / MANIFEST, path / HAND
    if which.folder is None and which.name not in known():
        raise UserError(
            f"{file}: hand.name is {which.name!r}, must be one of {', '.join(known())} (any other hand comes in the"
            f" bundle's own folder, hand.folder: {HAND}); {manifests.AGAIN}"
        )
    if which.folder is not None and not (own / HAND_FILE).is_file():
        raise UserError(f"{file}: hand.folder is {which.folder}, but there is no {own / HAND_FILE}; {manifests.AGAIN}")
    try:
        return load_hand(which.name if which.folder is None else own, which.mirror, which.scale)
    except UserError as error:
        raise UserError(f"{file}: its hand cannot be read: {error}") from None


def _mapping(file: Path) -> dict[str, Any]:
    data = yaml_text.parse(files.text(file, "bundle's"), file)
    if not isinstance(data, dict):
        raise UserError(f"{file}: is {type(data).__name__}, must map keys to values; export the bundle again")
    return data


def session(data: bytes, policy: Path) -> Any:
    """Return onnxruntime on one thread: a policy this small gains nothing from more, and a loop's time must not wander.
    The network is taken from `data` alone: one that keeps weights in other files is refused, so that it reads none."""
    try:
        import onnx
        import onnxruntime
    except ImportError:
        raise UserError("onnxruntime is not installed: pip install onnxruntime") from None
    try:
        model = onnx.ModelProto.FromString(data)
        outside = next(
            (t.name for t in _tensors(model) if t.data_location == onnx.TensorProto.EXTERNAL or t.external_data), None
        )
    except Exception as error:  # protobuf's
        raise UserError(f"{policy}: not an ONNX network ({' '.join(str(error).split())[:120]})") from None
    if outside is not None:
        raise UserError(
            f"{policy}: refused, its tensor {outside[:60]!r} is kept in another file; a bundle's network is one file"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions have no common base
        raise UserError(f"{policy}: onnxruntime cannot load it: {str(error).splitlines()[0][:160]}") from None


def _tensors(message: Any) -> Iterator[Any]:
    """Yield every TensorProto in a protobuf message, at any depth: initializers, attributes, sub-graphs, functions."""
    for field, value in message.ListFields():
        if field.message_type is None:
            continue
        for inner in value if hasattr(value, "__len__") else (value,):
            if field.message_type.name == "TensorProto":
                yield inner
            yield from _tensors(inner)


def _blank(p: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return what a recurrent policy carries as an episode begins."""
    return {k: np.zeros((layers, 1, size), np.float32) for k, (layers, size) in (p.get("state") or {}).items()}


def _act(
    session: Any, p: dict[str, Any], observation: np.ndarray, carried: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return actions, and what is carried on."""
    given = {p["input"]: np.asarray(observation, np.float32)} | {f"{k}_in": v for k, v in carried.items()}
    action, *new = session.run([p["output"], *(f"{k}_out" for k in carried)], given)
    return action, dict(zip(carried, new, strict=True))


def _tried(data: bytes, policy: Path, p: dict[str, Any]) -> None:
    """Check that the network answers an observation of zeros with one finite action a joint."""
    loaded = session(data, policy)
    try:
        out = np.asarray(_act(loaded, p, np.zeros((1, p["observation_size"]), np.float32), _blank(p))[0])
    except Exception as error:  # onnxruntime's
        raise UserError(
            f"{policy}: does not take the observations that {MANIFEST} states: {str(error).splitlines()[0][:160]}"
        ) from None
    if out.shape != (1, p["action_size"]) or not np.issubdtype(out.dtype, np.floating):
        raise UserError(
            f"{policy}: gives {out.dtype} of shape {list(out.shape)}, must give floats of shape [1, "
            f"{p['action_size']}]; export the bundle again"
        )
    if not np.isfinite(out).all():
        raise UserError(
            f"{policy}: its action is not finite: its weights are not, or overflow; export another checkpoint"
        )


def sha256(path: Path) -> str:
    """Return hex digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
