"""`dexsim doctor`: what this machine has and lacks."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

from dexsim import system
from dexsim.errors import UserError
from dexsim.version import VERSION

USAGE = """usage: dexsim doctor

Say what this machine has and lacks: versions against what dexsim needs, GPU, engine, compiler's cache, OpenGL for
films, memory, the folder that results go into, extras. Paste it into a report of a bug. Every line that lacks
something says what to do. The exit status is 1 where dexsim cannot run here.
"""
OK, LACKS, BROKEN = "ok", "lacks", "broken"
Line = tuple[str, str, str]
"""ok, lacks (dexsim runs without) or broken; what; in words."""
EXTRAS = {
    "deploy": ("onnxruntime", "dexsim export, dexsim deploy"),
    "objects": ("coacd", "hollow meshes as objects"),
    "lerobot": ("pyarrow", "LeRobot data sets: recordings=DATASET, dexsim convert format=lerobot"),
    "zarr": ("zarr", "recordings in Zarr: recordings=FILE.zarr"),
    "hdf5": ("h5py", "recordings in HDF5: recordings=FILE.hdf5"),
    "ros2": ("cyclonedds", "driver=ros2 and dexsim record where there is no ROS 2"),
    "cluster": ("submitit", "on=slurm, on=dask"),
    "hub": ("huggingface_hub", "checkpoint=hub:..."),
    "wandb": ("wandb", "agent.logger=wandb"),
    "hands": ("robot_descriptions", "hand=menagerie:NAME, hand=robot_descriptions:NAME"),
}
SHARED_MIN = 256 << 20
"""Bytes of /dev/shm that NCCL's channels of eight GPUs take at most, with room."""


def main(argv: list[str]) -> int:
    """Print a line for each check; returns 0, or 1 where dexsim cannot run. Raises UserError."""
    if argv:
        raise UserError(f"{argv[0]}: dexsim doctor takes no settings")
    print(f"dexsim {VERSION} on {platform.platform()} {platform.machine()}, Python {platform.python_version()}\n")
    worst = 0
    for check in (packages, gpu, engine, cache, opengl, memory, folder, extras):
        for state, what, words in _checked(check):
            print(f"{state:<7} {what:<9} {words}", flush=True)
            worst = max(worst, int(state == BROKEN))
    print(f"\n{'dexsim cannot run here: see what is broken' if worst else 'dexsim runs here'}")
    return worst


