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
from protocol.arrays import Bools, Floats, Ints

AXES = ev.SECTORS // 2
ALONG_M, ACROSS_M = 4.0, 1.0  # standard deviations of the blur
SIDE_M = 3.0  # half the distance of two lanes that stay apart
SHARE = 0.55  # of the highest response across the line
LEAST_M = 0.05  # response, in metres per square metre: less than one pass gives in a bend between two axes
_UNITS = 1 << 10  # of the blur's weights
_LEAST_WEIGHT = 20  # in these units
SCALE = 1 << 6  # of 1/4096 m: what the blur sums up, so that any sum is a whole number that a float64 holds


class Blur:
    """The blur of each axis as runs of weights along rows, for cells of one size. reach: how far it looks, in cells."""

    def __init__(self, cell_m: float) -> None:
        self.reach = int(np.ceil(2.9 * ALONG_M / cell_m))
        steps = np.arange(-self.reach, self.reach + 1)
        x, y = np.meshgrid(steps * cell_m, steps * cell_m)
        runs, weights, self._sums, used = [], [], [], 0
        self.ends: Ints = np.zeros(AXES + 1, np.int64)
        for axis in range(AXES):
            turn = np.pi * axis / AXES
            along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
            weight = np.rint(_UNITS * np.exp(-((along / ALONG_M) ** 2 + (across / ACROSS_M) ** 2) / 2))
            weight[weight < _LEAST_WEIGHT] = 0.0
            for row in np.flatnonzero(weight.any(axis=1)).tolist():
                columns = np.flatnonzero(weight[row])  # without a gap: an ellipse
                runs.append((row - self.reach, int(columns[0]) - self.reach, len(columns), used))
                weights.append(weight[row, columns])
                used += len(columns)
            self.ends[axis + 1] = len(runs)
            self._sums.append(int(weight.sum()))
        self.runs: Ints = np.array(runs)  # of each: row and first column from the cell, length, first weight
        self.weights: Floats = np.concatenate(weights)
        per_m2 = ev.WEIGHT_UNITS_PER_M // SCALE * cell_m**2
        self.least: Floats = np.array([float(round(LEAST_M * total * per_m2)) for total in self._sums])
        self.side = max(1, round(SIDE_M / cell_m))
        steps = np.array([step for step in range(-self.side, self.side + 1) if step])
        turns = np.pi * np.arange(AXES) / AXES
        # Cells across each axis: (AXES, steps, 2) rows and columns.
        self.across: Ints = np.stack(
            [np.rint(np.outer(np.cos(turns), steps)), np.rint(np.outer(-np.sin(turns), steps))], axis=-1
        ).astype(np.int64)


def ridges(axes: Ints, blur: Blur) -> Bools:
    """Which cells lie on a road. axes: (rows, columns, AXES) in 1/4096 m, driven along each.

    (rows - 2 m, columns - 2 m), without a margin of m = reach + side cells, which decide but are not decided.
    """
    margin = blur.reach + blur.side
    rows, columns = (size - 2 * margin for size in axes.shape[:2])
    response = np.zeros((AXES, rows + 2 * blur.side, columns + 2 * blur.side))
    _blurred(axes, blur.reach, blur.runs, blur.weights, blur.ends, response)
    out = np.zeros((rows, columns), np.bool_)
    _outstanding(response, blur.side, blur.least, blur.across, out)
    return out


@numba.njit(cache=True, nogil=True)
def _blurred(axes: Any, reach: int, runs: Any, weights: Any, ends: Any, out: Any) -> None:
    """Blur the metres of each axis along it. Whole numbers as floats: processors multiply many of these at once."""
    rows, columns = out.shape[1:]
    for row in range(axes.shape[0]):
        for column in range(axes.shape[1]):
            for axis in range(AXES):
                metres = float(axes[row, column, axis] // SCALE)
                if metres == 0.0:
                    continue
                for i in range(ends[axis], ends[axis + 1]):
                    y = row - reach + runs[i, 0]
                    if not 0 <= y < rows:
                        continue
                    first = column - reach + runs[i, 1]
                    begin, end = max(0, -first), min(runs[i, 2], columns - first)
                    if begin >= end:
                        continue
                    part = out[axis, y, first + begin : first + end]
                    weight = weights[runs[i, 3] + begin : runs[i, 3] + end]
                    for j in range(len(part)):
                        part[j] += metres * weight[j]


@numba.njit(cache=True, nogil=True)
def _outstanding(response: Any, side: int, least: Any, across: Any, out: Any) -> None:
    """Mark cells whose response in some axis is no less than its neighbour axes', nor than a share of those beside.

    response: (AXES, rows, columns), `side` cells more on each side than out.
    """
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            y, x = row + side, column + side
            for axis in range(AXES):
                own = response[axis, y, x]
                if own < least[axis]:
                    continue
                if own < response[axis - 1, y, x] or own < response[(axis + 1) % AXES, y, x]:
                    continue
                if own >= SHARE * _highest(response, y, x, axis, across):
                    out[row, column] = True
                    break


@numba.njit(cache=True, nogil=True)
def _highest(response: Any, row: int, column: int, axis: int, across: Any) -> float:
    """Highest response on a line across an axis, of it and its neighbours.

    Between two lanes, an axis askew takes a little of both, and would stand out.
    """
    highest = response[axis, row, column]
    for step in range(across.shape[1]):
        y, x = row + across[axis, step, 0], column + across[axis, step, 1]
        for turn in range(-1, 2):
            highest = max(highest, response[(axis + turn) % AXES, y, x])
    return float(highest)
