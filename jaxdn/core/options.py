"""The options of a method: one frozen dataclass, read by its factory, the command line and the docs.

Only a field's annotation is declared: ``Literal`` for a choice, ``Annotated[float, Range(...)]`` for a number,
``bool``, ``None``, a class, unions of these, nested tuples of numbers. Given values are checked here and nowhere else.
"""

import dataclasses
import json
import math
import re
from collections.abc import Mapping, Sequence
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


_MOST = 10**7
"""Numbers of a range: more would fill the memory before anything else is done."""


class Range(NamedTuple):
    """The allowed values of an option: finite numbers from ``low`` to ``high``."""

    low: float = -float("inf")
    high: float = float("inf")
    without_low: bool = False
    """``low`` itself is excluded."""

    def __contains__(self, value: object) -> bool:
        inside = isinstance(value, int | float) and math.isfinite(value) and self.low <= value <= self.high
        return inside and not (self.without_low and value == self.low)

    def __str__(self) -> str:
        if self.high == float("inf"):
            return f"{'>' if self.without_low else '>='} {self.low:g}"
        return f"in {'(' if self.without_low else '['}{self.low:g}, {self.high:g}]"


def make(cls: type[T], given: Mapping[str, Any], *, method: str, base: T | None = None) -> T:
    """The options ``cls`` with the ``given`` values in place of those of ``base`` (default: the declared defaults).

    Lists become tuples, as JSON has only lists. Raises ValueError, naming what is allowed, for an unknown option or an
    invalid value.
    """
    hints = get_type_hints(cls, include_extras=True)
    unknown = [name for name in given if name not in hints]
    if unknown:
        raise ValueError(f"{method}: expected options out of {', '.join(hints)}, got {', '.join(map(repr, unknown))}.")
    values = {name: _tuples(value) for name, value in given.items()}
    check(values, hints, of=method)
    return cls(**values) if base is None else dataclasses.replace(base, **values)  # type: ignore[type-var]


def check(values: Mapping[str, Any], hints: Mapping[str, Any], *, of: str) -> None:
    """Raise ValueError, naming what is allowed, unless every value fits the annotation of its name in ``hints``."""
    for name, value in values.items():
        if not _fits(value, hints[name]):
            raise ValueError(f"{of} {name}: expected {_expected(hints[name])}, got {value!r}.")


def numbers(words: list[str], option: str, *, negative: bool = False) -> list[int]:
    """The whole numbers of words such as 3 and 0-49, whose ends count. Raises ValueError for anything else.

    With ``negative``, numbers may be below 0: -3, -3-2, -3--1.
    """
    minus, least = ("-?", "") if negative else ("", " >= 0")
    if not words:
        raise ValueError(
            f"{option}: expected whole numbers{least} or ranges such as 0-49, got none; leave {option} out."
        )
    found: list[int] = []
    for word in words:
        match = re.fullmatch(rf"({minus}[0-9]+)(?:-({minus}[0-9]+))?", word)
        if match is None:
            raise ValueError(f"{option}: expected whole numbers{least} or ranges such as 0-49, got {word!r}.")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ValueError(f"{option}: expected a range from low to high, got {word!r}; swap its ends.")
        if last - first >= _MOST:
            raise ValueError(f"{option}: expected ranges of at most {_MOST:,} numbers, got {word!r}; name its end.")
        found += range(first, last + 1)
    return found


def parse(assignments: Sequence[str], *, option: str = "--set", words: bool = False) -> dict[str, Any]:
    """``["size=small", "levels=3"]`` as a dict: values are parsed as JSON if possible, else taken as strings.

    With ``words`` every value is a string, whatever it looks like. Raises ValueError, naming the command line's
    ``option``, for what is not ``name=value`` and for a name that is there twice.
    """
    parsed: dict[str, Any] = {}
    for assignment in assignments:
        name, sign, text = assignment.partition("=")
        if not (name and sign):
            raise ValueError(f"{option} {assignment!r}: expected name=value.")
        if name in parsed:
            raise ValueError(f"{option}: expected {name} once, got it twice; leave one out.")
        try:
            parsed[name] = text if words else json.loads(text)
        except ValueError:
            parsed[name] = {"True": True, "False": False, "None": None}.get(text, text)
    return parsed


def describe(cls: type) -> str:
    """One line per option: its name, its allowed values, and its default."""
    hints = get_type_hints(cls, include_extras=True)
    fields = dataclasses.fields(cls)
    return "\n".join(f"* ``{each.name}``: {_expected(hints[each.name])}; default {each.default!r}" for each in fields)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if type(value) in (list, tuple) else value


def _fits(value: Any, hint: Any) -> bool:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _fits(value, arguments[0]) and all(value in rule for rule in arguments[1:] if isinstance(rule, Range))
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in arguments)
    if origin is Literal:
        return any(value == choice and type(value) is type(choice) for choice in arguments)
    if origin is tuple:
        return isinstance(value, tuple) and len(value) > 0 and all(_fits(item, arguments[0]) for item in value)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, NoneType if hint is None else hint)


def _expected(hint: Any) -> str:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return " ".join([_expected(arguments[0]), *(str(rule) for rule in arguments[1:] if isinstance(rule, Range))])
    if origin in (Union, UnionType):
        return " or ".join(_expected(one) for one in arguments)
    if origin is Literal:
        return "one of " + ", ".join(map(repr, arguments)) if len(arguments) > 1 else repr(arguments[0])
    if origin is tuple:
        return f"a tuple of {_expected(arguments[0])}"
    names = {float: "a number", int: "a whole number", bool: "True or False", NoneType: "None", str: "a string"}
    return names.get(hint) or f"a {hint.__name__}"
