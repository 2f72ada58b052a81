"""Public hands as their makers ship them: import, check, excite, two iterations of training, a diagnosis; in a table.

    python -m benchmarks.hands [folder=../shared/hands] [models=a.urdf,b.xml] [steps=import,check,excite,train,diagnose]
    [drops=0] [limit=300] [jobs=1] [seed=1] [out=out/hands] [page=]

folder: its hands are taken: every .urdf, and every .xml or .mjcf that has a <mujoco> with two joints or more and is
included by no other, of its archives (.tar.xz) too. models: these files instead. The diagnosis is of recordings with a
large effect in the transmission of one drive, drawn by `seed` (`benchmarks.hidden_drives`). limit: seconds a step may
take. A hand counts as right where it comes in without a setting and all steps end well; where one is refused, the table
has its line. Resumable: a step that ended stands in out=/HAND/row.json and is not run again. Writes table.md,
results.json and measurement.json (for `python -m tools.results record`) to out=, and prints the table.
page=docs/hands.md writes the page with the table, the commands and a sheet of pictures (media/hands.png beside it).
"""

from __future__ import annotations

import datetime
import json
import os
import re
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import answers, hidden_drives
from dexsim.console.ending import guard
from dexsim.errors import UserError

STEPS = ("import", "check", "excite", "train", "diagnose")
LABELS = ("imported", "checked", "excited", "trained for two iterations", "hidden effect named first")
SETTINGS = {"folder": "../shared/hands", "models": "", "steps": ",".join(STEPS), "drops": 0, "limit": 300, "jobs": 1,
            "seed": 1, "out": "out/hands", "page": ""}  # fmt: skip
TRAIN = ("task=grasp", "worlds=16", "iterations=2", "device=cpu", "final_episodes=0")
SHEET = 4  # pictures in a row


def found(folder: Path, out: Path) -> Iterator[Path]:
    """Return models of hands in a folder, and in its archives, which are unpacked below `out`."""
    for archive in sorted(folder.glob("*.tar.xz")):
        place = out / "unpacked" / archive.name.removesuffix(".tar.xz")
        if not place.is_dir():
            with tarfile.open(archive) as tar:
                tar.extractall(place, filter="data")
        yield from found(place, out)
    yield from sorted(folder.rglob("*.urdf"))
    models = {p: p.read_text(encoding="utf-8", errors="replace") for p in sorted(folder.rglob("*"))
              if p.suffix in (".xml", ".mjcf")}  # fmt: skip
    inside = {p: [(p.parent / name).resolve() for name in re.findall(r'<include\s+file="([^"]+)"', text)]
              for p, text in models.items()}  # fmt: skip
    included = {q for files in inside.values() for q in files}
    for path, text in models.items():
        whole = text + "".join(q.read_text(encoding="utf-8", errors="replace") for q in inside[path] if q.is_file())
        joints = len(re.findall(r"<(joint|freejoint)\b", whole))
        if re.search(r"<mujoco\b", text) and path.resolve() not in included and joints > 1:
            yield path


def step(words: Sequence[str], limit: int) -> tuple[str, list[str]]:
    """Return ("ok" or the line of the error, all lines) of a command of dexsim."""
    threads = os.environ | {"OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run([sys.executable, "-m", "dexsim", *words], capture_output=True, text=True, timeout=limit,
                              env=threads, check=False)  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"not done in {limit} s", []
    lines = (done.stdout + done.stderr).strip().splitlines()
    ends = [x for x in lines if x.startswith("error:")] or lines[-1:] or ["no word"]
    return "ok" if done.returncode == 0 else ends[-1], lines


def name_of(model: Path) -> str:
    """Return what a hand is called here: the folder of its file and the file."""
    return re.sub(r"\W+", "_", f"{model.parent.name}_{model.stem}")


