"""Kinds of parameters of a selector: the text of a value, and the checked value of a text.

QueryError names the parameter and what is wrong with it.
"""

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
MAX_TEXT = 200  # characters of a text that a person writes
MAX_NUMBER = 1e15

Parameters = Mapping[str, str]


def text_of(number: float) -> str:
    """All digits; as a plain number, where numpy's own `repr` writes its type."""
    return repr(float(number))


def selector_of(parameters: Parameters) -> str:
    """Parameters as they stand in a selector, behind its question mark."""
    return ";".join(f"{name}={value}" for name, value in parameters.items())


def split_selector(text: str) -> dict[str, str]:
    """Undo `selector_of`; by hand, because a missing value must be seen as one."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}


def refusal(parameter: str, problem: str, reason: Refusal = Refusal.OUT_OF_RANGE) -> QueryError:
    """What is wrong with a parameter."""
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
    """Refuse what is no finite number of a usual size."""
    if not math.isfinite(value) or abs(value) > MAX_NUMBER:
        raise refusal(name, f"{value} is not usable", Refusal.NOT_FINITE)


def check_order(from_ns: int | None, to_ns: int | None) -> None:
    """Refuse a time that ends before it begins."""
    if from_ns and to_ns and from_ns > to_ns:
        raise QueryError(Refusal.OUT_OF_RANGE, f"`from` ({from_ns}) is after `to` ({to_ns})")


class ValueForm(Enum):
    """How a value is given: on the command line, in a request over HTTP."""

    NUMBER = auto()
    TEXT = auto()
    LINE = auto()  # of a person, which a selector has percent-encoded
    FLAG = auto()
    STAMP = auto()
    PLACE = auto()  # in metres, as the next two
    PLACES = auto()
    RECTANGLE = auto()


@dataclass(frozen=True)
class ValueKind:
    """A kind of value. read: of a parameter's name and text. write: its text, empty for what a selector leaves out.

    check: refuses a value of the kind that is too large or too small, by the parameter's name.
    """

    form: ValueForm
    read: Callable[[str, str], Any]
    write: Callable[[Any], str] = str
    check: Callable[[str, Any], None] = lambda _, __: None


def number(low: float = -MAX_NUMBER, high: float = MAX_NUMBER, unit: str = "", *, above: bool = False) -> ValueKind:
    """A number from low to high; above: not low itself."""

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
    """A whole number from low to high; is_stated: written also if it is 0."""

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


STAMP = ValueKind(ValueForm.STAMP, _read_stamp, str, _check_stamp)  # nanoseconds since 1970, UTC, to the last digit


def flag(*, usual: bool) -> ValueKind:
    """Yes or no, as 1 or 0; left out where it is as usual."""

    def read(name: str, text: str) -> bool:
        if text not in ("0", "1"):
            raise refusal(name, f"{text[:40]!r} is neither 0 nor 1")
        return text == "1"

    return ValueKind(ValueForm.FLAG, read, lambda value: "" if value == usual else str(int(value)))


def choice(values: Mapping[str, Any], usual: str = "") -> ValueKind:
    """One of some words, each with what it means; usual: the word that is not written."""

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


# Names, comma-separated; left out where there are none.
WORDS = ValueKind(ValueForm.TEXT, lambda _, text: tuple(part for part in text.split(",") if part), ",".join)


def _check_line(name: str, value: str) -> None:
    if len(value) > MAX_TEXT or not value.isprintable():
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `{name}` must be one line of at most {MAX_TEXT} characters")


# One line that a person wrote, percent-encoded; left out where it is empty.
LINE = ValueKind(
    ValueForm.LINE, lambda _, text: unquote(text).strip(), lambda value: quote(value, safe=""), _check_line
)


def name_of(pattern: re.Pattern[str] = NAME, rule: str = "a name") -> ValueKind:
    """A name by a rule, which `rule` says in words."""

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
