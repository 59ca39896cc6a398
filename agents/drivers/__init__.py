"""The driver door: simulation, replayed logs and real sensors enter an agent as the same stream of readings.

A `Driver` hands readings to the agent. A `Source` is what a [[driver]] table makes, ours or a plug-in's: its values
have times of the host's monotonic clock, and `Sources` (agents/drivers/sources.py) makes readings of them, in UTC.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, TypeVar

from protocol.machine.readings import Reading

Item = TypeVar("Item", covariant=True)


class Observed(NamedTuple):
    """Values of a sensor, before they are a reading.

    sensor: of the machine, empty where the time alone counts. host_ns: when they were true or arrived, by
    `time.monotonic_ns`. utc_ns: when they were true by a receiver's clock, 0 where nothing states it.
    """

    sensor: str
    kind: str
    values: tuple[float, ...]
    host_ns: int
    utc_ns: int = 0


class Stream(Protocol[Item]):
    """What comes in, in the order in which a machine has it: mostly that of its stamps. Bad input never raises."""

    def read(self, timeout_s: float) -> Sequence[Item] | None:
        """What has come in, nothing if nothing came within timeout_s, None once the stream has ended."""

    def counters(self) -> Mapping[str, int]:
        """What was refused or lost on the way, by name."""

    def problems(self) -> Sequence[str]:
        """What hinders it now, and what to do: a sentence each."""

    def close(self) -> None:
        """Let go of ports, files and subscriptions."""


Driver = Stream[Reading]
Source = Stream[Observed]  # a thread of its own reads it
