"""What this machine is and has: device, memory, versions."""

from __future__ import annotations

import os
import platform

import torch

from dexsim import system
from dexsim.errors import UserError
from dexsim.version import VERSION, installed

PACKAGES = ("torch", "warp-lang", "mujoco", "mujoco-warp", "rsl-rl-lib")


def device(setting: str | None) -> str:
    """Return "cpu" or "cuda:<k>". None picks the first CUDA device where there is one. Raises UserError for one not
    here."""
    count = cuda_devices()
    if setting is None:
        return "cuda:0" if count else "cpu"
    name, _, index = str(setting).partition(":")
    if name == "cpu" and not index:
        return "cpu"
    if name == "cuda" and (not index or index.isdecimal()):
        if not count:
            raise UserError(
                f"device={setting}: torch {torch.__version__} sees no CUDA device here; use device=cpu"
                " (or check nvidia-smi and that torch is a CUDA build)"
            )
        if int(index or 0) >= count:
            raise UserError(f"device={setting}: this machine has {count} CUDA device(s), cuda:0 to cuda:{count - 1}")
        return f"cuda:{int(index or 0)}"
    raise UserError(f"device={setting}: must be cpu, cuda or cuda:<number>")


def cuda_devices() -> int:
    """Return how many CUDA devices torch sees here."""
    return torch.cuda.device_count() if torch.cuda.is_available() else 0


def set_threads(where: str) -> None:
    """Use one torch thread on the CPU, unless OMP_NUM_THREADS says otherwise: batches are small and C MuJoCo has a
    thread pool of its own, so torch's threads would mostly wait for each other (on two busy cores a control step of
    256 worlds took 150 to 480 ms with two, 37 to 75 with one: lab/results/speed.md)."""
    if where == "cpu" and "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)


def versions() -> dict[str, str]:
    """Return versions of dexsim, Python and what it stands on, for the printout and for checkpoints."""
    return {"dexsim": VERSION, "python": platform.python_version()} | installed(*PACKAGES)


def memory(where: str) -> str:
    """Free and total memory of a device, e.g. "14.2 of 16.0 GiB free"."""
    if where.startswith("cuda"):
        free, total = torch.cuda.mem_get_info(where)
    else:
        known = system.memory()
        if known is None:
            return "memory unknown"
        free, total = known
    return f"{free / 2**30:.1f} of {total / 2**30:.1f} GiB free"


def describe(where: str) -> str:
    """Return a device in words, e.g. "cuda:0 (NVIDIA H200)" or "cpu (2 cores)"."""
    if where.startswith("cuda"):
        return f"{where} ({torch.cuda.get_device_name(where)})"
    return f"cpu ({system.cores()} cores)"
