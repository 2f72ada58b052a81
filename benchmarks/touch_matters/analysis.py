"""Table and figure of what has been judged: python -m benchmarks.touch_matters.analysis out=FOLDER [figure=FILE.png].

Writes FOLDER/touch_matters.md, .json and the figure. How a difference is judged was fixed before any row was trained
(docs/results/touch_matters.md).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks import tools
from benchmarks.touch_matters import rows
from dexsim.errors import UserError

DRAWS = 4000
NAMES = {"training": "training's physics", "wide": "wide friction and mass", "bench": "test world `bench`"}


def read(out: Path) -> dict[tuple[str, str], dict[int, dict]]:
    """(row, world) -> seed -> what the judging wrote."""
    found: dict[tuple[str, str], dict[int, dict]] = {}
    for path in sorted(out.glob("*/seed*/*.json")):
        data = json.loads(path.read_text())
        if "world" in data:
            found.setdefault((data["row"], data["world"]), {})[data["seed"]] = data
    return found


def trials(data: dict) -> np.ndarray:
    """Successes of each trial [E]."""
    return np.array([t[0] for t in data["metrics"]["trials"]], float)


def paired(a: Sequence[np.ndarray], b: Sequence[np.ndarray], rng: np.random.Generator) -> dict:
    """Mean difference of two rows over S paired seeds, each with its trials; its 95 % interval is the wider of the
    bootstrap over pairs and trials within them, and Student's t over the pairs. Raises UserError for fewer than two
    pairs."""
    if len(a) != len(b) or len(a) < 2:
        raise UserError(f"{len(a)} and {len(b)} seeds: a comparison needs at least two pairs")
    each = np.array([x.mean() - y.mean() for x, y in zip(a, b, strict=True)])
    draws = np.empty(DRAWS)
    for k in range(DRAWS):
        picks = rng.integers(len(each), size=len(each))
        draws[k] = np.mean([
            a[i][rng.integers(len(a[i]), size=len(a[i]))].mean() - b[i][rng.integers(len(b[i]), size=len(b[i]))].mean()
            for i in picks
        ])  # fmt: skip
    low, high = np.percentile(draws, [2.5, 97.5])
    half = stats.t.ppf(0.975, len(each) - 1) * each.std(ddof=1) / np.sqrt(len(each))
    low, high = min(low, each.mean() - half), max(high, each.mean() + half)
    verdict = "more" if low > 0 else "fewer" if high < 0 else "undecided"
    return {"difference": float(each.mean()), "interval": [float(low), float(high)], "by_seed": each.tolist(),
            "verdict": verdict}  # fmt: skip


def summary(found: dict[tuple[str, str], dict[int, dict]]) -> dict:
    """Averages by row and world, and the difference of the row with everything to every other."""
    rng = np.random.default_rng(0)
    averages: dict[str, dict] = {}
    differences: dict[str, dict] = {}
    for world in rows.WORLDS:
        for row in rows.EVERY:
            seeds = found.get((row.key, world))
            if not seeds:
                continue
            by_seed = {s: float(trials(d).mean()) for s, d in sorted(seeds.items())}
            every = np.concatenate([trials(d) for d in seeds.values()])
            ends: dict[str, int] = {}
            for d in seeds.values():
                for k, v in d["metrics"]["ends"].items():
                    ends[k] = ends.get(k, 0) + v
            averages.setdefault(world, {})[row.key] = {
                "average": float(np.mean(list(by_seed.values()))),
                "by_seed": by_seed,
                "median": float(np.median(every)),
                "share_25": float((every >= 25).mean()),
                "seconds_to_end": float(np.mean([d["metrics"]["seconds_to_fall"] for d in seeds.values()])),
                "touched_by_others": float(np.mean([d["metrics"]["touched_by_others"] for d in seeds.values()])),
                "ends": ends,
                "steps": sorted({d["steps"] for d in seeds.values()}),
            }
            whole = found.get((rows.FULL.key, world), {})
            shared = sorted(set(whole) & set(seeds))
            if row != rows.FULL and len(shared) >= 2:
                a, b = [trials(whole[s]) for s in shared], [trials(seeds[s]) for s in shared]
                differences.setdefault(world, {})[row.key] = paired(a, b, rng)
    return {"averages": averages, "differences": differences}


def markdown(data: dict) -> str:
    """The page's tables."""
    label = {r.key: r.label for r in rows.EVERY}
    lines = []
    for world, by in data["averages"].items():
        steps = sorted({s for r in by.values() for s in r["steps"]})
        lines += [
            f"**Judged in {NAMES[world]}** ({' and '.join(f'{s / 1e6:.1f}' for s in steps)} M steps a training)", "",
            "| row | successes in a row | by seed | median | trials of 25 or more | s to the end | dropped, leaned,"
            " to the cap | touched by others | `full` makes more by (95 %) |", "|---" * 9 + "|",
        ]  # fmt: skip
        for key, r in by.items():
            total = sum(r["ends"].values())
            ends = ", ".join(f"{100 * r['ends'][e] / total:.0f} %" for e in ("dropped", "leaned", "capped"))
            d = data["differences"].get(world, {}).get(key)
            said = "" if d is None else (
                f"{d['difference']:+.1f} ({d['interval'][0]:+.1f} to {d['interval'][1]:+.1f}), "
                + {"more": "holds", "fewer": "the reverse holds", "undecided": "undecided"}[d["verdict"]]
            )  # fmt: skip
            lines.append(
                f"| {label[key]} | {r['average']:.1f} | {', '.join(f'{v:.1f}' for v in r['by_seed'].values())} |"
                f" {r['median']:.0f} | {100 * r['share_25']:.0f} % | {r['seconds_to_end']:.1f} | {ends} |"
                f" {100 * r['touched_by_others']:.1f} % | {said} |"
            )
        lines.append("")
    return "\n".join(lines)


