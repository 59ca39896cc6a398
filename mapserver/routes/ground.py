"""The ground along a line, and over a window: layers of cells as a route reads them.

Between the centres of cells values are interpolated, over those of the four around that are known. Ground that is not
known costs what the dearest tenth of the known ground around costs: at its median, the way would lead through whatever
nobody has driven.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Floats32
from protocol.site.geometry import CellWindow

DEAREST = 90.0  # percentile of the known ground that unknown ground is taken for


@dataclass(frozen=True)
class Field:
    """Values (rows, columns) of the cells of a window, NaN where unknown."""

    window: CellWindow
    cell_m: float
    values: Floats32 | Floats

    def at(self, position_m: Floats) -> Floats:
        """Values (n,) at places (n, 2): bilinear over the known of the four cells around; NaN where none is."""
        rows, columns = self.values.shape
        x = position_m[:, 0] / self.cell_m - self.window.column - 0.5
        y = position_m[:, 1] / self.cell_m - self.window.row - 0.5
        total, weight = np.zeros(len(position_m)), np.zeros(len(position_m))
        for dx in (0, 1):
            for dy in (0, 1):
                column, row = np.floor(x).astype(int) + dx, np.floor(y).astype(int) + dy
                inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
                value = self.values[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)].astype(float)
                share = np.maximum(1 - np.abs(x - column), 0) * np.maximum(1 - np.abs(y - row), 0)
                known = inside & np.isfinite(value)
                total += np.where(known, share * np.where(known, value, 0.0), 0.0)
                weight += np.where(known, share, 0.0)
        near = weight > 0.25  # less is a cell's corner, and no ground under a wheel
        return np.where(near, total / np.where(near, weight, 1.0), np.nan)


def dearest(resistance: Mapping[str, Floats32] | Floats | Floats32) -> float:
    """What unknown ground is taken for [-]: DEAREST of the known; NaN where none is known."""
    known = np.asarray(resistance)[np.isfinite(resistance)]
    return float(np.percentile(known, DEAREST)) if known.size else float("nan")
