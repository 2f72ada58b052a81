"""What a world was before its state stopped being finite: kept on the device, written once an iteration.

`dexsim nan-dump FILE` repeats the step (`dexsim.tasks.nan_replay`).
"""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import torch

from dexsim.errors import UserError

KEEP = 10
"""Files a run writes at most; `nan_count` goes on counting."""


class NanDump:
    """Watches an environment (`tasks/env.py`). `before` and `after` only fill buffers that exist already, so that the
    step that calls them can be recorded; `write` reads from the device.

    Kept: qpos [nq], qvel [nv], applied forces and the servo's state before the step, the action [12], the world, how
    many control steps its episode had lasted, the servo's columns and every model field that varies by world.
    """

    def __init__(self, env):
        e, dev = env.engine, env.device
        self._env, self._count = env, 0
        live = {"qpos": e.t.qpos, "qvel": e.t.qvel, "time": e.t.time, "servo_state": env.servo.state}
        self._live = live
        self._before = {k: v.clone() for k, v in live.items()}
        # unchanged by a step (joint damping and friction, which the servo writes, it writes again)
        rows = {
            **self._before,
            "xfrc_applied": e.t.xfrc_applied,
            "action": env.action,
            "target": env.target,
            "servo_params": env.servo.params,
            "episode_step": env.episode_length_buf,
            **{f"field/{k}": e.field(k) for k in (*e.field_names, "body_subtreemass", "body_invweight0")},
        }
        self._rows = rows
        self._kept = {k: torch.zeros(v.shape[1:], dtype=v.dtype, device=dev) for k, v in rows.items()}
        self._world = torch.zeros(1, dtype=torch.long, device=dev)
        self._taken = torch.zeros((), dtype=torch.bool, device=dev)

    def before(self) -> None:
        """Targets are sent and forces set; physics is next."""
        for k, v in self._live.items():
            self._before[k].copy_(v)

    def after(self, nan: torch.Tensor) -> None:
        """nan [N]: worlds that are not finite. Keeps one of them, unless one is kept that is not written yet."""
        take = nan.any() & ~self._taken
        world = nan.to(torch.uint8).argmax(0, keepdim=True)
        self._world.copy_(torch.where(take, world, self._world))
        for k, kept in self._kept.items():
            kept.copy_(torch.where(take, self._rows[k].index_select(0, world)[0], kept))
        self._taken |= take

    def write(self, folder: Path) -> Path | None:
        """Write what is kept to folder/nan_<k>.npz; returns the path, None if there is nothing to write (or enough)."""
        if not bool(self._taken) or self._count >= KEEP:
            return None
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"nan_{self._count}.npz"
        while path.exists():
            self._count += 1
            path = folder / f"nan_{self._count}.npz"
        self._count += 1
        data = {k.replace("/", "."): v.cpu().numpy() for k, v in self._kept.items()}
        cfg = {
            k: v for k, v in self._env.cfg.items() if k in ("choices", "task", "sim", "servo", "tactile", "randomize")
        }
        try:
            np.savez_compressed(path, world=int(self._world), config=json.dumps(cfg), **data)
        except OSError as error:  # a full disk must not end the training over this
            print(f"{path}: a world that was not finite could not be written ({error.strerror})", flush=True)
            path.unlink(missing_ok=True)
            path = None
        self._taken.zero_()
        return path


def load(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a dump by name. Raises UserError for a file that is not one."""
    try:
        with np.load(path, allow_pickle=False) as f:
            data = {k: f[k] for k in f.files}
        json.loads(str(data["config"]))
        data["qpos"], data["servo_state"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: not a dump of a world ({type(error).__name__}: {error})") from None
    return data


if __name__ == "__main__":  # python -m dexsim.tasks.nan_dump FILE
    from dexsim.console.ending import guard
    from dexsim.tasks.nan_replay import main

    sys.exit(guard(main, sys.argv[1:]))
