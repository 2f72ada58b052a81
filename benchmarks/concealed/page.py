"""The tables and figures of lab/results/concealed.md:

    python -m benchmarks.concealed.page results=out/concealed/seed_N/results.json [figure=FILE.png] [limits=FILE.png]

figure: answers by hidden effect and size; limits: how often it is right by size of the effect, and by how sure it is.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from benchmarks.concealed import score
from benchmarks.concealed.baselines import LABELS
from dexsim import intervals

AIMS = {  # line: (to publish, aim), from the project's judging table
    "right effect first, easy": ("85 %", "95 %"), "right effect first, medium": ("70 %", "88 %"),
    "right effect first, hard": ("45 %", "65 %"),
    "right joint (F1), rigs of several": ("0.85", "0.95"),
    "regime: overlap >= 0.5, where named right": ("70 %", "85 %"), "several effects at once (F1)": ("0.60", "0.80"),
    "parameter error, median": ("15 %", "8 %"), "90 % interval covers the truth": ("", "85-95 %"),
    "held-out error removed, mean": ("0.70", "0.90"),
    "false alarm, nothing missing": ("8 %", "3 %"), "outside the catalogue: not claimed": ("60 %", "80 %"),
    "confident and wrong, all cases": ("10 %", "3 %"),
}  # fmt: skip
PLAIN = ("(F1)", "mean", "error removed")
SIZES = (1.0, 1.25, 1.6, 2.2, 3.5, 6.0, 1e3)  # x the floor: edges of the bins of the effect's error
SURE = (0.0, 0.4, 0.65, 0.8, 0.95, 1.0)  # edges of the bins of confidence
COLOURS = {
    "right alone": "#2f855a",
    "right in a set": "#9ae6b4",
    "nothing claimed": "#cbd5e0",
    "another, unsure": "#f6ad55",
    "another, confident": "#c53030",
}


def value(line: str, x: float) -> str:
    """A figure as its line is read: per cent unless it is a score."""
    return f"{x:.2f}" if any(word in line for word in PLAIN) else f"{100 * x:.1f} %"


def tables(data: dict) -> str:
    """Markdown: the judging table, rates by law and by confidence, the effects, the baselines."""
    out = ["| | reached | 95 % interval | cases | to publish | aim |", "|---|---|---|---|---|---|"]
    for line, v in data["lines"].items():
        least, aim = AIMS.get(line, ("", ""))
        name = line.strip() if not line.startswith("  ") else "&nbsp;&nbsp;" + line.strip()
        out.append(
            f"| {name} | {value(line, v['value'])} | {value(line, v['low'])} to {value(line, v['high'])} |"
            f" {v['n']} | {least} | {aim} |"
        )
    out += by_law(data["results"]) + asked(data["results"])
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
        out += [
            "",
            "| | held-out error over the floor, median | 95 % interval | cases | time, median | error of the"
            " hidden number, median |",
            "|---|---|---|---|---|---|",
        ]
        for k, v in data["baselines"]["lines"].items():
            number = f"{100 * v['parameter']:.0f} % of {v['parameters']}" if "parameter" in v else "-"
            out.append(
                f"| {LABELS[k]} | {v['value']:.2f} | {v['low']:.2f} to {v['high']:.2f} | {v['n']} |"
                f" {v['seconds']:.0f} s | {number} |"
            )
    return "\n".join(out) + "\n"


def by_law(results: list[dict]) -> list[str]:
    """Rows: effects that have two laws, by the law that was drawn, and those that have one."""
    out = ["", "| | first law | second law | effects of one law |", "|---|---|---|---|"]
    for line, of in score.by_law(results).items():
        cells = []
        for law in ("first", "second", "only"):
            v = of.get(law)
            if v is None:
                cells.append("-")
                continue
            x, low, high = (value(line, v[k]) for k in ("value", "low", "high"))
            cells.append(f"{x} ({low} to {high}, {v['n']})")
        out.append(f"| {line} | " + " | ".join(cells) + " |")
    return out if len(out) > 3 else []  # answers of before laws were drawn do not say


def asked(results: list[dict]) -> list[str]:
    """Rows: cases with one effect whose hidden effect was named first, by the confidence asked of the name."""
    mine = [r for r in results if "right" in r and r["group"] in ("effect", "hand", "touch")]
    out = ["", "| | " + " | ".join(f"{t} ({sum(r['tier'] == t for r in mine)})" for t in score.TIERS) + " |"]
    out.append("|---|" + "---|" * len(score.TIERS))
    rows = [("right effect first, alone or in a set", lambda r: r["right"])]
    rows += [(f"named alone, at {least:g} or more" if least else "named alone, at any confidence",
              lambda r, least=least: score.alone_at(r, least)) for least in (0.0, *score.LEAST)]  # fmt: skip
    for name, holds in rows:
        cells = []
        for tier in score.TIERS:
            hits = [bool(holds(r)) for r in mine if r["tier"] == tier]
            cells.append(f"{100 * sum(hits) / len(hits):.0f} % ({sum(hits)})" if hits else "-")
        out.append(f"| {name} | " + " | ".join(cells) + " |")
    return out


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
    axes[0].set_ylim(len(names) - 0.4, -0.6)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="lower center", ncol=5, fontsize=9, frameon=False)
    fig.tight_layout(rect=(0, 0.06, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=120)
    plt.close(fig)


def by_size(results: list[dict]) -> list[tuple[float, float, int, int, int]]:
    """(from, to, cases, first name right, nothing said) by the size of the one hidden effect, in floors."""
    mine = [r for r in results if "right" in r and r["group"] in ("effect", "hand", "touch") and r.get("ratio")]
    out = []
    for a, b in zip(SIZES, SIZES[1:], strict=False):
        x = [r for r in mine if a <= r["ratio"] < b]
        out.append((a, b, len(x), sum(r["right"] for r in x), sum(not r["said"] for r in x)))
    return out


def by_confidence(results: list[dict]) -> list[tuple[float, float, int, int]]:
    """(from, to, names, of them hidden there) of every single name that was said of physics, sets left out; names are
    right where the effect is hidden, on any joint."""
    pairs = [(s[2], s[0] in {h[0] for h in r["hidden"]}) for r in results if r["decoy"] not in ("bad_channel",
                                                                                                "confounded",
                                                                                                "wrong_mass")
             for s in r["said"] if s[0] != "bad_channel" and len(s[3]) < 2]  # fmt: skip
    out = []
    for a, b in zip(SURE, SURE[1:], strict=False):
        x = [hit for c, hit in pairs if a <= c < b or (b == 1.0 and c >= a)]
        out.append((a, b, len(x), sum(x)))
    return out


def limits(data: dict, path: Path) -> None:
    """Two panels: right and silent by size; right by confidence, beside what was promised."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6))
    rows = [r for r in by_size(data["results"]) if r[2]]
    x = range(len(rows))
    for values, colour, label in (
        ([r[3] for r in rows], "#2f855a", "first name right"),
        ([r[4] for r in rows], "#718096", "nothing said"),
    ):
        rate = [v / r[2] for v, r in zip(values, rows, strict=True)]
        spread = [intervals.share(v, r[2]) for v, r in zip(values, rows, strict=True)]
        left.errorbar(
            x,
            rate,
            [
                [max(v - s[0], 0) for v, s in zip(rate, spread, strict=True)],
                [max(s[1] - v, 0) for v, s in zip(rate, spread, strict=True)],
            ],
            fmt="o-",
            color=colour,
            label=label,
            capsize=3,
        )
    left.set_xticks(
        list(x), [(f"{a:g}-{b:g}" if b < SIZES[-1] else f"over {a:g}") + f"\n({n})" for a, b, n, *_ in rows], fontsize=8
    )
    left.set_xlabel("error that the effect makes, in floors (cases)")
    left.set_ylim(-0.02, 1.04)
    left.legend(frameon=False, fontsize=9)
    bins = [b for b in by_confidence(data["results"]) if b[2]]
    x = [0.5 * (a + b) for a, b, *_ in bins]
    rate = [k / n for *_, n, k in bins]
    spread = [intervals.share(k, n) for *_, n, k in bins]
    right.plot([0, 1], [0, 1], color="#cbd5e0", label="as sure as right")
    right.errorbar(
        x,
        rate,
        [
            [max(v - s[0], 0) for v, s in zip(rate, spread, strict=True)],
            [max(s[1] - v, 0) for v, s in zip(rate, spread, strict=True)],
        ],
        fmt="o-",
        color="#2b6cb0",
        label="names that are true (count)",
        capsize=3,
    )
    for at, v, (*_, n, _) in zip(x, rate, bins, strict=True):
        right.annotate(str(n), (at, v), textcoords="offset points", xytext=(6, -10), fontsize=8)
    right.set_xlabel("confidence of a name")
    right.set_ylim(-0.02, 1.04)
    right.legend(frameon=False, fontsize=9)
    fig.tight_layout()
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
    if "limits" in given:
        limits(found, Path(given["limits"]))
