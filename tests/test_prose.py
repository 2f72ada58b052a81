"""`tools/prose.py`: sentences are counted as a reader reads them, and what it allows can only shrink."""

from __future__ import annotations

import json

import pytest

from tools import prose

PAGE = """# A heading that does not count

One short sentence. Another one, e.g. with `code that is one word` and [a link](https://example.org/a/b).
It goes on here.

- An item of a list
- Another. Two sentences.

| a table | does not count |

```
nor does code. At all.
```
"""


def test_sentences_leave_out_code_tables_and_headings():
    found = prose.sentences(PAGE)
    assert [prose.words(s) for s in found] == [3, 8, 4, 5, 1, 2]
    assert not any("count" in s or "At all" in s for s in found)


def test_first_word_of_a_docstring_is_a_verb(tmp_path):
    path = tmp_path / "a.py"
    path.write_text(
        'def a():\n    """Return one."""\n\ndef b():\n    """Whether it is."""\n\n'
        'def c():\n    """Copies it."""\n\ndef test_d():\n    """What holds."""\n'
    )
    found = {node.name: first for node, first in prose.functions(path)}
    assert found == {"a": "return", "b": "whether", "c": "copies"}
    assert [prose.is_verb(w) for w in found.values()] == [True, False, True]


def test_private_names_are_counted_where_they_are_given(tmp_path):
    path = tmp_path / "a.py"
    path.write_text("def f(told):\n    left = told\n    self.kept = 1\n    return left.apart\n")
    assert sorted(n for n in prose.names(path) if n in prose.PRIVATE) == ["kept", "left", "told"]


def test_a_folder_without_an_allowance_keeps_the_rules():
    assert prose.worse({"docs": {"mean": 21.9, "longest": 45}, "dexsim": {"clause": 0}}, {}) == []
    assert prose.worse({"docs": {"mean": 22.1}, "dexsim": {"clause": 1}}, {"docs": {"mean": 22.1}}) == [
        "dexsim: clause 1, allowed 0"
    ]


def test_what_is_allowed_only_shrinks():
    allowed = {"dexsim": {"private": 5}, "docs": {"mean": 25.0}}
    found = {"dexsim": {"private": 3}, "docs": {"mean": 26.0}, "tools": {"private": 2}}
    assert prose.lowered(found, allowed) == {"dexsim": {"private": 3}, "docs": {"mean": 25.0}}
    assert prose.lowered({"dexsim": {"private": 0}}, allowed) == {}


def test_allowances_are_of_folders_that_exist():
    allowed = json.loads(prose.ALLOWED.read_text(encoding="utf-8"))
    assert [f for f in allowed if not (prose.ROOT / f).exists()] == []


@pytest.mark.parametrize("word", ["returns", "return", "carries", "catches", "writes"])
def test_verbs_of_either_form_count(word):
    assert prose.is_verb(word) and not prose.is_verb("position")
