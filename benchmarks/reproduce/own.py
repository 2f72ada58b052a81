"""Rows of our own beside the paper's rotation table: each against the row with everything that was trained for as many
steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.reproduce import jobs, report, rows
from benchmarks.reproduce.jobs import Job, Plan
from dexsim import intervals

REFERENCE = rows.ROTATION[0]
"""What rows of our own are compared with; each differs from it in one setting."""


def judged_at(row: rows.Row, plan: Plan, world: str, steps: float) -> list[dict]:
    """Metrics of every seed of a row that `plan.out` holds judged in `world` after `steps` environment steps."""
    seeds = sorted(int(n) for p in (plan.out / row.key).glob("seed*") if (n := p.name.removeprefix("seed")).isdigit())
    return [m for seed in seeds if (m := jobs.read_at(Job(row, seed), plan, world, steps)) is not None]


def reference(plan: Plan, world: str, steps: float, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """The paper's rows by key, as far as they have been judged in `world` after `steps` environment steps."""
    found = {row: judged_at(row, plan, world, steps) for row in rows.ROTATION}
    return {row.key: report.rotation_row(row, metrics, rng) for row, metrics in found.items() if metrics}


def compared(row: dict[str, Any], others: dict[str, dict[str, Any]], spread: float) -> dict[str, Any]:
    """A row's difference to the REFERENCE among `others`: `difference` in average successes, its 95 % `interval`, and
    what it says.
    spread: `report._between_seeds` of all rows of these steps; 0 where none has two seeds."""
    if REFERENCE.key not in others:
        return {"difference": None, "interval": None, "here": f"`{REFERENCE.key}` was not judged at these steps"}
    difference, low, high = report._difference(row, others[REFERENCE.key], spread)
    word = "more" if low > 0 else "fewer" if high < 0 else "undecided"
    word = word if spread else "undecided, one seed a row"
    return {
        "difference": difference,
        "interval": [low, high],
        "here": f"{word} ({difference:+.1f}, {low:+.1f} to {high:+.1f})",
    }


def lost(found: dict[str, list[dict]], rng: np.random.Generator) -> dict[str, Any] | None:
    """Share of its own simulation's successes that a row loses in the other world: of the averages, its 95 % bootstrap
    over seeds and trials, and by seed. found: metrics of each world, seed by seed. None where a seed is missing in one,
    or none succeeds."""
    simulated, other = (report.trials(found[w])[0] if found.get(w) else [] for w in jobs.WORLDS)
    if not simulated or len(simulated) != len(other) or not all(s.mean() > 0 for s in simulated):
        return None
    picks = intervals.singles(len(simulated), rng, report.RESAMPLES)
    kept, all_of_it = (intervals.nested_means(x, picks, rng) for x in (other, simulated))
    draws = 1 - kept / np.maximum(all_of_it, 1e-9)
    return {
        "lost": 1 - float(np.mean([s.mean() for s in other]) / np.mean([s.mean() for s in simulated])),
        "interval": [float(x) for x in np.percentile(draws, [2.5, 97.5])],
        "by_seed": [1 - float(b.mean() / a.mean()) for a, b in zip(simulated, other, strict=True)],
    }


