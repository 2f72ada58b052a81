"""Two runs of the same concealed cases beside each other, with the code of before and of after a change:

    python -m benchmarks.concealed.same_cases before=benchmarks/concealed/published/seed_32005.tgz after=results.json

before, after: results.json of a run, or an archive that holds one. Only cases that both answered are counted; what was
asked of them (hidden effects, tier, rig) must agree. Prints the judging table of both on these cases, and each case
whose answer is another: its hidden effects, and what was said before and after.
"""

from __future__ import annotations

import json
import sys
import tarfile
from pathlib import Path

from benchmarks.concealed import score
from benchmarks.options import options
from dexsim.console.ending import guard
from dexsim.errors import UserError

ASKED = ("group", "decoy", "shape", "tier", "hidden")


def value(line: str, x: float) -> str:
    """Return a figure as text: per cent, or a plain number where the line is a score."""
    return f"{x:.2f}" if any(word in line for word in ("(F1)", "mean", "error removed")) else f"{100 * x:.1f} %"


def load(path: str) -> dict[str, dict]:
    """Return the scored cases by name. Raises UserError."""
    try:
        if path.endswith(".tgz"):
            with tarfile.open(path) as archive:
                member = next(m for m in archive.getmembers() if m.name.endswith("results.json"))
                data = json.load(archive.extractfile(member))
        else:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        return {r["name"]: r for r in data["results"]}
    except (OSError, StopIteration, ValueError, KeyError, tarfile.TarError) as error:
        raise UserError(
            f"{path}: must be a results.json of benchmarks.concealed, or an archive of one: {error}"
        ) from None


def compared(before: dict[str, dict], after: dict[str, dict]) -> tuple[list[dict], list[dict]]:
    """Return the cases that both answered, in one order. Raises UserError where they are not the same cases."""
    names = [n for n in before if n in after]
    for n in names:
        questions = [{k: r[k] for k in ASKED} for r in (before[n], after[n])]
        if questions[0] != questions[1]:
            raise UserError(f"case {n}: {questions[0]} before and {questions[1]} after: not the same cases")
    return [before[n] for n in names], [after[n] for n in names]


def said(r: dict) -> str:
    """Return what a case was answered: verdict, then the names with their confidence."""
    names = [f"{effect}@{joint} {sure:.2f}" for effect, joint, sure, *_ in r["said"]]
    return f"{r['verdict']}: {', '.join(names) or '-'}"


def show(before: list[dict], after: list[dict]) -> str:
    """Return the judging table of both, and what is answered otherwise, as Markdown."""
    old, new = score.table(before), score.table(after)
    out = [f"| {len(before)} cases | before | after | cases |", "|---|---|---|---|"]
    for line in dict.fromkeys([*old, *new]):
        cells = [value(line, t[line]["value"]) if line in t else "" for t in (old, new)]
        out.append(f"| {line.strip()} | {cells[0]} | {cells[1]} | {(new.get(line) or old[line])['n']} |")
    changed = [(a, b) for a, b in zip(before, after, strict=True) if said(a) != said(b)]
    named = lambda r: [(effect, joint) for effect, joint, *_ in r["said"]]  # noqa: E731
    other = [(a, b) for a, b in changed if (a["verdict"], named(a)) != (b["verdict"], named(b))]
    all_ = len(before)
    out += [
        "",
        f"The same answer to the last digit of its confidences in {all_ - len(changed)} of {all_}; the same verdict and"
        f" names in {all_ - len(other)}.",
        "",
    ]
    for a, b in other:
        hidden = ", ".join(f"{effect}@{joint}" for effect, joint in a["hidden"]) or a["decoy"] or "nothing"
        out.append(f"- {a['name']} ({a['group']}, {a['tier']}), hidden {hidden}: {said(a)} -> {said(b)}")
    return "\n".join(out)


def main(argv: list[str]) -> int:
    """Exit status; UserError for what is missing."""
    given = options(argv, {"before": "", "after": ""})
    if not all(given.values()):
        raise UserError("give before=FILE after=FILE, results.json of two runs of the same cases or archives of them")
    print(show(*compared(load(given["before"]), load(given["after"]))))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
