"""Data of files against a declared type (msgspec): what does not fit is said in one line, with the place in the
file."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import inspect

from dexsim.errors import UserError

T = TypeVar("T")
Real = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
"""A finite number."""
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e12)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]


def real(value: Any) -> float:
    """Return the number that a text or a value is (YAML reads 1e-3 as text); NaN where it is none, or no double holds
    it."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)) or (isinstance(value, str) and "_" in value):
        return math.nan
    try:
        return float(value)
    except (ValueError, OverflowError):
        return math.nan


def number(key: str, value: Any, low: float = -1e12, high: float = 1e12, unit: str = "", exact: bool = False) -> float:
    """Return a number as it was typed or stands in a file; exact: a whole one. Raises UserError for what is none, and
    outside [low, high]."""
    out = real(value)
    if not low <= out <= high or not math.isfinite(out) or (exact and out != int(out)):
        bounds = f"from {low:g} up" if high == math.inf else f"from {low:g} to {high:g}"
        kind = "a whole number" if exact else "a number"
        raise UserError(f"{key}={value}: must be {kind} {bounds}{' ' * bool(unit)}{unit}")
    return out


def interval(
    key: str, value: Any, unit: str = "", low: float = -1e12, high: float = 1e12, also: str = ""
) -> tuple[float, float, float]:
    """Return (low, value, high) of a number, of [low, high], whose value is their middle, or of {value, low, high};
    texts as `real` takes them. also: what else the place may hold, for messages. Raises UserError, also outside
    [low, high]."""
    allowed = f"allowed: {low:g} to {high:g}{'' if unit in ('', '1') else ' ' + unit}"
    given = [value]
    if isinstance(value, Mapping) and "value" in value and set(value) <= {"value", "low", "high"}:
        given = [value.get("low", value["value"]), value["value"], value.get("high", value["value"])]
    elif isinstance(value, Mapping) or (isinstance(value, Sequence) and not isinstance(value, str)):
        given = list(value)
        if isinstance(value, Mapping) or len(given) != 2:
            raise UserError(f"{key}={value}: must be a number, [low, high] or {{value, low, high}}{also}; {allowed}")
    numbers = [real(x) for x in given]
    for x, n in zip(given, numbers, strict=True):
        if not low <= n <= high:
            raise UserError(f"{key}={x}: must be a number{also}; {allowed}")
    if sorted(numbers) != numbers:
        raise UserError(f"{key}={given}: must rise from low to high; {allowed}")
    middle = numbers[1] if len(numbers) == 3 else 0.5 * (numbers[0] + numbers[-1])
    return numbers[0], middle, numbers[-1]


def whole(key: str, text: str, low: int = 0, high: int = 2**63 - 1) -> int:
    """Return a whole number as it was typed. Raises UserError for what is none, or lies outside [low, high]."""
    try:
        value = int(text) if text.isascii() and len(text) <= 20 and "_" not in text else None
    except ValueError:
        value = None
    if value is None or not low <= value <= high:
        raise UserError(f"{key}={text}: must be a whole number from {low} to {high}")
    return value


def defaults(page: str) -> dict[str, str]:
    """Return the settings that a help page lists, each with its default: lines such as `  seed=0   of the order`."""
    return dict(re.findall(r"^  (\w+)=(\S*)(?=  |$)", page, re.M))


def settings(argv: Iterable[str], keys: Collection[str], also: tuple[str, ...] = ()) -> dict[str, str]:
    """Take the key=value of a command line apart; also: what further keys begin with. Raises UserError for another."""
    out = {}
    for text in argv:
        key, equals, value = text.partition("=")
        if not equals or not (key in keys or key.startswith(also)):
            near = difflib.get_close_matches(key, keys, 1)
            hint = f" (did you mean {near[0]}=?)" if near else ""
            begun = "".join(f", {begin}..." for begin in also)
            raise UserError(f"'{text}': expected key=value with one of the keys {', '.join(keys)}{begun}{hint}")
        out[key] = value
    return out


def words(
    argv: Iterable[str], keys: Collection[str], also: tuple[str, ...] = ()
) -> tuple[list[str], dict[str, str]]:
    """Return what of a command line is no key=value, and the `settings` that are."""
    argv = list(argv)
    return [text for text in argv if "=" not in text], settings([text for text in argv if "=" in text], keys, also)


def truth(key: str, text: str) -> bool:
    """Return the truth value that was typed. Raises UserError."""
    return one_of(key, text, ("true", "false")) == "true"


def one_of(key: str, text: str, known: Collection[str]) -> str:
    """Return a word as it was typed. Raises UserError for one that is not known."""
    if text not in known:
        raise UserError(f"{key}={text}: must be {', '.join([*known][:-1])} or {[*known][-1]}")
    return text


