"""ROS 2 messages (CDR) of any type, from the definition that the recording carries, by `rosbags`.

`rosbags` turns a definition into Python code. Definitions come from strangers: only names and sizes that can be of a
message reach it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg
from rosbags.typesys.store import Typestore

MAX_DEFINITION = 1 << 16
"""Characters of a message definition."""
MAX_ARRAY = 1 << 20
"""Entries of an array of fixed size."""
MAX_TYPES = 200
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*_?\Z")


class BadDefinition(ValueError):
    """A message definition that is not read; the text says why."""


@lru_cache(maxsize=64)  # a definition takes longer to read than a short recording's messages
def decoder(name: str, encoding: str, text: str) -> Callable[[bytes], Any]:
    """A function from the bytes of a message (CDR) to an object with its fields; arrays of numbers are NumPy's.

    name: "pkg/msg/Name"; encoding: "ros2msg" or "ros2idl", as MCAP stores them. Raises BadDefinition; the function
    raises ValueError, or what the reading of a damaged message leads to."""
    parts = [p for p in re.split(r"::|/", name) if p]
    if len(text) > MAX_DEFINITION or not 2 <= len(parts) <= 3 or not _NAME.match("/".join(parts)):
        raise BadDefinition(f"its name is no message's, or it has more than {MAX_DEFINITION} characters")
    root = f"{parts[0]}/msg/{parts[-1]}"
    try:
        if encoding == "ros2idl":
            types = get_types_from_idl(re.sub(r"^={3,}\s*$|^IDL:.*$|^\s*#.*$", "", text, flags=re.M))
        else:
            types = get_types_from_msg(text, root)
        types = {key: ([], list(fields)) for key, (_, fields) in types.items()}  # constants are not in a message
        if root not in types:
            raise BadDefinition(f"{root} is not defined in it; defined: {', '.join(types) or 'nothing'}")
        _check(types, root)
        store = Typestore()
        store.register(types)
        read = store.get_msgdef(root)
    except BadDefinition:
        raise
    except (
        TypesysError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        AssertionError,
        SyntaxError,
        RecursionError,
        IndexError,
    ) as error:
        raise BadDefinition(" ".join(str(error).split())[:200] or type(error).__name__) from None

    def decode(data: bytes) -> Any:
        if len(data) < 4 or data[1] not in (0, 1):
            raise ValueError(f"not plain CDR: {bytes(data[:4]).hex()}")
        view = bytes(data[4:])
        message, end = (read.deserialize_cdr_le if data[1] else read.deserialize_cdr_be)(view, 0, read.cls, store)
        if end > len(view):
            raise ValueError("message ends inside a field")
        return message

    return decode


def _check(types: dict[str, tuple[list, list]], root: str) -> None:
    """Names, sizes and depth of the types that a message needs."""
    if len(types) > MAX_TYPES:
        raise BadDefinition(f"it defines {len(types)} types; at most {MAX_TYPES} are read")
    for key, (_, fields) in types.items():
        for field, kind in fields:
            for x in _flat((key, field, kind)):
                if isinstance(x, str) and x and not _NAME.match(x):
                    raise BadDefinition(f"'{x[:40]}' is no name of a type or field")
                if isinstance(x, int) and not 0 <= x <= MAX_ARRAY:
                    raise BadDefinition(f"{key}.{field} has {x} entries; at most {MAX_ARRAY} are read")
    open_: list[str] = []

    def visit(key: str) -> None:
        if key in open_ or len(open_) > 20:
            raise BadDefinition(f"{key} holds itself, or is nested more than 20 deep")
        if key not in types:
            raise BadDefinition(f"{key} is used and not defined in it")
        open_.append(key)
        for _, kind in types[key][1]:
            for x in _flat(kind):
                if isinstance(x, str) and "/" in x:
                    visit(x)
        open_.pop()

    visit(root)


def _flat(x: Any) -> list[Any]:
    if isinstance(x, (tuple, list)):
        return [z for y in x for z in _flat(y)]
    return [] if hasattr(x, "name") else [x]
