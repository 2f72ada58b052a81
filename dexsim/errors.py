"""The one exception that a user's mistake raises."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator

WORD, MESSAGE = 300, 2000
"""Characters of a word, and of a message, at most: what a file says may be of any length."""


class UserError(ValueError):
    """Bad input: the message alone must name the file, field, value, allowed range and the fix.

    Entry points print it as one line and exit with status 2; it never comes with a traceback.
    """

    def __init__(self, message: object = "") -> None:
        """Keep `message` to one line that a terminal prints as it stands, whatever line breaks, control characters or
        lengths a value in it has."""
        super().__init__(_plain(str(message)))


@contextlib.contextmanager
def about(what: object, fix: str = "") -> Iterator[None]:
    """Begin a UserError raised within with the file or setting that it is of, and end it with what to do about it,
    unless it says so itself."""
    try:
        yield
    except UserError as error:
        text = str(error) if str(what) in str(error) else f"{what}: {error}"
        raise UserError(f"{text}; {fix}" if fix and fix not in text else text) from None


def _plain(text: str) -> str:
    text = " ".join(text.split())
    # not printable: escapes that move a cursor, marks that turn the direction of writing, halves of a character
    text = "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)
    text = re.sub(rf"\S{{{WORD},}}", lambda word: _short(word.group(), WORD), text)
    return _short(text, MESSAGE)


def _short(text: str, most: int) -> str:
    """Return its beginning and its end, where it is longer."""
    return text if len(text) <= most else f"{text[: most * 2 // 3]}...{text[-most // 4 :]}"