def draw(data: dict, path: Path) -> None:
    """Successes of every row in every world; differences to the row with everything; successes over sensors."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    known = [r for r in rows.EVERY if any(r.key in by for by in data["averages"].values())]
    sensors = [r for r in known if r.sensors is not None]
    parts = 3 if len(sensors) > 3 else 2
    figure, axes = plt.subplots(1, parts, figsize=(5.2 * parts, 4.2), constrained_layout=True)
    for k, (world, by) in enumerate(data["averages"].items()):
        for i, row in enumerate(known):
            x = i + 0.26 * (k - 1)
            if row.key in by:
                values = list(by[row.key]["by_seed"].values())
                axes[0].bar(x, by[row.key]["average"], 0.24, color=f"C{k}", label=NAMES[world] if i == 0 else None)
                axes[0].plot([x] * len(values), values, "k.", markersize=4)
            d = data["differences"].get(world, {}).get(row.key)
            if d is not None:
                axes[1].errorbar(x, d["difference"], [[d["difference"] - d["interval"][0]],
                                 [d["interval"][1] - d["difference"]]], fmt="o", capsize=3, color=f"C{k}")  # fmt: skip
    for ax in axes[:2]:
        ax.set_xticks(range(len(known)), [r.key.replace("_", "\n") for r in known], fontsize=8)
    axes[0].axhline(25, color="0.6", linewidth=0.8, linestyle="--")
    axes[0].set_ylabel("successes in a row (dots: seeds)")
    axes[0].legend(fontsize=8)
    axes[1].axhline(0, color="0.5", linewidth=0.8)
    axes[1].set_ylabel("`full` makes more by (95 %)")
    if parts == 3:
        at = {0: 0.0, 5: 1.0, 25: 2.0, 120: 3.0, 600: 4.0}
        for k, (world, by) in enumerate(data["averages"].items()):
            shown = sorted((r for r in sensors if r.key in by), key=lambda r: (r.sensors, r.key))
            xs = [at[r.sensors or 0] + (0.25 if r.key == "bits" else 0) for r in shown]
            axes[2].plot(xs, [by[r.key]["average"] for r in shown], "o-", color=f"C{k}", label=NAMES[world])
        axes[2].set_xticks([*at.values(), 1.25], [*map(str, at), "\n5 bits"], fontsize=8)
        axes[2].set_xlabel("taxels in all")
        axes[2].set_ylabel("successes in a row")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main(argv: list[str]) -> None:
    own, rest = tools.split(argv, {"out": "out/touch_matters", "figure": ""})
    if rest:
        raise UserError(f"{rest[0]!r}: the settings are out=FOLDER and figure=FILE")
    out = Path(own["out"]).expanduser()
    found = read(out)
    if not found:
        raise UserError(f"out={out}: nothing judged there; first python -m benchmarks.touch_matters out={out}")
    data = summary(found)
    (out / "touch_matters.json").write_text(json.dumps(data, indent=1))
    text = markdown(data)
    (out / "touch_matters.md").write_text(text + "\n")
    draw(data, Path(own["figure"]) if own["figure"] else out / "touch_matters.png")
    print(text)


if __name__ == "__main__":
    tools.command(main, __doc__)
