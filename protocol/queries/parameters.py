"""Kinds of selector parameters: values to text and back, checked; QueryError names the parameter."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any
from urllib.parse import quote, unquote

from protocol.errors import QueryError, Refusal
from protocol.machine.readings import MAX_STAMP_NS
from protocol.site.geometry import Bounds
from protocol.site.site_config import NAME

MAX_WAIT_S = 60.0
MAX_TEXT = 200  # characters of a person's text
MAX_NUMBER = 1e15

Parameters = Mapping[str, str]


def text_of(number: float) -> str:
    """All digits, as a plain number, without numpy's type."""
    return repr(float(number))


def selector_of(parameters: Parameters) -> str:
    """Parameters in a selector, behind the question mark."""
    return ";".join(f"{name}={value}" for name, value in parameters.items())


def split_selector(text: str) -> dict[str, str]:
    """Undo `selector_of`; keeps missing values visible."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}


def refusal(parameter: str, problem: str, reason: Refusal = Refusal.OUT_OF_RANGE) -> QueryError:
    """The error of a parameter."""
    return QueryError(reason, f"parameter `{parameter}`: {problem}")


def read_number(name: str, text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        raise refusal(name, f"{text[:40]!r} is no number", Refusal.WRONG_TYPE) from None
    check_finite(name, value)
    return value


def check_finite(name: str, value: float) -> None:
    """Refuse what is not finite and of usual size."""
    if not math.isfinite(value) or abs(value) > MAX_NUMBER:
        raise refusal(name, f"{value} is not usable", Refusal.NOT_FINITE)


def check_order(from_ns: int | None, to_ns: int | None) -> None:
    """Refuse an end before the begin."""
    if from_ns and to_ns and from_ns > to_ns:
        raise QueryError(Refusal.OUT_OF_RANGE, f"`from` ({from_ns}) is after `to` ({to_ns})")


class ValueForm(Enum):
    """Form of a value on the command line and over HTTP."""

    NUMBER = auto()
    TEXT = auto()
    LINE = auto()  # of a person, percent-encoded in selectors
    STAMP = auto()
    PLACE = auto()  # in metres, like the next two
    PLACES = auto()
    RECTANGLE = auto()


@dataclass(frozen=True)
class ValueKind:
    """A kind of value. read: from name and text. write: text, empty if left out. check: refuses values out of range."""

    form: ValueForm
    read: Callable[[str, str], Any]
    write: Callable[[Any], str] = str
    check: Callable[[str, Any], None] = lambda _, __: None


def number(low: float = -MAX_NUMBER, high: float = MAX_NUMBER, unit: str = "", *, above: bool = False) -> ValueKind:
    """A number from low to high; above: excluding low."""

    def check(name: str, value: float) -> None:
        check_finite(name, value)
        if not low <= value <= high or (above and value == low):
            span = f"above {low:g} and at most" if above else f"between {_with(low, unit)} and"
            raise refusal(name, f"{_with(value, unit)} is not {span} {_with(high, unit)}")

    return ValueKind(ValueForm.NUMBER, read_number, text_of, check)


def _with(value: float, unit: str) -> str:
    return f"{value:g} {unit}".rstrip()


METRES = number()


def count(low: int = 0, high: int = int(MAX_NUMBER), *, is_stated: bool = False) -> ValueKind:
    """An integer from low to high; is_stated: write 0 too."""

    def read(name: str, text: str) -> int:
        value = read_number(name, text)
        if value < 0 or value != int(value):
            raise refusal(name, f"{value:g} is no whole number from 0 on")
        return int(value)

    def check(name: str, value: int) -> None:
        if not low <= value <= high:
            raise refusal(name, f"{value} is not between {low} and {high}")

    return ValueKind(ValueForm.NUMBER, read, lambda value: str(value) if value or is_stated else "", check)


def _read_stamp(name: str, text: str) -> int:
    if not (text.isascii() and text.isdigit()):
        raise refusal(name, f"{text[:40]!r} is no stamp in nanoseconds", Refusal.WRONG_TYPE)
    if len(text) > len(str(MAX_STAMP_NS)):
        raise refusal(name, f"{text[:40]} is not between 1 and {MAX_STAMP_NS}")
    return int(text)


def _check_stamp(name: str, value: int) -> None:
    if not 1 <= value <= MAX_STAMP_NS:
        raise refusal(name, f"{value} is not between 1 and {MAX_STAMP_NS}")


STAMP = ValueKind(ValueForm.STAMP, _read_stamp, str, _check_stamp)  # nanoseconds since 1970, UTC, all digits


def choice(values: Mapping[str, Any], usual: str = "") -> ValueKind:
    """A word with its meaning; the usual one is left out."""

    def read(name: str, text: str) -> Any:
        if text not in values:
            raise refusal(name, f"{text[:40]!r} is none of {', '.join(values)}")
        return values[text]

    def write(value: Any) -> str:
        word = next(word for word, meaning in values.items() if meaning == value)
        return "" if word == usual else word

    def check(name: str, value: Any) -> None:
        if value not in values.values():
            read(name, str(value))

    return ValueKind(ValueForm.TEXT, read, write, check)


# Comma-separated names, left out if none.
WORDS = ValueKind(ValueForm.TEXT, lambda _, text: tuple(part for part in text.split(",") if part), ",".join)


def _check_line(name: str, value: str) -> None:
    if len(value) > MAX_TEXT or not value.isprintable():
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `{name}` must be one line of at most {MAX_TEXT} characters")


# A person's line, percent-encoded, left out if empty.
LINE = ValueKind(
    ValueForm.LINE, lambda _, text: unquote(text).strip(), lambda value: quote(value, safe=""), _check_line
)


def name_of(pattern: re.Pattern[str] = NAME, rule: str = "a name") -> ValueKind:
    """A name by a pattern; rule: the pattern in words."""

    def read(name: str, text: str) -> str:
        if not pattern.fullmatch(text):
            raise refusal(name, f"{text[:70]!r} is not {rule}")
        return text

    return ValueKind(ValueForm.TEXT, read)


def _read_rectangle(name: str, text: str) -> Bounds:
    parts = text.split(",")
    if len(parts) != 4:
        raise QueryError(Refusal.MISSING_FIELD, f"parameter `{name}` must be west,south,east,north in metres")
    numbers = [read_number(name, part) for part in parts]
    try:
        return Bounds(*numbers)
    except ValueError as error:
        raise QueryError(Refusal.OUT_OF_RANGE, str(error)) from None


def _write_rectangle(value: Bounds) -> str:
    return ",".join(text_of(edge) for edge in (value.west_m, value.south_m, value.east_m, value.north_m))


RECTANGLE = ValueKind(ValueForm.RECTANGLE, _read_rectangle, _write_rectangle)  # west,south,east,north [m]
