"""Interface of recordings: topics for sensors, and their values in recorded order."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol


@dataclass(frozen=True)
class Topic:
    """A stream of a recording.

    kinds: possible sensor kinds, with fields and units. sure: taken by default. question: why somebody must choose.
    joints: parts for `TOPIC[a,b]`. frame: of the measurement; empty: unstated. measures: as of a sensor. note: caveat.
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
    """A message as a reading. values: its columns, unstated variances 0. problem: why it is none."""

    topic: str
    kind: str
    stamp_ns: int
    values: tuple[float, ...]
    problem: str = ""


class Recording(Protocol):
    """unread: what is not read and why, a phrase each; complete after all values."""

    topics: list[Topic]
    unread: list[str]

    def values(self, wanted: Collection[tuple[str, str]]) -> Iterator[Value]:
        """Values of these (topic, kind) pairs; LogFolderError if the recording is damaged."""
