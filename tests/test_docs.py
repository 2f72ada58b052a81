"""README and docs/: short enough, their commands and links exist, tables made from the code are whole."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import yaml

from dexsim.cli.main import COMMANDS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
LISTED = ("train", "play", "diagnose", "calibrate")
HYDRA = {
    "task",
    "agent",
    "servo",
    "tactile",
    "randomize",
    "reality",
    "sweep",
    "hydra/launcher",
    "hydra.launcher.n_jobs",
}


def _reference():
    spec = importlib.util.spec_from_file_location("docs_reference", DOCS / "scripts" / "reference.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


REFERENCE = _reference()


def _fences(text: str) -> list[str]:
    """Return the lines of a page's fenced blocks without a language; one that a backslash breaks is one."""
    blocks = re.findall(r"^```\n(.*?)^```$", text, re.M | re.S)
    return [line.strip() for block in blocks for line in re.sub(r" *\\\n\s*", " ", block).splitlines()]


def _commands() -> list[tuple[str, str]]:
    """Return (page, command) of every command in README, tutorials and how-to, without its comment."""
    found = []
    for path in (
        ROOT / "README.md",
        *sorted((DOCS / "tutorials").glob("*.md")),
        *sorted((DOCS / "howto").glob("*.md")),
    ):
        for line in _fences(path.read_text(encoding="utf-8")):
            line = re.sub(r"\s+#\s.*$", "", line)
            if (
                re.match(r"(torchrun|chrt|python|dexsim|make) ", line)
                and "python -c" not in line
                and "-m venv" not in line
            ):
                found.append((path.name, line))
    return found


@cache
def _keys(script: str) -> set[str]:
    """Return every setting of a script, with the groups of settings above them."""
    folder = REFERENCE.config_folder()
    if script == "diagnose":
        from dexsim.gap.command import KEYS

        return set(KEYS)
    if script == "calibrate":
        return {s.key for s in REFERENCE.leaves(folder / "calibrate.yaml")}
    keys = {s.key for s in REFERENCE.leaves(folder / "config.yaml")} | HYDRA
    if script == "play":
        from dexsim.cli.recorded import KEYS as replay_keys

        keys |= {s.key for s in REFERENCE.leaves(folder / "play.yaml")} | set(replay_keys)
    for group in folder.iterdir():
        if group.is_dir():
            for option in group.glob("*.yaml"):
                keys |= {f"{group.name}.{s.key}" for s in REFERENCE.leaves(option)}
    return keys


def test_readme_is_read_in_three_minutes():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 90
    assert max(map(len, lines)) <= 120
    assert {"make train", "make test"} <= {re.sub(r"\s+#.*", "", line) for line in lines}


def test_figures_of_the_readme_are_those_of_the_results():
    table = [line for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    results = (DOCS / "results" / "index.md").read_text(encoding="utf-8")
    figures = [n for line in table for n in re.findall(r"\d[\d,]*(?:\.\d+)?", line.split("|")[2])]
    assert len(figures) > 8
    assert [n for n in figures if not re.search(rf"(?<![\d.]){re.escape(n)}(?![\d])", results)] == []


def test_there_are_commands_to_check():
    assert len(_commands()) > 50


@pytest.mark.parametrize(("page", "command"), _commands())
def test_command_exists(page, command):
    words = shlex.split(command)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M), (
            f"{page}: no target {words[1]}"
        )
        return
    while words[0] in ("torchrun", "chrt", "python") or words[0].startswith("-") or words[0].isdigit():
        words.pop(0)
    name, given = words[0], [w.partition("=")[0] for w in words[1:] if "=" in w and not w.startswith("-")]
    if name != "dexsim":
        where = ROOT / name.replace(".", "/")
        assert name == "pytest" or where.with_suffix(".py").is_file() or (where / "__init__.py").is_file(), (
            f"{page}: no module {name}"
        )
        return
    assert words[1] in COMMANDS or words[1].startswith("--"), f"{page}: no command dexsim {words[1]}"
    if words[1] in LISTED:
        unknown = [k for k in given if k not in _keys(words[1]) and not k.startswith(("remap.", "meta.", "+"))]
        assert not unknown, f"{page}: {command}: dexsim {words[1]} has no {unknown}"


