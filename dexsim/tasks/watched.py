"""Settings that know which of them were read, so that one that nothing reads is an error and not a silence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


class Watched(dict):
    """A nested dict that notes, under dotted names in `read`, what is asked of it. Taken whole (iterated), all of it
    is read. Nested dicts are watched too; writes go through."""

    def __init__(self, content: Mapping[str, Any], prefix: str, read: set[str] | None = None):
        self.read: set[str] = set() if read is None else read
        self._prefix = prefix
        super().__init__({k: Watched(v, f"{prefix}.{k}", self.read) if isinstance(v, dict) else v
                          for k, v in content.items()})  # fmt: skip

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        if not isinstance(value, Watched):
            self.read.add(f"{self._prefix}.{key}")
        return value

    def get(self, key: str, default: Any = None) -> Any:
        return self[key] if key in self else default

    def __iter__(self) -> Iterator[str]:
        self._all()
        return super().__iter__()

    def items(self) -> Any:
        self._all()
        return super().items()

    def values(self) -> Any:
        self._all()
        return super().values()

    def __or__(self, other: Any) -> dict:
        self._all()
        return dict(super().items()) | other

    def __ror__(self, other: Any) -> dict:
        self._all()
        return other | dict(super().items())

    def _all(self) -> None:
        for key, value in super().items():
            if isinstance(value, Watched):
                value._all()
            else:
                self.read.add(f"{self._prefix}.{key}")
        self.read.add(self._prefix)

    def __deepcopy__(self, memo: Any) -> dict:
        import copy

        return {k: copy.deepcopy(v, memo) for k, v in self.items()}

    def __reduce__(self) -> Any:
        return dict, (dict(self.items()),)


def names(node: Any, prefix: str) -> Iterator[str]:
    """Yield the dotted names of all values below a nested mapping; none of what is no mapping."""
    for key, value in node.items() if isinstance(node, Mapping) else ():
        if isinstance(value, Mapping):
            yield from names(value, f"{prefix}.{key}")
        else:
            yield f"{prefix}.{key}"


def unread(read: set[str], keys: list[str]) -> list[str]:
    """Return those of the dotted names that were not read: neither they, nor anything in them, nor all that they are
    in."""
    out = []
    for key in keys:
        parts = key.split(".")
        above = {".".join(parts[:k]) for k in range(2, len(parts))}
        if key not in read and not any(r.startswith(f"{key}.") for r in read) and not above & read:
            out.append(key)
    return out
