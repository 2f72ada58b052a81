"""Imports run down the floors, and no files import each other in a circle. Read off the source with `ast`, nothing is
imported.

What stands under `if __name__ == "__main__":`, and `dexsim/__main__.py`, is a door: it runs only as a program and may
lead to any floor. Imports inside functions count like those at the top; what stands under `if TYPE_CHECKING:` does not.
"""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

from dexsim.recording import schema

ROOT = Path(__file__).resolve().parents[1]
FLOORS: tuple[frozenset[str], ...] = tuple(
    frozenset(names.split())
    for names in (
        "errors paths version rotation intervals system",
        "typed door agents",
        "guard",
        "files",
        "console",
        "outputs yaml_text model_file surface",
        "assets hand",
        "sim",
        "actuator tactile",
        "recording view",
        "calibration",
        "tasks gap",  # neither knows of the other
        "deploy",
        "learning",
        "cli excite export import_object",
        "import_hand",  # lets objects fall as `task=grasp` does, by the settings that the command line reads
        "api",
        "gym",
    )
)
"""Parts of dexsim from the ground up. A part imports itself and lower floors only."""
NEVER = {"gap": {"view"}, "tasks": {"recording"}}
"""What a part does not import though it stands lower."""
STEPS = ("read", "plant", "search", "locate", "judge", "report")
"""The steps of a diagnosis in the order in which `gap.inquiry.Steps` takes them, each a part of `dexsim.gap` (and of
`dexsim.gap.touch` what it has of them): what is measured goes down them, so that none imports from a later one."""
CIRCLES: dict[frozenset[str], str] = {}
"""Circles of files that are allowed, each with its reason. None is."""
WARP = re.compile(r"@wp\.(kernel|func|func_native|struct)\b|wp\.kernel\(")


def door(node: ast.AST) -> bool:
    """Return whether a statement is `if __name__ == "__main__":` or `if TYPE_CHECKING:`."""
    return isinstance(node, ast.If) and (
        "TYPE_CHECKING" in ast.unparse(node.test)
        or ast.unparse(node.test).replace('"', "'") == "__name__ == '__main__'"
    )


