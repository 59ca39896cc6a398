"""Times on the command line, as people write and read them."""

from __future__ import annotations

import re
from argparse import ArgumentTypeError
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from protocol.errors import ConfigError
from protocol.machine.readings import MAX_STAMP_NS

STAMP_HELP = "ISO 8601 (UTC unless it names a zone) or a stamp in ns"
HELP = f"{STAMP_HELP}, or a duration before the newest sample of the site: -2h, -30m, -90s"
_UNIT_S = {"d": 86_400, "h": 3600, "m": 60, "s": 1}
_AGO = re.compile(r"-(\d+(?:\.\d+)?)([dhms])")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class SiteTime:
    """ns: a stamp; from_now: counted from the site's now instead, and not above 0."""

    ns: int
    from_now: bool = False

    def stamp(self, option: str, site_now_ns: Callable[[], int]) -> int:
        """As a stamp. site_now_ns: asked only where it is needed; ConfigError names the option."""
        if not self.from_now:
            return self.ns
        now_ns = site_now_ns()
        if not now_ns:
            raise ConfigError(option, "the site has no samples yet, so no now to count from; give a time")
        if now_ns + self.ns < 1:
            raise ConfigError(option, f"so long before the site's now, {utc_text(now_ns)}, is before 1970")
        return now_ns + self.ns


def parse_time(text: str) -> SiteTime:
    """Parse ISO 8601, a stamp, or a time before the site's now; as a type of an argparse option."""
    if ago := _AGO.fullmatch(text):
        return SiteTime(-round(float(ago[1]) * _UNIT_S[ago[2]] * 1e9), from_now=True)
    return SiteTime(parse_stamp(text))


def parse_stamp(text: str) -> int:
    """Parse ISO 8601, UTC where no zone is named, or a stamp in ns; as a type of an argparse option."""
    ns = int(text) if text.isascii() and text.isdigit() and len(text) < 30 else _iso_ns(text)
    if not 1 <= ns <= MAX_STAMP_NS:
        raise ArgumentTypeError(f"{text} is not between the years 1970 and 2100")
    return ns


def utc_text(stamp_ns: int) -> str:
    """A stamp as people read it, to the second; `never` for 0."""
    if not stamp_ns:
        return "never"
    return (_EPOCH + timedelta(seconds=stamp_ns // 10**9)).strftime("%Y-%m-%d %H:%M:%SZ")


def _iso_ns(text: str) -> int:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is no time: {STAMP_HELP}") from None
    zoned = time if time.tzinfo else time.replace(tzinfo=UTC)
    return (zoned - _EPOCH) // timedelta(microseconds=1) * 1000  # exact, where floating point would not be
