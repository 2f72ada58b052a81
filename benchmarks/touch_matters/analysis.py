"""Table and figure of what has been judged: python -m benchmarks.touch_matters.analysis out=FOLDER [figure=FILE.png].

Writes FOLDER/touch_matters.md, .json and the figure. How a difference is judged was fixed before any row was trained
(lab/results/touch_matters.md). Three things were added when the rows had been seen, and decide nothing: intervals of
a row's average, Holm's correction over the paper's orderings, and the difference to a row of other seeds.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks import tools
from benchmarks.touch_matters import rows
from dexsim import intervals
from dexsim.errors import UserError

DRAWS = 4000
AIM = 25  # successes in a row that the row with everything should make
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
    picks = intervals.singles(len(each), rng, DRAWS)
    draws = intervals.nested_means(a, picks, rng) - intervals.nested_means(b, picks, rng)
    low, high = np.percentile(draws, [2.5, 97.5])
    student = over_seeds(each)
    low, high = min(low, student[0]), max(high, student[1])
    verdict = "more" if low > 0 else "fewer" if high < 0 else "undecided"
    return {"difference": float(each.mean()), "interval": [float(low), float(high)], "by_seed": each.tolist(),
            "verdict": verdict, "p": against_zero(each)}  # fmt: skip


def over_seeds(each: np.ndarray) -> list[float]:
    """Student's 95 % interval of the mean of `each` [S], S of at least two."""
    half = stats.t.ppf(0.975, len(each) - 1) * each.std(ddof=1) / np.sqrt(len(each))
    return [float(each.mean() - half), float(each.mean() + half)]


def against_zero(each: np.ndarray) -> float:
    """p of Student's test, two-sided, that the mean of `each` [S] is 0."""
    error = each.std(ddof=1) / np.sqrt(len(each))
    if error == 0:  # all alike: no variation to hold the mean against
        return float(each.mean() == 0)
    return float(2 * stats.t.sf(abs(each.mean()) / error, len(each) - 1))


def holm(p: dict[str, float]) -> dict[str, float]:
    """Holm's adjusted p of each of a family of tests (Scand. J. Stat. 6, 1979): below 0.05, it is decided with the
    family's chance of any false decision kept at 5 %."""
    adjusted, largest = {}, 0.0
    for i, key in enumerate(sorted(p, key=lambda k: p[k])):
        largest = max(largest, min(1.0, (len(p) - i) * p[key]))
        adjusted[key] = largest
    return adjusted


def unpaired(a: np.ndarray, b: np.ndarray) -> dict:
    """Difference of two rows' averages over seeds that have nothing to do with each other, a [S], b [T], each of at
    least two; 95 % interval by Welch's t."""
    test = stats.ttest_ind(a, b, equal_var=False).confidence_interval()
    return {"difference": float(a.mean() - b.mean()), "interval": [float(test.low), float(test.high)]}