def one(job: tuple[Path, dict[str, Any]]) -> dict[str, Any]:
    """Return what becomes of one hand: a row. job: its file, settings."""
    model, s = job
    place = Path(s["out"]) / name_of(model)
    hand, file = place / "hand", place / "row.json"
    row: dict[str, Any] = {"hand": place.name, "file": model.name}
    if file.is_file():
        row = json.loads(file.read_text(encoding="utf-8"))
    place.mkdir(parents=True, exist_ok=True)
    commands = {
        "import": ["import-hand", str(model), f"out={hand}", f"drops={s['drops']}", "picture=false"],
        "check": ["import-hand", "check", str(hand)],
        "excite": ["excite", f"hand={hand}", f"out={place / 'excite'}"],
        "train": ["train", *TRAIN, f"hand={hand}", f"out={place / 'run'}"],
    }
    for what in (x for x in STEPS if x in s["steps"].split(",") and x not in row):
        if what != "import" and row.get("import") != "ok":
            break
        began = time.time()
        if what == "diagnose":
            row |= hidden(place, hand, s)
        else:
            row[what], lines = step(commands[what], s["limit"])
        row[f"{what}_s"] = round(time.time() - began, 1)
        if what == "import":
            row["coupled"] = sum(x.startswith("coupled:") for x in lines)
            row["said"] = [x for x in lines if x.startswith(("check:", "not used:", "missing:", "inertia of"))]
            if row[what] == "ok":
                from dexsim.hand import load_hand

                loaded = load_hand(hand)
                row |= {"drives": len(loaded.joints), "passive": len(loaded.couplings.passive)}
        file.write_text(json.dumps(row, indent=1), encoding="utf-8")
    return row


def hidden(place: Path, hand: Path, s: dict[str, Any]) -> dict[str, Any]:
    """Return the end of a diagnosis of a large effect that is hidden in a drive of the hand."""
    rng = np.random.default_rng([s["seed"], *place.name.encode()])
    try:
        truth = hidden_drives.make(place / "hidden", hand, rng)
    except UserError as error:
        return {"diagnose": f"error: {error}"}
    got = hidden_drives.diagnosed(place / "hidden", truth, s["limit"])
    end = "ok" if got["right"] else f"not named: {'; '.join(got['said']) or got['verdict']}"
    return {"diagnose": end, "hidden": f"{truth['kind']} of {truth['joint']}", "said_of_it": got["said"]}


