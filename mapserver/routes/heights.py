"""Slopes of ground where nobody was, from heights that its surroundings have in common.

No gradient was measured there, but a line through it leads from one place of known slopes to another, and has to climb
what the known ways between them climb. So heights h over a window are those that agree best with measured gradients g,

    sum over neighbours  w ((h_j - h_i) / d - g)^2  least,   w = 1 and g measured; w small and g = 0 where none was,

which makes them harmonic between known ground: as even as it lets them be.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg import solveh_banded

from protocol.arrays import Bools, Floats

COARSE = 8  # cells to a side of those that heights are told for: hills are larger
FAINT = 1e-3  # weight of ground where nobody was: it follows what is measured, and hardly bends it
HOLD = 1e-9  # of the mean height, which nothing tells


@dataclass(frozen=True)
class Rises:
    """Known rises over coarse cells (..., m, m) to the east and north, in cells, and which share of each is known."""

    east: Floats
    north: Floats
    share: Floats

    @classmethod
    def of_slopes(cls, east: Floats, north: Floats, known: Bools) -> Rises:
        """From slopes (..., n, n) [m/m]; m: coarse cells that cover n."""
        number = _sums(known.astype(np.float64))
        east_sum, north_sum = (_sums(np.where(known, grade, 0.0)) for grade in (east, north))
        per_cell = COARSE / np.maximum(number, 1.0)
        return cls(east_sum * per_cell, north_sum * per_cell, number / COARSE**2)


def heights(rises: Rises) -> Floats:
    """Heights (m, m) in cells, that fit the known rises (m, m) best."""
    size = len(rises.share)
    band = np.zeros((size + 1, size * size))  # of the normal equations: the diagonal, what is to the right, and above
    wanted = np.zeros((size, size))
    diagonal, right, above = (band[row].reshape(size, size) for row in (0, 1, size))
    diagonal += HOLD
    for off, rise, first, second in (
        (right, rises.east, np.s_[:, :-1], np.s_[:, 1:]),
        (above, rises.north, np.s_[:-1], np.s_[1:]),
    ):
        share = np.minimum(rises.share[first], rises.share[second])
        weight = np.maximum(share, FAINT)
        pulls = weight * np.where(share > 0.0, 0.5 * (rise[first] + rise[second]), 0.0)
        diagonal[first] += weight
        diagonal[second] += weight
        off[first] -= weight
        wanted[first] -= pulls
        wanted[second] += pulls
    return np.asarray(solveh_banded(band, wanted.ravel(), lower=True, check_finite=False).reshape(size, size))


def slopes(height: Floats) -> tuple[Floats, Floats]:
    """Slopes (n, n) to the east and north [m/m] of the cells in all coarse ones (m, m) but the outermost."""
    fine = cv2.resize(height, None, fx=COARSE, fy=COARSE, interpolation=cv2.INTER_LINEAR)
    inner = slice(COARSE, -COARSE)
    north, east = np.gradient(fine)
    return east[inner, inner], north[inner, inner]


def _sums(values: Floats) -> Floats:
    """Sums (..., m, m) over COARSE x COARSE cells of (..., n, n); the last ones may be cut short."""
    short = -values.shape[-1] % COARSE
    whole = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(0, short)] * 2)
    m = whole.shape[-1] // COARSE
    return np.asarray(whole.reshape(*whole.shape[:-2], m, COARSE, m, COARSE).sum(axis=(-3, -1)))
