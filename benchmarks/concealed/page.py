"""The tables and the figure of docs/concealed.md: python -m benchmarks.concealed.page results=out/concealed/seed_N/results.json [figure=FILE.png]"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from benchmarks.concealed.baselines import LABELS

AIMS = {  # line: (to publish, aim), from the project's judging table
    "right effect first, easy": ("85 %", "95 %"), "right effect first, medium": ("70 %", "88 %"), "right effect first, hard": ("45 %", "65 %"),
    "right joint (F1), rigs of several": ("0.85", "0.95"), "regime: overlap >= 0.5, where named right": ("70 %", "85 %"), "several effects at once (F1)": ("0.60", "0.80"),
    "parameter error, median": ("15 %", "8 %"), "90 % interval covers the truth": ("90 %", "85-95 %"), "held-out error removed, mean": ("0.70", "0.90"),
    "false alarm, nothing missing": ("8 %", "3 %"), "outside the catalogue: not claimed": ("60 %", "80 %"), "confident and wrong, all cases": ("10 %", "3 %"),
}  # fmt: skip
PLAIN = ("(F1)", "mean", "error removed")
COLOURS = {"right alone": "#2f855a", "right in a set": "#9ae6b4", "nothing claimed": "#cbd5e0", "another, unsure": "#f6ad55", "another, confident": "#c53030"}


def value(line: str, x: float) -> str:
    """A figure as its line is read: per cent unless it is a score."""
    return f"{x:.2f}" if any(word in line for word in PLAIN) else f"{100 * x:.1f} %"


def tables(data: dict) -> str:
    """Markdown: the judging table, the effects, the baselines."""
    out = ["| | reached | 95 % interval | cases | to publish | aim |", "|---|---|---|---|---|---|"]
    for line, v in data["lines"].items():
        least, aim = AIMS.get(line, ("", ""))
        name = line.strip() if not line.startswith("  ") else "&nbsp;&nbsp;" + line.strip()
        out.append(f"| {name} | {value(line, v['value'])} | {value(line, v['low'])} to {value(line, v['high'])} | {v['n']} | {least} | {aim} |")
    out += ["", "| hidden | easy | medium | hard | when not named, taken for |", "|---|---|---|---|---|"]
    for effect, row in effects(data["results"]).items():
        cells = []
        for tier in ("easy", "medium", "hard"):
            mine = row[tier]
            cells.append(f"{sum(r['right'] for r in mine)}/{len(mine)}" if mine else "-")
        taken: dict[str, int] = {}
        for r in (r for tier in row.values() for r in tier if not r["right"]):
            name = r["said"][0][0] if r["said"] else "nothing"
            taken[name] = taken.get(name, 0) + 1
        wrong = ", ".join(f"{k} {n}" for k, n in sorted(taken.items(), key=lambda x: -x[1]))
        out.append(f"| {effect} | " + " | ".join(cells) + f" | {wrong or '-'} |")
    if data.get("baselines"):
        out += ["", "| | held-out error over the floor, median | 95 % interval | cases | time, median | error of the hidden number, median |", "|---|---|---|---|---|---|"]
        for k, v in data["baselines"]["lines"].items():
            number = f"{100 * v['parameter']:.0f} % of {v['parameters']}" if "parameter" in v else "-"
            out.append(f"| {LABELS[k]} | {v['value']:.2f} | {v['low']:.2f} to {v['high']:.2f} | {v['n']} | {v['seconds']:.0f} s | {number} |")
    return "\n".join(out) + "\n"


def effects(results: list[dict]) -> dict[str, dict[str, list[dict]]]:
    """Cases with one effect hidden, by effect and tier."""
    out: dict[str, dict[str, list[dict]]] = {}
    for r in results:
        if "right" in r and r["group"] in ("effect", "hand", "touch") and r["tier"] in ("easy", "medium", "hard"):
            out.setdefault(r["hidden"][0][0], {"easy": [], "medium": [], "hard": []})[r["tier"]].append(r)
    return dict(sorted(out.items()))


def answer(r: dict) -> str:
    """Which of COLOURS a case's answer is."""
    if r["right"]:
        return "right alone" if r["alone"] else "right in a set"
    if not r["said"]:
        return "nothing claimed"
    return "another, confident" if r["wrong_sure"] else "another, unsure"


def figure(data: dict, path: Path) -> None:
    """Answers by effect, stacked, a column for each tier."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    by = effects(data["results"])
    names = list(by)
    fig, axes = plt.subplots(1, 3, figsize=(11, 0.28 * len(names) + 1.4), sharey=True)
    for ax, tier in zip(axes, ("easy", "medium", "hard"), strict=True):
        left = [0.0] * len(names)
        for kind, colour in COLOURS.items():
            share = [sum(answer(r) == kind for r in by[n][tier]) / max(len(by[n][tier]), 1) for n in names]
            ax.barh(range(len(names)), share, left=left, color=colour, label=kind, height=0.8)
            left = [a + b for a, b in zip(left, share, strict=True)]
        ratio = {"easy": "10", "medium": "3", "hard": "1.5"}[tier]
        ax.set_title(f"{tier}: error {ratio} x the floor", fontsize=10)
        ax.set_xlim(0, 1)
        ax.set_xticks([0, 0.5, 1], ["0", "50 %", "100 %"])
    axes[0].set_yticks(range(len(names)), names, fontsize=9)
    axes[0].invert_yaxis()
    fig.legend(*axes[0].get_legend_handles_labels(), loc="lower center", ncol=5, fontsize=9, frameon=False)
    fig.tight_layout(rect=(0, 0.06, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=120)
    plt.close(fig)


if __name__ == "__main__":
    given = dict(item.split("=", 1) for item in sys.argv[1:])
    if "results" not in given:
        raise SystemExit(__doc__)
    found = json.loads(Path(given["results"]).read_text(encoding="utf-8"))
    print(tables(found))
    if "figure" in given:
        figure(found, Path(given["figure"]))
