"""Rows whose trainings are not paired: python -m benchmarks.touch_matters.unpaired out=FOLDER[,FOLDER,..][:FOLDER,..]
[world=training] [claims=no_pose:successes,no_pose:seconds] [figure=FILE.png].

A seed does not repeat on a GPU, so trainings of the same seed share no more than others do. Of every row against the
one with everything, over trainings and with Welch's 95 % interval: the difference in successes in a row, and the ratio
of seconds a success (of logarithms: a row that takes six times as long varies six times as much); Holm's correction
over `claims`, the ones fixed before. Beside it the interval of the difference that takes every row's trainings to
spread alike, which one training has, too. Rows that differ in the number of taxels alone also give a slope: successes
over the binary logarithm of that number. Trainings of several folders count as one set, those after a `:` as another,
of other steps; the figure shows the paper's rows as a share of what everything makes, in each set and in the paper,
and the rows that differ in how much touch there is.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks import tools
from benchmarks.reproduce.rows import ROTATION
from benchmarks.touch_matters import analysis, rows
from dexsim.errors import UserError

OWN = {"out": "out/touch_matters", "world": "training", "claims": "no_pose:successes,no_pose:seconds",
       "figure": ""}  # fmt: skip
GRADED = ("taxels_5", "taxels_25", "taxels_120", rows.FULL.key)
"""Rows that have nothing but the number of taxels between them."""
ALIKE = tuple(r.key for r in rows.EVERY if r.key != "no_pose")
"""Rows that make about as many successes, so that their trainings may be taken to spread alike."""


PAPER = {{"no_orientation": "no_pose"}.get(r.key, r.key): r.paper["average"] / ROTATION[0].paper["average"]
         for r in ROTATION}  # fmt: skip
"""What each row of the paper's makes of what its first does; where the paper drops the orientation, ours drops the
position with it."""


def gathered(folders: list[Path], world: str) -> tuple[dict[str, dict[str, np.ndarray]], int]:
    """Row -> successes and seconds: averages [S] of its S trainings; and their steps. Raises UserError where nothing is
    judged, not all at the same steps, or one training twice."""
    found: dict[str, dict[str, list[float]]] = {}
    steps: dict[int, str] = {}
    once: dict[tuple, str] = {}
    for folder in folders:
        for (key, where), seeds in analysis.read(folder).items():
            if where != world:
                continue
            for seed, data in seeds.items():
                place, same = f"{folder}/{key}/seed{seed}", (key, seed, json.dumps(data["metrics"]["trials"]))
                if same in once:
                    raise UserError(f"out: {place} is the training of {once[same]} again, trial by trial; give it once")
                once[same] = place
                steps.setdefault(data["steps"], place)
                row = found.setdefault(key, {"successes": [], "seconds": []})
                row["successes"].append(float(analysis.trials(data).mean()))
                row["seconds"].append(float(data["metrics"]["seconds_per_success"] or np.inf))
    if not found:
        raise UserError(f"out={','.join(map(str, folders))}: nothing judged there in world={world}")
    if len(steps) > 1:
        told = "; ".join(f"{n / 1e6:.1f} M in {where}" for n, where in sorted(steps.items()))
        raise UserError(f"out: trainings of different steps cannot be compared: {told}. Judge all at one iteration")
    return {key: {k: np.array(v) for k, v in row.items()} for key, row in found.items()}, next(iter(steps))


def welch(a: np.ndarray, b: np.ndarray) -> dict:
    """Difference of the means of a [S] and b [T], each of at least two trainings, with Welch's 95 % interval and p."""
    test = stats.ttest_ind(a, b, equal_var=False)
    interval = test.confidence_interval()
    return {"difference": float(a.mean() - b.mean()), "interval": [float(interval.low), float(interval.high)],
            "p": float(test.pvalue)}  # fmt: skip


def pooled_spread(by: dict[str, np.ndarray]) -> tuple[float, int]:
    """Standard deviation of a training about its row's mean, pooled over the rows that have two or more, and its
    degrees of freedom. Rows that hardly succeed vary less and are left out (ALIKE)."""
    each = [v for k, v in by.items() if k in ALIKE and len(v) > 1]
    free = sum(len(v) - 1 for v in each)
    return (float(np.sqrt(sum(((v - v.mean()) ** 2).sum() for v in each) / free)) if free else np.nan), free


def alike(a: np.ndarray, b: np.ndarray, spread: float, free: int) -> list[float]:
    """95 % interval of the difference of the means of a [S] and b [T] where a training of either varies by `spread`,
    known to `free` degrees of freedom; one training is enough."""
    half = stats.t.ppf(0.975, free) * spread * np.sqrt(1 / len(a) + 1 / len(b))
    difference = a.mean() - b.mean()
    return [float(difference - half), float(difference + half)]


