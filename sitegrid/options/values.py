"""Types of options: numbers and addresses; a wrong value is refused in one line."""

from __future__ import annotations

from argparse import ArgumentTypeError


def count(text: str) -> int:
    """A whole number of 1 or more."""
    value = int(text)
    if value < 1:
        raise ArgumentTypeError(f"{text} is not positive")
    return value


def days(text: str) -> int:
    """A whole number of days that a certificate may be valid."""
    value = count(text)
    if value > 3650:
        raise ArgumentTypeError(f"{text} is more than 3650, the ten years of the authority")
    return value


def positive(text: str) -> float:
    """A finite number above 0."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise ArgumentTypeError(f"{text} is not positive")
    return value


def not_negative(text: str) -> float:
    """A finite number of 0 or more."""
    value = float(text)
    if not 0 <= value < float("inf"):
        raise ArgumentTypeError(f"{text} is negative")
    return value


def seed(text: str) -> int:
    """A whole number of 0 or more."""
    value = int(text)
    if value < 0:
        raise ArgumentTypeError(f"{text} is negative")
    return value


def address(text: str) -> tuple[str, int]:
    """`9464`, of this host alone, or `0.0.0.0:9464`; port 0 takes a free one."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdecimal() and int(port) < 2**16):
        raise ArgumentTypeError(f"{text!r} is neither PORT nor HOST:PORT")
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
    if not 0 < off_s < period_s < float("inf"):
        raise ArgumentTypeError(f"{text!r} is neither OFF/PERIOD in seconds, as 10/30, nor none")
    return off_s, period_s
