"""The locks hold what pyproject.toml asks for, each package at one version and with hashes."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
AGAIN = "make the locks again: python tools/lock.py wheels=FOLDER"


def locked(*names: str) -> dict[str, list[str]]:
    """Return the versions by package of these files, after a look at each entry's hashes."""
    out: dict[str, list[str]] = {}
    for name in names:
        text = (ROOT / "locks" / f"{name}.txt").read_text(encoding="utf-8")
        for block in re.split(r"\n(?=\S)", text.strip()):
            if block.startswith("#"):
                continue
            assert re.search(r"--hash=sha256:[0-9a-f]{64}", block), f"{name}: {block.splitlines()[0]} has no hash"
            package, version = re.match(r"([A-Za-z0-9._-]+)==([^ \\;]+)", block).groups()
            out.setdefault(package.lower(), []).append(version)
    return out


@pytest.mark.parametrize(
    ("name", "extras"), [("base", ()), ("test", ("test", "view", "deploy", "objects")), ("docs", ("docs",))]
)
def test_what_is_asked_for_is_locked(name, extras):
    there = locked(name, "torch")
    requested = [
        *PROJECT["dependencies"],
        *(r for e in extras for r in PROJECT["optional-dependencies"][e]),
        "setuptools>=77",
    ]
    for text in requested:
        requirement = Requirement(text)
        versions = there.get(requirement.name.lower().replace("_", "-"), [])
        assert versions and all(requirement.specifier.contains(v) for v in versions), f"{text}: {versions}; {AGAIN}"


def test_all_locks_are_of_one_resolution():
    base, test, docs = (locked(name) for name in ("base", "test", "docs"))
    for package, versions in base.items():
        assert versions == test[package] == docs[package], f"{package}; {AGAIN}"
    assert locked("torch-cpu")["torch"] == [f"{locked('torch')['torch'][0]}+cpu"]
    assert not any(p.startswith("nvidia") for p in (*base, *test, *docs)), "what only torch's CUDA build needs is apart"


def test_a_library_users_ranges_are_ranges():
    for text in PROJECT["dependencies"]:
        assert "==" not in text, f"{text}: the exact version stands in locks/"
