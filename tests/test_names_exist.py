"""Every name that a file imports from the project exists, also where it is imported inside a function that no test
runs."""

from __future__ import annotations

import ast
import importlib
import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
OURS = ("dexsim", "benchmarks")


def _submodule(module: ModuleType, name: str) -> bool:
    return hasattr(module, "__path__") and importlib.util.find_spec(f"{module.__name__}.{name}") is not None


def _missing(path: Path) -> list[str]:
    out = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom) or node.level or (node.module or "").split(".")[0] not in OURS:
            continue
        module = importlib.import_module(node.module)
        out += [
            f"{path.relative_to(ROOT)}:{node.lineno}: {node.module} has no {alias.name}"
            for alias in node.names
            if not hasattr(module, alias.name) and not _submodule(module, alias.name)
        ]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("folder", [*OURS, "tests"])
def test_what_is_imported_exists(folder):
    found = [line for path in sorted((ROOT / folder).rglob("*.py")) for line in _missing(path)]
    assert not found, "\n".join(found)