def slope(by: dict[str, np.ndarray]) -> dict | None:
    """Successes a doubling of the number of taxels, by least squares over all trainings of GRADED rows, with Student's
    95 % interval; None with fewer than three trainings or one number of taxels."""
    number = {r.key: r.sensors for r in rows.EVERY}
    pairs = [(np.log2(number[k]), v) for k in GRADED if k in by for v in by[k]]
    if len(pairs) < 3 or len({x for x, _ in pairs}) < 2:
        return None
    fit = stats.linregress(*zip(*pairs, strict=True))
    half = stats.t.ppf(0.975, len(pairs) - 2) * fit.stderr
    return {"slope": float(fit.slope), "interval": [float(fit.slope - half), float(fit.slope + half)],
            "trainings": len(pairs)}  # fmt: skip


def claimed(text: str) -> list[tuple[str, str]]:
    """ROW:successes and ROW:seconds. Raises UserError."""
    keys = [r.key for r in rows.EVERY]
    pairs = []
    for item in filter(None, text.split(",")):
        key, _, what = item.partition(":")
        if key not in keys or what not in ("successes", "seconds"):
            raise UserError(f"claims={item}: must be ROW:successes or ROW:seconds, ROW of {', '.join(keys)}")
        pairs.append((key, what))
    return pairs


def spoken(value: float, interval: Sequence[float] | None, form: str) -> str:
    """'24.6 (20.5 to 28.7)'."""
    return f"{value:{form}}" + ("" if interval is None else f" ({interval[0]:{form}} to {interval[1]:{form}})")


def markdown(found: dict[str, dict[str, np.ndarray]], claims: list[tuple[str, str]]) -> str:
    """Table of the rows, Holm's correction and the slope."""
    lines = ["| row | trainings | successes in a row (95 %) | by training | `full` makes more by (95 %) | were all to"
             " spread alike | s a success | times that of `full` (95 %) |", "|---" * 8 + "|"]  # fmt: skip
    p = {}
    spread, free = pooled_spread({k: v["successes"] for k, v in found.items()})
    for row in rows.EVERY:
        if row.key not in found:
            continue
        each, full = found[row.key], found.get(rows.FULL.key)
        more = times = same = ""
        if row != rows.FULL and full is not None and row.key in ALIKE and free:
            ends = alike(full["successes"], each["successes"], spread, free)
            same = spoken(full["successes"].mean() - each["successes"].mean(), ends, "+.1f")
        if row != rows.FULL and full is not None and min(len(v["successes"]) for v in (each, full)) >= 2:
            by = {"successes": welch(full["successes"], each["successes"]),
                  "seconds": welch(np.log(each["seconds"]), np.log(full["seconds"]))}  # fmt: skip
            more = spoken(by["successes"]["difference"], by["successes"]["interval"], "+.1f")
            times = spoken(np.exp(by["seconds"]["difference"]), np.exp(by["seconds"]["interval"]), ".2f")
            p |= {f"{row.key}:{what}": w["p"] for what, w in by.items() if (row.key, what) in claims}
        own = each["successes"]
        average = spoken(own.mean(), analysis.over_seeds(own) if len(own) > 1 else None, ".1f")
        lines.append(f"| {row.label} | {len(own)} | {average} | {', '.join(f'{v:.1f}' for v in own)} | {more} |"
                     f" {same} | {np.exp(np.log(each['seconds']).mean()):.2f} | {times} |")  # fmt: skip
    if free:
        lines += ["", f"A training lies {spread:.1f} from its row's average (standard deviation, {free} degrees of"
                  " freedom, without the pose's)."]  # fmt: skip
    if p:
        lines += ["", "Holm's correction over what was fixed before: "
                  + ", ".join(f"`{k}` p = {v:.2g}" for k, v in analysis.holm(p).items()) + "."]  # fmt: skip
    graded = slope({k: v["successes"] for k, v in found.items()})
    if graded is not None:
        lines += ["", f"A doubling of the taxels: {spoken(graded['slope'], graded['interval'], '+.2f')} successes"
                  f" ({graded['trainings']} trainings)."]  # fmt: skip
    return "\n".join(lines)


def shares(found: dict[str, dict[str, np.ndarray]]) -> dict[str, tuple[float, list[float]]]:
    """Row of the paper's -> what it makes of what everything does, with Welch's interval of the difference over the
    latter's mean (so that it holds 1 where the difference is undecided)."""
    full = found[rows.FULL.key]["successes"]
    out = {}
    for row in rows.PAPER[1:]:
        if row.key in found and min(len(full), len(found[row.key]["successes"])) >= 2:
            w = welch(full, found[row.key]["successes"])
            ends = [float(1 - v / full.mean()) for v in w["interval"]]
            out[row.key] = (float(1 - w["difference"] / full.mean()), ends[::-1])
    return out


