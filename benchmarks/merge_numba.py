"""The hard-vote kernel in numba; imported only where numba is installed."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def add(rows: Any, sums: Any, side: int) -> None:
    """Add count, value and its square of each row to its cell of sums (side * side * 3,).

    A cell's three sums lie side by side, so that a sample costs one cache miss, not three. Indices are unsigned: numba
    then need not look for negative ones, which count from the end.
    """
    one, two, three = np.uintp(1), np.uintp(2), np.uintp(3)
    for k in range(len(rows)):
        row = rows[k]
        at = three * (np.uintp(row.y_m) * np.uintp(side) + np.uintp(row.x_m))
        value = np.float64(row.c_rr)  # float() would leave it single
        sums[at] += 1.0
        sums[at + one] += value
        sums[at + two] += value * value
