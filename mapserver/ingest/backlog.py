"""Batches waiting for a commit: limited in bytes, in turn by machine. No threads, no clock.

After an outage all machines catch up. When full, the machine with most bytes loses its newest batch: live data passes
late data, and no machine blocks another.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")

QUEUE_BYTES = 64 * 2**20  # limit of waiting bytes: half a minute of work is not worth more
BATCH_BYTES = 1024  # overhead of a waiting batch: the query that waits for its reply
GROUP_BATCHES = 256  # most batches per commit, for one sync
GROUP_BYTES = 4 * 2**20  # most bytes per commit, one batch at least; takes 0.1 s
FIRST_BYTES_PER_S = 4 * 2**20  # assumed rate until measured
PACE_WEIGHT = 0.1  # weight of the newest group in the running mean
MOST_RETRY_S = 30.0


def size_of(payload: bytes) -> int:
    """Bytes of a waiting batch."""
    return len(payload) + BATCH_BYTES


@dataclass
class _Lane(Generic[T]):
    """A machine's waiting batches, with sizes."""

    batches: deque[tuple[int, T]] = field(default_factory=deque)
    size: int = 0


class Backlog(Generic[T]):
    """Waiting batches of all machines."""

    def __init__(self, limit: int = QUEUE_BYTES) -> None:
        """limit: bytes that may wait."""
        self._limit = limit
        self._lanes: OrderedDict[str, _Lane[T]] = OrderedDict()  # the next in turn first
        self._count = 0
        self.size = 0

    def __len__(self) -> int:
        return self._count

    def add(self, machine: str, size: int, batch: T) -> list[T]:
        """Queue a batch; returns those dropped for it, or itself if there is no room."""
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
        """The next group: one batch of each machine in turn, in its order."""
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
    """Throughput, which says when there will be room."""

    def __init__(self) -> None:
        self._bytes_per_s = float(FIRST_BYTES_PER_S)

    def worked(self, size: int, seconds: float) -> None:
        """Update with a finished group."""
        self._bytes_per_s += PACE_WEIGHT * (size / max(seconds, 1e-6) - self._bytes_per_s)

    def retry_after_s(self, size: int) -> float:
        """Time until so many waiting bytes are done."""
        return min(size / self._bytes_per_s, MOST_RETRY_S)
