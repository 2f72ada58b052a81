"""Reference pages written from the code and the config files, so that they cannot go stale.

    python docs/scripts/reference.py settings | columns | effects | rules | audit | metadata | commands | summary | llms

prints one as Markdown; `hooks.py` puts them into the site where a page says `<!-- GENERATED: name -->`.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
ORDER = ("config.yaml", "task", "agent", "servo", "tactile", "randomize", "reality", "play.yaml", "calibrate.yaml")
LONGEST = 90  # characters of a default that are shown


@dataclass(frozen=True)
class Setting:
    """One leaf of a config file: dotted key, default as YAML text, the comment behind it ("" where there is none)."""

    key: str
    default: str
    comment: str


def config_folder() -> Path:
    """Return where the config files lie."""
    return ROOT / "dexsim" / "configs"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; bars in cells are escaped."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(_cell(str(cell)) for cell in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """Return the bars would end the cell; outside code, <word> would be taken for HTML."""
    text = text.replace("|", "\\|")
    return text if text.startswith("`") else text.replace("<", "&lt;")


def leaves(path: Path) -> list[Setting]:
    """Return every setting of a config file in its order; Hydra's `defaults` list is left out.

    A mapping written on one line is one setting. Comments are those on the line on which a key stands.
    """
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    out: list[Setting] = []

    def visit(node: yaml.Node, prefix: str) -> None:
        for key, value in node.value:
            dotted = f"{prefix}.{key.value}" if prefix else key.value
            if dotted == "defaults":
                continue
            if isinstance(value, yaml.MappingNode) and not value.flow_style and value.value:
                visit(value, dotted)
                continue
            default = " ".join(text[value.start_mark.index : value.end_mark.index].split())
            default = re.sub(r"\s+#.*", "", default) if value.start_mark.line == key.start_mark.line else default
            comment = lines[value.end_mark.line if value.end_mark.column else value.start_mark.line]
            comment = comment[value.end_mark.column if value.end_mark.line == key.start_mark.line else 0 :]
            found = re.search(r"#\s*(.+)$", comment)
            out.append(
                Setting(
                    dotted,
                    default if len(default) <= LONGEST else default[: LONGEST - 3] + "...",
                    found[1].strip() if found else "",
                )
            )

    root = yaml.compose(text)
    if root is not None:
        visit(root, "")
    return out


def heading_comment(path: Path) -> str:
    """Return the comment lines at the top of a config file as one text."""
    top: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        top.append(line.lstrip("# ").rstrip())
    return " ".join(top)


def settings() -> str:
    """Return all groups, their options, and every setting of every config file but the drawn numbers of realities."""
    folder, out = config_folder(), []
    names = [
        *ORDER,
        *sorted(
            p.name
            for p in folder.iterdir()
            if p.name not in ORDER and (p.is_dir() or p.suffix == ".yaml") and not p.name.startswith("__")
        ),
    ]
    for name in names:
        path = folder / name
        if path.is_file():
            out += [f"## {path.stem}", "", heading_comment(path), "", _rows(path)]
        elif path.is_dir():
            options = sorted(path.glob("*.yaml"))
            if not options:
                continue
            out += [f"## {name}=", "", "Options: " + ", ".join(f"`{o.stem}`" for o in options) + ".", ""]
            for option in options:
                out += [f"### {name}={option.stem}", "", heading_comment(option), ""]
                out += (
                    ["Its numbers are drawn once from a seed; read the file itself.", ""]
                    if name == "reality"
                    else [_rows(option, name + ".")]
                )
    return "\n".join(out)


def _rows(path: Path, prefix: str = "") -> str:
    found = leaves(path)
    return (
        table(("setting", "default", "meaning"), [(f"`{prefix}{s.key}`", f"`{s.default}`", s.comment) for s in found])
        if found
        else ""
    )


def columns() -> str:
    """Return the servo table's columns."""
    from dexsim.actuator.columns import COLUMNS

    return table(
        ("column", "unit", "neutral", "allowed", "meaning"),
        [(f"`{c.name}`", c.unit, f"{c.neutral:g}", f"{c.low:g} to {c.high:g}", c.text) for c in COLUMNS],
    )


def effects() -> str:
    """Return the catalogue of the diagnosis: effects of joints, then of touch and contact."""
    from dexsim.gap.effects import catalogue

    head = ("effect", "what it means", "where it shows", "what shows it best", "may be confused with")

    def rows(what: str, entries: Sequence, confusable: Callable[[str, str], bool]) -> list[tuple[str, ...]]:
        like = {e.id: [f"`{x.id}`" for x in entries if x.id != e.id and confusable(e.id, x.id)] for e in entries}
        return [
            (f"`{e.id}`", f"the {what} {e.words}", e.shows, e.experiment, ", ".join(like[e.id]) or "-") for e in entries
        ]

    joints = table(head, rows("joint", catalogue.CATALOGUE, catalogue.confusable))
    touches = table(head, rows("fingertip", catalogue.TOUCH_CATALOGUE, catalogue.touch_confusable))
    return f"## Joints\n\n{joints}\n## Touch and contact\n\n{touches}"


