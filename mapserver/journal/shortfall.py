"""Shortfalls: acknowledged data missing from an opened journal, kept as events for ever.

Machines send missing samples again or declare them lost, which moves watermarks; the rest is missing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mapserver.journal.rows import Event, SpoolKey, Watermark
from protocol.disk.high_water_mark import Traces

KIND = "shortfall"
ROW, EVENT = "row", "event"  # names in a mark, besides spools


@dataclass(frozen=True)
class SpoolShortfall:
    """Acknowledged samples after < seq <= until of one spool."""

    machine: str
    spool_id: int
    after: int
    until: int

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.until - self.after


@dataclass(frozen=True)
class Shortfall:
    """What a journal lacks. row, event: last present; expected_row, expected_event: last known.

    damage: of the write-ahead log, or a snapshot beyond, or "".
    """

    row: int
    expected_row: int
    event: int = 0
    expected_event: int = 0
    spools: tuple[SpoolShortfall, ...] = ()
    damage: str = ""

    def body(self) -> dict[str, Any]:
        """As plain values of an event."""
        spools = [[s.machine, f"{s.spool_id:016x}", s.after, s.until] for s in self.spools]
        return {**vars(self), "spools": spools}

    @classmethod
    def from_event(cls, event: Event) -> Shortfall:
        """Inverse of `body`."""
        spools = (SpoolShortfall(name, int(spool, 16), *span) for name, spool, *span in event.body["spools"])
        return cls(**{**event.body, "spools": tuple(spools)})

    def __str__(self) -> str:
        """One line for people."""
        parts = [self.damage] if self.damage else []
        if (rows := self.expected_row - self.row) > 0:
            parts.append(f"{rows} journal rows after row {self.row} are gone")
        if (events := self.expected_event - self.event) > 0:
            parts.append(f"{events} events are gone: look at `sitegrid query machines`")
        counts: Counter[str] = Counter()
        for spool in self.spools:
            counts[spool.machine] += spool.samples
        parts += [f"{n} acknowledged samples of {machine} are gone" for machine, n in sorted(counts.items())]
        return "; ".join(parts)


def spool_name(machine: str, spool_id: int) -> str:
    """Name of a spool in a mark."""
    return f"{machine} {spool_id:016x}"


def marked(row: int, event: int, watermarks: Mapping[SpoolKey, Watermark]) -> dict[str, int]:
    """A journal's progress as in a mark."""
    return {ROW: row, EVENT: event, **{spool_name(*spool): mark.seq for spool, mark in watermarks.items()}}


def compare(traces: Traces, present: Mapping[str, int]) -> Shortfall | None:
    """Compare a journal's traces with its progress (`marked`); None if nothing is missing."""
    before = traces.mark
    spools = [
        SpoolShortfall(name, int(spool, 16), present.get(f"{name} {spool}", 0), until)
        for (name, spool), until in ((key.split(" "), n) for key, n in before.items() if key not in (ROW, EVENT))
        if until > present.get(f"{name} {spool}", 0)
    ]
    shortfall = Shortfall(
        present[ROW],
        max(before.get(ROW, 0), present[ROW]),
        present[EVENT],
        max(before.get(EVENT, 0), present[EVENT]),
        tuple(spools),
        traces.damage,
    )
    return shortfall if str(shortfall) else None


def beyond(last_row: int, snapshot_row: int) -> Shortfall:
    """The shortfall proved by a snapshot beyond the journal."""
    return Shortfall(last_row, snapshot_row, damage=f"a snapshot of row {snapshot_row} lies beyond the journal")


def missing(shortfalls: Iterable[Shortfall], watermarks: Mapping[SpoolKey, Watermark]) -> Counter[str]:
    """Missing acknowledged samples by machine, not sent again or declared lost."""
    until: dict[SpoolKey, int] = {}
    for spool in (spool for shortfall in shortfalls for spool in shortfall.spools):
        key = (spool.machine, spool.spool_id)
        until[key] = max(until.get(key, 0), spool.until)
    counts: Counter[str] = Counter()
    for key, seq in until.items():
        if (n := seq - watermarks.get(key, Watermark()).seq) > 0:
            counts[key[0]] += n
    return counts