def convert(data: Any, kind: type[T], source: object, fix: str = "") -> T:
    """Return `data` (plain: dicts, lists, text, numbers) as `kind`. Raises UserError naming source, place, what is
    there and what must be.

    fix: what to do about it, appended. Instances of classes that `kind` names (tensors) pass as they are.
    """
    try:
        out = msgspec.convert(data, kind, dec_hook=_instance)
    except msgspec.ValidationError as error:
        what, _, at = str(error).partition(" - at `$")
        place = _named(data, kind, str(error), at.removesuffix("`").lstrip(".").replace("[...]", ".*").lstrip("."))
        if what.startswith("Invalid enum value") and (allowed := _allowed(inspect.type_info(kind), place)):
            what = f"must be one of {', '.join(map(str, allowed))}"
        elif what.startswith("Object contains unknown field"):
            name = what.split("`")[1]
            valid = ", ".join(_fields(inspect.type_info(kind), place))
            what = f"{place}{'.' * bool(place)}{name}: unknown; valid ones: {valid}"
            raise UserError(f"{source}: {what}{f'; {fix}' if fix else ''}") from None
        excerpt = f" ({_excerpt(data, place)})" if place else ""
        fix = f"; {fix}" if fix else ""
        raise UserError(f"{source}: {place or 'its contents'}{excerpt}: {what[0].lower()}{what[1:]}{fix}") from None
    except RecursionError:
        raise UserError(f"{source}: nested too deeply{f'; {fix}' if fix else ''}") from None
    finite(data, source, fix)
    return out


def _named(data: Any, kind: Any, message: str, place: str) -> str:
    """Return the place with the keys in it that msgspec leaves out (*): those without which it would not fail so."""
    parts = place.split(".")
    for k, part in enumerate(parts):
        node = _at(data, ".".join(parts[:k])) if part.startswith("*") else None
        node = node if isinstance(node, dict) else {}
        for key in list(node):
            alone = _with(data, parts[:k], {key: node[key]})
            try:
                msgspec.convert(alone, kind, dec_hook=_instance)
            except msgspec.ValidationError as error:
                if str(error) == message:
                    data, parts[k] = alone, str(key) + part[1:]
                    break
    return ".".join(parts)


def _at(node: Any, place: str) -> Any:
    """Return the value at a place that msgspec names (a.b[3].c); None where it cannot be told."""
    for part in filter(None, place.replace("[", ".[").split(".")):
        try:
            node = node[int(part[1:-1])] if part.startswith("[") else {str(k): v for k, v in node.items()}[part]
        except (AttributeError, KeyError, IndexError, TypeError, ValueError):
            return None
    return node


def _with(node: Any, parts: list[str], value: Any) -> Any:
    """Return a copy of the data with `value` at a place of dicts."""
    if not parts or not isinstance(node, dict):
        return value if not parts else node
    return {k: _with(v, parts[1:], value) if str(k) == parts[0] else v for k, v in node.items()}


def _allowed(kind: Any, place: str) -> list[Any]:
    """Return what a value may be there, where only some words or numbers are."""
    return [x for t in _types(kind, place) if isinstance(t, inspect.LiteralType) for x in t.values]


def _fields(kind: Any, place: str) -> list[str]:
    """Names that may stand in the mapping there."""
    return [f.encode_name for t in _types(kind, place) if isinstance(t, inspect.StructType) for f in t.fields]


def _types(kind: Any, place: str) -> list[Any]:
    """Return what a place may be of."""
    if isinstance(kind, inspect.UnionType):
        return [x for t in kind.types for x in _types(t, place)]
    if isinstance(kind, inspect.Metadata):
        return _types(kind.type, place)
    part, _, rest = place.replace("[", ".[").lstrip(".").partition(".")
    if not part:
        return [kind]
    if isinstance(kind, inspect.StructType):
        # names may hold dots themselves
        inner = [(f, place[len(f.encode_name) :].lstrip(".")) for f in kind.fields if _begins(place, f.encode_name)]
        return [x for f, rest in inner for x in _types(f.type, rest)]
    if isinstance(kind, inspect.DictType):
        return _types(kind.value_type, rest)
    if isinstance(kind, inspect.TupleType):
        return _types(kind.item_types[int(part[1:-1])], rest)
    return _types(kind.item_type, rest) if hasattr(kind, "item_type") else []


def _begins(place: str, name: str) -> bool:
    return place == name or place.startswith((f"{name}.", f"{name}["))


def _instance(kind: type, value: Any) -> Any:
    if isinstance(value, kind):
        return value
    raise TypeError(f"Expected `{kind.__name__}`, got `{type(value).__name__}`")


def finite(node: Any, source: object, fix: str = "", place: str = "") -> None:
    """Raise UserError for NaN, which passes every comparison with a bound, and for a whole number of more than 64 bits,
    which no double may hold, anywhere in plain data."""
    if isinstance(node, dict):
        for key, value in node.items():
            finite(value, source, fix, f"{place}.{key}" if place else str(key))
    elif isinstance(node, (list, tuple)):
        for k, value in enumerate(node):
            finite(value, source, fix, f"{place}[{k}]")
    elif isinstance(node, float) and node != node or isinstance(node, int) and node.bit_length() > 64:
        what = "nan" if node != node else "a whole number of more than 64 bits"
        raise UserError(f"{source}: {place or 'its value'} ({what}): expected a number{f'; {fix}' if fix else ''}")


def _excerpt(data: Any, place: str) -> str:
    """Return the value at a place, shortened."""
    text = " ".join(repr(_at(data, place)).split())
    return text if len(text) <= 60 else text[:57] + "..."
