"""The one exception that a user's mistake raises."""

from __future__ import annotations


class UserError(ValueError):
    """Bad input: the message alone must name the file, field, value, allowed range and the fix.

    Entry points print it as one line and exit with status 2; it never comes with a traceback.
    """

    def __init__(self, message: object = "") -> None:
        """message: kept to one line, whatever line breaks a value in it has."""
        super().__init__(" ".join(str(message).split()))
