"""Checks the English of pages and docstrings, and names that came back (part of `make lint`).

    python -m tools.prose          # fail where a folder is worse than tools/prose.json allows
    python -m tools.prose report   # every folder's figures, and the worst sentences
    python -m tools.prose record   # lower what tools/prose.json allows to today's figures; it never raises them,
                                      and takes them as they are where there is no such file

Pages: words a sentence on average (at most 22) and the longest sentence (at most 45). Docstrings of functions: how many
do not begin with a verb, and how many begin with a word such as "What" or "Whether". Names: how many are words that
this project used with a meaning of its own. `tools/prose.json` holds what each folder still has of these; a folder that
is not in it has none. The rewrite of `dexsim/gap` is a task of its own, so that folder is left out.
"""

from __future__ import annotations

import ast
import json
import re
import statistics
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ALLOWED = ROOT / "tools" / "prose.json"
MEAN, LONGEST = 22.0, 45
"""Words of a sentence: on average over a page's folder, and at most."""
PAGES = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "docs")
CODE = ("dexsim", "tests", "benchmarks", "tools", "docs/scripts")
LEFT_OUT = ("dexsim/gap", "dexsim/assets")
WRITTEN = ("docs/results/index.md", "docs/reference/summary.md")
"""Pages that a script writes."""
CLAUSES = {"what", "whether", "of", "how", "where", "which", "who", "that", "as", "so"}
"""First words that make a clause of a docstring where a verb is meant."""
PRIVATE = {"told", "left", "kept", "felt", "earned", "shown", "apart", "asked", "borne", "astray"}
"""Names that this project used with several meanings of its own."""
LABELS = {"property", "cached_property", "fixture", "setter", *"observe reward done command event metric".split()}
"""Decorators of methods whose docstring names a thing."""
VERBS = set(
    """
    cap click feel hear
    abort accept accumulate act adapt add adjust advance aggregate aim align allocate allow answer append apply arrange
    ascend ask assemble assert assign attach average await bake balance begin bend bind blend blur bound break bring
    broadcast bucket build bundle cache call capture carry cast catch centre change check choose circle claim clamp
    classify clean clear climb clip close coerce collect colour combine command compare compensate compile complain
    complete compose compress compute concatenate condition confirm connect construct continue convert copy correct
    count couple cover create crop cross cut cycle damp decide declare decode default define delay delete derive
    descend describe detach detect determine diagnose differ differentiate discard dispatch display dispose divide do
    double download drag draw drive drop dry dump echo embed empty encode end enforce ensure enter enumerate equal
    escape estimate evaluate exceed exchange exclude execute exit expand expect explain export expose express extend
    extract fail fake feed fetch fill filter find finish fire fit fix flag flatten flip flush fold follow force
    forget format forward free freeze gather generate get give go group grow guard guess halve hand handle hash have
    hide highlight hold hover identify ignore import include increase index infer initialise initialize insert
    inspect install integrate interleave intern interpolate intersect invent invert iterate join judge keep kill
    label launch lay learn leave let lift light limit link list listen load locate lock log look lose lower make map
    mark mask match mean measure mend merge mimic mirror mix model mount move multiply name narrow need normalise
    normalize note notice notify number observe offer open order orient own pack pad paint parse part pass paste
    patch pay perform persist pick pin pipe place plan play plot point poll predict prefer prepare press prevent
    price print probe produce profile project promise propose protect prove prune publish pull push put quantise
    quantize queue quiet quote raise randomize rank reach read realise reap rebuild receive reckon recompute record redo
    reduce refer refine refit refresh refuse regenerate register reject relax release reload remap remember remove
    rename renew
    render repeat replace replay report request require resample reserve reset resize resolve respond rest restore
    restrict resume retry return reuse reverse rewrite rig rotate round route run sample save say scale scan scatter
    schedule score search see seed select send sense separate serve set settle shadow shape share shift shorten show
    shrink shuffle sign simulate sink size skip sleep slice slide smooth snap solve sort sound spawn specify split
    spread squeeze stack stamp stand start state stay steer step stick stop store stream stretch strike strip study
    subtract suggest sum summarise summarize supply survive swap sweep switch synchronise synchronize tabulate tag
    take taper tear tell test tick time toggle touch trace track train transform translate trigger trim try tune
    turn type undo unfold unload unlock unpack unroll untie unwrap update upgrade use validate vary view visit wait
    walk warm warn warp watch wear weigh widen wire work wrap write yield zero
    """.split()
)


def prose(text: str) -> list[str]:
    """Return the paragraphs and list items of a Markdown page without code, tables, headings and addresses."""
    text = re.sub(r"^```.*?^```$|<!--.*?-->|<[^>]+>", "", text, flags=re.M | re.S)
    text = re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"\$`[^`]*`\$|`[^`]*`", "code", text)
    blocks: list[str] = [""]
    for line in text.splitlines():
        plain = line.strip()
        if not plain or plain.startswith(("|", "#", "::", "---", "!!!")) or re.match(r"^\[.*\]: ", plain):
            blocks.append("")
        elif re.match(r"([-*]|\d+\.) ", plain):
            blocks.append(re.sub(r"^([-*]|\d+\.) ", "", plain))
        else:
            blocks[-1] += " " + plain
    return [b.strip() for b in blocks if b.strip()]


def sentences(text: str) -> list[str]:
    """Return the sentences of a Markdown page; a colon or a semicolon does not end one."""
    found = []
    for block in prose(text):
        block = re.sub(r"\b(e\.g|i\.e|etc|vs|approx|Fig)\.", r"\1", block).replace("*", "")
        found += [s for s in re.split(r"(?<=[.!?])\)?\s+(?=[A-Z\"(0-9]|code\b)", block) if words(s)]
    return found