def test_links_of_the_readme_exist():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)#]+)", text) + re.findall(r"^\[[^]]+\]: (\S+)", text, re.M)
    assert len(targets) > 10
    missing = [t for t in targets if not t.startswith("http") and not (ROOT / t.partition("#")[0]).exists()]
    assert not missing
    prose = re.sub(r"^```.*?^```$|`[^`]*`", "", text, flags=re.M | re.S)
    for label in re.findall(r"\[([^]\[]+)\](?![(\[:])", prose):
        assert re.search(rf"^\[{re.escape(label)}\]:", text, re.M), f"[{label}] leads nowhere"


def test_every_page_is_in_the_menu():
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert [str(p.relative_to(DOCS)) for p in PAGES if f" {p.relative_to(DOCS)}\n" not in menu] == []


EXAMPLES = ("0123456789ab", "seed=99999999999999999999")
"""What looks like a commit or a seed outside the results and is an example: of a hash, of a value that is refused."""


def seeds_and_commits(text: str) -> list[str]:
    """Seeds that figures hang on, and commits."""
    for example in EXAMPLES:
        text = text.replace(example, "")
    hashes = [w for w in re.findall(r"\b[0-9a-f]{7,40}\b", text) if re.search(r"\d", w) and re.search(r"[a-f]", w)]
    return hashes + re.findall(r"\bseeds? \d+|\bseeds?=\d{3,}", text)


def test_seeds_and_commits_stay_with_the_results():
    assert seeds_and_commits("by 0a1b2c3, 852c50907ac311c542c29f6eda6e9c2839da60fe, seed 7, seeds=123,4, seed=1") == [
        "0a1b2c3", "852c50907ac311c542c29f6eda6e9c2839da60fe", "seed 7", "seeds=123",
    ]  # fmt: skip
    for path in (ROOT / "README.md", ROOT / "CHANGELOG.md", *(p for p in PAGES if p.parent.name != "results")):
        assert seeds_and_commits(path.read_text(encoding="utf-8")) == [], path.name


def test_tables_from_the_code_are_whole():
    from dexsim.actuator.columns import NAMES
    from dexsim.recording.audit import KINDS
    from dexsim.recording.schema import KEYS

    for page, names in (("columns", NAMES), ("audit", KINDS), ("metadata", KEYS)):
        text = REFERENCE.PAGES[page]()
        assert [n for n in names if f"| `{n}` |" not in text] == []
    assert {"backlash", "command_delay", "tactile_gain", "contact_stiffness"} <= set(
        re.findall(r"^\| `(\w+)` \|", REFERENCE.effects(), re.M)
    )


def test_settings_are_listed_with_their_comments(tmp_path):
    file = tmp_path / "x.yaml"
    file.write_text(
        "# top\ndefaults: [a]\nseed: 1  # of all\npart:\n  low: [0, 1]  # m\n  inner: {a: 1, b: 2}\nlast: null\n"
    )
    assert [(s.key, s.default, s.comment) for s in REFERENCE.leaves(file)] == [
        ("seed", "1", "of all"), ("part.low", "[0, 1]", "m"), ("part.inner", "{a: 1, b: 2}", ""), ("last", "null", ""),
    ]  # fmt: skip
    task = next(REFERENCE.config_folder().glob("task/grasp.yaml"))

    flat = ("cuda", "cpu", "task", "contact", "emphasis", "objects")

    def leaves(node, prefix="task"):
        for key, value in node.items():
            if isinstance(value, dict) and value and key not in flat:
                yield from leaves(value, f"{prefix}.{key}")
            elif not isinstance(value, dict):
                yield f"{prefix}.{key}"

    text = REFERENCE.settings()
    assert [k for k in leaves(yaml.safe_load(task.read_text())) if f"`{k}`" not in text] == []


def test_generated_tables_that_pages_ask_for_exist():
    wanted = [name for p in PAGES for name in re.findall(r"<!-- GENERATED: (\w+) -->", p.read_text(encoding="utf-8"))]
    assert sorted(wanted) == sorted(REFERENCE.PAGES)


def test_list_of_pages_for_assistants_is_that_of_the_menu():
    text = REFERENCE.llms()
    assert {str(p.relative_to(DOCS)) for p in PAGES} == set(re.findall(r"\]\(([^)]+)\)", text))
    assert [p for p in re.findall(r"\]\(([^)]+)\)", text) if not (DOCS / p).is_file()] == []


