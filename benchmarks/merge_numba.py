"""The hard-vote kernel in numba; imported only where numba is installed."""

from __future__ import annotations

from typing import Any

import numba


@numba.njit(cache=True, nogil=True)
def add(rows: Any, sums: Any, side: int) -> None:
    """Add count, value and its square of each row to its cell of sums (side * side, 3).

    A cell's three sums lie side by side, so that a sample costs one cache miss, not three.
    """
    for k in range(len(rows)):
        row = rows[k]
        of_cell = sums[int(row.y_m) * side + int(row.x_m)]
        value = float(row.c_rr)
        of_cell[0] += 1.0
        of_cell[1] += value
        of_cell[2] += value * value
