"""Litres burned on segments, beside the map's prediction for the same drives.

For each slice and direction, from stated masses and speeds (Willans line):

    F = m g (c + s) + (m k / 2) d(v^2)/dx        litres = max(0, a F L + b t + d L)

The marginal rate a and the losses of an engine, b by time and d by way as they grow with speed, are fitted to all
burned litres, so the total is measured and the map only distributes it. An engine driven by the hill burns nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import chain, permutations
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
JOULES = 1e6  # joules per unit of work, to balance the fit
LEAST_L = 0.001  # litres; a lower bound for weights, a second of idling
ROUNDS = 10  # upper bound of the fit's iterations, which mostly settle after three


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
    work = np.where(known, force, 0.0) * metres / JOULES
    doubt = NINETY * weight * np.nan_to_num(lost.c_std)[owner, None] * metres / JOULES
    price = _price([work, hours, metres], burned, ledger.ends)

    def predicted(shift: float) -> Floats:
        spent = _spent(price, [work + shift * doubt, hours, metres])
        return np.asarray(by_segment(np.maximum(spent, 0.0), ledger.ends).sum(axis=1), np.float64)

    driven = by_segment(ledger.of_slices("metres") / PER_M, ledger.ends).sum(axis=1)
    share = by_segment(metres, ledger.ends).sum(axis=1) / np.maximum(driven, 1e-9)
    total = by_segment(burned, ledger.ends).sum(axis=1)
    return Litres(total, BURNED_SHARE * total, predicted(0.0), predicted(-1.0), predicted(1.0), share)


def _price(uses: list[Floats], burned: Floats, ends: Ints) -> Floats:
    """Litres per unit of each use by least squares; inputs of slices (s, 2).

    A segment's residual grows with the root of its litres, because passes vary independently.
    """
    price, active = np.zeros(len(uses)), np.ones(burned.shape, np.bool_)
    litres = by_segment(burned, ends).ravel()
    weights = np.where(litres > 0, 1.0 / np.sqrt(np.maximum(litres, LEAST_L)), 0.0)
    for _ in range(ROUNDS):
        columns = [by_segment(np.where(active, use, 0.0), ends).ravel() for use in uses]
        price, _ = nnls(np.stack(columns, axis=1) * weights[:, None], litres * weights)
        before, active = active, _spent(price, uses) > 0
        if (before == active).all():
            break
    return np.asarray(price, np.float64)


def _spent(price: Floats, uses: list[Floats]) -> Floats:
    return np.asarray(sum(each * use for each, use in zip(price.tolist(), uses, strict=True)), np.float64)


def _accelerations(ledger: Ledger, segments: SegmentTable, owner: Ints) -> Floats:
    """d(v^2 / 2)/dx [m/s2] of slices (s, 2) in the direction of travel, from end to end of each.

    v^2 is linear between the middles of slices, also from segment to segment along a road, and beyond the last one.
    """
    fuelled = ledger.of_slices("fuelled").astype(np.float64)
    known = np.where(fuelled > 0, ledger.of_slices("v2") / np.maximum(fuelled, 1.0) / PER_V2, np.nan)
    square = np.stack([filled(column, ledger.ends) for column in known.T], axis=1)
    length_m = (segments.length_m / np.diff(ledger.ends))[owner]
    inner = np.flatnonzero(np.diff(owner) == 0)
    sides = np.stack([square, square])  # v^2 at begin and end (2, s, 2)
    sides[0, inner + 1] = sides[1, inner] = (square[inner] + square[inner + 1]) / 2
    outer = np.stack([ledger.ends[:-1], ledger.ends[1:] - 1])
    begin, end = (2 * square[own] - sides[1 - side, own] for side, own in enumerate(outer))
    sides[0, outer[0]], sides[1, outer[1]] = begin, end
    for (segment, side), (other, other_side) in _joints(segments):
        own, beyond = outer[side, segment], outer[other_side, other]
        onward = square[beyond] if side != other_side else square[beyond][::-1]
        between = square[own] + (onward - square[own]) * length_m[own] / (length_m[own] + length_m[beyond])
        sides[side, own] = np.where(np.isfinite(between), between, sides[side, own])
    rise = (sides[1] - sides[0]) / (2 * length_m[:, None])
    return np.asarray(np.nan_to_num(rise * (1.0, -1.0)), np.float64)


def _joints(segments: SegmentTable) -> Iterator[tuple[tuple[int, int], ...]]:
    """Pairs of (segment, side) at one point, both ways round; side 0: its begin, 1: its end. Junctions are left out."""
    at: dict[bytes, list[tuple[int, int]]] = defaultdict(list)
    for side, points in enumerate((segments.points[segments.ends[:-1]], segments.points[segments.ends[1:] - 1])):
        for segment, point in enumerate(points):
            at[point.tobytes()].append((segment, side))
    return chain.from_iterable(permutations(joint) for joint in at.values() if len(joint) == 2)
