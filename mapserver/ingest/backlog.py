"""Batches that wait to be committed: bounded in bytes, taken in turn by machine. No threads, no clock.

Machines send one batch at a time, but all of them have a backlog after the server was away. Where there is no room, the
machine with the most bytes waiting gives way, with its newest batch: what is live passes what is late, and one machine
never keeps another out.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")

QUEUE_BYTES = 64 * 2**20  # that wait at most: half a minute of the fullest queue's work is not worth more memory
BATCH_BYTES = 1024  # of a batch beside its payload: the query that waits for its answer
GROUP_BATCHES = 256  # committed together at most: one sync to disk for all of them
GROUP_BYTES = 4 * 2**20  # likewise, but never less than one batch; the others wait 0.1 s for so many samples
FIRST_BYTES_PER_S = 4 * 2**20  # assumed until some were worked off
PACE_WEIGHT = 0.1  # of the last group in the mean
MOST_RETRY_S = 30.0


def size_of(payload: bytes) -> int:
    """What a batch takes while it waits."""
    return len(payload) + BATCH_BYTES


@dataclass
class _Lane(Generic[T]):
    """What one machine has waiting: size and batch of each."""

    batches: deque[tuple[int, T]] = field(default_factory=deque)
    size: int = 0


class Backlog(Generic[T]):
    """Batches of all machines."""

    def __init__(self, limit: int = QUEUE_BYTES) -> None:
        """limit: bytes that may wait."""
        self._limit = limit
        self._lanes: OrderedDict[str, _Lane[T]] = OrderedDict()  # whose turn it is comes first
        self._count = 0
        self.size = 0

    def __len__(self) -> int:
        return self._count

    def add(self, machine: str, size: int, batch: T) -> list[T]:
        """Let a batch wait; returns those that have to give way for it, or itself if there is no room for it."""
        gone: list[T] = []
        while self.size + size > self._limit:
            largest = max(self._lanes, key=lambda name: self._lanes[name].size, default=machine)
            own = self._lanes[machine].size if machine in self._lanes else 0
            if largest == machine or self._lanes[largest].size <= own + size:
                return [*gone, batch]
            gone.append(self._remove(largest, newest=True))
        lane = self._lanes.setdefault(machine, _Lane())
        lane.batches.append((size, batch))
        lane.size += size
        self.size, self._count = self.size + size, self._count + 1
        return gone

    def take(self) -> list[T]:
        """The next group: one batch of each machine in turn, each machine's own in their order."""
        group: list[T] = []
        taken = 0
        while self._lanes and len(group) < GROUP_BATCHES:
            machine, lane = next(iter(self._lanes.items()))
            taken += lane.batches[0][0]
            if group and taken > GROUP_BYTES:
                break
            group.append(self._remove(machine, newest=False))
            if machine in self._lanes:
                self._lanes.move_to_end(machine)
        return group

    def _remove(self, machine: str, *, newest: bool) -> T:
        lane = self._lanes[machine]
        size, batch = lane.batches.pop() if newest else lane.batches.popleft()
        lane.size -= size
        self.size, self._count = self.size - size, self._count - 1
        if not lane.batches:
            del self._lanes[machine]
        return batch


class WorkRate:
    """How fast batches are worked off, which tells when there will be room again."""

    def __init__(self) -> None:
        self._bytes_per_s = float(FIRST_BYTES_PER_S)

    def worked(self, size: int, seconds: float) -> None:
        """Learn from a group of so many bytes."""
        self._bytes_per_s += PACE_WEIGHT * (size / max(seconds, 1e-6) - self._bytes_per_s)

    def retry_after_s(self, size: int) -> float:
        """How long so many bytes take that wait already."""
        return min(size / self._bytes_per_s, MOST_RETRY_S)
