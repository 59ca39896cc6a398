"""Workers of a fold: the owner of a grid, or several threads lent for a long one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Workers:
    """Workers of a fold. map: like the built-in, for `count` elements at a time, such as a thread pool's."""

    count: int = 1
    map: Callable[[Callable[[int], Any], Iterable[int]], Iterable[Any]] = map

    def each(self, work: Callable[[int], None]) -> None:
        """Run `work` once per worker, with its number, and wait."""
        for _ in self.map(work, range(self.count)):
            pass


ALONE = Workers()
