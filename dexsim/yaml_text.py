"""YAML that strangers wrote: plain data only (text, numbers, true and false, lists, mappings; a date is text), and
neither size, depth nor aliases can hang or fill the machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from dexsim import files, guard
from dexsim.errors import UserError

SMALL = 4096
"""Bytes of a text that is read at once; a longer one in a process of its own."""
MOST_NODES = 500_000
"""Values in a file, what an alias (*name) repeats counted each time."""
_YAML = "tag:yaml.org,2002:"
_OTHER = {_YAML + kind for kind in ("timestamp", "binary", "set", "omap", "pairs")}


class _Loader(yaml.SafeLoader):
    """SafeLoader without the kinds of data that no setting has."""

    yaml_constructors = {k: v for k, v in yaml.SafeLoader.yaml_constructors.items() if k not in _OTHER}
    yaml_implicit_resolvers = {
        first: [r for r in rules if r[0] not in _OTHER]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Refuse merge keys and keys that stand twice."""
        seen = set()
        for key, _ in node.value:
            if key.tag == _YAML + "merge":
                raise yaml.MarkedYAMLError(None, None, "merge keys (<<) are not read; write values out", key.start_mark)
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in seen:
                    raise yaml.MarkedYAMLError(None, None, f"key '{key.value}' stands twice", key.start_mark)
                seen.add((key.tag, key.value))


def parse(text: str | bytes, source: object) -> Any:
    """Return the plain data of a YAML text. Raises UserError naming `source`, the line where there is one, and the
    limit that was passed: size, depth, number of values (aliases expanded), merge keys (<<), a key that stands twice, a
    value that holds itself, tags of other data than plain."""
    if len(text) <= SMALL:
        return _parse(text, source)
    return guard.call(_parse, text, source, what=str(source))


def _parse(text: str | bytes, source: object) -> Any:
    try:
        return _plain(yaml.load(text, _Loader), [MOST_NODES])
    except RecursionError:
        said = "nested too deeply, or a value holds itself"
    except (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        said = " ".join(str(error).split())[:300]
    raise UserError(f"{source}: cannot be read as YAML: {said}")


def load(path: Path, what: str) -> Any:
    """Return the plain data of a YAML file of people (at most `files.MAX_TEXT` bytes); `what` it is, for the message.
    Raises UserError."""
    return parse(files.text(path, what), f"{what} '{path}'")


def _plain(node: Any, rest: list[int]) -> Any:
    """Return the data, each alias a copy. Raises ValueError for more than `rest[0]` values, and for text that is
    none."""
    rest[0] -= 1
    if rest[0] < 0:
        raise ValueError(f"more than {MOST_NODES} values, aliases expanded")
    if isinstance(node, dict):
        return {_plain(k, rest): _plain(v, rest) for k, v in node.items()}
    if isinstance(node, list):
        return [_plain(v, rest) for v in node]
    if isinstance(node, (str, int)):
        str(node).encode()  # halves of characters, and numbers of more than 4,300 digits (0xff...), are none
    return node
