"""The driver door: simulation, replayed logs and real sensors enter an agent as the same stream of readings.

A `Driver` hands readings to the agent. A `Source` is what a [[driver]] table makes, ours or a plug-in's: its values
have times of the host's monotonic clock, and `Sources` (agents/drivers/sources.py) makes readings of them, in UTC.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from protocol.machine.readings import Reading


class Driver(Protocol):
    """A source of readings in the order in which a machine has them: mostly that of their stamps."""

    def read(self, timeout_s: float) -> Sequence[Reading] | None:
        """Readings that have come in, none if nothing came within timeout_s, None once the stream has ended."""

    def counters(self) -> Mapping[str, int]:
        """What was refused or lost on the way, by name."""

    def problems(self) -> Sequence[str]:
        """What hinders it now, and what to do: a sentence each."""

    def close(self) -> None:
        """Let go of files and subscriptions."""


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


class Source(Protocol):
    """Where values of one [[driver]] table come from. A thread of its own reads it; nothing that comes in raises."""

    def read(self, timeout_s: float) -> Sequence[Observed] | None:
        """Values that have come in, none if nothing came within timeout_s, None once there will be no more."""

    def counters(self) -> Mapping[str, int]:
        """What was refused or lost, by name."""

    def problems(self) -> Sequence[str]:
        """What hinders it now, and what to do: a sentence each."""

    def close(self) -> None:
        """Let go of ports and files."""
