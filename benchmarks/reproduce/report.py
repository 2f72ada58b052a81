"""The tables as Markdown, JSON and a figure, beside the paper's numbers; which of its orderings hold here."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import t as student

from benchmarks.reproduce import jobs, rows
from benchmarks.reproduce.jobs import Job, Plan
from benchmarks.reproduce.rows import Row
from dexsim import intervals

RESAMPLES = 4000
SMOOTH = 15
"""Iterations of the learning curves' running median: after a resume all worlds begin their episodes at once, and dip
together."""
COLUMNS = "row | average (95 %) | by seed | median | s a success (seeds) | s to fall (seeds) | to the cap"
WORLD_NAMES = {"simulation": "simulation", "reality": "other world"}


def trials(found: list[dict]) -> tuple[list[np.ndarray], float, float]:
    """(successes of each seed's trials, mean seconds to fall over seeds, share of trials that lasted to the cap)."""
    successes = [np.array(m["consecutive_successes"]["all"], float) for m in found]
    fall = float(np.mean([m["seconds_to_fall"] for m in found]))
    capped = sum(m["capped"] for m in found) / sum(m["episodes"] for m in found)
    return successes, fall, capped


def rotation_row(row: Row, found: list[dict], rng: np.random.Generator) -> dict[str, Any]:
    """One row of the rotation table in one world, trials of all seeds together."""
    successes, fall, capped = trials(found)
    everything = np.concatenate(successes)
    draws = intervals.nested_means(successes, intervals.singles(len(successes), rng, RESAMPLES), rng)
    average = float(np.mean([s.mean() for s in successes]))
    return {
        "average": average, "interval": [float(x) for x in np.percentile(draws, [2.5, 97.5])],
        "median": float(np.median(everything)),
        "by_seed": [float(s.mean()) for s in successes], "seconds_per_success": fall / average if average else None,
        "seconds_to_fall": fall,
        "seconds_by_seed": [m["seconds_to_fall"] / s.mean() if s.any() else None for m,
                            s in zip(found, successes, strict=True)],
        "fall_by_seed": [m["seconds_to_fall"] for m in found],
        "capped": capped, "trials": len(everything), "cap_s": found[0]["cap_s"],
        "steps": [m["trained_steps"] for m in found],
        "spread": [int(x) for x in np.percentile(everything, np.linspace(5, 95, 10), method="nearest")],
        "_draws": draws,
    }  # fmt: skip


def rotation(plan: Plan, all_jobs: list[Job]) -> tuple[str, dict, Any]:
    """(Markdown, JSON, figure) of what has been judged so far of the paper's rows."""
    rng = np.random.default_rng(0)
    table: dict[str, dict[str, dict]] = {}
    order = list(dict.fromkeys(j.row for j in all_jobs if j.row.paper))
    for row in order:
        for world in jobs.WORLDS:
            found = [m for j in all_jobs if j.row == row and (m := jobs.read(j, plan, world)) is not None]
            if found:
                table.setdefault(row.key, {})[world] = rotation_row(row, found, rng)
    lines = []
    for world in jobs.WORLDS:
        lines += [
            "",
            f"**Judged in {WORLD_NAMES[world]}**",
            "",
            f"| {COLUMNS} | paper: average, median, s, s to fall |",
            "|---" * 8 + "|",
        ]
        for row in order:
            paper = ", ".join(f"{v:g}" for v in row.paper.values())
            lines.append(f"| {row.label} | {_cells(table.get(row.key, {}).get(world))} | {paper} |")
    claims = {world: orderings(table, world) for world in jobs.WORLDS}
    lines += [
        "",
        "**The paper's orderings** (difference with its 95 % interval: bootstrap over seeds and trials, and"
        " at least what seeds do to an average, pooled over the rows; undecided: it holds 0)",
        "",
        "| the paper says | simulation | other world |",
        "|---|---|---|",
    ]
    lines += [
        f"| {a['says']} | {a['here']} | {b['here']} |"
        for a, b in zip(claims["simulation"], claims["reality"], strict=True)
    ]
    return (
        "\n".join(lines) + "\n",
        {"rows": _plain(table), "orderings": claims},
        lambda axes: _rotation_figure(axes, order, table),
    )


def _cells(r: dict[str, Any] | None) -> str:
    """What stands under COLUMNS, but for the row's name."""
    if r is None:
        return "not judged | | | | | "
    seconds = (
        "-"
        if r["seconds_per_success"] is None
        else f"{r['seconds_per_success']:.2f} ({_each(r['seconds_by_seed'], 2)})"
    )
    return (
        f"{r['average']:.1f} ({r['interval'][0]:.1f}-{r['interval'][1]:.1f}) | {_each(r['by_seed'], 1)} |"
        f" {r['median']:.1f} | {seconds} | "
        f"{r['seconds_to_fall']:.1f} ({_each(r['fall_by_seed'], 1)}) | {100 * r['capped']:.0f} %"
    )


def _plain(table: dict[str, dict[str, dict]]) -> dict[str, dict[str, dict]]:
    """As it can be written."""
    return {
        k: {w: {n: v for n, v in r.items() if not n.startswith("_")} for w, r in by.items()} for k, by in table.items()
    }


def _between_seeds(by_seed: list[list[float]]) -> float:
    """Half the 95 % interval of one training's average about its row's: pooled over the rows, since a bootstrap of two
    seeds sees only these two. 0 where no row has two seeds."""
    free = sum(len(s) - 1 for s in by_seed)
    if free == 0:
        return 0.0
    squares = sum(len(s) * float(np.var(s)) for s in by_seed)
    return float(student.ppf(0.975, free)) * math.sqrt(squares / free)


def _difference(a: dict, b: dict, spread: float) -> tuple[float, float, float]:
    """(a's average less b's, and the ends of its 95 % interval): the wider one of the bootstrap's and of what seeds do
    to an average (`spread`, of `_between_seeds`)."""
    difference, between = a["average"] - b["average"], spread * math.sqrt(1 / len(a["by_seed"]) + 1 / len(b["by_seed"]))
    low, high = np.percentile(a["_draws"] - b["_draws"], [2.5, 97.5])
    return difference, min(float(low), difference - between), max(float(high), difference + between)


def _each(values: list[float | None], digits: int) -> str:
    return ", ".join("-" if v is None else f"{v:.{digits}f}" for v in values)


def orderings(table: dict, world: str) -> list[dict[str, str]]:
    """Each claim of the paper and whether it holds: averages by the interval of their difference (`_difference`); times
    by every pair of seeds."""
    spread = _between_seeds([by[world]["by_seed"] for by in table.values() if world in by])
    labels = {r.key: r.label for r in rows.ROTATION}
    out = []
    for first, second, quantity, word in rows.ROTATION_CLAIMS:
        better = "more successes than" if quantity == "average" else "less time a success than"
        says = f"{labels[first]}: {better} {labels[second]}"
        a, b = (table.get(k, {}).get(world) for k in (first, second))
        if a is None or b is None or (quantity != "average" and None in (a[quantity], b[quantity])):
            here = "not judged"
        elif quantity == "average":
            difference, low, high = _difference(a, b, spread)
            here = "holds" if low > 0 else "reversed" if high < 0 else "undecided"
            here += f" ({difference:+.1f}, {low:+.1f} to {high:+.1f})"
        else:
            mine, theirs = ([math.inf if v is None else v for v in r["seconds_by_seed"]] for r in (a, b))
            here = (
                "holds"
                if max(mine) < min(theirs)
                else "reversed"
                if min(mine) > max(theirs)
                else "undecided, the seeds overlap"
            )
            here = "undecided, one seed" if min(len(mine), len(theirs)) == 1 else here
            here += f" ({a[quantity]:.2f} and {b[quantity]:.2f} s)"
        out.append({"says": says, "here": here, "first": first, "second": second, "quantity": quantity, "word": word})
    return out


def _rotation_figure(axes, order: list[Row], table: dict) -> None:
    x = np.arange(len(order))
    for quantity, seeds, ax, unit in (
        ("average", "by_seed", axes[0], "consecutive successes; dots: each seed"),
        ("seconds_per_success", "seconds_by_seed", axes[1], "s a success; dots: each seed"),
    ):
        dots: list[tuple[int, int, float]] = []
        series = [("paper, real hand", [r.paper.get(quantity, np.nan) for r in order], None)]
        for world in jobs.WORLDS:
            found = [table.get(r.key, {}).get(world) for r in order]
            value = [np.nan if f is None or f[quantity] is None else f[quantity] for f in found]
            error = None
            if quantity == "average":
                error = np.array(
                    [
                        [np.nan, np.nan]
                        if f is None
                        else [f["average"] - f["interval"][0], f["interval"][1] - f["average"]]
                        for f in found
                    ]
                ).T
            series.append((WORLD_NAMES[world], value, error))
            for i, f in enumerate(found):
                here = [(i, len(series) - 2, v) for v in (f or {}).get(seeds, ()) if v is not None]
                ax.plot([i + 0.27 * k for i, k, _ in here], [v for _, _, v in here], "k.", markersize=5, zorder=3)
                dots += here
        for k, (label, value, error) in enumerate(series):
            ax.bar(x + 0.27 * (k - 1), value, width=0.25, yerr=error, label=label, capsize=2, ecolor="#777777")
        if quantity == "seconds_per_success":  # a seed that hardly turns must not flatten the others
            top = 1.3 * max((v for _, value, _ in series for v in value if np.isfinite(v)), default=1.0)
            ax.set_ylim(0, top)
            for i, k, v in dots:
                if v > top:
                    ax.annotate(
                        f"{v:.0f} s",
                        (i + 0.27 * k, top),
                        xytext=(i + 0.27 * k, 0.86 * top),
                        ha="center",
                        fontsize=7,
                        arrowprops={"arrowstyle": "->"},
                    )
        ax.set_ylabel(unit)
        ax.set_xticks(x, [r.key.replace("_", "\n") for r in order], fontsize=7)
    axes[0].legend(fontsize=7)


def grasp(plan: Plan, all_jobs: list[Job]) -> tuple[str, dict, Any]:
    """(Markdown, JSON, figure) of the grasp rows judged so far: means over seeds, each seed in brackets."""
    quantities = (
        ("hold_rate", "held", lambda m: m.get("hold_rate")),
        ("force_low", "force, low (N)", lambda m: m.get("contact_force_range_N", [None] * 2)[0]),
        ("force_high", "force, high (N)", lambda m: m.get("contact_force_range_N", [None] * 2)[1]),
        ("torque_low", "torque, low (N m)", lambda m: m.get("joint_torque_range_Nm", [None] * 2)[0]),
        ("torque_high", "torque, high (N m)", lambda m: m.get("joint_torque_range_Nm", [None] * 2)[1]),
        ("force_correlation", "force and command", lambda m: m.get("force_command_correlation")),
        ("torque_correlation", "torque and command", lambda m: m.get("torque_command_correlation")),
    )  # fmt: skip
    order = list(dict.fromkeys(j.row for j in all_jobs))
    table: dict[str, dict[str, dict]] = {}
    lines = []
    for world in jobs.WORLDS:
        lines += [
            "",
            f"**Judged in {WORLD_NAMES[world]}** (5 to 95 % of held episodes; correlations over held"
            " episodes; in brackets each seed)",
            "",
            "| row | " + " | ".join(q[1] for q in quantities) + " | paper: force, torque (no units) |",
            "|---" * (len(quantities) + 2) + "|",
        ]
        for row in order:
            found = [m for j in all_jobs if j.row == row and (m := jobs.read(j, plan, world)) is not None]
            p = row.paper
            paper = f"{p['force_low']:g}-{p['force_high']:g}, {p['torque_low']:g}-{p['torque_high']:g}" if p else "-"
            cells, entry = (
                [],
                {"by_command": [m.get("by_command") for m in found], "steps": [m["trained_steps"] for m in found]},
            )
            for name, _, get in quantities:
                values = [v for m in found if (v := get(m)) is not None]
                entry[name] = values
                cells.append("-" if not values else f"{np.mean(values):.2f} ({', '.join(f'{v:.2f}' for v in values)})")
            table.setdefault(row.key, {})[world] = entry
            lines.append(f"| {row.label} | " + " | ".join(cells) + f" | {paper} |")
    lines += [
        "",
        "**Strength of the correlation of force and command** (the paper: both > force only > torque only;"
        " differences with the 95 % interval of what"
        " seeds do to a correlation, pooled over the rows)",
        "",
    ]
    said: dict[str, list] = {}
    for world in jobs.WORLDS:
        said[world] = []
        each = {k: by[world]["force_correlation"] for k, by in table.items()}
        spread = _between_seeds([v for v in each.values() if v])
        ours = [("force", rows.TORQUE_NEAR.key)] if rows.TORQUE_NEAR.key in table else []
        for first, second in (("both", "force"), ("force", "torque"), *ours):
            here = {"first": first, "second": second} | _stronger(each.get(first) or [], each.get(second) or [], spread)
            said[world].append(here)
            lines.append(f"- {WORLD_NAMES[world]}, {first} > {second}: {here['here']}.")
    return "\n".join(lines) + "\n", {"rows": table, "orderings": said}, lambda axes: _grasp_figure(axes, order, table)


def _stronger(a: list[float], b: list[float], spread: float) -> dict[str, Any]:
    """Whether the correlations `a`, one of each seed, are above `b`: by the interval of their difference and by every
    pair of seeds.
    spread: `_between_seeds` of all rows."""
    if not a or not b:
        return {"here": "not judged"}
    difference, between = float(np.mean(a) - np.mean(b)), spread * math.sqrt(1 / len(a) + 1 / len(b))
    if not spread:
        return {
            "here": f"{'so' if difference > 0 else 'not so'} for one seed each ({a[0]:.3f}, {b[0]:.3f})",
            "difference": difference,
        }
    here = "holds" if difference > between else "reversed" if difference < -between else "undecided"
    pairs = (
        "above in every pair of seeds"
        if min(a) > max(b)
        else "below in every pair of seeds"
        if max(a) < min(b)
        else "the seeds overlap"
    )
    return {
        "here": f"{here} ({difference:+.3f}, {difference - between:+.3f} to {difference + between:+.3f}; {pairs})",
        "difference": difference,
        "interval": [difference - between, difference + between],
    }


def _grasp_figure(axes, order: list[Row], table: dict) -> None:
    for k, row in enumerate(order):
        for world, style in (("simulation", "-"), ("reality", "--")):
            for i, c in enumerate(table.get(row.key, {}).get(world, {}).get("by_command") or []):
                if not c:
                    continue
                label = f"{row.label}, {WORLD_NAMES[world]}" if i == 0 else None
                axes[0].plot(c["command"], c["force_N"], style, color=f"C{k}", label=label, linewidth=1.2)
                axes[1].plot(c["command"], c["torque_Nm"], style, color=f"C{k}", linewidth=1.2)
    for ax, unit in ((axes[0], "contact force of five fingers [N]"), (axes[1], "torque of a flexion joint [N m]")):
        ax.set_xlabel("force command")
        ax.set_ylabel(unit)
    axes[0].legend(fontsize=6)


def learning(plan: Plan, all_jobs: list[Job]) -> dict[Row, list[tuple[np.ndarray, np.ndarray]]]:
    """(millions of steps, successes a minute while training) of each training of each row, as far as there are any:
    rotation."""
    out: dict[Row, list[tuple[np.ndarray, np.ndarray]]] = {}
    for job in all_jobs:
        files = list(job.folder(plan).glob("train_*/progress.csv"))
        if not files:
            continue
        longest = max(files, key=lambda f: f.stat().st_size)  # a resumed training's holds its past
        with open(longest, newline="") as file:
            rows_ = [r for r in csv.DictReader(file) if r.get("task/successes_per_minute")]
        if rows_:
            out.setdefault(job.row, []).append(
                (
                    np.array([float(r["steps"]) / 1e6 for r in rows_]),
                    np.array([float(r["task/successes_per_minute"]) for r in rows_]),
                )
            )
    return out


def _learning_figure(ax, curves: dict[Row, list[tuple[np.ndarray, np.ndarray]]]) -> None:
    for k, (row, seeds) in enumerate(curves.items()):
        for i, (steps, successes) in enumerate(seeds):
            ax.plot(
                steps,
                median_filter(successes, SMOOTH, mode="nearest"),
                "-" if i % 2 == 0 else "--",
                color=f"C{k}",
                linewidth=1.1,
                label=row.label if i == 0 else None,
            )
    ax.set_xlabel("environment steps [million]; dashed: the second seed")
    ax.set_ylabel(f"successes a minute, while training\n(running median of {SMOOTH} iterations)")
    ax.legend(fontsize=7)
    ax.grid(alpha=0.3)


def write(table: str, plan: Plan, all_jobs: list[Job], about: dict[str, Any]) -> list[Path]:
    """<table>.md, .json and .png in the plan's folder (<table>_at_<steps>M of a stage), the same of rows of our own
    (<table>_own..., `benchmarks.reproduce.own`), and the learning curves of the rotation, rotation_learning.png;
    returns the Markdowns' paths."""
    from matplotlib.figure import Figure

    from benchmarks.reproduce import own

    stage = "" if plan.level is None else f"_at_{plan.level / 1e6:.4g}M"
    written = []
    apart = [j for j in all_jobs if not j.row.paper] if table == "rotation" else []
    for name, make, chosen in (
        (table, {"rotation": rotation, "grasp": grasp}[table], [j for j in all_jobs if j not in apart]),
        (f"{table}_own", own.table, apart),
    ):
        if not chosen:
            continue
        text, data, draw = make(plan, chosen)
        steps = sorted(
            {s for j in chosen for w in jobs.WORLDS if (m := jobs.read(j, plan, w)) and (s := m["trained_steps"])}
        )
        trained = (
            "nothing trained yet"
            if not steps
            else f"{steps[0] / 1e6:.1f} M" + (f" to {steps[-1] / 1e6:.1f} M" if steps[-1] > steps[0] else "")
        )
        title = (
            f"The paper's {table} table" if chosen[0].row.paper else f"Rows of our own beside the paper's {table} table"
        )
        head = (
            f"# {title}\n\n`{about['command']}`\n\n{about['device']}; {trained} environment steps a training,"
            f" {len({j.seed for j in chosen})} seed(s) a row; "
            + ", ".join(f"{n} trials a seed in {WORLD_NAMES[w]}" for w, n in plan.episodes.items())
            + (f", ended after {plan.cap:g} s at the latest" if plan.task == "rotate" else "")
            + ".\n"
        )
        path = plan.out / f"{name}{stage}.md"
        path.write_text(head + text)
        path.with_suffix(".json").write_text(json.dumps({"about": about, **data}, indent=1) + "\n")
        figure = Figure(figsize=(11, 3.6), layout="constrained")
        draw(figure.subplots(1, 2))
        figure.savefig(path.with_suffix(".png"), dpi=110)
        written.append(path)
    if table == "rotation" and plan.level is None and (curves := learning(plan, all_jobs)):
        figure = Figure(figsize=(8, 4), layout="constrained")
        _learning_figure(figure.subplots(), curves)
        figure.savefig(plan.out / f"{table}_learning.png", dpi=110)
    return written
