"""Times from people: ISO 8601, `datetime`, nanoseconds since 1970, or a duration before the site's now."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from protocol.errors import ConfigError
from protocol.machine.readings import MAX_STAMP_NS

Time = int | str | datetime
STAMP_HELP = "ISO 8601 (UTC unless it names a zone) or a stamp in ns"
HELP = f"{STAMP_HELP}, or a duration before the newest sample of the site: -2h, -30m, -90s"
_UNIT_S = {"d": 86_400, "h": 3600, "m": 60, "s": 1}
_AGO = re.compile(r"-(\d+(?:\.\d+)?)([dhms])")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class SiteTime:
    """ns: a stamp; from_now: relative to the site's now, not positive."""

    ns: int
    from_now: bool = False

    def stamp(self, name: str, site_now_ns: Callable[[], int]) -> int:
        """As a stamp. site_now_ns: called if needed; ConfigError names the option or argument."""
        if not self.from_now:
            return self.ns
        now_ns = site_now_ns()
        if not now_ns:
            raise ConfigError(name, "the site has no samples yet, so no now to count from; give a time")
        if now_ns + self.ns < 1:
            raise ConfigError(name, f"so long before the site's now, {utc_text(now_ns)}, is before 1970")
        return now_ns + self.ns


def parse_time(time: Time) -> SiteTime:
    """Parse a time; ValueError if it is none."""
    if isinstance(time, str) and (ago := _AGO.fullmatch(time)):
        return SiteTime(-round(float(ago[1]) * _UNIT_S[ago[2]] * 1e9), from_now=True)
    return SiteTime(parse_stamp(time))


def parse_stamp(time: Time) -> int:
    """Parse ISO 8601 (default zone UTC) or nanoseconds; ValueError otherwise."""
    if isinstance(time, datetime):
        ns = _ns(time)
    elif isinstance(time, int) or (time.isascii() and time.isdigit() and len(time) < 30):
        ns = int(time)
    else:
        ns = _iso_ns(time)
    if not 1 <= ns <= MAX_STAMP_NS:
        raise ValueError(f"{time} is not between the years 1970 and 2100")
    return ns


def utc_text(stamp_ns: int) -> str:
    """A stamp for people, to the second; `never` for 0."""
    if not stamp_ns:
        return "never"
    return (_EPOCH + timedelta(seconds=stamp_ns // 10**9)).strftime("%Y-%m-%d %H:%M:%SZ")


def iso(stamp_ns: int) -> str | None:
    """ISO 8601 in UTC; None for 0, never."""
    if not stamp_ns:
        return None
    seconds, rest_ns = divmod(stamp_ns, 10**9)
    return f"{_EPOCH + timedelta(seconds=seconds):%Y-%m-%dT%H:%M:%S}.{rest_ns:09d}Z"


def _iso_ns(text: str) -> int:
    try:
        return _ns(datetime.fromisoformat(text))
    except ValueError:
        raise ValueError(f"{text!r} is no time: {STAMP_HELP}") from None


def _ns(time: datetime) -> int:
    zoned = time if time.tzinfo else time.replace(tzinfo=UTC)
    return (zoned - _EPOCH) // timedelta(microseconds=1) * 1000  # exact, unlike floating point