def rules() -> str:
    """Return the figures that the diagnosis decides by: each with the comment above or beside it."""
    import inspect

    from dexsim.gap.rules import BELIEF, JUDGE, SEARCH, TORQUE, TOUCH

    parts = []
    for name, room in zip(("search", "judge", "touch", "torque", "belief"), (SEARCH, JUDGE, TOUCH, TORQUE, BELIEF)):
        rows, means = [], ""
        for line in map(str.strip, inspect.getsource(type(room)).splitlines()):
            code, _, comment = line.partition("# ")
            means = f"{means} {comment}".strip()
            if code:
                key = code.partition(":")[0]
                if hasattr(room, key):
                    rows.append((f"`{name}.{key}`", f"{getattr(room, key):.4g}", means))
                means = ""
        of = table(("figure", "value", "what it means"), rows)
        parts.append(f"## {name.capitalize()}\n\n{type(room).__doc__}\n\n{of}")
    return "\n".join(parts)


def audit() -> str:
    """Return the kinds of findings of the recording's audit."""
    from dexsim.recording.audit import KINDS

    return table(("kind", "meaning"), [(f"`{k}`", v) for k, v in KINDS.items()])


def metadata() -> str:
    """Return the topics and metadata keys of a recording."""
    from dexsim.recording.schema import DEFAULTS, KEYS, TOPICS, UNIT_KEYS

    topics = table(("topic", "ROS 2 type"), [(f"`{k}`", f"`{v}`") for k, v in TOPICS.items()])
    keys = table(
        ("key", "meaning", "where it is not stated"),
        [(f"`{k}`", v, f"`{DEFAULTS[k]}`" if DEFAULTS.get(k) else "-") for k, v in KEYS.items()],
    )
    units = table(("key", "values"), [(f"`{k}`", ", ".join(f"`{u}`" for u in v)) for k, v in UNIT_KEYS.items()])
    return f"### Topics\n\n{topics}\n### Metadata\n\n{keys}\nFor recordings in other units:\n\n{units}"


def commands() -> str:
    """Return what `dexsim COMMAND --help` prints, for every command."""
    from dexsim.cli.main import COMMANDS, dispatch

    out = []
    for name, command in COMMANDS.items():
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            dispatch([name, "--help"])
        out.append(
            f"## dexsim {name}\n\n{command.about[0].upper()}{command.about[1:]}.\n\n"
            f"```text\n{printed.getvalue().strip()}\n```\n"
        )
    return "\n".join(out)


def _first_sentence(text: str) -> str:
    """Return the first sentence of a docstring, on one line."""
    return re.split(r"(?<=\.)\s", " ".join(text.split("\n\n")[0].split()), maxsplit=1)[0]


def summary() -> str:
    """Return the public API and the commands on one page: signatures, and one sentence each."""
    import dexsim
    from dexsim.cli.main import COMMANDS

    out = ["## Python", ""]
    for name in dexsim.__all__:
        thing = getattr(dexsim, name)
        shape = ""
        if inspect.isfunction(thing):
            shape = re.sub(r"(: |-> )'([^']*)'", r"\1\2", str(inspect.signature(thing))).replace("dexsim.", "")
        said = "the version" if isinstance(thing, str) else _first_sentence(inspect.getdoc(thing) or "")
        out.append(f"- `dexsim.{name}{shape}`: {said}")
    out += ["", "## Commands", ""]
    out += [f"- `dexsim {name}`: {command.about.rstrip('.')}." for name, command in COMMANDS.items()]
    return "\n".join(out) + "\n"


def llms() -> str:
    """Return llms.txt: what dexsim is, and every page of the documentation with its title, from the site's menu."""

    def pages(node: object, above: str = "") -> Iterable[tuple[str, str]]:
        for item in node if isinstance(node, list) else []:
            for title, below in item.items() if isinstance(item, dict) else ((above, item),):
                yield from [(f"{title}", below)] if isinstance(below, str) else pages(below, title)

    class Loader(yaml.SafeLoader):
        """Reads mkdocs.yml, whose Python tags mean nothing here."""

    menu = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Loader)["nav"]
    out = [
        "# dexsim",
        "",
        "> Train dexterous-hand policies in simulation (MuJoCo-Warp on a GPU, C MuJoCo on a CPU), feel what the real"
        " hand feels, and find what the simulator left out of recordings of a real machine.",
        "",
        "Every setting is key=value on the command line; the commands are dexsim train, play, diagnose, excite, audit,"
        " export, deploy, calibrate, import-hand. The same from Python: import dexsim.",
        "",
        "## Documentation",
        "",
        *(f"- [{title}]({path})" for title, path in pages(menu)),
    ]
    return "\n".join(out) + "\n"


PAGES = {
    "summary": summary,
    "settings": settings,
    "columns": columns,
    "effects": effects,
    "rules": rules,
    "audit": audit,
    "metadata": metadata,
    "commands": commands,
}


def main(argv: Sequence[str]) -> int:
    """Print one page; returns the exit status."""
    made = {**PAGES, "llms": llms}
    if len(argv) != 1 or argv[0] not in made:
        print(__doc__)
        return 2
    print(made[argv[0]](), end="")
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main(sys.argv[1:]))