def short(text: str, most: int = 240) -> str:
    """Return how a step ended, for a cell: of a long line what it is about, and its end, which says what to do."""
    text = re.sub(r"(\S*/)?([^/\s]+\.(urdf|xml|mjcf)):", r"\2:", text.replace("|", "/"))
    if len(text) <= most:
        return text
    return f"{text[: most // 2].rsplit(' ', 1)[0]} ... {text[-most // 2 :].partition(' ')[2]}"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as a table in Markdown."""
    out = ["| hand | drives | joints that follow | import | check | excite | two iterations | hidden effect named |",
           "|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for r in rows:
        cells = [f"{short(r[k])} ({r[f'{k}_s']:.0f} s)" if k in r else "" for k in STEPS]
        if "hidden" in r:
            cells[-1] = f"{r['hidden']}: {cells[-1]}"
        out.append(f"| {r['hand']} | {r.get('drives', '')} | {r.get('passive', '')} | " + " | ".join(cells) + " |")
    tried = {k: [r[k] == "ok" for r in rows if k in r] for k in STEPS}
    ends = [f"{label} {sum(x)} of {len(x)}" for label, x in zip(LABELS, tried.values(), strict=True) if x]
    out += ["", f"Without a setting: {', '.join(ends)}. An empty cell was not tried."]
    return "\n".join(out) + "\n"


def measurement(rows: Sequence[dict[str, Any]], argv: Sequence[str]) -> dict[str, Any]:
    """Return the figures as `python -m tools.results record` takes them."""
    here = subprocess.run(["git", "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=False)
    figures = [{"name": label, "value": f"{sum(r.get(what) == 'ok' for r in rows)} of {len(rows)}"}
               for what, label in zip(STEPS, LABELS, strict=True)]  # fmt: skip
    return {
        "what": "Public hands as their makers ship them",
        "command": " ".join(["python -m benchmarks.hands", *argv]),
        "date": datetime.date.today().isoformat(),
        "hardware": "CPU",
        "version": here.stdout.strip() or "unknown",
        "figures": figures,
        "note": "Table: docs/hands.md.",
    }


def sheet(rows: Sequence[dict[str, Any]], out: Path, path: Path) -> None:
    """Draw every hand that came in, cupped, on one sheet."""
    from matplotlib.figure import Figure

    from dexsim.hand import load_hand
    from dexsim.import_hand import picture
    from dexsim.view.stills import Shot, render

    came = [r for r in rows if r.get("import") == "ok"]
    lines = -(-len(came) // SHEET)
    figure = Figure(figsize=(2.6 * SHEET, 2.4 * lines), dpi=70, layout="constrained")
    for k, row in enumerate(came):
        hand = load_hand(out / row["hand"] / "hand")
        model = hand.spec().compile()
        q = picture.qpos(hand, model, 0.5 * (hand.pose("open") + hand.pose("cupped")))
        middle, radius = picture.bounds(model, picture.posed(model, q))
        shot = Shot(0, q, [float(x) for x in middle], 2.6 * radius, 140.0, -25.0, (300, 270))
        axes = figure.add_subplot(lines, SHEET, k + 1)
        axes.imshow(render([model], [shot])[0])
        axes.set(xticks=[], yticks=[])
        axes.set_title(row["hand"], fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def main(argv: Sequence[str]) -> int:
    """Try every hand; print the table."""
    s, engine = answers.settings(argv, SETTINGS)
    out, folder = Path(s["out"]).resolve(), Path(s["folder"])
    s["out"] = str(out)
    out.mkdir(parents=True, exist_ok=True)
    models = [Path(p) for p in s["models"].split(",") if p]
    if not models and not folder.is_dir():
        raise UserError(f"folder={folder}: no such folder; folder=FOLDER of hands, or models=FILE,FILE")
    if unknown := set(s["steps"].split(",")) - set(STEPS):
        raise UserError(f"steps={s['steps']}: {', '.join(sorted(unknown))} is none of {', '.join(STEPS)}")
    given = {name_of(m): (m.resolve(), s) for m in models or found(folder, out)}
    rows = list(answers.at_once(one, given, out, engine))
    (out / "results.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    (out / "table.md").write_text(table(rows), encoding="utf-8")
    (out / "measurement.json").write_text(json.dumps(measurement(rows, argv), indent=1), encoding="utf-8")
    print("\n" + table(rows), end="")
    if s["page"]:
        page(rows, out, Path(s["page"]))
    return 0


PAGE = """\
# Hands that others made

Hands as their makers ship them, each imported by one line and without a setting: `dexsim import-hand FILE
out=hands/NAME`. Written by `python -m benchmarks.hands folder=FOLDER page=docs/hands.md`, which runs per hand

```
dexsim import-hand FILE out=hands/NAME
dexsim import-hand check hands/NAME
dexsim excite hand=hands/NAME out=excite
dexsim train {train} hand=hands/NAME
dexsim diagnose recordings=[a.mcap,b.mcap] held_out=[c.mcap] hand=hands/NAME
```

The recordings are of the hand in simulation with a large play, dry friction or elasticity in the transmission of one
drive (`benchmarks/hidden_drives.py`). "ok" there means: this effect of this drive was named first. Joints that follow
have no drive of their own. A hand that is refused comes in with the setting that its line names, or not at all where
it names none. No file of these hands is in the repository.

{table}
![Hands that came in, between open and cupped](media/hands.png)
"""


def page(rows: Sequence[dict[str, Any]], out: Path, path: Path) -> None:
    """Write the page, and its sheet of pictures beside it; its later sections stay."""
    sheet(rows, out, path.parent / "media" / "hands.png")
    _, more, rest = (path.read_text(encoding="utf-8") if path.is_file() else "").partition("\n## ")
    path.write_text(PAGE.format(train=" ".join(TRAIN[:-1]), table=table(rows)) + more + rest, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
