"""Where roads run: ridges of the metres driven, in each of the eight axes of the sixteen heading sectors.

The metres of an axis are blurred along it and hardly across it, so that gaps close along a road and never between two
lanes. A cell lies on a road where the response of some axis stands out among the axes and across its own line. Sums of
integers, and only what lies near counts: a window of cells gives the same ridges as any other that reaches far enough.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence import cells as ev
from protocol.arrays import Bools, Ints

AXES = ev.SECTORS // 2
ALONG_M, ACROSS_M = 4.0, 1.0  # standard deviations of the blur
SIDE_M = 3.0  # half the distance of two lanes that stay apart
SHARE = 0.55  # of the highest response across the line
LEAST_M = 0.05  # response, in metres per square metre: less than one pass gives in a bend between two axes
_UNITS = 1 << 10  # of the blur's weights
_LEAST_WEIGHT = 20  # in these units
SCALE = 1 << 6  # of 1/4096 m: what the blur sums up, so that thousands of passes fit


@numba.njit(cache=True, nogil=True)
def add_axes(votes: Any, first_plane: int, cells: int, counts: Any) -> None:
    """Add packed votes (place in the lower 16 bits, count above) of headings to counts (cells, AXES)."""
    for vote in votes:
        place, count = np.int64(vote & np.uint64(0xFFFF)), np.int64(vote >> np.uint64(16))
        sector = place // cells - first_plane
        if 0 <= sector < 2 * AXES:
            counts[place % cells, sector % AXES] += count


class Blur:
    """The blur of each axis as offsets and weights, for cells of one size. reach: how far it looks, in cells."""

    def __init__(self, cell_m: float) -> None:
        self.reach = int(np.ceil(2.9 * ALONG_M / cell_m))
        offsets, weights, self._sums = [], [], []
        steps = np.arange(-self.reach, self.reach + 1)
        x, y = np.meshgrid(steps * cell_m, steps * cell_m)
        for axis in range(AXES):
            turn = np.pi * axis / AXES
            along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
            weight = np.rint(_UNITS * np.exp(-((along / ALONG_M) ** 2 + (across / ACROSS_M) ** 2) / 2)).astype(np.int64)
            rows, columns = np.nonzero(weight >= _LEAST_WEIGHT)
            offsets.append(np.stack([rows, columns], axis=1) - self.reach)
            weights.append(weight[rows, columns])
            self._sums.append(int(weights[-1].sum()))
        self.ends: Ints = np.cumsum([0, *map(len, weights)])
        self.offsets: Ints = np.concatenate(offsets)
        self.weights: Ints = np.concatenate(weights)
        per_m2 = ev.WEIGHT_UNITS_PER_M // SCALE * cell_m**2
        self.least: Ints = np.array([round(LEAST_M * total * per_m2) for total in self._sums], np.int64)
        side = max(1, round(SIDE_M / cell_m))
        steps = np.array([step for step in range(-side, side + 1) if step])
        turns = np.pi * np.arange(AXES) / AXES
        # Cells across each axis: (AXES, steps, 2) rows and columns.
        self.across: Ints = np.stack(
            [np.rint(np.outer(np.cos(turns), steps)), np.rint(np.outer(-np.sin(turns), steps))], axis=-1
        ).astype(np.int64)
        self.side = side


def ridges(axes: Ints, blur: Blur) -> Bools:
    """Which cells (rows, columns) lie on a road. axes: (rows, columns, AXES) in 1/4096 m, driven along each."""
    response = np.zeros(axes.shape, np.int64)
    touched, out = (np.zeros(axes.shape[:2], np.bool_) for _ in range(2))
    _blurred(axes, blur.offsets, blur.weights, blur.ends, response, touched)
    _outstanding(response, touched, blur.least, blur.across, out)
    return out


@numba.njit(cache=True, nogil=True)
def _blurred(axes: Any, offsets: Any, weights: Any, ends: Any, out: Any, touched: Any) -> None:
    """Blur the metres of each axis along it, and mark the cells that this reaches."""
    rows, columns, count = axes.shape
    for row in range(rows):
        for column in range(columns):
            for axis in range(count):
                metres = axes[row, column, axis] // SCALE
                if metres == 0:
                    continue
                for i in range(ends[axis], ends[axis + 1]):
                    y, x = row + offsets[i, 0], column + offsets[i, 1]
                    if 0 <= y < rows and 0 <= x < columns:
                        out[y, x, axis] += metres * weights[i]
                        touched[y, x] = True


@numba.njit(cache=True, nogil=True)
def _outstanding(response: Any, touched: Any, least: Any, across: Any, out: Any) -> None:
    """Mark cells whose response in some axis is no less than its neighbour axes', nor than a share of those beside."""
    rows, columns, count = response.shape
    for row in range(rows):
        for column in range(columns):
            if not touched[row, column]:
                continue
            for axis in range(count):
                own = response[row, column, axis]
                if own < least[axis]:
                    continue
                if own < response[row, column, axis - 1] or own < response[row, column, (axis + 1) % count]:
                    continue
                if own >= SHARE * _highest(response, row, column, axis, across):
                    out[row, column] = True
                    break


@numba.njit(cache=True, nogil=True)
def _highest(response: Any, row: int, column: int, axis: int, across: Any) -> int:
    """Highest response on a line across an axis, of it and its neighbours.

    Between two lanes, an axis askew takes a little of both, and would stand out.
    """
    rows, columns, count = response.shape
    highest = response[row, column, axis]
    for step in range(across.shape[1]):
        y, x = row + across[axis, step, 0], column + across[axis, step, 1]
        if 0 <= y < rows and 0 <= x < columns:
            for turn in range(-1, 2):
                highest = max(highest, response[y, x, (axis + turn) % count])
    return int(highest)
