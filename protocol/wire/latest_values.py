"""Latest values by machine name. Without keys, names are unchecked: their number is bounded."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")
MOST_NAMES = 1000
SILENT_S = 60.0  # silence after which a name makes room; agents speak every second


class LatestValues(Generic[T]):
    """Values by name and time heard [s of the clock]; not thread-safe."""

    def __init__(self, clock: Callable[[], float], most: int = MOST_NAMES) -> None:
        self._clock, self._most = clock, most
        self._values: OrderedDict[str, tuple[T, float]] = OrderedDict()  # longest silent first

    def hear(self, name: str, value: T) -> bool:
        """Keep a value; False if all places have names heard lately."""
        now_s = self._clock()
        if name not in self._values and len(self._values) >= self._most:
            oldest, (_, heard_s) = next(iter(self._values.items()))
            if now_s - heard_s < SILENT_S:
                return False
            del self._values[oldest]
        self._values[name] = value, now_s
        self._values.move_to_end(name)
        return True

    def get(self, name: str) -> T | None:
        """The latest value, or None."""
        value = self._values.get(name)
        return value[0] if value else None

    def items(self) -> list[tuple[str, T, float]]:
        """Names, values, times heard."""
        return [(name, *item) for name, item in self._values.copy().items()]

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[T]:
        return (value for value, _ in self._values.values())
