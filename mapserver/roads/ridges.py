"""Ridges of the metres driven, along each of eight axes: where roads run.

The blur runs along an axis and little across it: it closes gaps, but never joins two lanes. A cell is road if some axis
stands out among axes and across its line. Integer sums of nearby cells only, so any window gives the same ridges.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence import cells as ev
from protocol.arrays import Bools, Floats, Ints

AXES = ev.SECTORS // 2
ALONG_M, ACROSS_M = 4.0, 1.0  # standard deviations of the blur [m]
SIDE_M = 3.0  # half the least lane distance [m]
SHARE = 0.55  # least share of the highest response across the line
LEAST_M = 0.05  # least response [m/m2]: below one pass in a bend between two axes
_UNITS = 1 << 10  # integer units per unit of weight
_LEAST_WEIGHT = 20  # smallest weight, in units
SCALE = 1 << 6  # units of the blurred metres [1/4096 m]: sums stay integers that a float64 holds


class Blur:
    """Weights of each axis as runs along rows, for one cell size. reach: radius in cells."""

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
                columns = np.flatnonzero(weight[row])  # contiguous: an ellipse
                runs.append((row - self.reach, int(columns[0]) - self.reach, len(columns), used))
                weights.append(weight[row, columns])
                used += len(columns)
            self.ends[axis + 1] = len(runs)
            self._sums.append(int(weight.sum()))
        self.runs: Ints = np.array(runs)  # row and first column from the cell, length, first weight
        self.weights: Floats = np.concatenate(weights)
        per_m2 = ev.WEIGHT_UNITS_PER_M // SCALE * cell_m**2
        self.least: Floats = np.array([float(round(LEAST_M * total * per_m2)) for total in self._sums])
        self.side = max(1, round(SIDE_M / cell_m))
        steps = np.array([step for step in range(-self.side, self.side + 1) if step])
        turns = np.pi * np.arange(AXES) / AXES
        # (AXES, steps, 2) [row, column]
        self.across: Ints = np.stack(
            [np.rint(np.outer(np.cos(turns), steps)), np.rint(np.outer(-np.sin(turns), steps))], axis=-1
        ).astype(np.int64)


def ridges(axes: Ints, blur: Blur) -> Bools:
    """Which cells are road. axes: (rows, columns, AXES) in 1/4096 m; the result lacks reach + side cells per edge."""
    margin = blur.reach + blur.side
    rows, columns = (size - 2 * margin for size in axes.shape[:2])
    response = np.zeros((AXES, rows + 2 * blur.side, columns + 2 * blur.side))
    _blurred(axes, blur.reach, blur.runs, blur.weights, blur.ends, response)
    out = np.zeros((rows, columns), np.bool_)
    _outstanding(response, blur.side, blur.least, blur.across, out)
    return out


@numba.njit(cache=True, nogil=True)
def _blurred(axes: Any, reach: int, runs: Any, weights: Any, ends: Any, out: Any) -> None:
    """Whole numbers as floats, which vectorise well."""
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
    """Mark cells that stand out among neighbouring axes and across their own.

    response: (AXES, rows, columns), `side` cells wider on each side than out.
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
    """Highest response of an axis and its neighbours: between two lanes an oblique axis collects a little of both."""
    highest = response[axis, row, column]
    for step in range(across.shape[1]):
        y, x = row + across[axis, step, 0], column + across[axis, step, 1]
        for turn in range(-1, 2):
            highest = max(highest, response[(axis + turn) % AXES, y, x])
    return float(highest)
