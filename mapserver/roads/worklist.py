"""The worklist: road sections worth grading, most expensive first; and trends of c_rr."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mapserver.roads.ledger import Ledger
from mapserver.roads.loss import Losses
from mapserver.roads.tally import PER_C
from protocol.arrays import Floats, Ints
from protocol.units import DAY_NS, DIESEL_J_PER_L

# Full power over mass [W/kg], which turns work into time. Assumed; loaded trucks have 5, empty ones 11.
ENGINE_W_PER_KG = 6.0
TIE_SHARE = 0.05  # share of the highest loss; smaller differences tie
TREND_DAYS = 3  # days a trend needs; fewer are weather


class Ranked(NamedTuple):
    """Segments by loss. order: (k,) segments, most expensive first; rank: (k,), from 1."""

    order: Ints
    rank: Ints


def ranked(losses: Losses) -> Ranked:
    """Rank segments by lost work, without losses inside their noise."""
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
    """Time that machines of these masses take for work."""
    return np.asarray(work_j / (ENGINE_W_PER_KG * kg), np.float64)


class Daily(NamedTuple):
    """Daily mean c_rr (n,) by segment and day since 1970."""

    segment: Ints
    day: Ints
    c_rr: Floats


def daily(ledger: Ledger) -> Daily:
    """Daily means; days without measurements are missing."""
    rows = ledger.rows[ledger.rows["measured"] > 0]
    day = rows["slot"] * ledger.slot_ns // DAY_NS
    first = np.flatnonzero(np.append(len(day) > 0, (np.diff(rows["segment"]) != 0) | (np.diff(day) != 0)))
    if not len(first):
        return Daily(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    c, measured = (np.add.reduceat(rows[name], first) for name in ("c", "measured"))
    return Daily(rows["segment"][first], day[first], c / (measured * float(PER_C)))


def trends(ledger: Ledger) -> Floats:
    """Change of c_rr per day (k,) by Theil and Sen (one day of rain is no trend); NaN for less than three days."""
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
