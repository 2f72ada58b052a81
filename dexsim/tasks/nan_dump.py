"""What a world was before its state stopped being finite: kept on the device, written once an iteration.

`dexsim nan-dump FILE` repeats the step (`dexsim.tasks.nan_replay`).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from dexsim import files
from dexsim.errors import UserError

if TYPE_CHECKING:
    from dexsim.tasks.env import HandEnv

KEEP = 10
"""Files a run writes at most; `nan_count` goes on counting."""
_NONE = 2**31 - 1
_THREADS = 64  # that copy one field


@wp.kernel(enable_backward=False)
def _first(nan: wp.array(dtype=wp.bool), first: wp.array(dtype=int)):
    """Find the lowest world that is not finite."""
    w = wp.tid()
    if nan[w]:
        wp.atomic_min(first, 0, w)


@wp.func_native("((unsigned*)to)[k] = ((const unsigned*)(source + stride * (unsigned long long)world))[k];")
def _copy_word(to: wp.uint64, source: wp.uint64, stride: wp.uint64, world: int, k: int):
    """Copy 4 bytes of a world's row. Fields differ in type and shape; what is kept of them is bytes."""
    ...


@wp.kernel(enable_backward=False)
def keep_world(first: wp.array(dtype=int), taken: wp.array(dtype=wp.bool), fields: wp.array2d(dtype=wp.uint64)):
    """Copies that world's row of every field (address, bytes between worlds, address to copy to, words of a world)."""
    f, lane = wp.tid()
    if first[0] == wp.static(_NONE) or taken[0]:
        return
    words = int(fields[f, 3])
    for k in range(lane, words, wp.static(_THREADS)):
        _copy_word(fields[f, 2], fields[f, 0], fields[f, 1], first[0], k)


@wp.kernel(enable_backward=False)
def _take(first: wp.array(dtype=int), taken: wp.array(dtype=wp.bool), world: wp.array(dtype=wp.int64)):
    if first[0] != wp.static(_NONE) and not taken[0]:
        world[0] = wp.int64(first[0])
        taken[0] = True
    first[0] = wp.static(_NONE)


class NanDump:
    """Watches an environment (`tasks/env.py`). `before` and `after` only fill buffers that exist already, so that the
    step that calls them can be recorded; `write` reads from the device.

    Kept: qpos [nq], qvel [nv], applied forces and the servo's state before the step, the action [12], the world, how
    many control steps its episode had lasted, the servo's columns and every model field that varies by world.
    """

    def __init__(self, env: HandEnv):
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
        self._copies = {k: torch.zeros(v.shape[1:], dtype=v.dtype, device=dev) for k, v in rows.items()}
        self._world = torch.zeros(1, dtype=torch.long, device=dev)
        self._taken = torch.zeros(1, dtype=torch.bool, device=dev)
        self._first = torch.full((1,), _NONE, dtype=torch.int32, device=dev)
        fields = [_row(rows[k], copy) for k, copy in self._copies.items()]
        self._fields = torch.tensor(fields, dtype=torch.int64).to(dev)

    def before(self) -> None:
        """Keep the state before physics, once targets are sent and forces set."""
        torch._foreach_copy_(list(self._before.values()), list(self._live.values()))

    def after(self, nan: torch.Tensor) -> None:
        """Keep one of the worlds that are not finite (nan [N]), unless one is kept that is not written yet."""
        device = str(nan.device)
        first, taken = wp.from_torch(self._first), wp.from_torch(self._taken)
        fields = wp.from_torch(self._fields, dtype=wp.uint64)
        wp.launch(_first, dim=len(nan), inputs=[wp.from_torch(nan)], outputs=[first], device=device)
        wp.launch(keep_world, dim=(len(self._fields), _THREADS), inputs=[first, taken, fields], device=device)
        wp.launch(_take, dim=1, inputs=[first, taken], outputs=[wp.from_torch(self._world)], device=device)

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
        data = {k.replace("/", "."): v.cpu().numpy() for k, v in self._copies.items()}
        cfg = {
            k: v for k, v in self._env.cfg.items() if k in ("choices", "task", "sim", "servo", "tactile", "randomize")
        }
        try:
            with files.beside(path) as part, open(part, "wb") as file:
                about = {"world": int(self._world), "config": json.dumps(cfg)}
                np.savez_compressed(file, **about, **data)  # type: ignore[arg-type]  # as the stub has it
        except OSError as error:  # a full disk must not end the training over this
            print(f"{path}: a world that was not finite could not be written ({error.strerror})", flush=True)
            path.unlink(missing_ok=True)
            self._taken.zero_()
            return None
        self._taken.zero_()
        return path


def _row(source: torch.Tensor, copy: torch.Tensor) -> list[int]:
    """Return what `keep_world` has to know of a field [N, ...]."""
    if not source[0].is_contiguous() or source.element_size() % 4:
        raise ValueError(f"NanDump: a world's row of {tuple(source.shape)} {source.dtype} is not words in one piece")
    size = source.element_size()
    return [source.data_ptr(), source.stride(0) * size, copy.data_ptr(), copy.numel() * size // 4]


def load(path: Path) -> dict[str, np.ndarray]:
    """Return arrays of a dump by name. Raises UserError for a file that is not one."""
    try:
        data = files.arrays(path)
        json.loads(str(data["config"]))
        data["qpos"], data["servo_state"]
    except (ValueError, KeyError) as error:
        raise UserError(f"{path}: not a dump of a world ({type(error).__name__}: {error})") from None
    return data
