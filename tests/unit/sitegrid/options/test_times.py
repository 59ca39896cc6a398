from __future__ import annotations

from argparse import ArgumentTypeError

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.machine.readings import MAX_STAMP_NS
from sitegrid.options.values import site_time
from sitegrid.times import SiteTime, utc_text

T0 = 1_750_000_000_000_000_000  # 2025-06-15 15:06:40 UTC
S = 10**9


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("2025-06-15T15:06:40", T0),  # default zone UTC
        ("2025-06-15 15:06:40Z", T0),
        ("2025-06-15T17:06:40+02:00", T0),
        ("2025-06-15T15:06:40.000001", T0 + 1000),
        ("2025-06-15", T0 - (15 * 3600 + 6 * 60 + 40) * S),
        (str(T0 + 1), T0 + 1),
    ],
)
def test_a_time_is_iso_or_a_stamp(text: str, ns: int):
    assert site_time(text) == SiteTime(ns)


@pytest.mark.parametrize(
    ("text", "s"), [("-90s", 90), ("-30m", 1800), ("-2h", 7200), ("-1.5h", 5400), ("-3d", 259_200), ("-0s", 0)]
)
def test_a_time_may_count_back_from_the_sites_now(text: str, s: int):
    time = site_time(text)
    assert time == SiteTime(-s * S, from_now=True)
    assert time.stamp("--as-of", lambda: T0) == T0 - s * S


@given(st.integers(S, MAX_STAMP_NS))
def test_every_stamp_is_a_time_and_is_shown_to_the_second(ns: int):
    assert site_time(str(ns)).stamp("--as-of", lambda: pytest.fail("not needed")) == ns
    assert site_time(utc_text(ns)).ns == ns // S * S


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("yesterday", "'yesterday' is no time: ISO 8601"),
        ("", "'' is no time"),
        ("-2", "'-2' is no time"),
        ("0", "0 is not between the years 1970 and 2100"),
        ("1969-12-31", "is not between"),
        ("2101-01-01", "is not between"),
        ("9" * 5000, "is no time"),
    ],
)
def test_a_bad_time_is_refused_by_what_it_is(text: str, words: str):
    with pytest.raises(ArgumentTypeError, match=words):
        site_time(text)


def test_a_time_before_1970_names_its_option():
    with pytest.raises(ConfigError, match="--minus: so long before the site's now, 2025-06-15 15:06:40Z, is before"):
        site_time("-99999d").stamp("--minus", lambda: T0)
