"""Public hands as their makers ship them: import, check, excite and two iterations of training of each, in a table.

    python -m benchmarks.hands [folder=../shared/hands] [models=a.urdf,b.xml] [drops=0] [limit=300] [out=out/hands]

folder: its hands are taken: every .urdf, and every .xml or .mjcf that has a <mujoco> with two hinges or more, of its
archives (.tar.xz) too. models: these files instead. limit: seconds a step may take. A hand counts as right where it
comes in without a setting and all steps end well; where one is refused, the table has its line. Writes table.md and
results.json to out=, and prints the table.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.options import options
from dexsim.console.ending import guard
from dexsim.errors import UserError

SETTINGS = {"folder": "../shared/hands", "models": "", "drops": 0, "limit": 300, "out": "out/hands"}
TRAIN = ("task=grasp", "worlds=16", "iterations=2", "device=cpu", "final_episodes=0")


def found(folder: Path, out: Path) -> Iterator[Path]:
    """Return models of hands in a folder, and in its archives, which are unpacked below `out`."""
    for archive in sorted(folder.glob("*.tar.xz")):
        place = out / "unpacked" / archive.name.removesuffix(".tar.xz")
        if not place.is_dir():
            with tarfile.open(archive) as tar:
                tar.extractall(place, filter="data")
        yield from found(place, out)
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".urdf":
            yield path
        elif path.suffix in (".xml", ".mjcf") and not path.name.startswith("scene"):
            text = path.read_text(encoding="utf-8", errors="replace")
            if (
                "<mujoco" in text
                and "<mujocoinclude" not in text
                and len(re.findall(r"<(joint|freejoint)\b", text)) > 1
            ):
                yield path


def step(words: Sequence[str], limit: int) -> tuple[str, float, list[str]]:
    """Return ("ok" or the line of the error, seconds, all lines) of a command of dexsim."""
    began = time.time()
    try:
        done = subprocess.run([sys.executable, "-m", "dexsim", *words], capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return f"not done in {limit} s", time.time() - began, []
    lines = (done.stdout + done.stderr).strip().splitlines()
    ends = [x for x in lines if x.startswith("error:")] or lines[-1:] or ["no word"]
    return "ok" if done.returncode == 0 else ends[-1], time.time() - began, lines


def one(model: Path, out: Path, drops: int, limit: int) -> dict[str, Any]:
    """Return what becomes of one hand: a row."""
    name = re.sub(r"\W+", "_", f"{model.parent.name}_{model.stem}")
    hand = out / name
    row: dict[str, Any] = {"hand": name, "file": model.name}
    steps = {
        "import": ["import-hand", str(model), f"out={hand}", f"drops={drops}", "picture=false"],
        "check": ["import-hand", "check", str(hand)],
        "excite": ["excite", f"hand={hand}", f"out={out / name}_excite"],
        "train": ["train", *TRAIN, f"hand={hand}", f"out={out / name}_run"],
    }
    for what, words in steps.items():
        said, seconds, lines = step(words, limit)
        row[what], row[f"{what}_s"] = said, round(seconds, 1)
        if what == "import":
            row["coupled"] = sum(x.startswith("coupled:") for x in lines)
            row["said"] = [x for x in lines if x.startswith(("check:", "not used:", "missing:", "inertia of"))]
        if said != "ok" and what == "import":
            break
    return row


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as a table in Markdown."""
    out = ["| hand | coupled | import | check | excite | two iterations |", "|---|---|---|---|---|---|"]
    for r in rows:
        cells = [f"{r[k]} ({r[f'{k}_s']:.0f} s)" if k in r else "" for k in ("import", "check", "excite", "train")]
        out.append(f"| {r['hand']} | {r.get('coupled', '')} | " + " | ".join(cells) + " |")
    right = sum(all(r.get(k) == "ok" for k in ("import", "check", "excite", "train")) for r in rows)
    return "\n".join([*out, "", f"{right} of {len(rows)} right without help"]) + "\n"


def main(argv: Sequence[str]) -> int:
    given = options(argv, SETTINGS)
    out, folder = Path(given["out"]), Path(given["folder"])
    out.mkdir(parents=True, exist_ok=True)
    models = [Path(p) for p in given["models"].split(",") if p]
    if not models and not folder.is_dir():
        raise UserError(f"folder={folder}: no such folder; folder=FOLDER of hands, or models=FILE,FILE")
    rows = []
    for model in models or list(found(folder, out)):
        rows.append(one(model, out, given["drops"], given["limit"]))
        print(table(rows[-1:]).splitlines()[2], flush=True)
        (out / "results.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
        (out / "table.md").write_text(table(rows), encoding="utf-8")
    print("\n" + table(rows), end="")
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
