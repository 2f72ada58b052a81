"""Data of files against a declared type (msgspec): what does not fit is said in one line, with the place in the
file."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

import msgspec

from dexsim.errors import UserError

T = TypeVar("T")
Real = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
"""A finite number."""
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e12)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]


def convert(data: Any, kind: type[T], source: object, fix: str = "") -> T:
    """`data` (plain: dicts, lists, text, numbers) as `kind`. Raises UserError naming source, place, what is there and
    what must be.

    fix: what to do about it, appended. Instances of classes that `kind` names (tensors) pass as they are.
    """
    try:
        out = msgspec.convert(data, kind, dec_hook=_instance)
    except msgspec.ValidationError as error:
        what, _, at = str(error).partition(" - at `$")
        place = at.removesuffix("`").lstrip(".").replace("[...]", ".*")
        shown = f" ({_shown(data, place)})" if place else ""
        fix = f"; {fix}" if fix else ""
        raise UserError(f"{source}: {place or 'its contents'}{shown}: {what[0].lower()}{what[1:]}{fix}") from None
    except RecursionError:
        raise UserError(f"{source}: nested too deeply{f'; {fix}' if fix else ''}") from None
    _finite(data, source, fix)
    return out


def _instance(kind: type, value: Any) -> Any:
    if isinstance(value, kind):
        return value
    raise TypeError(f"Expected `{kind.__name__}`, got `{type(value).__name__}`")


def _finite(node: Any, source: object, fix: str, place: str = "") -> None:
    """No NaN anywhere: it passes every comparison with a bound."""
    if isinstance(node, dict):
        for key, value in node.items():
            _finite(value, source, fix, f"{place}.{key}" if place else str(key))
    elif isinstance(node, (list, tuple)):
        for k, value in enumerate(node):
            _finite(value, source, fix, f"{place}[{k}]")
    elif isinstance(node, float) and node != node:
        raise UserError(f"{source}: {place} (nan): expected a number{f'; {fix}' if fix else ''}")


def _shown(data: Any, place: str) -> str:
    """The value at a place that msgspec names (a.b[3].c), shortened; '?' where it cannot be told."""
    node = data
    for part in place.replace("[", ".[").split("."):
        try:
            if part.startswith("["):
                node = node[int(part[1:-1])]
            elif part:
                node = node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return "?"
    text = " ".join(repr(node).split())
    return text if len(text) <= 60 else text[:57] + "..."
