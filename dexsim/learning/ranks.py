"""Training on several devices at once: one process (a rank) for each, started by ``torchrun``.

    torchrun --nproc_per_node=8 train.py task=grasp

Gradients, normalization statistics, KL divergence and learning rate go through rsl-rl's own distributed PPO (NCCL
between GPUs, gloo between CPU processes). What is here is the rest: which device, which seed, who writes, and how all
of them end.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import os
import random
import tempfile
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist

from dexsim.errors import UserError
from dexsim.learning.lifeline import Lifeline

SEED_STEP = 1_000_003  # between the seeds of neighbouring ranks: far more than anyone numbers runs
COPY, PART = "dexsim/leaders", 16 << 20  # keys of the leader's file in torch's store; bytes of each of its parts
COMPILE_LIMIT = datetime.timedelta(minutes=30)  # how long others wait for rank 0 of their node to compile kernels


class Ranks:
    """This process among those of one training run.

    Attributes: rank (0 .. size - 1, over all machines), local (on this machine), size, here (size on this machine);
    leader: whether this is rank 0, which alone prints, logs and saves. With size 1 everything here does nothing.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        try:
            self.size = int(environment.get("WORLD_SIZE", "1"))
            self.rank, self.local = (int(environment.get(k, "0")) for k in ("RANK", "LOCAL_RANK"))
            self.here = int(environment.get("LOCAL_WORLD_SIZE", self.size))
        except ValueError:
            raise UserError(
                "WORLD_SIZE, LOCAL_WORLD_SIZE, RANK and LOCAL_RANK must be whole numbers; torchrun sets them"
            ) from None
        if self.size > 1 and "MASTER_ADDR" not in environment:
            raise UserError(
                f"WORLD_SIZE={self.size} without MASTER_ADDR: start several processes with torchrun"
                " --nproc_per_node=N train.py ..., or unset WORLD_SIZE"
            )
        self.leader = self.rank == 0
        self._lifeline: Lifeline | None = None
        self._store: Any = None

    def device(self, setting: str | None, cuda_devices: int) -> str | None:
        """Return the device to ask for: each rank of a machine gets a GPU of its own. Raises UserError where they do
        not suffice.

        Args:
            setting: of ``device``. cuda_devices: how many this machine has.
        """
        if self.size == 1 or setting == "cpu" or (setting is None and not cuda_devices):
            return setting
        if setting not in (None, "cuda"):
            raise UserError(
                f"device={setting}: under torchrun each process takes the GPU of its own number; leave device= away"
                " (CUDA_VISIBLE_DEVICES chooses which)"
            )
        if self.here > cuda_devices:
            raise UserError(
                f"torchrun: {self.here} processes on this machine, which has {cuda_devices} CUDA device(s); use"
                f" --nproc_per_node={max(cuda_devices, 1)}{'' if cuda_devices else ' or device=cpu'}"
            )
        return f"cuda:{self.local}"

    def seed(self, seed: int, iteration: int = 0) -> int:
        """Return the seed of this rank's worlds and exploration; ``seed`` itself for rank 0 at the start.

        iteration: of a resumed run: ranks but 0, whose random state no checkpoint holds, begin a stream of their own.
        """
        return seed + SEED_STEP * self.rank + (7919 * iteration if self.rank else 0)

    @contextlib.contextmanager
    def joined(self, device: str) -> Iterator[None]:
        """Join the group; at the end, or when one of the ranks ends early, all end (see ``Lifeline``)."""
        if self.size == 1:
            yield
            return
        if device.startswith("cuda"):
            torch.cuda.set_device(device)
        backend, store = "cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo", self._meeting()
        dist.init_process_group(backend, store=store, rank=self.rank, world_size=self.size, timeout=COMPILE_LIMIT)
        self._lifeline = Lifeline(self.rank, self.size, store)
        try:
            yield
        except KeyboardInterrupt:
            self._lifeline.fail("", 130)
            raise
        except UserError as error:
            self._lifeline.fail(str(error), 2)  # the leader says it, once
            raise
        except Exception as error:
            if not self.leader:
                traceback.print_exc()  # here: the interpreter's own would come after fail(), which ends this process
            self._lifeline.fail(
                f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'see above'}", 1
            )
            raise
        self.leave()

    @property
    def machines(self) -> int:
        """How many machines take part."""
        return max(self.size // max(self.here, 1), 1)

    @contextlib.contextmanager
    def leaders(self, path: str) -> Iterator[str]:
        """Give a path of the leader's file: its own, which is also that of others whose file there is the same; for
        those of another machine that have none, or another, a copy until the block ends."""
        if self.machines == 1:
            yield path
            return
        own, store = Path(path).expanduser(), self._meeting()
        mark = hashlib.sha256(own.read_bytes()).hexdigest() if own.is_file() else "none"
        if self.leader:
            store.set(f"{COPY}/mark", mark)
            if mark != "none" and any(store.get(f"{COPY}/{k}/mark").decode() != mark for k in range(1, self.size)):
                with open(own, "rb") as file:
                    parts = list(iter(lambda: file.read(PART), b""))
                store.set(f"{COPY}/parts", str(len(parts)))
                for k, part in enumerate(parts):
                    store.set(f"{COPY}/part/{k}", part)
        else:
            store.set(f"{COPY}/{self.rank}/mark", mark)
            if store.get(f"{COPY}/mark").decode() not in (mark, "none"):
                with tempfile.TemporaryDirectory(prefix="dexsim_") as folder:
                    copy = Path(folder, own.name)
                    with open(copy, "wb") as file:
                        for k in range(int(store.get(f"{COPY}/parts"))):
                            file.write(store.get(f"{COPY}/part/{k}"))
                    yield str(copy)
                return
        yield path

    def _meeting(self) -> Any:
        """Return torch's key-value store that all ranks share, before and after they have joined."""
        if self._store is None:
            self._store, _, _ = next(dist.rendezvous("env://", self.rank, self.size, timeout=COMPILE_LIMIT))
        return self._store

    def leave(self) -> None:
        """Say good-bye and close the group: nothing is shared from here on. Called by all ranks."""
        if self._lifeline is not None:
            self.wait()
            self._lifeline.close()
            self._lifeline = None
            dist.destroy_process_group()

    @property
    def several(self) -> bool:
        """True if there are others to talk to now."""
        return self._lifeline is not None

    def on_loss(self, text: str) -> None:
        """Set what to add, should another rank be lost from now on: how to go on."""
        if self._lifeline is not None:
            self._lifeline.hint = text

    def tell(self, value: Any) -> Any:
        """Return the leader's value, everywhere (pickled; small things)."""
        if not self.several:
            return value
        box = [value]
        dist.broadcast_object_list(box, src=0, device=torch.device("cpu"))
        return box[0]

    def wait(self) -> None:
        """Wait until all ranks are here."""
        self.any(False)

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set on any rank; decided in host memory, so that no GPU is waited for."""
        if not self.several:
            return flag
        votes = torch.tensor([int(flag)])
        dist.all_reduce(votes, op=dist.ReduceOp.MAX)
        return bool(votes.item())

    def sum(self, values: torch.Tensor) -> torch.Tensor:
        """Return ``values`` summed over ranks, in place, on their device."""
        if self.several:
            dist.all_reduce(values)
        return values

    @contextlib.contextmanager
    def one_compiles(self) -> Iterator[None]:
        """Let one compile: the first rank of each machine does it alone, the others then find them
        cached."""
        first = self.local == 0
        if self.several and not first:
            self.wait()
        yield
        if self.several and first:
            self.wait()

    @contextlib.contextmanager
    def only_leader_prints(self) -> Iterator[None]:
        """Send the standard output of the other ranks nowhere; their errors still show."""
        if self.leader:
            yield
            return
        with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):
            yield


def seed_all(seed: int) -> None:
    """Seed every global random generator."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)
