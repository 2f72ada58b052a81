"""Rows of the paper's ablation tables, and of ours: each is trained and judged by the same commands.

    python -m benchmarks.rows table=rotation|grasp|fingertips|skin [rows=full,no_touch] [seeds=1,2] [gpus=0,1]
                              [iterations=N] [out=out/rows] [judge=KEY=VALUE,...] [on=slurm|dask]
                              [any setting of train.py]

table: `rotation` and `grasp` are the paper's tables, `fingertips` asks with less help from the palm what each sense is
worth, `skin` what touch on palm and links adds to a grasp. rows: by name (all). seeds: one training each. gpus: as many
trainings at a time as there are names; none: one, on the CPU. judge: settings of `dexsim play`, such as episodes=256.
Goes on where it was interrupted: what was judged is not repeated, and a training resumes from its last.pt.

Prints a table beside the paper's numbers, and every ordering that the paper claims: the difference of means over seeds
with its 95 % interval (Welch), which needs two seeds of each row. Writes OUT/TABLE.json.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks import tools
from benchmarks.options import options
from dexsim.console import jobs
from dexsim.errors import UserError

SETTINGS = {"table": "", "rows": "", "seeds": "1,2", "gpus": "", "out": "out/rows", "judge": ""}
OBSERVE, REWARD = "task.observe", "task.rewards"


@dataclass(frozen=True)
class Row:
    """One row: label, settings of train.py, and the paper's number (nan: it has none)."""

    label: str
    settings: tuple[str, ...] = ()
    paper: float = float("nan")


@dataclass(frozen=True)
class Table:
    """One table: task, the measure that is compared, its rows, and pairs (more, fewer) that the paper claims."""

    task: str
    measure: str
    rows: dict[str, Row]
    claims: tuple[tuple[str, str], ...]


NO_FORCE, NO_CENTRE = f"{OBSERVE}.contact_force=false", f"{OBSERVE}.contact_centre=false"
PLAIN = f"{OBSERVE}.force_weighted=false"
TABLES = {
    "rotation": Table(  # paper: "Ablation analysis of multiple observation combinations in the real world"
        "rotate",
        "consecutive_successes",
        {
            "full": Row("everything, 6D orientation", (), 25.1),
            "quaternion": Row("quaternion instead of 6D", (f"{OBSERVE}.orientation=quaternion",), 2.9),
            "plain_centre": Row("contact centre not weighted by force", (PLAIN,), 12.2),
            "no_force": Row("no contact force", (NO_FORCE,), 13.2),
            "neither": Row("neither force nor weighting", (NO_FORCE, PLAIN), 7.5),
            "no_touch": Row("no touch at all", (NO_FORCE, NO_CENTRE), 1.1),
            "no_orientation": Row("no orientation", (f"{OBSERVE}.orientation=none",), 11.2),
            "fixed": Row("everything, trained without randomization", ("randomize=rotate_fixed",)),
            "paper_critic": Row("everything, the paper's critic", ("task.critic=paper",)),
        },
        (
            *(("full", r) for r in ("quaternion", "plain_centre", "no_force", "neither", "no_touch", "no_orientation")),
            *(("plain_centre", "neither"), ("no_force", "neither"), ("neither", "no_touch")),
            ("no_orientation", "quaternion"),
        ),
    ),
    "grasp": Table(  # paper: "Ablation on the rewards R_Force and R_torque"
        "grasp",
        "force_command_correlation",
        {
            "both": Row("R_force + R_torque"),
            "force": Row("R_force only", (f"{REWARD}.torque=0",)),
            "torque": Row(
                "R_torque only, with equal companions",
                tuple(
                    f"{REWARD}.{r}" for r in ("force=0", "force_near=0", "worst=0", "torque_near=1", "torque_worst=1")
                ),
            ),
        },
        (("both", "force"), ("force", "torque")),
    ),
    "skin": Table(  # ours: does touch on palm and links pay?
        "grasp",
        "hold_rate",
        {
            "fingertips": Row("600 taxels on fingertips", ("hand=xhand",)),
            "whole": Row("200 more on palm and links", ("hand=xhand_skin",)),
            "none": Row("no touch", ("task.observe.touch=false",)),
        },
        (),
    ),
    "fingertips": Table(
        "rotate_fingertips",
        "consecutive_successes",
        {
            "full": Row("everything", (), 25.1),
            "plain_centre": Row("contact centre not weighted by force", (PLAIN,), 12.2),
            "no_force": Row("no contact force", (NO_FORCE,), 13.2),
            "no_touch": Row("no touch at all", (NO_FORCE, NO_CENTRE), 1.1),
            "no_pose": Row("no pose of the object", (f"{OBSERVE}.orientation=none",), 11.2),
            "taxels_120": Row("120 taxels, 24 a finger", (f"{OBSERVE}.taxels=24",)),
            "taxels_5": Row("5 taxels, one a finger", (f"{OBSERVE}.taxels=1",)),
            "bits": Row("5 contact bits", (f"{OBSERVE}.taxels=bits", NO_CENTRE)),
        },
        tuple(("full", row) for row in ("plain_centre", "no_force", "no_touch", "no_pose")),
    ),
}


