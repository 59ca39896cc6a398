"""Interface of recordings: topics that can feed sensors, and their values in recorded order."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol


@dataclass(frozen=True)
class Topic:
    """A stream of a recording.

    kinds: sensor kinds it can feed, with the fields and units taken. sure: taken by default. question: why somebody
    must choose. joints: parts for `TOPIC[a,b]`. frame: of the measurement; empty: not stated. measures: as of a sensor.
    note: caveat if taken.
    """

    name: str
    type: str
    kinds: Mapping[str, str]
    sure: tuple[str, ...] = ()
    question: str = ""
    joints: tuple[str, ...] = ()
    frame: str = ""
    measures: tuple[str, ...] = ()
    note: str = ""


class Value(NamedTuple):
    """One message as a kind of reading. values: its columns, unstated variances 0. problem: why it is no reading."""

    topic: str
    kind: str
    stamp_ns: int
    values: tuple[float, ...]
    problem: str = ""


class Recording(Protocol):
    """unread: what is not read, and why, a phrase each; complete after all values."""

    topics: list[Topic]
    unread: list[str]

    def values(self, wanted: Collection[tuple[str, str]]) -> Iterator[Value]:
        """Values of these (topic, kind) pairs; LogFolderError if the recording is damaged."""
