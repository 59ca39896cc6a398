"""Reused arrays, because new memory costs microseconds per page."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from protocol.arrays import AnyArray


class Buffers:
    """Named arrays of one thread."""

    def __init__(self) -> None:
        self._arrays: dict[str, AnyArray] = {}

    def array(self, name: str, rows: int, dtype: DTypeLike, columns: int = 0) -> AnyArray:
        """An array (rows,) or (rows, columns) of any content, valid until its name is asked for again."""
        kept = self._arrays.get(name)
        if kept is None or len(kept) < rows:
            kept = self._arrays[name] = np.empty((rows + rows // 4, columns) if columns else rows + rows // 4, dtype)
        return kept[:rows]
