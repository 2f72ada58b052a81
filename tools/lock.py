"""`python tools/lock.py [uv=uv] [wheels=FOLDER]`: make `locks/` anew from pyproject.toml, every package at one version
and with the hashes of its files.

locks/base.txt is what `pip install .` needs but torch, test.txt and docs.txt have those extras, too. torch.txt is torch
with, on Linux, what its CUDA build needs; torch-cpu.txt its CPU build, of the wheels in the folder `wheels` (not on the
package index). All are for CPython from 3.11 on, Linux, macOS and Windows, of one resolution. Needs uv (pip
install uv).
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = {"base": (), "test": ("deploy", "objects", "hub", "cluster", "test"), "docs": ("docs",)}
BUILD = "setuptools>=77\n"
"""What builds dexsim itself: installed from the lock, too, and not fetched by pip."""
HELD = "torch<2.14\n"
"""Not the newest: the release with which the results on GPUs were made. `python -m tests.newest` tries newer ones."""
OF_TORCH = re.compile(r"^(torch==|nvidia-|cuda-|triton==)")
HEAD = "# Made by tools/lock.py. Install with: pip install --no-deps --require-hashes -r {name}\n"


def compiled(uv: str, extras: tuple[str, ...], constraints: Path | None) -> list[str]:
    """Return the lines of each package: version, marker, hashes. One may come more than once, for other Pythons."""
    with tempfile.TemporaryDirectory() as folder:
        build = Path(folder) / "build.in"
        build.write_text(BUILD + HELD)
        command = [uv, "pip", "compile", "pyproject.toml", str(build), "--universal", "--python-version=3.11"]
        command += ["--quiet", "--generate-hashes", "--no-annotate", "--no-header"]
        command += [f"--extra={e}" for e in extras]
        command += [f"--constraints={constraints}"] if constraints else []
        text = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return re.split(r"\n(?=\S)", text.strip())


def cpu_build(folder: Path, every: list[str]) -> list[str]:
    """Return torch's CPU build, of the version that is locked."""
    version = next(block.split(" ")[0] for block in every if block.startswith("torch=="))
    wheels = sorted(folder.glob(f"{version.replace('==', '-')}+cpu-*.whl"))
    hashes = "".join(f" \\\n    --hash=sha256:{hashlib.sha256(w.read_bytes()).hexdigest()}" for w in wheels)
    return [f"{version}+cpu{hashes}"] if wheels else []


def main(argv: list[str]) -> int:
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    if set(given) - {"uv", "wheels"} or any("=" not in a for a in argv):
        print(__doc__)
        return 2
    uv, wheels = given.get("uv", "uv"), Path(given["wheels"]) if "wheels" in given else None
    every = compiled(uv, tuple(dict.fromkeys(e for extras in EXTRAS.values() for e in extras)), None)
    with tempfile.TemporaryDirectory() as folder:
        pins = Path(folder) / "pins.txt"
        pins.write_text("\n".join(block.split(" \\")[0] for block in every))
        found = {name: compiled(uv, extras, pins) for name, extras in EXTRAS.items()}
    found = {name: [b for b in blocks if not OF_TORCH.match(b)] for name, blocks in found.items()}
    found["torch"] = [b for b in every if OF_TORCH.match(b)]
    if wheels is not None:
        found["torch-cpu"] = cpu_build(wheels, every)
    for name, blocks in found.items():
        path = ROOT / "locks" / f"{name}.txt"
        path.parent.mkdir(exist_ok=True)
        path.write_text(HEAD.format(name=f"locks/{name}.txt") + "\n".join(sorted(blocks)) + "\n")
        print(f"{path.relative_to(ROOT)}: {len(blocks)} packages")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
