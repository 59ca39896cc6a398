"""A follower with an answer to everything, and no thread."""

from dataclasses import asdict
from typing import Any

from protocol.errors import QueryError, Refusal
from protocol.queries.answers import GroundChange
from tests.unit.records import machine_state


class FakeFollower:
    """Stands for a Follower that knows the machines a and b; notes what it is asked."""

    def __init__(self, *excluded: str) -> None:
        self.asked: list[object] = []
        self._excluded = frozenset(excluded)

    def machines(self) -> list[dict[str, Any]]:
        return [asdict(machine_state("a")), asdict(machine_state("b", trusted=False))]

    def changes(self, after: int) -> list[GroundChange]:
        self.asked.append(after)
        return [GroundChange(after + 1, 1, 1, (0.0, 0.0, 1.0, 1.0), 4, None, 0.25, None, None)]

    def trust(self, machine: str, trusted: bool | None, reason: str, wait_s: float) -> dict[str, Any]:
        self.asked.append((machine, trusted, reason, wait_s))
        if machine not in "ab":
            raise QueryError(Refusal.UNKNOWN_MACHINE, f"machine `{machine}` is not known")
        return asdict(machine_state(machine, trusted=trusted is not False))

    def excluded(self) -> frozenset[str]:
        return self._excluded
