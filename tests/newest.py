"""`python -m tests.newest [packages=mujoco,mujoco-warp,...] [torch=false] [tests="FILE FILE ..."]`: do the newest
MuJoCo, MuJoCo-Warp, Warp, tensordict and rsl-rl work?

Makes a fresh environment, puts the newest releases of the packages there over those of the environment that runs this
(they must bring what they need: nothing else is changed), and runs the fast tests of the engines, of learning and of
checkpoints with them. torch=true also takes the newest torch, with all that it needs (gigabytes on Linux). Prints a
line a package and ends with the tests' status.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tempfile
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = "mujoco,mujoco-warp,warp-lang,tensordict,rsl-rl-lib"
TESTS = (
    "tests/test_conformance.py tests/test_sim.py tests/test_learning.py tests/test_resume.py tests/test_servo_laws.py"
)
ASK = "import importlib.metadata as m, json, sys; print(json.dumps({p: m.version(p) for p in sys.argv[1:]}))"


def main(argv: list[str]) -> int:
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    if set(given) - {"packages", "torch", "tests"} or any("=" not in a for a in argv):
        print(__doc__)
        return 2
    packages = given.get("packages", PACKAGES).split(",")
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        python = str(Path(folder) / "bin" / "python")
        ask = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
        site = Path(subprocess.run(ask, capture_output=True, text=True, check=True).stdout.strip())
        own = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
        (site / "below.pth").write_text("\n".join([str(ROOT), *sorted(own)]) + "\n")  # after its own: the newest win
        pip = [
            python,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
            "--upgrade",
            "--ignore-installed",
        ]
        subprocess.run([*pip, "--no-deps", *packages], check=True)
        if given.get("torch", "false") == "true":
            subprocess.run([*pip, "torch"], check=True)
            packages.append("torch")
        newest = json.loads(
            subprocess.run([python, "-c", ASK, *packages], capture_output=True, text=True, check=True).stdout
        )
        for name in packages:
            print(f"{name:14s} {newest[name]}{'' if newest[name] != version(name) else ' (as here)'}", flush=True)
        tests = given.get("tests", TESTS).split()
        command = [python, "-m", "pytest", "-q", "-n", "0", "-m", "not slow", "-p", "no:cacheprovider", *tests]
        done = subprocess.run(command, cwd=ROOT, env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"})
    print(
        "the newest releases pass"
        if done.returncode == 0
        else f"the newest releases do not pass (status {done.returncode})"
    )
    return done.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