def words(sentence: str) -> int:
    """Return the number of words: what holds a letter or a digit."""
    return sum(any(c.isalnum() for c in w) for w in sentence.split())


def functions(path: Path) -> Iterator[tuple[ast.FunctionDef, str]]:
    """Yield the functions of a file that have a docstring, with its first word in lower case. Left out are properties,
    and a task's declared terms, whose docstring is the text of a table's row."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.FunctionDef) or node.name.startswith("test_"):
            continue
        marks = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
        decorators = {getattr(d, "id", getattr(d, "attr", "")) for d in marks}
        first = re.match(r"\W*(\w+)", ast.get_docstring(node) or "")
        if first and not decorators & LABELS:
            yield node, first[1].lower()


def is_verb(word: str) -> bool:
    """Return whether a docstring's first word is a verb, as a command ("return") or of a third person ("returns")."""
    forms = {word, word.removesuffix("s"), word.removesuffix("es"), re.sub("ies$", "y", word)}
    return bool(forms & VERBS)


def names(path: Path) -> Iterator[str]:
    """Yield the names that a file gives to functions, arguments, variables and attributes, without underscores."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name.strip("_")
        elif isinstance(node, ast.arg):
            yield node.arg.strip("_")
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id.strip("_")
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr.strip("_")


def files(roots: Iterable[str], ending: str) -> dict[str, list[Path]]:
    """Return the files of that ending by folder, relative to the repository."""
    found: dict[str, list[Path]] = {}
    for root in roots:
        path = ROOT / root
        for file in [path] if path.is_file() else sorted(path.rglob(f"*{ending}")):
            folder = file.relative_to(ROOT).parent.as_posix() if path.is_dir() else root
            if file.relative_to(ROOT).as_posix() not in WRITTEN and not folder.startswith(LEFT_OUT):
                found.setdefault(folder, []).append(file)
    return found


def measured() -> dict[str, dict[str, float]]:
    """Return the figures of every folder: mean and longest of pages; not_a_verb, clause and private of code."""
    out: dict[str, dict[str, float]] = {}
    for folder, pages in files(PAGES, ".md").items():
        lengths = [words(s) for p in pages for s in sentences(p.read_text(encoding="utf-8"))]
        if lengths:
            out[folder] = {"mean": round(statistics.fmean(lengths), 1), "longest": max(lengths)}
    for folder, sources in files(CODE, ".py").items():
        firsts = [first for p in sources for _, first in functions(p)]
        counts = {
            "not_a_verb": sum(not is_verb(f) for f in firsts),
            "clause": sum(f in CLAUSES for f in firsts),
            "private": sum(n in PRIVATE for p in sources for n in names(p)),
        }
        out.setdefault(folder, {}).update(counts)
    return out


def most(folder: str, measure: str, allowed: dict[str, dict[str, float]]) -> float:
    """Return what a folder may have of a measure."""
    return allowed.get(folder, {}).get(measure, {"mean": MEAN, "longest": LONGEST}.get(measure, 0))


def worse(found: dict[str, dict[str, float]], allowed: dict[str, dict[str, float]]) -> list[str]:
    """Return one line for each figure that is above what its folder may have."""
    return [
        f"{folder}: {measure} {value:g}, allowed {most(folder, measure, allowed):g}"
        for folder, figures in found.items()
        for measure, value in figures.items()
        if value > most(folder, measure, allowed)
    ]


def lowered(found: dict[str, dict[str, float]], allowed: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return what is allowed from now on: today's figures where they are lower, nothing where they are within the
    rules."""
    out: dict[str, dict[str, float]] = {}
    for folder, figures in sorted(found.items()):
        for measure, value in figures.items():
            value = min(value, most(folder, measure, allowed))
            if value > most(folder, measure, {}):
                out.setdefault(folder, {})[measure] = value
    return out


def report() -> str:
    """Return every folder's figures, the longest sentences and the docstrings that begin without a verb, as text."""
    lines = [f"{folder}: " + ", ".join(f"{k} {v:g}" for k, v in f.items()) for folder, f in measured().items()]
    for pages in files(PAGES, ".md").values():
        for p in pages:
            for s in sentences(p.read_text(encoding="utf-8")):
                if words(s) > LONGEST:
                    lines.append(f"{p.relative_to(ROOT)}: {words(s)} words: {s[:90]} ...")
    for sources in files(CODE, ".py").values():
        for p in sources:
            for node, first in functions(p):
                if not is_verb(first):
                    lines.append(f"{p.relative_to(ROOT)}:{node.lineno} {node.name}: {first} ...")
    return "\n".join(lines)


def main(argv: Sequence[str]) -> int:
    """Check, report or record; return the exit status."""
    allowed = json.loads(ALLOWED.read_text(encoding="utf-8")) if ALLOWED.is_file() else {}
    if argv == ["report"]:
        print(report())
        return 0
    found = measured()
    if argv == ["record"]:
        first = not ALLOWED.is_file()  # then today's figures are what is owed
        ALLOWED.write_text(json.dumps(lowered(found, found if first else allowed), indent=1) + "\n", encoding="utf-8")
        return 0
    if argv:
        print(__doc__)
        return 2
    lines = worse(found, allowed)
    if lines:
        print("\n".join(lines), file=sys.stderr)
        print("error: the English got worse; python -m tools.prose report says where", file=sys.stderr)
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
