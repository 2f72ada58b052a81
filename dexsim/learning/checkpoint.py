"""Checkpoints: one file that holds all a run needs to go on and all a replay needs to be rebuilt.

A checkpoint is a ``torch.save`` zip of tensors, numbers and text, read with ``weights_only=True``: a file cannot run
code. It is written beside its place, synced and renamed, so that the previous one survives a full disk or a crash.

Keys (all of them always there in a ``train`` file; a ``policy`` file leaves out those marked t):
  format, version, kind ("train" | "policy"); config (JSON text, resolved); versions, git ({commit, dirty[, note]});
  layout ({joints, action, observations: {group: [[name, size], ...]}}); iteration, steps (environment steps); actor
  (state dict, its running normalization included); t critic, t optimizer, t env (the environment's counters, curriculum
  and random state), t rng (torch, cuda, numpy, python). A ``train`` file may hold worlds, the worlds' states, and
  learner, the weights that learn on where ``actor`` is their average.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import pickle
import random
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dexsim import files, guard
from dexsim.errors import UserError
from dexsim.learning import parts, policies


class SaveError(UserError):
    """A checkpoint could not be written; what was there before is whole."""


FORMAT = "dexsim-checkpoint"
VERSION = 1
KEYS = ("kind", "config", "versions", "git", "layout", "iteration", "steps", "actor")
TRAIN_KEYS = ("critic", "optimizer", "env", "rng")


def save(path: str | Path, payload: dict[str, Any]) -> Path:
    """Write a checkpoint so that ``path`` holds either the old file or the whole new one, never a part.

    Raises SaveError naming the path when the disk is full or the folder cannot be written.
    """
    return write(path, encode(payload))


def encode(payload: dict[str, Any]) -> bytes:
    """Return a checkpoint's bytes; ``config`` (a dict) becomes JSON text, format and version are added."""
    payload = {"format": FORMAT, "version": VERSION, **payload, "config": json.dumps(payload["config"])}
    buffer = io.BytesIO()  # torch reports a failed write as a RuntimeError without its cause, so write it ourselves
    torch.save(payload, buffer)
    return buffer.getvalue()