def _checked(check: Callable[[], Iterator[Line]]) -> list[Line]:
    try:
        return list(check())
    except Exception as error:  # a report of what is wrong must not end at it
        return [(BROKEN, check.__name__, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")]


def packages() -> Iterator[Line]:
    """Yield whether every package that dexsim needs is there, in a version of its range."""
    from packaging.requirements import Requirement

    try:
        needed = [Requirement(text) for text in metadata.requires("dexsim") or ()]
    except metadata.PackageNotFoundError:
        yield LACKS, "packages", "dexsim is not installed but run from its source: pip install -e . in the checkout"
        return
    found, wrong = [], []
    for need in needed:
        if need.marker is not None and not need.marker.evaluate({"extra": ""}):
            continue
        try:
            version = metadata.version(need.name)
        except metadata.PackageNotFoundError:
            wrong.append(f"{need} is missing")
            continue
        found.append(f"{need.name} {version}")
        if not need.specifier.contains(version, prereleases=True):
            wrong.append(f"{need} is wanted, {version} is here")
    if wrong:
        yield BROKEN, "packages", f"{'; '.join(wrong)}: pip install --upgrade dexsim"
    yield OK, "packages", ", ".join(found)


def gpu() -> Iterator[Line]:
    """Yield the GPUs that torch sees, or why it sees none."""
    import torch

    for k in range(torch.cuda.device_count() if torch.cuda.is_available() else 0):
        about = torch.cuda.get_device_properties(k)
        yield OK, "GPU", f"cuda:{k} {about.name}, {about.total_memory / 2**30:.0f} GiB, CUDA {torch.version.cuda}"
    if torch.cuda.is_available():
        free = system.shared_memory() if torch.cuda.device_count() > 1 else None
        if free is not None and free < SHARED_MIN:
            yield LACKS, str(system.SHARED), (
                f"{free >> 20} MiB, which several GPUs talk through: docker run --shm-size=1g, or NCCL_SHM_DISABLE=1"
            )
        return
    if shutil.which("nvidia-smi") is None:
        yield LACKS, "GPU", "no NVIDIA GPU: policies learn on the CPU, in hours where a GPU takes minutes"
    elif torch.version.cuda is None:
        yield LACKS, "GPU", f"torch {torch.__version__} is a CPU build: pip install --force-reinstall torch"
    else:
        said = subprocess.run(["nvidia-smi", "-L"], capture_output=True, encoding="utf-8", errors="replace")
        words = " ".join((said.stdout + said.stderr).split())[:120]
        yield LACKS, "GPU", f"torch (CUDA {torch.version.cuda}) sees none, nvidia-smi says: {words}; update its driver"


def engine() -> Iterator[Line]:
    """Yield whether both engines step a pendulum: MuJoCo, and MuJoCo-Warp on this machine's device."""
    import mujoco
    import warp

    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint axis='0 1 0'/><geom size='.1' pos='0 0 -1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[0] = 0.1
    mujoco.mj_step(model, data, 10)
    if not data.qvel[0] < 0:
        yield BROKEN, "engine", "a pendulum of MuJoCo does not fall"
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    yield OK, "engine", f"MuJoCo {mujoco.__version__} steps; Warp {warp.__version__} on {warp.get_preferred_device()}"


def cache() -> Iterator[Line]:
    """Yield where compiled kernels are kept."""
    import warp

    place = Path(warp.config.kernel_cache_dir or "")
    size = sum(p.stat().st_size for p in place.rglob("*") if p.is_file())
    if os.access(place, os.W_OK):
        yield OK, "cache", f"{place}, {size / 2**20:.0f} MiB of compiled kernels"
    else:
        yield BROKEN, "cache", f"{place} cannot be written: WARP_CACHE_PATH=FOLDER names another"


def opengl() -> Iterator[Line]:
    """Yield the OpenGL that films are rendered by."""
    if (name := system.renderer()) is not None:
        yield OK, "OpenGL", f"{name}: films and pictures are rendered by it"
        return
    tried = ", ".join(system.renderers())
    yield LACKS, "OpenGL", f"none of {tried} opens: no films or pictures; {system.no_renderer()}"


def memory() -> Iterator[Line]:
    """Yield cores and memory."""
    known = system.memory()
    words = "unknown memory" if known is None else f"{known[0] / 2**30:.1f} of {known[1] / 2**30:.1f} GiB free"
    yield (LACKS if known and known[0] < 2 << 30 else OK), "machine", f"{system.cores()} cores, {words}"


def folder() -> Iterator[Line]:
    """Yield whether results can be written into the folder that this runs in."""
    try:
        with tempfile.TemporaryDirectory(prefix=".dexsim_", dir="."):
            free = shutil.disk_usage(".").free
    except OSError as error:
        yield LACKS, "folder", f"{Path.cwd()} cannot be written ({error.strerror}): go to another, or give out="
        return
    yield (OK if free > 1 << 30 else LACKS), "folder", f"{Path.cwd()}, {free / 2**30:.0f} GiB free"


def extras() -> Iterator[Line]:
    """Yield which optional packages are here."""
    for name, (module, use) in EXTRAS.items():
        if importlib.util.find_spec(module) is None:
            yield LACKS, "extra", f"{name} ({use}): pip install 'dexsim[{name}]'"
        else:
            yield OK, "extra", f"{name} ({use})"