def modules(root: Path, package: str = "dexsim") -> dict[str, Path]:
    """Return the module name -> file of a package in the folder root, without the package's own `__main__.py`."""
    found = {}
    for path in sorted((root / package).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts != (package, "__main__"):
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(path: Path, known: dict[str, Path], package: str = "dexsim") -> set[str]:
    """Return the modules of the package that a file imports, wherever in it."""
    out: set[str] = set()
    waiting: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if door(node):
            waiting += node.orelse
            continue
        if isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute in dexsim"
            names = [
                f"{node.module}.{a.name}" if f"{node.module}.{a.name}" in known else node.module for a in node.names
            ]
        else:
            names = []
        for name in names:
            if name.split(".")[0] == package:
                assert name in known, f"{path}:{node.lineno}: {name} does not exist"
                out.add(name)
        waiting += ast.iter_child_nodes(node)
    return out


def part(module: str) -> str:
    """Return "sim" of "dexsim.sim.engine"; "" of the package itself."""
    return module.split(".")[1] if "." in module else ""


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return one closed path, as short as there is, through each file that lies on one; every set of files once."""
    found: dict[frozenset[str], list[str]] = {}
    for start in graph:
        before: dict[str, str] = {}
        waiting = [start]
        while waiting and start not in before:  # breadth first: the shortest way back
            node = waiting.pop(0)
            for follower in sorted(graph[node]):
                if follower not in before and follower != node:
                    before[follower] = node
                    waiting.append(follower)
        if start in before:
            path = [start]
            while (last := before[path[-1]]) != start:
                path.append(last)
            found.setdefault(frozenset(path), [start, *reversed(path)])
    return list(found.values())


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    known = modules(ROOT)
    return {name: imported(path, known) - {name} for name, path in known.items()}


def test_every_part_has_a_floor(graph):
    homeless = {part(name) for name in graph} - {""} - frozenset().union(*FLOORS)
    assert not homeless, f"say in FLOORS where these stand: {homeless}"


def test_imports_run_down(graph):
    level = {name: k for k, names in enumerate(FLOORS) for name in names}
    wrong = []
    for module, others in graph.items():
        own = part(module)
        for other in others:
            if (theirs := part(other)) in (own, "") or own == "":
                continue
            if level[theirs] >= level[own] or theirs in NEVER.get(own, ()):
                wrong.append(f"{module} imports {other}")
    assert not wrong, "\n".join(sorted(wrong))


def step(module: str) -> tuple[str, int] | None:
    """Return the room of a step of the diagnosis, `dexsim.gap` or `dexsim.gap.touch`, and which one it is there."""
    names = module.removeprefix("dexsim.gap.").split(".")
    room = "dexsim.gap.touch" if names[0] == "touch" else "dexsim.gap"
    name = names[len(names) > 1 and names[0] == "touch"]
    return (room, STEPS.index(name)) if module.startswith("dexsim.gap.") and name in STEPS else None


def reached(graph: dict[str, set[str]], module: str) -> set[str]:
    """Return all modules that one imports, itself or by what it imports."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        new = graph.get(waiting.pop(), set()) - found
        found |= new
        waiting += new
    return found


def later(graph: dict[str, set[str]]) -> list[str]:
    """Imports of a step of the diagnosis from a later one of the same room, by way of others too."""
    wrong = []
    for module in graph:
        for other in reached(graph, module):
            mine, theirs = step(module), step(other)
            if mine and theirs and mine[0] == theirs[0] and theirs[1] > mine[1]:
                wrong.append(f"{module} imports {other}")
    return sorted(wrong)


def test_no_step_of_the_diagnosis_imports_from_a_later_one(graph):
    there = {step(m) for m in graph}
    assert there >= {("dexsim.gap", k) for k in range(len(STEPS))}
    assert there >= {("dexsim.gap.touch", STEPS.index(n)) for n in ("read", "plant", "search", "judge")}
    assert later(graph) == []
    assert later({"dexsim.gap.search.fit": {"dexsim.gap.judge.held_out", "dexsim.gap.plant.case"}}) == [
        "dexsim.gap.search.fit imports dexsim.gap.judge.held_out"
    ]
    by_way = {"dexsim.gap.read.inputs": {"dexsim.gap.effects"}, "dexsim.gap.effects": {"dexsim.gap.plant.columns"}}
    assert later(by_way) == ["dexsim.gap.read.inputs imports dexsim.gap.plant.columns"]


def test_no_circles_of_files(graph):
    found = [c for c in circles(graph) if frozenset(c) not in CIRCLES]
    assert not found, "\n".join(" -> ".join(c) for c in found)


def untyped(path: Path) -> list[str]:
    """Return the public functions and methods of a file that leave out the type of an argument or of what they return.
    Warp's own say what they return by themselves."""
    found = []

    def visit(node: ast.Module | ast.ClassDef) -> None:
        for x in node.body:
            if isinstance(x, ast.ClassDef) and not x.name.startswith("_"):
                visit(x)
            if not isinstance(x, ast.FunctionDef | ast.AsyncFunctionDef) or x.name.startswith("_"):
                continue
            if any(ast.unparse(d).startswith("wp.") for d in x.decorator_list):
                continue
            given = [*x.args.posonlyargs, *x.args.args, *x.args.kwonlyargs]
            if x.returns is None or any(a.annotation is None and a.arg not in ("self", "cls") for a in given):
                found.append(f"{path}:{x.lineno}: {x.name}")

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return found


def test_public_functions_have_types(tmp_path):
    (tmp_path / "a.py").write_text("def f(x: int): ...\ndef g(x) -> int: ...\ndef h(x: int) -> int: ...\n")
    assert [line.split()[-1] for line in untyped(tmp_path / "a.py")] == ["f", "g"]
    missing = [line for path in modules(ROOT).values() for line in untyped(path)]
    assert not missing, "\n".join(missing)


def test_mypy_reads_every_file():
    """None is passed over; it looks away from Warp's annotations and operators only where there are kernels."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    assert settings["files"] == ["dexsim"] and "exclude" not in settings
    assert not [part["module"] for part in settings["overrides"] if part.get("ignore_errors")]
    known = modules(ROOT)
    eased = [m for part in settings["overrides"] if part.get("disable_error_code") for m in part["module"]]
    for name in eased:
        assert name in known, f"{name}: no such file"
        warp = WARP.search(known[name].read_text(encoding="utf-8"))
        assert warp, f"{name}: has no Warp function, so that mypy can check all of it"


def test_the_check_sees_what_it_must(tmp_path):
    """A lazy import closes a circle; a door and a type-checking import do not; a wrong name is answered."""
    house = tmp_path / "dexsim"
    house.mkdir()
    (house / "a.py").write_text("import dexsim.b\n")
    (house / "b.py").write_text("def f():\n    from dexsim import c\n")
    (house / "c.py").write_text("class C:\n    def g(self):\n        from dexsim.a import x\n")
    (house / "d.py").write_text(
        "from typing import TYPE_CHECKING\nimport dexsim.a\nif TYPE_CHECKING:\n    import dexsim.e\n"
    )
    (house / "e.py").write_text("import dexsim.d\nif __name__ == '__main__':\n    from dexsim.e import d\n")
    known = modules(tmp_path)
    graph = {name: imported(path, known) - {name} for name, path in known.items()}
    assert graph["dexsim.b"] == {"dexsim.c"} and graph["dexsim.d"] == {"dexsim.a"}
    assert [set(c) for c in circles(graph)] == [{"dexsim.a", "dexsim.b", "dexsim.c"}]
    (house / "__main__.py").write_text("import dexsim.a\n")
    (house / "part").mkdir()
    (house / "part" / "__main__.py").write_text("import dexsim.a\n")
    assert {m for m in modules(tmp_path) if m.endswith("__main__")} == {"dexsim.part.__main__"}
    (house / "f.py").write_text("import dexsim.gone\n")
    with pytest.raises(AssertionError, match="dexsim.gone does not exist"):
        imported(house / "f.py", known)


def test_no_private_module_of_another_decoder_is_imported():
    """It may be moved or changed by any release, though its version is held."""
    private = re.compile(r"\b(from|import)\s+mcap_ros2\._")
    folders = [ROOT / f for f in ("dexsim", "benchmarks", "tests", "tools", "docs", "notebooks")]
    files = [*ROOT.glob("*.py"), *(p for f in folders for p in f.rglob("*.*"))]
    files = [p for p in files if p.suffix in (".py", ".ipynb", ".md")]
    assert private.search("from mcap_ros2" + "._dynamic import x") and len(files) > 300
    assert [str(p.relative_to(ROOT)) for p in files if private.search(p.read_text(encoding="utf-8"))] == []


def test_topic_names_stand_in_the_schema_alone():
    """A check that compares a topic with a name of its own would fall silent when the topic gets another."""
    topics = [v for v in vars(schema).values() if isinstance(v, str) and re.fullmatch(r"/[a-z_]+", v)]
    assert len(topics) >= 5
    compared = re.compile(rf"""(==|\bin\b|,)\s*["']({"|".join(map(re.escape, topics))})["']""")
    found = [
        f"{p.relative_to(ROOT)}: {m[0]}"
        for p in sorted((ROOT / "dexsim").rglob("*.py"))
        if p.name != "schema.py"
        for m in compared.finditer(p.read_text(encoding="utf-8"))
    ]
    assert not found
