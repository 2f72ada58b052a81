"""YAML that strangers wrote, read within limits: plain data only, and neither size, depth nor aliases can hang or fill
the machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from dexsim import files
from dexsim.errors import UserError

MOST_BYTES = 8 << 20
MOST_DEPTH = 60
MOST_NODES = 500_000
"""Values in a file, what an alias (*name) repeats counted each time."""


class _Loader(yaml.SafeLoader):
    """SafeLoader that counts depth while it reads, so that no nesting reaches Python's recursion limit."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.depth += 1
        if self.depth > MOST_DEPTH:
            raise yaml.MarkedYAMLError(
                problem=f"nested more than {MOST_DEPTH} deep", problem_mark=self.peek_event().start_mark
            )
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1


def parse(text: str | bytes, source: object) -> Any:
    """The plain data of a YAML text. Raises UserError naming `source`, the line where there is one, and the limit that
    was passed: size, depth, number of values (aliases expanded), merge keys (<<), a node that holds itself, tags of
    Python objects."""
    if len(text) > MOST_BYTES:
        raise UserError(f"{source}: {len(text) / 2**20:.1f} MiB of YAML, allowed {MOST_BYTES >> 20} MiB")
    loader = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _count(node, source, {}, set())
        return loader.construct_document(node)
    except UserError:
        raise
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, OverflowError, RecursionError) as error:
        raise UserError(f"{source}: cannot be read as YAML: {' '.join(str(error).split())[:300]}") from None
    finally:
        if loader is not None:
            loader.dispose()


def load(path: Path, what: str) -> Any:
    """The plain data of a YAML file of people (at most `files.MAX_YAML` bytes); `what` it is, for the message. Raises
    UserError."""
    return parse(files.text(path, files.MAX_YAML, what), f"{what} '{path}'")


def _count(node: yaml.Node, source: object, known: dict[int, int], open_: set[int]) -> int:
    """Values below a node, aliases expanded; the node graph itself is as small as the file."""
    if id(node) in known:
        return known[id(node)]
    if id(node) in open_:
        raise UserError(
            f"{source}: line {node.start_mark.line + 1}: a value holds itself (an alias inside its own anchor)"
        )
    total = 1
    if isinstance(node, (yaml.MappingNode, yaml.SequenceNode)):
        open_.add(id(node))
        for inner in node.value:
            for child in inner if isinstance(inner, tuple) else (inner,):
                if child.tag == "tag:yaml.org,2002:merge":
                    raise UserError(
                        f"{source}: line {child.start_mark.line + 1}: merge keys (<<) are not read; write values out"
                    )
                total += _count(child, source, known, open_)
        open_.discard(id(node))
    if total > MOST_NODES:
        raise UserError(f"{source}: more than {MOST_NODES} values, aliases expanded")
    known[id(node)] = total
    return total
