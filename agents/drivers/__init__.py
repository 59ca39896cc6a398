"""The driver door: simulation, replayed logs and real sensors enter an agent as the same stream of readings."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from protocol.machine.readings import Reading


class Driver(Protocol):
    """A source of readings in the order in which a machine has them: mostly that of their stamps."""

    def read(self, timeout_s: float) -> Sequence[Reading] | None:
        """Readings that have come in, none if nothing came within timeout_s, None once the stream has ended."""

    def counters(self) -> Mapping[str, int]:
        """What was refused or lost on the way, by name."""

    def close(self) -> None:
        """Let go of files and subscriptions."""
