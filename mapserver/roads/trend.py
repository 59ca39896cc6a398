"""Whether a stretch gets better or worse: the change of its c_rr per day."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mapserver.roads.ledger import Ledger
from mapserver.roads.tally import HOUR_NS, PER_C
from protocol.arrays import Floats, Ints

TREND_DAYS = 3  # with measurements; fewer are weather
DAY_NS = 24 * HOUR_NS


def trends(ledger: Ledger) -> Floats:
    """Change of c_rr per day (k,), by Theil and Sen over days with measurements; NaN where there are less than three.

    The median of the slopes between all pairs of days: one day of rain is no trend.
    """
    rows = ledger.rows[ledger.rows["measured"] > 0]
    out = np.full(len(ledger.ends) - 1, np.nan)
    day = rows["slot"] * ledger.slot_ns // DAY_NS
    keys, which = np.unique(np.stack([rows["segment"], day], axis=1), axis=0, return_inverse=True)
    sums = np.zeros((2, len(keys)), np.int64)
    for own, name in zip(sums, ("c", "measured"), strict=True):
        np.add.at(own, which.ravel(), rows[name])
    c_rr = sums[0] / (np.maximum(sums[1], 1) * float(PER_C))
    bounds = [*np.flatnonzero(np.diff(keys[:, 0], prepend=-1)).tolist(), len(keys)]
    for first, end in pairwise(bounds):
        if end - first >= TREND_DAYS:
            out[keys[first, 0]] = theil_sen(keys[first:end, 1], c_rr[first:end])
    return out


def theil_sen(days: Ints, values: Floats) -> float:
    """Median slope of all pairs."""
    i, j = np.triu_indices(len(days), 1)
    return float(np.median((values[j] - values[i]) / (days[j] - days[i])))
