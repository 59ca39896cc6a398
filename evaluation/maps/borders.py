"""Wrong cells by their distance from the nearest border between two kinds of ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from protocol.arrays import Floats, Ints
from protocol.site.ground_classes import UNKNOWN, wrong_percent

EDGES_M = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # of the bins; the last bin is open


@dataclass(frozen=True)
class BorderBin:
    """Cells in a bin of distances, open (None) at the end.

    cells: with a truth. known_pct: share of them that is known. wrong_pct: share of the known ones that is wrong.
    """

    from_m: float
    to_m: float | None
    cells: int
    known_pct: float
    wrong_pct: float


def by_border_distance(estimated: Ints, true: Ints, border_m: Floats) -> list[BorderBin]:
    """Count known and wrong cells (k,) by their distance from the nearest border."""
    estimated, true, border_m = (values[true != UNKNOWN] for values in (estimated, true, border_m))
    which = np.digitize(border_m, EDGES_M) - 1
    bins = []
    for i, (low, high) in enumerate(zip(EDGES_M, (*EDGES_M[1:], None), strict=True)):
        here = which == i
        known = 100.0 * float((estimated[here] != UNKNOWN).mean()) if here.any() else np.nan
        bins.append(BorderBin(low, high, int(here.sum()), known, wrong_percent(estimated[here], true[here])))
    return bins


def border_distance(classes: Ints, cell_m: float) -> Floats:
    """Distance [m] of the cells' centres (rows, columns) from the nearest cell of another class.

    Cells of class UNKNOWN border on nothing; infinite where there is no other class.
    """
    distance = np.full(classes.shape, np.inf)
    for kind in np.unique(classes[classes != UNKNOWN]).tolist():
        others = (classes != kind) & (classes != UNKNOWN)
        if others.any():
            here = classes == kind
            distance[here] = (distance_transform_edt(~others)[here] - 0.5) * cell_m  # to its edge, not to its centre
    return distance
