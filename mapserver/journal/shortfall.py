"""What was acknowledged and is not in the journal: found when it is opened, kept as an event, never forgotten.

A machine that still has such samples sends them again; one that has not declares them lost. Either moves the watermark
past them, so what is missing is always what no watermark has reached.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mapserver.journal.rows import Event, SpoolKey, Watermark
from protocol.disk.high_water_mark import Traces

KIND = "shortfall"
ROW, EVENT = "row", "event"  # names of a mark; the others are those of spools


@dataclass(frozen=True)
class SpoolShortfall:
    """Samples after < seq <= until of one spool were acknowledged."""

    machine: str
    spool_id: int
    after: int
    until: int

    @property
    def samples(self) -> int:
        """How many."""
        return self.until - self.after


@dataclass(frozen=True)
class Shortfall:
    """What an opened journal lacks. row, event: the last ones that it has; expected_row, expected_event: that it had.

    damage: what is wrong with the write-ahead log, or which snapshot lies beyond; empty where nothing tells why.
    """

    row: int
    expected_row: int
    event: int = 0
    expected_event: int = 0
    spools: tuple[SpoolShortfall, ...] = ()
    damage: str = ""

    def body(self) -> dict[str, Any]:
        """As an event keeps it."""
        spools = [[s.machine, f"{s.spool_id:016x}", s.after, s.until] for s in self.spools]
        return {**vars(self), "spools": spools}

    @classmethod
    def from_event(cls, event: Event) -> Shortfall:
        """Undo `body`."""
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
    """Name of a spool's watermark in a mark."""
    return f"{machine} {spool_id:016x}"


def marked(row: int, event: int, watermarks: Mapping[SpoolKey, Watermark]) -> dict[str, int]:
    """What a mark says of a journal."""
    return {ROW: row, EVENT: event, **{spool_name(*spool): mark.seq for spool, mark in watermarks.items()}}


def compare(traces: Traces, present: Mapping[str, int]) -> Shortfall | None:
    """Compare what lies beside a journal with what the journal has, `marked`; None where nothing is missing."""
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
    """What a snapshot proves that is true for a row which the journal does not reach."""
    return Shortfall(last_row, snapshot_row, damage=f"a snapshot of row {snapshot_row} lies beyond the journal")


def missing(shortfalls: Iterable[Shortfall], watermarks: Mapping[SpoolKey, Watermark]) -> Counter[str]:
    """Samples by machine that were acknowledged, are gone, and that it has neither sent again nor declared lost."""
    until: dict[SpoolKey, int] = {}
    for spool in (spool for shortfall in shortfalls for spool in shortfall.spools):
        key = (spool.machine, spool.spool_id)
        until[key] = max(until.get(key, 0), spool.until)
    counts: Counter[str] = Counter()
    for key, seq in until.items():
        if (n := seq - watermarks.get(key, Watermark()).seq) > 0:
            counts[key[0]] += n
    return counts
