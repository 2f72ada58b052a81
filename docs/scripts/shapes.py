"""A Griffe extension: shapes in docstrings, such as [N] [m] or [F][O], are no Markdown links."""

from __future__ import annotations

import re
from typing import Any

import griffe

WORD_JOINER = "\u2060"  # seen by Markdown, not by a reader


class Shapes(griffe.Extension):
    """Parts brackets that Markdown would read as [text][reference]."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"\](\s?)\[", rf"]{WORD_JOINER}\1[", obj.docstring.value)
