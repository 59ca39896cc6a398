"""The driver door: simulation, replay and real sensors enter an agent as one stream of readings.

A `Driver` gives readings. A `Source`, made by a [[driver]] table, gives values with times of the host's monotonic
clock; `Sources` (agents/drivers/sources.py) turns them into readings in UTC.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, TypeVar

from protocol.machine.readings import Reading

Item = TypeVar("Item", covariant=True)


class Observed(NamedTuple):
    """A sensor's values before they are a reading.

    sensor: of the machine, empty if only the time counts. host_ns: when measured or received, by `time.monotonic_ns`.
    utc_ns: when measured, by a receiver's clock; 0 if unstated.
    """

    sensor: str
    kind: str
    values: tuple[float, ...]
    host_ns: int
    utc_ns: int = 0


class Stream(Protocol[Item]):
    """Input in order of arrival, mostly that of stamps. Bad input never raises."""

    def read(self, timeout_s: float) -> Sequence[Item] | None:
        """New items; empty after timeout_s, None at the end of the stream."""

    def counters(self) -> Mapping[str, int]:
        """What was refused or lost, by name."""

    def problems(self) -> Sequence[str]:
        """Current problems and remedies, a sentence each."""

    def close(self) -> None:
        """Release ports, files, subscriptions."""


Driver = Stream[Reading]
Source = Stream[Observed]  # read on a thread of its own
