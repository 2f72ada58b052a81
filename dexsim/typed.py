"""Data of files against a declared type (msgspec): what does not fit is said in one line, with the place in the
file."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import repeat
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

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


def convert(data: Any, kind: type[T], source: object, fix: str = "", lax: bool = False) -> T:
    """Return `data` (plain: dicts, lists, text, numbers) as `kind`. Raises UserError naming source, place, what is
    there and what must be.

    fix: what to do about it, appended; lax: numbers and truth values may be given as text. Instances of classes that
    `kind` names (tensors) pass as they are.
    """
    to = partial(msgspec.convert, strict=not lax, dec_hook=_instance)
    try:
        out: T = to(data, kind)
    except msgspec.ValidationError as error:
        place, value, inner, why = _innermost(to, data, kind, str(error))
        fix, what = f"; {fix}" if fix else "", why.partition(" - at `$")[0]
        if what.startswith("Object contains unknown field"):
            name = f"{place}{'.' * bool(place)}{what.split('`')[1]}"
            valid = [f.encode_name for t in _kinds(inner) if _is_struct(t) for f in msgspec.structs.fields(t)]
            raise UserError(f"{source}: {name}: unknown; valid ones: {', '.join(valid)}{fix}") from None
        if what.startswith("Invalid enum value"):
            allowed = [x for t in _kinds(inner) if get_origin(t) is Literal for x in get_args(t)]
            what = f"must be one of {', '.join(map(str, allowed))}"
        excerpt = f" ({_excerpt(value)})" if place else ""
        raise UserError(f"{source}: {place or 'its contents'}{excerpt}: {what[0].lower()}{what[1:]}{fix}") from None
    except RecursionError:
        raise UserError(f"{source}: nested too deeply{f'; {fix}' if fix else ''}") from None
    finite(msgspec.to_builtins(out, enc_hook=lambda x: None), source, fix)  # what is read: not what is for people
    return out


def _innermost(
    to: Callable[[Any, Any], Any], data: Any, kind: Any, why: str, place: str = ""
) -> tuple[str, Any, Any, str]:
    """Return the innermost part of `data` that `to` does not convert to its type, for which `why` is the reason: its
    place (as in a.b[3].c), itself, its type, and why."""
    for at, part, inner in _parts(data, kind):
        try:
            to(part, inner)
        except msgspec.ValidationError as error:
            return _innermost(to, part, inner, str(error), place + at)
    return place.removeprefix("."), data, kind, why


def _parts(data: Any, kind: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield what lies in data of a type: each part's place in it, itself, and its own type."""
    for t in _kinds(kind):
        of, args = get_origin(t), get_args(t)
        if isinstance(data, dict) and (of is dict or _is_struct(t)):
            types = dict.fromkeys(data, args[1]) if of is dict else {
                f.encode_name: f.type for f in msgspec.structs.fields(t)}  # fmt: skip
            yield from ((f".{key}", part, types[key]) for key, part in data.items() if key in types)
        elif isinstance(data, (list, tuple)) and of in (list, tuple):
            each = args if of is tuple and ... not in args else repeat(args[0])
            yield from ((f"[{k}]", part, inner) for k, (part, inner) in enumerate(zip(data, each, strict=False)))


def _kinds(kind: Any) -> list[Any]:
    """Return the types that a type stands for: those of a union, without what is said of them."""
    if get_origin(kind) is Annotated:
        return _kinds(get_args(kind)[0])
    return [x for t in get_args(kind) for x in _kinds(t)] if get_origin(kind) in (Union, UnionType) else [kind]


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


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


def _excerpt(value: Any) -> str:
    """Return a value, shortened."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
