"""Selector parameters of queries: values to text, and text to checked values; QueryError names what is wrong."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import quote, unquote

from protocol.errors import QueryError, Refusal
from protocol.machine.readings import MAX_STAMP_NS
from protocol.site.geometry import Bounds

MAX_WAIT_S = 60.0
MAX_TEXT = 200  # characters of a text that a person writes

Parameters = Mapping[str, str]


@dataclass(frozen=True)
class Freshness:
    """after: answer only once this journal row is merged; wait_s: how long to wait for it."""

    after: int = 0
    wait_s: float = 10.0


ANY_ROW = Freshness()


def text_of(number: float) -> str:
    """All digits; as a plain number, where numpy's own `repr` writes its type."""
    return repr(float(number))


def quoted(text: str) -> str:
    """Any text as a value: percent-encoded, since `;` and `=` divide parameters."""
    return quote(text, safe="")


def selector_of(parameters: Parameters) -> str:
    """Parameters as they stand in a selector, behind its question mark."""
    return ";".join(f"{name}={value}" for name, value in parameters.items())


def split_selector(text: str) -> dict[str, str]:
    """Undo `selector_of`; by hand, because a missing value must be seen as one."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}


def check_known(query: str, parameters: Parameters, known: Sequence[str]) -> None:
    """Refuse a parameter that the query does not take."""
    if unknown := sorted(set(parameters) - set(known)):
        problem = f"parameter `{unknown[0][:40]}` is not known; `{query}` takes {', '.join(known)}"
        raise QueryError(Refusal.UNKNOWN_PARAMETER, problem)


def required(parameters: Parameters, name: str) -> str:
    """Text of a parameter that has to be there."""
    if name not in parameters:
        raise QueryError(Refusal.MISSING_FIELD, f"parameter `{name}` is missing")
    return parameters[name]


def number(parameters: Parameters, name: str) -> float:
    """A finite number."""
    text = required(parameters, name)
    try:
        value = float(text)
    except ValueError:
        raise QueryError(Refusal.WRONG_TYPE, f"parameter `{name}`: {text[:40]!r} is no number") from None
    if not math.isfinite(value) or abs(value) > 1e15:
        raise QueryError(Refusal.NOT_FINITE, f"parameter `{name}`: {value} is not usable")
    return value


def flag(parameters: Parameters, name: str, *, default: bool) -> bool:
    """Yes or no, as 1 or 0."""
    text = parameters.get(name, str(int(default)))
    if text not in ("0", "1"):
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `{name}`: {text[:40]!r} is neither 0 nor 1")
    return text == "1"


def count(parameters: Parameters, name: str) -> int:
    """A whole number from 0 on; 0 where it is missing."""
    value = number({name: "0", **parameters}, name)
    if value < 0 or value != int(value):
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `{name}`: {value:g} is no whole number from 0 on")
    return int(value)


def seconds(parameters: Parameters, name: str, default_s: float, most_s: float) -> float:
    """A time to wait [s], 0 to most_s."""
    value = number({name: text_of(default_s), **parameters}, name)
    if not 0 <= value <= most_s:
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `{name}`: {value:g} s is not between 0 and {most_s:g} s")
    return value


def stamp(parameters: Parameters, name: str) -> int | None:
    """A stamp in ns, to the last digit; None where it is missing."""
    text = parameters.get(name)
    if text is None:
        return None
    if not (text.isascii() and text.isdigit()):
        raise QueryError(Refusal.WRONG_TYPE, f"parameter `{name}`: {text[:40]!r} is no stamp in nanoseconds")
    if len(text) > len(str(MAX_STAMP_NS)) or not 1 <= int(text) <= MAX_STAMP_NS:
        problem = f"parameter `{name}`: {text[:40]} is not between 1 and {MAX_STAMP_NS}"
        raise QueryError(Refusal.OUT_OF_RANGE, problem)
    return int(text)


def free_text(parameters: Parameters, name: str) -> str:
    """One line that a person wrote, percent-encoded; empty where it is missing."""
    text = unquote(parameters.get(name, "")).strip()
    if len(text) > MAX_TEXT or not text.isprintable():
        raise QueryError(Refusal.OUT_OF_RANGE, f"parameter `{name}` must be one line of at most {MAX_TEXT} characters")
    return text


def freshness(parameters: Parameters) -> Freshness:
    """Which row to wait for, and how long."""
    return Freshness(count(parameters, "after"), seconds(parameters, "wait", 10.0, MAX_WAIT_S))


def times(parameters: Parameters) -> tuple[int | None, int | None]:
    """The stamps `from` and `to`, in this order; None where one is missing."""
    from_ns, to_ns = stamp(parameters, "from"), stamp(parameters, "to")
    if from_ns and to_ns and from_ns > to_ns:
        raise QueryError(Refusal.OUT_OF_RANGE, f"`from` ({from_ns}) is after `to` ({to_ns})")
    return from_ns, to_ns


def text_of_stamps(stamps: Mapping[str, int | None]) -> dict[str, str]:
    """Stamps by name, those that there are."""
    return {name: str(stamp_ns) for name, stamp_ns in stamps.items() if stamp_ns is not None}


def bounds(parameters: Parameters) -> Bounds:
    """The rectangle `bounds`."""
    parts = parameters.get("bounds", "").split(",")
    if len(parts) != 4:
        raise QueryError(Refusal.MISSING_FIELD, "parameter `bounds` must be west,south,east,north in metres")
    numbers = [number({"bounds": part}, "bounds") for part in parts]
    try:
        return Bounds(*numbers)
    except ValueError as error:
        raise QueryError(Refusal.OUT_OF_RANGE, str(error)) from None


def text_of_bounds(b: Bounds) -> str:
    """Undo `bounds`."""
    return ",".join(text_of(v) for v in (b.west_m, b.south_m, b.east_m, b.north_m))
