"""The list of tests/mutations.py applies to today's sources, and names tests that exist."""

from __future__ import annotations

import ast

import pytest
from mutations import MUTATIONS, ROOT, Mutation, mutated


@pytest.mark.parametrize("m", MUTATIONS, ids=lambda m: m.breaks.replace(" ", "_"))
def test_every_mutation_applies_and_its_test_exists(m):
    changed = mutated(m)
    assert changed != (ROOT / m.file).read_text(encoding="utf-8")
    ast.parse(changed)
    file, name = m.test.split("::")
    known = {
        n.name for n in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8"))) if isinstance(n, ast.FunctionDef)
    }
    assert name.partition("[")[0] in known


def test_a_mutation_that_no_longer_fits_is_named():
    with pytest.raises(ValueError, match="dexsim/errors.py holds 'no such text' 0 times.*mend the line of 'nothing'"):
        mutated(Mutation("nothing", "dexsim/errors.py", "no such text", "", ""))
