"""What any recording is to the converter: topics that can feed sensors, and their values in the order recorded."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol


@dataclass(frozen=True)
class Topic:
    """A stream of a recording.

    kinds: of sensors that it can feed, and the fields with units that each takes. sure: those taken unless told
    otherwise. question: why somebody must choose. joints: parts of it that `TOPIC[a,b]` names. frame: in which it
    measures; empty where that is not stated. measures: as a sensor has it. note: what to know of it once it is taken.
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
    """One message as a kind of reading. values: its columns, 0 for a variance not stated; problem: why it is none."""

    topic: str
    kind: str
    stamp_ns: int
    values: tuple[float, ...]
    problem: str = ""


class Recording(Protocol):
    """unread: what is not read, and why, a phrase each; complete once all values were."""

    topics: list[Topic]
    unread: list[str]

    def values(self, wanted: Collection[tuple[str, str]]) -> Iterator[Value]:
        """Values of these topics as these kinds; raises LogFolderError where the recording is damaged."""
