"""The worklist: where work on roads pays, the stretch that costs most first; and whether a stretch gets worse."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mapserver.roads.ledger import Ledger
from mapserver.roads.loss import Losses
from mapserver.roads.tally import PER_C
from protocol.arrays import Floats, Ints
from protocol.units import DAY_NS, DIESEL_J_PER_L

# Of a hauler at full power, over its mass: what work takes longer costs at this rate. Assumed; a loaded truck has 5, an
# empty one 11.
ENGINE_W_PER_KG = 6.0
TIE_SHARE = 0.05  # of the highest loss: stretches that differ by less have the same rank
TREND_DAYS = 3  # with measurements; fewer are weather


class Ranked(NamedTuple):
    """Segments by what they cost. order: (k,) their numbers, first what costs most; rank: (k,) of these, from 1."""

    order: Ints
    rank: Ints


def ranked(losses: Losses) -> Ranked:
    """Segments where anything is lost for sure, by work lost; those that differ by less than the noise tie.

    What is not beyond its noise (low is 0) comes not at all.
    """
    sure = np.flatnonzero(losses.low_j > 0)
    order = sure[np.argsort(-losses.work_j[sure], kind="stable")]
    work = losses.work_j[order]
    least = TIE_SHARE * work[0] if len(work) else 0.0
    rank, leader = np.ones(len(order), np.int64), 0
    for i in range(1, len(order)):
        if work[leader] - work[i] > least:
            leader = i
        rank[i] = leader + 1
    return Ranked(order, rank)


def litres(work_j: Floats, efficiency: float) -> Floats:
    """Diesel for work at the wheels. efficiency: of engine and drive train, 0 to 1."""
    return np.asarray(work_j / (efficiency * DIESEL_J_PER_L), np.float64)


def seconds(work_j: Floats, kg: Floats) -> Floats:
    """How long machines of a mass take for work."""
    return np.asarray(work_j / (ENGINE_W_PER_KG * kg), np.float64)


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