def test_summary_names_everything_that_is_public():
    import dexsim

    text = REFERENCE.summary()
    assert [n for n in dexsim.__all__ if f"`dexsim.{n}" not in text] == []
    assert [c for c in COMMANDS if f"- `dexsim {c}`: " not in text] == []


def test_pages_that_the_code_names_exist():
    named = {
        (p, m)
        for folder in ("dexsim", "benchmarks")
        for p in (ROOT / folder).rglob("*.[py]*")
        if p.suffix in (".py", ".yaml")
        for m in re.findall(r"(?:docs|lab)/[\w/]+\.md", p.read_text(encoding="utf-8"))
    }
    assert len(named) > 5
    assert [f"{p}: {m}" for p, m in sorted(named) if not (ROOT / m).is_file()] == []


def test_files_that_the_pages_name_exist():
    named = {
        (p, m)
        for p in (ROOT / "README.md", *PAGES)
        for m in re.findall(r"`((?:dexsim|benchmarks|tests)/[\w/.*-]+)`", p.read_text(encoding="utf-8"))
    }
    assert len(named) > 30
    assert [f"{p.name}: {m}" for p, m in sorted(named) if not list(ROOT.glob(m.rstrip("/").replace("NAME", "*")))] == []


def test_every_benchmark_stands_where_figures_are_reproduced():
    text = (DOCS / "howto" / "reproducing.md").read_text(encoding="utf-8")
    jobs = [
        p.stem for p in (ROOT / "benchmarks").glob("*.py") if f"python -m benchmarks.{p.stem}" in p.read_text("utf-8")
    ]
    jobs += [p.parent.name for p in (ROOT / "benchmarks").glob("*/__main__.py")]
    assert len(jobs) > 7
    assert [job for job in sorted(jobs) if not re.search(rf"\b{job}\b", text)] == []


WRITTEN = ("results/index.md",)
"""Pages that a script writes, whose lines nobody edits."""
MAY_BE_LONG = re.compile(r"\s*(\|.*|(- )?!?\[[^]]*\](\([^)]*\)|: \S+)|<?https?://\S+)\s*")
"""Lines of a page that no editor can break: a table's row, an image or a link alone."""


def long_lines(page: str) -> list[int]:
    """Numbers of a page's lines beyond 120 columns, but those that cannot be broken and formulas."""
    found, formula = [], False
    for k, line in enumerate(page.splitlines(), 1):
        if line.strip().startswith("```"):
            formula = line.strip() == "```math"
        if len(line) > 120 and not formula and not MAY_BE_LONG.fullmatch(line):
            found.append(k)
    return found


def pages() -> list[Path]:
    """Return every Markdown file that git tracks, or, outside a checkout, those where pages are."""
    done = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True)
    if done.returncode == 0 and done.stdout:
        return [ROOT / name for name in done.stdout.splitlines() if (ROOT / name).is_file()]
    return [*ROOT.glob("*.md"), *PAGES, *(ROOT / "dexsim").rglob("*.md")]


def test_lines_of_pages_end_at_120():
    word = "x" * 60
    page = f"{word} {word}\n| {word} {word} |\n![{word}](a/{word}.png)\n```math\n{word} {word}\n```\n"
    assert long_lines(page) == [1]
    files = [p for p in pages() if not str(p).endswith(WRITTEN)]
    assert {ROOT / "README.md", ROOT / "CHANGELOG.md", *PAGES} - {DOCS / name for name in WRITTEN} <= set(files)
    assert {str(p.relative_to(ROOT)): found for p in files if (found := long_lines(p.read_text("utf-8")))} == {}


def test_lines_of_settings_end_at_120():
    """Ruff holds the Python files; what a script made (`dexsim/configs/reality`) keeps its form."""
    files = [ROOT / "Makefile", *(ROOT / "dexsim").rglob("*.cuh")]
    files += [p for p in (ROOT / "dexsim" / "configs").rglob("*.yaml") if p.parent.name != "reality"]
    lines = [(f"{p.name}:{k}", line) for p in files for k, line in enumerate(p.read_text("utf-8").splitlines(), 1)]
    assert len(lines) > 500 and [where for where, line in lines if len(line) > 120] == []