def write(path: str | Path, data: bytes) -> Path:
    """Write, sync, rename. Raises SaveError; the file that was at ``path`` before stays whole."""
    path = Path(path)
    part = files.unfinished(path)
    try:
        with open(part, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
        _sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        intact = "; the previous file there is whole" if path.exists() else ""
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise SaveError(
                f"cannot save {path}: the disk is full ({len(data) / 2**20:.1f} MiB needed){intact}"
            ) from None
        raise SaveError(f"cannot save {path}: {error.strerror}{intact}") from None
    return path


def _sync_folder(folder: Path) -> None:
    """Make a rename last through a power cut; some file systems cannot, which loses nothing now."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(handle)


def load(path: str | Path, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint; ``config`` comes back as a dict, tensors on ``device``.

    Raises UserError, one line each: no such file, truncated or damaged, pickled code (refused), not a dexsim
    checkpoint, another format version, a missing part, one of the wrong type, weights that are not finite.
    """
    path = policies.place(path)
    if not path.exists():
        names = ", ".join(policies.included())
        raise UserError(f"{path}: no such checkpoint{_nearby(path)}; dexsim comes with {names}")
    if path.is_dir():
        raise UserError(f"{path}: a folder, not a checkpoint{_nearby(path / 'last.pt')}")
    guard.call(_whole, path, what=f"{path}", size=files.check(path, "checkpoint", 16 << 30), wanted=False)
    return _load(path, device)


def _load(path: Path, device: str) -> dict[str, Any]:
    try:
        data = torch.load(path, map_location=device, weights_only=True)
    except pickle.UnpicklingError:
        raise UserError(f"{path}: refused, it holds pickled code; a dexsim checkpoint holds only tensors, numbers and"
                        " text") from None
    except Exception as error:  # a damaged pickle ends in whatever its wrong opcodes meet
        raise UserError(f"{path}: damaged or not a checkpoint ({_first_line(error)})") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise UserError(f"{path}: not a dexsim checkpoint (train.py writes them, as last.pt in the run folder)")
    if data.get("version") != VERSION:
        raise UserError(f"{path}: checkpoint format version {data.get('version')}, this dexsim reads version {VERSION};"
                        f" it was written by dexsim {_writer(data)}, install that one or train again")
    missing = [k for k in KEYS + (TRAIN_KEYS if data.get("kind") == "train" else ()) if k not in data]
    if missing:
        raise UserError(f"{path}: damaged checkpoint, it lacks {', '.join(missing)}")
    if "${" in str(data["config"]):  # what train.py stores is resolved; another's could read this machine's environment
        raise UserError(
            f"{path}: refused, its config holds an interpolation (${{...}}), which that of a dexsim checkpoint never "
            "does"
        )
    try:
        data["config"] = json.loads(data["config"])
    except (TypeError, ValueError, RecursionError):
        raise UserError(f"{path}: damaged checkpoint, its config is not JSON") from None
    parts.check(data, path)
    return data


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _whole(path: Path) -> None:
    """Tell a truncated, damaged or pickled file from a checkpoint, and read it."""
    with open(path, "rb") as file:
        head = file.read(2)
    another = "use another checkpoint of its run folder"
    try:
        with zipfile.ZipFile(path) as archive:
            bad = archive.testzip()
    except Exception:  # a damaged archive fails anywhere
        pickled = "refused, it is a raw pickle that can run code" if head[:1] == b"\x80" else "not a checkpoint"
        what = "truncated" if head == b"PK" else pickled
        raise UserError(f"{path}: {what} ({path.stat().st_size} bytes); {another}") from None
    if bad:
        raise UserError(f"{path}: damaged, its part {bad} fails its checksum; {another}")
    _load(path, "cpu")


def _nearby(path: Path) -> str:
    """Return the checkpoints that are there, newest first, for an error message."""
    try:
        found = sorted(path.parent.glob("*.pt"), key=lambda p: -p.stat().st_mtime)
    except OSError:
        found = []
    return f"; in {path.parent} there are {', '.join(p.name for p in found[:5])}" if found else ""


def _writer(data: dict[str, Any]) -> str:
    versions = data.get("versions")
    return str(versions.get("dexsim", "?")) if isinstance(versions, dict) else "?"


def policy_only(payload: dict[str, Any]) -> dict[str, Any]:
    """Return the small export: what a replay needs and no more (actor with its normalization, config, layout,
    versions)."""
    return {k: v for k, v in payload.items() if k in KEYS} | {"kind": "policy"}


def check_layout(data: dict[str, Any], layout: dict[str, Any], path: str | Path) -> None:
    """Raise UserError when the environment's joints or actor observations are not those the policy was trained on."""
    saved = data["layout"]
    if list(saved["joints"]) != list(layout["joints"]):
        raise UserError(f"{path}: trained with joints {', '.join(saved['joints'])}; this environment has"
                        f" {', '.join(layout['joints'])}")
    old, new = ([tuple(r) for r in x["observations"]["actor"]] for x in (saved, layout))
    if old != new:
        at = next((i for i, (a, b) in enumerate(zip(old, new)) if a != b), min(len(old), len(new)))
        had, has = (f"{x[at][0]} ({x[at][1]})" if at < len(x) else "nothing" for x in (old, new))
        raise UserError(f"{path}: trained on other observations: entry {at} of the actor's was {had}, here it is {has};"
                        " drop the override that changes them")


def layout_of(env: Any) -> dict[str, Any]:
    """Return the joint and observation layout of an environment, for the checkpoint (plain lists and text)."""
    tables = env.describe()
    groups = {g: [[str(row[0]), int(row[1])] for row in rows] for g, rows in tables["observations"].items()}
    return {"joints": [str(n) for n in env.action_names],
            "action": [[str(v) if isinstance(v, str) else float(v) for v in row] for row in tables["action"]],
            "observations": groups}


def git_state(folder: Path | None = None) -> dict[str, Any]:
    """Return the commit of the dexsim in use and whether its tracked files differ from it; "unknown" outside a git
    checkout."""
    folder = folder or Path(__file__).resolve().parent

    def git(*args: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(folder), *args], capture_output=True, encoding="utf-8", timeout=20)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if not git("ls-files", "__init__.py"):  # e.g. installed into a virtual environment inside some other repository
        return {"commit": "unknown", "dirty": False}
    return {"commit": git("rev-parse", "HEAD") or "unknown",
            "dirty": bool(git("status", "--porcelain", "--untracked-files=no"))}


def provenance(data: dict[str, Any]) -> str:
    """Return a checkpoint's origin in words: iteration, steps and the commit it was trained at, "+changes" where
    tracked files differed from it; "written in afterwards" where that is not known."""
    git = data["git"]
    commit = git["commit"]
    if commit != "unknown":
        commit = commit[:12] + {True: "+changes", False: "", None: ", written in afterwards"}[git["dirty"]]
    return f"iteration {data['iteration']}, {data['steps']:,} steps, trained at commit {commit}"


def rng_state() -> dict[str, Any]:
    """State of every global random generator, as tensors and plain numbers."""
    name, keys, position, has_gauss, cached = np.random.get_state(legacy=True)
    assert not isinstance(keys, str)  # the words of the Mersenne twister
    version, internal, gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [str(name), torch.from_numpy(keys.astype(np.int64)), int(position), int(has_gauss), float(cached)],
        "python": [int(version), torch.tensor(internal, dtype=torch.int64), gauss],
    }


def set_rng_state(state: dict[str, Any]) -> None:
    """Put :func:`rng_state` back. CUDA generators are set as far as this machine has the same devices."""
    torch.set_rng_state(state["torch"].cpu())
    for index, value in enumerate(state["cuda"][: torch.cuda.device_count() if torch.cuda.is_available() else 0]):
        torch.cuda.set_rng_state(value.cpu(), index)
    name, keys, position, has_gauss, cached = state["numpy"]
    np.random.set_state((name, keys.cpu().numpy().astype(np.uint32), position, has_gauss, cached))
    version, internal, gauss = state["python"]
    random.setstate((version, tuple(internal.tolist()), gauss))
