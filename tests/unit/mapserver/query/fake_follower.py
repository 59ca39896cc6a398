"""A follower with an answer to everything, and no thread."""

from typing import Any

from protocol.errors import QueryError, Refusal


class FakeFollower:
    """Stands for a Follower that knows the machines a and b; notes what it is asked."""

    def __init__(self, *excluded: str) -> None:
        self.asked: list[object] = []
        self._excluded = frozenset(excluded)

    def machines(self) -> list[dict[str, Any]]:
        return [{"name": "a", "trusted": True}, {"name": "b", "trusted": False}]

    def changes(self, after: int) -> list[dict[str, Any]]:
        self.asked.append(after)
        return [{"id": after + 1}]

    def trust(self, machine: str, trusted: bool | None, reason: str, wait_s: float) -> dict[str, Any]:
        self.asked.append((machine, trusted, reason, wait_s))
        if machine not in "ab":
            raise QueryError(Refusal.UNKNOWN_MACHINE, f"machine `{machine}` is not known")
        return {"name": machine, "trusted": trusted is not False}

    def excluded(self) -> frozenset[str]:
        return self._excluded
