"""Reads the key=value settings of a benchmark; imports nothing that is slow to load."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dexsim.errors import UserError


def options(
    argv: Sequence[str], defaults: dict[str, Any], others: list[str] | None = None, **choices: Sequence[str]
) -> dict[str, Any]:
    """Return key=value arguments over their defaults, with the defaults' types; raises UserError naming the setting.

    others: a list that takes what is no setting of the benchmark, for the command behind it (None: there is none).
    choices: by key, the texts that are allowed.
    """
    given = dict(defaults)
    for argument in argv:
        key, equals, text = argument.partition("=")
        if others is not None and not (equals and key in defaults):
            others.append(argument)
            continue
        if not equals or key not in defaults:
            raise UserError(f"'{argument}' is not a setting; valid: {', '.join(defaults)} (key=value)")
        if isinstance(defaults[key], bool):
            if text not in ("true", "false"):
                raise UserError(f"{argument}: must be true or false")
            given[key] = text == "true"
        elif isinstance(defaults[key], int):
            if not text.isdigit():
                raise UserError(f"{argument}: must be a whole number")
            given[key] = int(text)
        elif key in choices and text not in choices[key]:
            raise UserError(f"{argument}: must be {' or '.join(choices[key])}")
        else:
            given[key] = text
    return given
