"""Types of options: numbers and addresses; a wrong value is refused in one line."""

from __future__ import annotations

from argparse import ArgumentTypeError


def count(text: str) -> int:
    """A whole number of 1 or more."""
    _require(int(text) >= 1, f"{text} is not positive")
    return int(text)


def days(text: str) -> int:
    """A whole number of days that a certificate may be valid."""
    _require(count(text) <= 3650, f"{text} is more than 3650, the ten years of the authority")
    return int(text)


def seed(text: str) -> int:
    """A whole number of 0 or more."""
    _require(int(text) >= 0, f"{text} is negative")
    return int(text)


def positive(text: str) -> float:
    """A finite number above 0."""
    _require(0 < float(text) < float("inf"), f"{text} is not positive")
    return float(text)


def not_negative(text: str) -> float:
    """A finite number of 0 or more."""
    _require(0 <= float(text) < float("inf"), f"{text} is negative")
    return float(text)


def shares(text: str) -> tuple[float, ...]:
    """Shares of 0 to 1, comma-separated; the least first."""
    values = tuple(sorted(set(map(float, text.split(",")))))
    _require(all(0 <= value <= 1 for value in values), f"{text} is not from 0 to 1")
    return values


def address(text: str) -> tuple[str, int]:
    """`9464`, of this host alone, or `0.0.0.0:9464`; port 0 takes a free one."""
    host, _, port = text.rpartition(":")
    is_port = port.isascii() and port.isdecimal() and int(port) < 2**16
    _require(is_port, f"{text!r} is neither PORT nor HOST:PORT")
    return host or "127.0.0.1", int(port)


def withhold(text: str) -> tuple[float, float]:
    """Seconds off and period: `10/30`; `none` withholds nothing."""
    if text == "none":
        return 0.0, 1.0
    off, _, period = text.partition("/")
    try:
        off_s, period_s = float(off), float(period)
    except ValueError:
        off_s = period_s = 0.0
    _require(0 < off_s < period_s < float("inf"), f"{text!r} is neither OFF/PERIOD in seconds, as 10/30, nor none")
    return off_s, period_s


def _require(is_so: bool, problem: str) -> None:  # noqa: FBT001 - a condition
    if not is_so:
        raise ArgumentTypeError(problem)
