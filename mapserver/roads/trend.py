"""Whether a stretch gets better or worse: the change of its c_rr per day."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mapserver.roads.ledger import Ledger
from mapserver.roads.tally import HOUR_NS, PER_C
from protocol.arrays import Floats, Ints

TREND_DAYS = 3  # with measurements; fewer are weather
DAY_NS = 24 * HOUR_NS


class Daily(NamedTuple):
    """Mean c_rr of segments by day, (n,) each, by segment and day, of days with measurements. day: since 1970."""

    segment: Ints
    day: Ints
    c_rr: Floats


def daily(ledger: Ledger) -> Daily:
    """What was measured on each day."""
    rows = ledger.rows[ledger.rows["measured"] > 0]
    day = rows["slot"] * ledger.slot_ns // DAY_NS
    first = np.flatnonzero(np.append(len(day) > 0, (np.diff(rows["segment"]) != 0) | (np.diff(day) != 0)))
    if not len(first):
        return Daily(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    c, measured = (np.add.reduceat(rows[name], first) for name in ("c", "measured"))
    return Daily(rows["segment"][first], day[first], c / (measured * float(PER_C)))


def trends(ledger: Ledger) -> Floats:
    """Change of c_rr per day (k,), by Theil and Sen over days with measurements; NaN where there are less than three.

    The median of the slopes between all pairs of days: one day of rain is no trend.
    """
    out, days = np.full(len(ledger.ends) - 1, np.nan), daily(ledger)
    bounds = [*np.flatnonzero(np.diff(days.segment, prepend=-1)).tolist(), len(days.segment)]
    for first, end in pairwise(bounds):
        if end - first >= TREND_DAYS:
            out[days.segment[first]] = theil_sen(days.day[first:end], days.c_rr[first:end])
    return out


def theil_sen(days: Ints, values: Floats) -> float:
    """Median slope of all pairs."""
    i, j = np.triu_indices(len(days), 1)
    return float(np.median((values[j] - values[i]) / (days[j] - days[i])))
