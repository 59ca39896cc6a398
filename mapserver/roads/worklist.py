"""The worklist: where work on roads pays, the stretch that costs most first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mapserver.roads.loss import Losses
from protocol.arrays import Floats, Ints

DIESEL_J_PER_L = 35.8e6
# Of a hauler at full power, over its mass: what work takes longer costs at this rate. Assumed; a loaded truck has 5, an
# empty one 11.
ENGINE_W_PER_KG = 6.0
TIE_SHARE = 0.05  # of the highest loss: stretches that differ by less have the same rank


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