def summary(found: dict[tuple[str, str], dict[int, dict]]) -> dict:
    """Averages by row and world, and the difference of the row with everything to every other."""
    rng = np.random.default_rng(0)
    averages: dict[str, dict] = {}
    differences: dict[str, dict] = {}
    others: dict[str, dict] = {}
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
            each = np.array(list(by_seed.values()))
            averages.setdefault(world, {})[row.key] = {
                "average": float(each.mean()),
                "interval": over_seeds(each) if len(each) > 1 else None,
                "by_seed": by_seed,
                "median": float(np.median(every)),
                "share_25": float((every >= AIM).mean()),
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
            elif row != rows.FULL and min(len(whole), len(seeds)) >= 2:
                full = np.array([trials(d).mean() for d in whole.values()])
                others.setdefault(world, {})[row.key] = unpaired(full, each)
    claimed = {w: {b: by[b]["p"] for _, b in rows.CLAIMS if b in by} for w, by in differences.items()}
    return {"averages": averages, "differences": differences, "unpaired": others,
            "holm": {w: holm(p) for w, p in claimed.items()}}  # fmt: skip


def markdown(data: dict) -> str:
    """The page's tables."""
    label = {r.key: r.label for r in rows.EVERY}
    lines: list[str] = []
    for world, by in data["averages"].items():
        steps = sorted({s for r in by.values() for s in r["steps"]})
        lines += [
            f"**Judged in {NAMES[world]}** ({' and '.join(f'{s / 1e6:.1f}' for s in steps)} M steps a training)", "",
            "| row | successes in a row (95 %) | by seed | median | trials of 25 or more | s to the end |"
            " dropped, leaned, to the cap | touched by others | `full` makes more by (95 %) |", "|---" * 9 + "|",
        ]  # fmt: skip
        for key, r in by.items():
            total = sum(r["ends"].values())
            ends = ", ".join(f"{100 * r['ends'][e] / total:.0f} %" for e in ("dropped", "leaned", "capped"))
            d = data["differences"].get(world, {}).get(key)
            said = ""
            if d is not None:
                verdict = {"more": "holds", "fewer": "the reverse holds", "undecided": "undecided"}[d["verdict"]]
                said = f"{d['difference']:+.1f} ({d['interval'][0]:+.1f} to {d['interval'][1]:+.1f}), {verdict}"
            elif (u := data["unpaired"].get(world, {}).get(key)) is not None:
                said = f"{u['difference']:+.1f} ({u['interval'][0]:+.1f} to {u['interval'][1]:+.1f}), not paired"
            spread = "" if r["interval"] is None else f" ({r['interval'][0]:.1f}-{r['interval'][1]:.1f})"
            lines.append(
                f"| {label[key]} | {r['average']:.1f}{spread} |"
                f" {', '.join(f'{v:.1f}' for v in r['by_seed'].values())} | {r['median']:.0f} |"
                f" {100 * r['share_25']:.0f} % | {r['seconds_to_end']:.1f} | {ends} |"
                f" {100 * r['touched_by_others']:.1f} % | {said} |"
            )
        corrected = data["holm"].get(world)
        if corrected:
            lines += ["", f"After the fact, Holm's correction over these {len(corrected)} orderings: "
                      + ", ".join(f"`{k}` p = {v:.2g}" for k, v in corrected.items()) + "."]  # fmt: skip
        lines.append("")
    missing = [f"`{r.key}` ({r.label})" for r in rows.EVERY if not any(r.key in by for by in data["averages"].values())]
    if missing:
        lines += [f"Not trained: {'; '.join(missing)}.", ""]
    return "\n".join(lines)


def draw(data: dict, path: Path) -> None:
    """Successes of every row in every world; differences to the row with everything; successes over sensors."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    known = [r for r in rows.EVERY if any(r.key in by for by in data["averages"].values())]
    parts = 3 if sum(r.sensors is not None for r in known) > 2 else 2
    figure, axes = plt.subplots(1, parts, figsize=(5.2 * parts, 4.2), constrained_layout=True)
    compared = [r for r in known if any(r.key in by for by in data["differences"].values())]
    for k, (world, by) in enumerate(data["averages"].items()):
        for i, row in enumerate(known):
            if row.key in by:
                x, values = i + 0.26 * (k - 1), list(by[row.key]["by_seed"].values())
                axes[0].bar(x, by[row.key]["average"], 0.24, color=f"C{k}", label=NAMES[world] if i == 0 else None)
                axes[0].plot([x] * len(values), values, "k.", markersize=4)
        for i, row in enumerate(compared):
            d = data["differences"].get(world, {}).get(row.key)
            if d is not None:
                bar(axes[1], i + 0.2 * (k - 1), d["difference"], d["interval"], k)
    for ax, shown in zip(axes, (known, compared), strict=False):
        ax.set_xticks(range(len(shown)), [r.key.replace("_", "\n") for r in shown], fontsize=8)
    axes[0].axhline(AIM, color="0.6", linewidth=0.8, linestyle="--")
    axes[0].set_ylabel("successes in a row (dots: seeds)")
    axes[0].set_ylim(0, 1.25 * axes[0].get_ylim()[1])  # room for the legend above the dots
    axes[0].legend(fontsize=8, loc="upper right")
    axes[1].axhline(0, color="0.5", linewidth=0.8)
    axes[1].set_ylabel("`full` makes more by (95 %)")
    if parts == 3:
        over_sensors(data, axes[2])
    figure.savefig(path, dpi=130)
    plt.close(figure)


def bar(ax, x: float, middle: float, interval: Sequence[float] | None, color: int, **more) -> None:
    """A value with its interval."""
    error = None if interval is None else [[middle - interval[0]], [interval[1] - middle]]
    ax.errorbar(x, middle, error, fmt="o", capsize=3, color=f"C{color}", **more)


def over_sensors(data: dict, ax) -> None:
    """Successes of each row in which the number of sensors changes, one place a row; an untrained row's is empty."""
    counted = sorted((r for r in rows.EVERY if r.sensors is not None), key=lambda r: (r.sensors, r.key))
    names = []
    for i, row in enumerate(counted):
        of_row = [(k, w, by[row.key]) for k, (w, by) in enumerate(data["averages"].items()) if row.key in by]
        for k, _, r in of_row:
            bar(ax, i + 0.2 * (k - 1), r["average"], r["interval"], k)
        names.append(row.touch if of_row else f"{row.touch}\n(not\ntrained)")
    ax.axhline(AIM, color="0.6", linewidth=0.8, linestyle="--")
    ax.set_xticks(range(len(names)), names, fontsize=8)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("taxels in all")
    ax.set_ylabel("successes in a row (95 % over seeds)")


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