def measured(path: Path, measure: str) -> float:
    """Return a measure from a metrics.json, nan where it has none (nothing was held); of counts, the mean."""
    value = json.loads(path.read_text(encoding="utf-8"))[measure]
    value = value["average"] if isinstance(value, dict) else value
    return float("nan") if value is None else float(value)


def job_of(folder: Path, task: str, settings: list[str], judge: list[str], device: str) -> jobs.Job:
    """Return what trains and judges one row with one seed: judged/metrics.json in its folder."""
    run = folder / "run"
    judging = (f"checkpoint={run / 'policy.pt'}", f"device={device}", "video=false", *judge)
    commands = (
        ("train", f"task={task}", f"device={device}", *settings, "final_episodes=0", f"out={run}"),
        ("play", *judging, f"out={folder / 'judged'}"),
    )
    return jobs.Job(commands, folder, resumes=True)


def compare(more: list[float], fewer: list[float]) -> tuple[float, float, float, str]:
    """Return the difference of means, its 95 % interval (Welch), and whether it holds; undecided with one seed."""
    difference = float(np.mean(more) - np.mean(fewer))
    if min(len(more), len(fewer)) < 2:
        return difference, float("nan"), float("nan"), "undecided, one seed"
    low, high = stats.ttest_ind(more, fewer, equal_var=False).confidence_interval(0.95)
    return difference, float(low), float(high), "holds" if low > 0 else "the reverse holds" if high < 0 else "undecided"


def show(table: Table, found: dict[str, list[float]]) -> str:
    """Return the table and the paper's orderings as Markdown."""
    out = [f"| {table.measure} | mean | by seed | paper |", "|---|---|---|---|"]
    for name, values in found.items():
        row = table.rows[name]
        seeds = ", ".join(f"{v:.4g}" for v in values)
        out.append(f"| {row.label} | {np.mean(values):.4g} | {seeds} | {'' if row.paper != row.paper else row.paper} |")
    out += ["", "| the paper says | difference | 95 % | so |", "|---|---|---|---|"]
    for a, b in table.claims:
        if a in found and b in found:
            difference, low, high, word = compare(found[a], found[b])
            claim = f"{table.rows[a].label} > {table.rows[b].label}"
            out.append(f"| {claim} | {difference:.4g} | {low:.4g} to {high:.4g} | {word} |")
    return "\n".join(out)


def main(argv: list[str]) -> dict[str, Any]:
    settings: list[str] = []
    own = options(argv, SETTINGS, settings)
    if own["table"] not in TABLES:
        raise UserError(f"table={own['table']}: must be {', '.join(TABLES)}")
    table = TABLES[own["table"]]
    names = own["rows"].split(",") if own["rows"] else list(table.rows)
    if unknown := [n for n in names if n not in table.rows]:
        raise UserError(f"rows={unknown[0]}: must be of {', '.join(table.rows)}")
    out = Path(own["out"]).expanduser().resolve()
    gpus = [g for g in own["gpus"].split(",") if g]
    engine, settings = jobs.taken(settings, gpus)
    device = "cuda" if gpus or engine.on != "local" else "cpu"
    each = [(name, seed) for seed in tools.numbers(own["seeds"], "seeds") for name in names]
    work = [
        job_of(
            out / own["table"] / f"{name}_seed_{seed}", table.task,
            [*table.rows[name].settings, f"seed={seed}", *settings],
            [f"seed={1000 + seed}", *(x for x in own["judge"].split(",") if x)], device,
        )
        for name, seed in each
    ]  # fmt: skip
    tools.run(work, engine)
    values = [measured(job.folder / "judged" / "metrics.json", table.measure) for job in work]
    found = {name: [v for (n, _), v in zip(each, values, strict=True) if n == name] for name in names}
    result = {"benchmark": "rows", "table": own["table"], "measure": table.measure, "found": found}
    (out / f"{own['table']}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(show(table, found))
    print(json.dumps(result), flush=True)
    return result


if __name__ == "__main__":
    tools.command(main, __doc__)
