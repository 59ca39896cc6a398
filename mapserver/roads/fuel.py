"""Litres burned on segments, beside the map's prediction for the same drives.

For each slice and direction, from stated masses and speeds (Willans line):

    F = m g (c + s) + (m k / 2) d(v^2)/dx        litres = max(0, a F L + b t)

The marginal rate a and the idle rate b are fitted to all burned litres, so the total is measured and the map only
distributes it. An engine driven by the hill burns nothing.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from mapserver.error_model import NINETY
from mapserver.roads.ledger import Ledger, filled, resistance
from mapserver.roads.loss import Losses, by_segment, slope_of
from mapserver.roads.segments import SegmentTable
from mapserver.roads.tally import PER_L, PER_M, PER_V2
from protocol.arrays import Floats, Ints
from protocol.units import GRAVITY_MPS2

ROTATING = 1.1  # ratio of effective to real mass, with a hauler's rotating parts
BURNED_SHARE = 0.03  # relative standard deviation of an engine controller's fuel, by data sheets
LEAST_M = 100.0  # metres with known fuel that a fit needs
JOULES = 1e6  # joules per unit of the fit, to balance its columns
LEAST_L = 0.001  # litres; a lower bound for weights, a second of idling
ROUNDS = 4  # iterations of the fit, which settles after two


class Litres(NamedTuple):
    """Litres of segments (k,), 0 where unknown.

    burned_std: of the engines' figures. low, high: 90 % limits of predicted, from c_rr. share: of metres with known
    fuel.
    """

    burned: Floats
    burned_std: Floats
    predicted: Floats
    low: Floats
    high: Floats
    share: Floats


def litres_of(ledger: Ledger, segments: SegmentTable, lost: Losses) -> Litres | None:
    """Litres of segments; None if too little fuel is known. lost: of the same ledger and segments."""
    fuelled, fuel, ms = (ledger.of_slices(name).astype(np.float64) for name in ("fuelled", "fuel", "ms"))
    if fuelled.sum() < LEAST_M * PER_M or not fuel.any():
        return None
    owner = np.repeat(np.arange(len(segments.ids)), np.diff(ledger.ends))
    slope, weight = slope_of(ledger, segments, owner), lost.kg[owner] * GRAVITY_MPS2
    ground = resistance(ledger)[:, None] + np.stack([slope, -slope], axis=1)
    force = weight * ground + lost.kg[owner] * _accelerations(ledger, segments, owner) * ROTATING
    known = np.isfinite(force) & (fuelled > 0)
    metres, hours, burned = (np.where(known, one, 0.0) for one in (fuelled / PER_M, ms / 3.6e6, fuel / PER_L))
    work = np.where(known, force, 0.0) * metres
    doubt = NINETY * weight * np.nan_to_num(lost.c_std)[owner, None] * metres
    price = _price(work, hours, burned, ledger)

    def predicted(shift: float) -> Floats:
        spent = price[0] * (work + shift * doubt) + price[1] * hours
        return np.asarray(by_segment(np.maximum(spent, 0.0), ledger.ends).sum(axis=1), np.float64)

    driven = by_segment(ledger.of_slices("metres") / PER_M, ledger.ends).sum(axis=1)
    share = by_segment(metres, ledger.ends).sum(axis=1) / np.maximum(driven, 1e-9)
    total = by_segment(burned, ledger.ends).sum(axis=1)
    return Litres(total, BURNED_SHARE * total, predicted(0.0), predicted(-1.0), predicted(1.0), share)


def _price(work: Floats, hours: Floats, burned: Floats, ledger: Ledger) -> tuple[float, float]:
    """Litres per joule and per hour by least squares; inputs of slices (s, 2).

    A segment's residual grows with the root of its litres, because passes vary independently.
    """
    price, active = (0.0, 0.0), np.ones(work.shape, np.bool_)
    litres = by_segment(burned, ledger.ends).ravel()
    weights = np.where(litres > 0, 1.0 / np.sqrt(np.maximum(litres, LEAST_L)), 0.0)
    for _ in range(ROUNDS):
        columns = [by_segment(np.where(active, one, 0.0), ledger.ends).ravel() for one in (work / JOULES, hours)]
        solution, _ = nnls(np.stack(columns, axis=1) * weights[:, None], litres * weights)
        price = float(solution[0]) / JOULES, float(solution[1])
        active = price[0] * work + price[1] * hours > 0
    return price


def _accelerations(ledger: Ledger, segments: SegmentTable, owner: Ints) -> Floats:
    """d(v^2 / 2)/dx [m/s2] of slices (s, 2) in the direction of travel."""
    fuelled = ledger.of_slices("fuelled").astype(np.float64)
    length_m = (segments.length_m / np.diff(ledger.ends))[owner]
    out = np.zeros(fuelled.shape)
    for direction, sign in ((0, 1.0), (1, -1.0)):
        own = fuelled[:, direction]
        square = np.where(own > 0, ledger.of_slices("v2")[:, direction] / np.maximum(own, 1.0) / PER_V2, np.nan)
        square = filled(square, ledger.ends)
        for first, end in pairwise(ledger.ends.tolist()):
            if end - first > 1:
                out[first:end, direction] = sign * np.gradient(square[first:end]) / (2.0 * length_m[first:end])
    return np.nan_to_num(out)
