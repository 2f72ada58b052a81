"""ROS 2 messages (CDR) of any type, from the definition that the recording carries, by `rosbags`.

`rosbags` turns a definition into Python code. Definitions come from strangers: only names that can be of a message
reach it; its size is the guard's affair (`dexsim.guard`).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from rosbags.typesys import get_types_from_idl, get_types_from_msg
from rosbags.typesys.store import Typestore

from dexsim.recording.cdr import standard

MAX_DEFINITION = 1 << 16  # characters: rosbags compiles it, which takes seconds a megabyte
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*_?\Z")


class BadDefinition(ValueError):
    """A message definition that is not read; the text says why."""


@lru_cache(maxsize=64)  # a definition takes longer to read than a short recording's messages
def decoder(name: str, encoding: str, text: str) -> Callable[[bytes], Any]:
    """Return a function from the bytes of a message (CDR) to an object with its fields; arrays of numbers are NumPy's.

    name: "pkg/msg/Name"; encoding: "ros2msg" or "ros2idl", as MCAP stores them. Raises BadDefinition; the function
    raises ValueError, or what the reading of a damaged message leads to."""
    parts = [p for p in re.split(r"::|/", name) if p]
    if not 2 <= len(parts) <= 3 or not _NAME.match("/".join(parts)):
        raise BadDefinition("its name is no message's")
    if len(text) > MAX_DEFINITION:
        raise BadDefinition(f"it has more than {MAX_DEFINITION} characters")
    root = f"{parts[0]}/msg/{parts[-1]}"
    try:
        if encoding == "ros2idl":
            types = get_types_from_idl(re.sub(r"^={3,}\s*$|^IDL:.*$|^\s*#.*$", "", text, flags=re.M))
        else:
            types = get_types_from_msg(text, root)
        types = {key: ([], list(fields)) for key, (_, fields) in types.items()}  # constants are not in a message
        if root not in types:
            raise BadDefinition(f"{root} is not defined in it; defined: {', '.join(types) or 'nothing'}")
        for x in _flat([(key, fields) for key, (_, fields) in types.items()]):
            if isinstance(x, str) and x and not _NAME.match(x):
                raise BadDefinition(f"'{x[:40]}' is no name of a type or field")
        store = Typestore()
        store.register(types)
        read = store.get_msgdef(root)
    except BadDefinition:
        raise
    except KeyError as error:  # rosbags looks it up when it registers
        raise BadDefinition(f"{str(error.args[0])[:80]} is used and not defined") from None
    except Exception as error:  # rosbags' parsers, and Python's of the code that it writes
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


@lru_cache(maxsize=64)
def is_standard(name: str, text: str) -> bool:
    """Return whether a definition (ros2msg) that `decoder` takes is the one that comes with ROS 2, comments aside."""
    known = standard().fielddefs
    return all(fields == known.get(key, ((), None))[1] for key, (_, fields) in get_types_from_msg(text, name).items())


def _flat(x: Any) -> list[Any]:
    if isinstance(x, (tuple, list)):
        return [z for y in x for z in _flat(y)]
    return [] if hasattr(x, "name") else [x]
