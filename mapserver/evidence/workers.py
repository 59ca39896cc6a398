"""Who folds: the thread that owns a grid, or several that an edge lends it for a long fold."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Workers:
    """map: as the built-in, and may work on `count` elements at the same time, as that of a pool of threads does."""

    count: int = 1
    map: Callable[[Callable[[int], Any], Iterable[int]], Iterable[Any]] = map

    def each(self, work: Callable[[int], None]) -> None:
        """Have `work` done once by each, which is handed its number; returns when all are done."""
        for _ in self.map(work, range(self.count)):
            pass


ALONE = Workers()
