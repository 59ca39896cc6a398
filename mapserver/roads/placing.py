"""Which segment a place and a direction of travel belong to, and which slice of it.

The nearest one in place and axis together: where roads cross, or run beside each other, the direction tells them apart.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from mapserver.roads.segments import Segments
from protocol.arrays import Bools, Floats, Ints

REACH_M = 8.0  # so far from a road's line its traffic drives
TURN_M = 6.0  # so far away is a road at right angles, beside one that is not
SLICE_M = 5.0  # about: patches of bad ground are longer, and a slice has the samples of several passes


class Placed(NamedTuple):
    """Where things lie, all (n,). segment: -1 for no road; direction: 0 from its beginning to its end, 1 back."""

    segment: Ints
    slice: Ints
    direction: Ints


class Placing:
    """Finds segments. slices: (k + 1,) number of the first slice of each segment, one behind the other."""

    def __init__(self, segments: Segments) -> None:
        counts = np.maximum(1, np.rint(segments.length_m / SLICE_M)).astype(np.int64)
        self.slices: Ints = np.concatenate([[0], np.cumsum(counts)])
        owner = np.repeat(np.arange(len(segments.ids)), np.diff(segments.ends))
        same: Bools = owner[1:] == owner[:-1]
        begin, run = segments.points[:-1][same], np.diff(segments.points, axis=0)[same]
        self._owner = owner[1:][same]
        self._tangent = np.arctan2(run[:, 1], run[:, 0])
        along = np.cumsum(np.hypot(*run.T)) - np.hypot(*run.T) / 2
        first = np.searchsorted(self._owner, np.arange(len(segments.ids)))
        begins = along[first] - np.hypot(*run[first].T) / 2 if len(first) else along
        share = (along - begins[self._owner]) / segments.length_m[self._owner]
        inner = np.minimum((share * counts[self._owner]).astype(np.int64), counts[self._owner] - 1)
        self._slice = self.slices[self._owner] + inner
        points = _embedded(begin + run / 2, self._tangent)
        self._tree = cKDTree(points) if len(points) else None

    def place(self, places_m: Floats, heading_rad: Floats) -> Placed:
        """Segments of places (n, 2) with directions of travel (n,) [rad]; of each line the nearest point counts."""
        if self._tree is None or not len(places_m):
            nothing = np.zeros(len(places_m), np.int64)
            return Placed(nothing - 1, nothing - 1, nothing)
        distance, at = self._tree.query(
            _embedded(places_m, heading_rad), distance_upper_bound=float(np.hypot(REACH_M, TURN_M))
        )
        known = np.isfinite(distance)
        at = np.where(known, at, 0)
        back = np.cos(heading_rad - self._tangent[at]) < 0
        return Placed(np.where(known, self._owner[at], -1), np.where(known, self._slice[at], -1), back.astype(np.int64))


def _embedded(places_m: Floats, heading_rad: Floats) -> Floats:
    """Place and axis (n, 4) as places: those of axes at right angles are TURN_M apart."""
    axis = np.stack([np.cos(2 * heading_rad), np.sin(2 * heading_rad)], axis=1)
    return np.asarray(np.concatenate([places_m, TURN_M / 2 * axis], axis=1), np.float64)