def draw(sets: list[tuple[dict[str, dict[str, np.ndarray]], int]], path: Path) -> None:
    """Left: share of what everything makes of each of the paper's rows, in each set and in the paper. Right, of the
    first set: the trainings of the rows that differ in how much touch there is."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    lines = sum(any(r.key in found for found, _ in sets) for r in rows.PAPER)
    figure, axes = plt.subplots(1, 2, figsize=(13.4, 1.8 + 0.5 * lines), constrained_layout=True, width_ratios=(8, 5))
    over_rows(sets, axes[0])
    over_sensors(*sets[0], axes[1])
    figure.savefig(path, dpi=110)
    plt.close(figure)


def over_rows(sets: list[tuple[dict[str, dict[str, np.ndarray]], int]], ax) -> None:
    """One line a row of the paper's: its share of what everything makes, in each set and in the paper."""
    by = [(shares(found), found[rows.FULL.key]["successes"], steps) for found, steps in sets]
    shown = [r for r in rows.PAPER if any(r.key in one for one, _, _ in by)][::-1]
    there = [(100 * PAPER[r.key], i) for i, r in enumerate(shown) if r.key in PAPER]
    ax.plot([x for x, _ in there], [i for _, i in there], "kx", markersize=8, label="the paper's hand")
    for k, (one, full, steps) in enumerate(by):
        at = [(i, *one[r.key]) for i, r in enumerate(shown) if r.key in one]
        middle = np.array([100 * m for _, m, _ in at])
        ends = np.array([[100 * v for v in interval] for *_, interval in at]).reshape(-1, 2).T
        ax.errorbar(middle, [i + 0.12 * (2 * k - len(by) + 1) for i, *_ in at], xerr=np.abs(ends - middle), fmt="o",
                    capsize=3, color=f"C{k}",
                    label=f"here, {steps / 1e6:.0f} M steps; everything makes {full.mean():.1f} in a row")  # fmt: skip
    ax.axvline(100, color="0.5", linewidth=0.8)
    ax.set_yticks(range(len(shown)), [r.label for r in shown])
    ax.set_ylim(-0.6, len(shown) - 0.1 + 0.35 * (1 + len(by)))  # room for the legend above
    ax.set_xlim(left=0)
    ax.set_xlabel("successes in a row, % of what the hand with everything makes (95 %)")
    ax.legend(fontsize=8, loc="upper left", frameon=False)


def over_sensors(found: dict[str, dict[str, np.ndarray]], steps: int, ax) -> None:
    """A dot a training, and the mean with its interval, of the rows in which the amount of touch changes. The interval
    takes trainings to spread alike in all rows, so that those of two or three can be seen beside those of many."""
    counted = sorted((r for r in rows.EVERY if r.sensors is not None and r.key in found),
                     key=lambda r: (r.sensors, r.key))  # fmt: skip
    spread, free = pooled_spread({k: v["successes"] for k, v in found.items()})
    for i, row in enumerate(counted):
        each = found[row.key]["successes"]
        ax.plot([i + 0.12] * len(each), each, ".", color="0.55", markersize=5)
        if free:
            half = stats.t.ppf(0.975, free) * spread / np.sqrt(len(each))
            analysis.bar(ax, i - 0.12, float(each.mean()), [each.mean() - half, each.mean() + half], 0)
    ax.set_xticks(range(len(counted)), [r.touch for r in counted], fontsize=8)
    ax.set_xlabel("taxels in all, or bits")
    ax.set_xlim(-0.5, len(counted) - 0.5)
    ax.set_ylim(bottom=0)
    ax.set_ylabel("successes in a row (95 %; dots: trainings)")
    ax.set_title(f"{steps / 1e6:.0f} M steps", fontsize=9)


def main(argv: list[str]) -> None:
    own, rest = tools.split(argv, OWN)
    if rest:
        raise UserError(f"{rest[0]!r}: the settings are {', '.join(OWN)}")
    if own["world"] not in rows.WORLDS:
        raise UserError(f"world={own['world']}: must be {', '.join(rows.WORLDS)}")
    claims = claimed(own["claims"])
    sets = [gathered([Path(p).expanduser() for p in one.split(",")], own["world"]) for one in own["out"].split(":")]
    for found, steps in sets:
        print(f"{steps / 1e6:.1f} M steps a training\n\n{markdown(found, claims)}\n")
    if own["figure"]:
        lacking = [steps for found, steps in sets if rows.FULL.key not in found]
        if lacking:
            raise UserError(f"figure={own['figure']}: no training with everything at {lacking[0] / 1e6:.1f} M steps")
        draw(sets, Path(own["figure"]).expanduser())


if __name__ == "__main__":
    tools.command(main, __doc__)