def table(plan: Plan, all_jobs: list[Job]) -> tuple[str, dict, Any]:
    """(Markdown, JSON, figure) of what has been judged so far of rows of our own."""
    rng = np.random.default_rng(0)
    order = list(dict.fromkeys(j.row for j in all_jobs))
    found = {
        (row, world): [m for j in all_jobs if j.row == row and (m := jobs.read(j, plan, world)) is not None]
        for row in order
        for world in jobs.WORLDS
    }
    ours = {
        row.key: {w: report.rotation_row(row, found[row, w], rng) for w in jobs.WORLDS if found[row, w]}
        for row in order
    }
    lines, said, against = [], {}, {}
    for world in jobs.WORLDS:
        levels: list[float] = []  # steps that rows of ours were judged after; seeds of different steps are not compared
        for by in ours.values():
            steps = by[world]["steps"] if world in by else []
            if steps and max(steps) - min(steps) < plan.per and all(abs(steps[0] - s) >= plan.per for s in levels):
                levels.append(steps[0])
        at = {}
        for level in levels:
            theirs = reference(plan, world, level, rng)
            alike = [
                by[world]["by_seed"]
                for by in ours.values()
                if world in by and all(abs(s - level) < plan.per for s in by[world]["steps"])
            ]
            at[level] = (theirs, report._between_seeds([*(r["by_seed"] for r in theirs.values()), *alike]))
        lines += [
            "",
            f"**Judged in {report.WORLD_NAMES[world]}**",
            "",
            f"| {report.COLUMNS} | against the first row (95 %) |",
            "|---" * 8 + "|",
        ]
        for level, (theirs, _) in at.items():
            lines.append(
                f"| {REFERENCE.label} (the paper's first row), {level / 1e6:.3g} M steps |"
                f" {report._cells(theirs.get(REFERENCE.key))} | |"
            )
            against.setdefault(f"{level:.0f}", {}).update(
                {world: theirs[REFERENCE.key]} if REFERENCE.key in theirs else {}
            )
        for row in order:
            r = ours[row.key].get(world)
            here = {"difference": None, "interval": None, "here": "its seeds have different steps" if r else ""}
            for level, (theirs, spread) in at.items():
                if r and all(abs(s - level) < plan.per for s in r["steps"]):
                    here = compared(r, theirs, spread) | {"to_steps": level}
            said.setdefault(row.key, {})[world] = here
            lines.append(f"| {row.label} | {report._cells(r)} | {here['here']} |")
    lines += [
        "",
        "(Differences of averages; their intervals are the wider one of the bootstrap over seeds and trials"
        " and of what seeds do to an average,"
        " pooled over all rows judged after the same steps. Undecided: the interval holds 0.)",
        "",
        "**Lost in the other world** (share of a row's successes in its own simulation; bootstrap over its seeds"
        " and trials)",
        "",
        "| row | lost (95 %) | by seed |",
        "|---|---|---|",
    ]
    losses = {}
    if len(against) == 1:
        found |= {(REFERENCE, w): judged_at(REFERENCE, plan, w, float(level)) for w in jobs.WORLDS for level in against}
    for row in dict.fromkeys(row for row, _ in sorted(found, key=lambda f: f[0] != REFERENCE)):
        share = losses[row.key] = lost({w: found[row, w] for w in jobs.WORLDS}, rng)
        lines.append(
            f"| {row.label} | "
            + (
                "not judged in both | |"
                if share is None
                else f"{100 * share['lost']:.0f} % ({100 * share['interval'][0]:.0f} to"
                f" {100 * share['interval'][1]:.0f}) | "
                f"{', '.join(f'{100 * v:.0f} %' for v in share['by_seed'])} |"
            )
        )
    if (share := losses.get(rows.UNRANDOMIZED.key)) is not None:
        bites = sum(v >= 1 / 3 for v in share["by_seed"])
        lines += [
            "",
            f"Trained without randomization, {bites} of {len(share['by_seed'])} seeds lose at least a third"
            " of their successes in the other world.",
        ]
    data = {
        "rows": report._plain(ours),
        "against": said,
        "reference": report._plain(against),
        "lost_in_the_other_world": losses,
    }
    return "\n".join(lines) + "\n", data, lambda axes: draw(axes, order, ours, said, against)


def draw(axes, order: list[rows.Row], ours: dict, said: dict, against: dict) -> None:
    """Successes of every row in both worlds on the left, the reference first; differences to it on the right."""
    names = [REFERENCE.key] * len(against) + [r.key for r in order]
    for k, world in enumerate(jobs.WORLDS):
        values = [by.get(world) for by in against.values()] + [ours[r.key].get(world) for r in order]
        for i, v in enumerate(values):
            if v is None:
                continue
            error = [[v["average"] - v["interval"][0]], [v["interval"][1] - v["average"]]]
            axes[0].bar(
                i + 0.36 * (k - 0.5),
                v["average"],
                0.34,
                color=f"C{k + 1}",
                yerr=error,
                capsize=2,
                ecolor="#777777",
                label=report.WORLD_NAMES[world] if i == 0 else None,
            )
            axes[0].plot([i + 0.36 * (k - 0.5)] * len(v["by_seed"]), v["by_seed"], "k.", markersize=5, zorder=3)
        for i, row in enumerate(order):
            here = said[row.key][world]
            if here["difference"] is not None:
                d, (low, high) = here["difference"], here["interval"]
                axes[1].errorbar(
                    i + 0.2 * (k - 0.5),
                    d,
                    yerr=[[d - low], [high - d]],
                    fmt="o",
                    color=f"C{k + 1}",
                    capsize=3,
                    label=report.WORLD_NAMES[world] if i == 0 else None,
                )
    axes[0].set_xticks(range(len(names)), [n.replace("_", "\n") for n in names], fontsize=8)
    axes[0].set_ylabel("consecutive successes; dots: each seed")
    axes[1].set_xticks(range(len(order)), [r.key.replace("_", "\n") for r in order], fontsize=8)
    axes[1].set_ylabel(f"more successes than `{REFERENCE.key}`\nat the same steps (95 %)")
    axes[1].axhline(0, color="0.5", linewidth=0.8)
    for ax in axes:
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=7)
