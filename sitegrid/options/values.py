"""Types of options: numbers, addresses, times, output files.

Wrong values are refused in one line, unwritable files before the work. That is tried with an unnamed file, because
permissions do not tell (root, read-only mounts).
"""

from __future__ import annotations

import math
import tomllib
from argparse import ArgumentTypeError
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TypeVar

from protocol.errors import ConfigError
from sitegrid.times import SiteTime, parse_stamp, parse_time

T = TypeVar("T")


def count(text: str) -> int:
    """Integer >= 1."""
    _require(int(text) >= 1, f"{text} is not positive")
    return int(text)


def days(text: str) -> int:
    """Days of a certificate's validity."""
    _require(count(text) <= 3650, f"{text} is more than 3650, the ten years of the authority")
    return int(text)


def seed(text: str) -> int:
    """Integer >= 0."""
    _require(int(text) >= 0, f"{text} is negative")
    return int(text)


def positive(text: str) -> float:
    """Finite number > 0."""
    _require(0 < float(text) < float("inf"), f"{text} is not positive")
    return float(text)


def not_negative(text: str) -> float:
    """Finite number >= 0."""
    _require(0 <= float(text) < float("inf"), f"{text} is negative")
    return float(text)


def shares(text: str) -> tuple[float, ...]:
    """Comma-separated shares of 0 to 1, sorted."""
    values = tuple(sorted(set(map(float, text.split(",")))))
    _require(all(0 <= value <= 1 for value in values), f"{text} is not from 0 to 1")
    return values


def address(text: str) -> tuple[str, int]:
    """`9464`, for this host alone, or `0.0.0.0:9464`; port 0: any free one."""
    host, _, port = text.rpartition(":")
    is_port = port.isascii() and port.isdecimal() and int(port) < 2**16
    _require(is_port, f"{text!r} is neither PORT nor HOST:PORT")
    return host or "127.0.0.1", int(port)


def withhold(text: str) -> tuple[str, float, float]:
    """Outage and period, `10/30` [s]; start and length, `120,60`; or `none`."""
    if text == "none":
        return text, 0.0, 0.0
    sign = "/" if "/" in text else ","
    one, _, other = text.partition(sign)
    try:
        first_s, second_s = float(one), float(other)
    except ValueError:
        first_s = second_s = -1.0
    is_right = 0 < first_s < second_s < math.inf if sign == "/" else 0 <= first_s < math.inf and 0 < second_s < math.inf
    problem = f"{text!r} is neither OFF/PERIOD in seconds, as 10/30, nor START,LENGTH, as 120,60, nor none"
    _require(is_right, problem)
    return sign, first_s, second_s


def names(text: str) -> tuple[str, ...]:
    """Comma-separated names."""
    listed = tuple(name.strip() for name in text.split(","))
    _require(all(listed), f"{text!r} is no list of names, as gps-1,imu")
    return listed


def count_or_names(text: str) -> int | tuple[str, ...]:
    """Integer >= 1, or comma-separated names."""
    return count(text) if text.lstrip("+-").isdecimal() else names(text)


def setting(text: str) -> tuple[str, Any]:
    """An option with a TOML value: `slip=0.1`, `start=[1, 2, 0.5]`; a word needs no quotes."""
    name, equals, value = text.partition("=")
    _require(bool(name and equals and value), f"{text!r} is not NAME=VALUE, as slip=0.1")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value


def taken(text: str) -> tuple[str, tuple[str, ...]]:
    """A topic of a recording, and the sensor kinds it feeds: `/imu=imu,attitude`."""
    topic, _, kinds = text.rpartition("=")
    _require(bool(topic and all(kinds.split(","))), f"{text!r} is not TOPIC=KIND, as /imu=imu,attitude")
    return topic, tuple(kinds.split(","))


def _require(is_so: bool, problem: str) -> None:  # noqa: FBT001 - a condition
    if not is_so:
        raise ArgumentTypeError(problem)


def site_time(text: str) -> SiteTime:
    """A time, possibly relative to the site's now; for argparse."""
    return _said(parse_time, text)


def stamp(text: str) -> int:
    """A time as a stamp; for argparse."""
    return _said(parse_stamp, text)


def _said(read: Callable[[str], T], text: str) -> T:
    try:
        return read(text)
    except ValueError as error:
        raise ArgumentTypeError(str(error)) from None


@dataclass(frozen=True)
class OutputFile:
    """Output file. suffixes: of its formats, empty: any. makes_folder: creates its folder."""

    suffixes: tuple[str, ...] = ()
    makes_folder: bool = False

    def __call__(self, text: str) -> Path:
        """Parse the option; ConfigError if unwritable."""
        path = Path(text)
        if self.suffixes and path.suffix.lower() not in self.suffixes:
            fitting = path.with_suffix(self.suffixes[0]) if path.name else Path(f"NAME{self.suffixes[0]}")
            raise ConfigError(path, f"a file with {' or '.join(self.suffixes)} is written: name it {fitting}")
        if path.is_dir():
            raise ConfigError(path, "is a folder; name a file")
        if not self.makes_folder and not path.parent.is_dir():
            raise ConfigError(path, f"cannot be written: there is no folder {path.parent}")
        _require_writable(path.parent, path)
        return path


@dataclass(frozen=True)
class OutputFolder:
    """Output folder, created if missing."""

    def __call__(self, text: str) -> Path:
        """Parse the option; ConfigError if unwritable."""
        path = Path(text)
        _require_writable(path, path)
        return path


PICTURE = OutputFile((".png", ".jpg", ".jpeg"))
FOLDER = OutputFolder()


def _require_writable(folder: Path, path: Path) -> None:
    """Refuse a path if its nearest existing folder takes no file."""
    there = folder.absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise ConfigError(path, f"cannot be written: {there} is no folder")
    try:
        TemporaryFile(dir=there).close()
    except OSError as error:
        raise ConfigError(path, f"cannot be written: {there}: {error.strerror}; choose another place") from None
