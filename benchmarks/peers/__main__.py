"""dexsim beside its peers, one command each; quote ratios only. Each ends in one JSON line.

    python -m benchmarks.peers gpu [mjlab=PYTHON] [worlds=8192] [device=cuda:0] [out=FOLDER]
    python -m benchmarks.peers cpu shadow=PYTHON [seconds=20]
    python -m benchmarks.peers sysid [cases=8]

gpu: the same hand and box, the same targets: dexsim's full environment step (servo, 600 taxels, rewards, resets) beside
bare MuJoCo-Warp of the same version and, with `mjlab=` an interpreter that has mjlab 1.6 (pip install mjlab==1.6.0 in a
virtual environment of its own), beside mjlab's environment loop and its older bare MuJoCo-Warp. `mjlab=` may also be a
folder to put before sys.path of this interpreter. cpu: one world and one thread beside Gymnasium-Robotics' Shadow hand
with its touch sensors, in an interpreter that has gymnasium-robotics. sysid: `mujoco.sysid` beside `diagnose` on one
joint.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from dexsim.console import folders
from dexsim.console.ending import guard
from dexsim.errors import UserError

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
OWN = ("mjlab", "shadow", "worlds", "device", "out", "seconds", "cases")


def child(command: list[str], environment: dict[str, str], limit: float = 600.0) -> dict:
    """The JSON line that a program prints last; {"error": ...} where it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, env=os.environ | environment)
    except subprocess.TimeoutExpired:
        return {"error": f"no end after {limit:.0f} s"}
    lines = [x for x in done.stdout.splitlines() if x.startswith("{")]
    if done.returncode == 0 and lines:
        return json.loads(lines[-1])
    words = [x for x in done.stderr.splitlines() if x.strip()]
    return {"error": f"status {done.returncode}: {words[-1][:300] if words else 'no message'}"}


def interpreter(given: str) -> tuple[list[str], dict[str, str]]:
    """Command and environment of a peer's Python: an interpreter, or a folder for the front of sys.path."""
    path = Path(given).expanduser()
    if path.is_dir():
        return [sys.executable], {"PYTHONPATH": f"{path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
                                  "MUJOCO_GL": "off"}
    if not path.exists():
        raise UserError(f"{given}: neither an interpreter nor a folder of packages")
    return [str(path)], {"PYTHONPATH": "", "MUJOCO_GL": "off"}


def gpu(own: dict[str, str], out: Path) -> list[dict]:
    """The loops on the GPU (or, to rehearse, on device=cpu), one process each, twice around."""
    worlds, device = own.get("worlds", "8192"), own.get("device", "cuda:0")
    scene = str(out / "scene")
    subprocess.run([sys.executable, "-m", "benchmarks.peers.scene", scene], check=True, cwd=ROOT, capture_output=True)
    here = {"PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    plan = [("dexsim", [sys.executable, "-m", "benchmarks.peers.dexsim_loop", scene, worlds, device], here),
            ("bare", [sys.executable, str(HERE / "bare.py"), scene, worlds, device], here)]
    if "mjlab" in own:
        python, environment = interpreter(own["mjlab"])
        plan += [("mjlab", [*python, str(HERE / "mjlab_loop.py"), scene, worlds, device], environment),
                 ("bare_old", [*python, str(HERE / "bare.py"), scene, worlds, device], environment)]
    rows: list[dict] = []
    for turn in range(2):  # what failed is tried again: another process may have been writing the same kernel
        for name, command, environment in plan:
            row = {"name": name, "turn": turn} | child(command, environment)
            rows.append(row)
            print("  " + "  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()),
                  flush=True)
            (out / "peers_gpu.json").write_text(json.dumps({"benchmark": "peers gpu", "worlds": int(worlds),
                                                            "device": device, "rows": rows,
                                                            "ratios": ratios(rows)}, indent=1))
    for name, ratio in ratios(rows).items():
        print(f"  {name:10s} {ratio:.3f} of dexsim's time for a control step")
    print(json.dumps({"benchmark": "peers gpu", "worlds": int(worlds), "device": device, "ratios": ratios(rows),
                      "rows": rows}), flush=True)
    return rows


def ratios(rows: list[dict]) -> dict[str, float]:
    """Time of each over dexsim's, the best turn of each."""
    best: dict[str, float] = {}
    for r in rows:
        if "ms" in r:
            best[r["name"]] = min(r["ms"], best.get(r["name"], float("inf")))
    return {k: v / best["dexsim"] for k, v in best.items()} if "dexsim" in best else {}


def main(argv: list[str]) -> int:
    """gpu, cpu or sysid."""
    if not argv or argv[0] not in ("gpu", "cpu", "sysid"):
        raise UserError("say which: gpu, cpu or sysid (python -m benchmarks.peers gpu ...)")
    own = {}
    for a in argv[1:]:
        key, _, value = a.partition("=")
        if key not in OWN:
            raise UserError(f"unknown setting {key!r}; there are {', '.join(OWN)}")
        own[key] = value
    out = folders.make(Path(own.get("out", "out/peers")).resolve(), "out=")
    if argv[0] == "gpu":
        return 0 if all("error" not in r for r in gpu(own, out)) else 1
    if argv[0] == "cpu":
        from benchmarks.peers import shadow

        return shadow.main(own, out)
    from benchmarks.peers import sysid

    return sysid.main(own, out)


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
