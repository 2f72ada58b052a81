"""Commands of the wheel, installed in an environment of its own (the fixture `installed`)."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path


def call(installed: Path, folder: Path, *argv: str | Path) -> str:
    """Return what a command of the fresh environment says, run in a folder."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        [installed / argv[0], *argv[1:]], cwd=folder, capture_output=True, text=True, timeout=600, env=clean
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def provide(installed: Path, file: str, code: str, group: str, line: str) -> None:
    """Leave what `pip install` of a small package leaves: a module and its entry point."""
    ask = [installed / "python", "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])"]
    site = Path(subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip())
    (site / file).write_text(code)
    made = site / f"{Path(file).stem}-1.0.dist-info"
    made.mkdir(exist_ok=True)
    (made / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {Path(file).stem}\nVersion: 1.0\n")
    (made / "entry_points.txt").write_text(f"[{group}]\n{line}\n")
