"""`remap.OURS=THEIRS`, `meta.KEY=VALUE` and `units.QUANTITY=UNIT` of a command line."""

from __future__ import annotations

from collections.abc import Sequence

from dexsim.errors import UserError


def read_arguments(argv: Sequence[str]) -> tuple[list[str], dict[str, str], dict[str, str]]:
    """Return (what is neither, remap, meta with units). Raises UserError for another KEY=VALUE."""
    rest: list[str] = []
    maps: dict[str, dict[str, str]] = {"remap": {}, "meta": {}}
    for argument in argv:
        key, equals, value = argument.partition("=")
        group, dot, name = key.partition(".")
        if group == "units":
            group, name = "meta", key
        if equals and dot and group in maps and name:
            try:
                value.encode()
            except UnicodeEncodeError as error:
                raise UserError(f"{key}={value}: character {error.start} is no text; write it in UTF-8") from None
            maps[group][name] = value
        elif equals and "/" not in key:
            raise UserError(f"'{argument}': expected FILE, remap.OURS=THEIRS, meta.KEY=VALUE or units.QUANTITY=UNIT")
        else:
            rest.append(argument)
    if not rest:
        raise UserError("say which recording: FILE.mcap")
    return rest, maps["remap"], maps["meta"]
