"""A journal's content as values: batches, rows, watermarks, events; selections; checksums."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapserver.calibration.correction import UNCORRECTED, SampleCorrections
from mapserver.evidence.fold_config import name_hash
from mapserver.journal.facts import Facts
from protocol.arrays import Bools, Ints, Table
from protocol.machine.readings import MAX_STAMP_NS
from protocol.machine.samples import RAW_SAMPLE, SAMPLE_DTYPE, joined
from protocol.site.geometry import Bounds
from protocol.wire.messages import SampleBatch

SpoolKey = tuple[str, int]  # machine, spool_id
LAST = 2**63 - 1  # upper bound of row numbers
_EXTENT = struct.Struct("<3q4d")


@dataclass(frozen=True)
class Admission:
    """The new part of a batch. trimmed: samples known before; lost: declared lost."""

    batch: SampleBatch
    trimmed: int
    lost: int

    @property
    def watermark(self) -> int:
        """The last sample on disk after the commit."""
        return self.batch.last_seq


@dataclass(frozen=True)
class JournalRow:
    """An admitted batch on disk. received_ns: server time of reception."""

    row: int
    machine: str
    spool_id: int
    first_seq: int
    rows: Table
    received_ns: int = 0


@dataclass(frozen=True)
class JournalRows:
    """Journal rows as a table; iterable.

    samples (n,): of all rows. lengths (k,): samples per row. machines: names; machine (k,): indices. Others (k,): as
    JournalRow.
    """

    samples: Table
    lengths: Ints
    machines: tuple[str, ...]
    machine: Ints
    numbers: Ints
    spool_ids: NDArray[np.uint64]
    first_seqs: Ints
    received_ns: Ints

    @classmethod
    def joined(cls, rows: Sequence[JournalRow]) -> JournalRows:
        """Join rows."""
        numbers = {name: number for number, name in enumerate(dict.fromkeys(row.machine for row in rows))}
        return cls(
            joined([row.rows for row in rows]),
            np.array([len(row.rows) for row in rows], np.int64),
            tuple(numbers),
            np.array([numbers[row.machine] for row in rows], np.int64),
            np.array([row.row for row in rows], np.int64),
            np.array([row.spool_id for row in rows], np.uint64),
            np.array([row.first_seq for row in rows], np.int64),
            np.array([row.received_ns for row in rows], np.int64),
        )

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[JournalRow]:
        ends = np.cumsum(self.lengths)
        columns = (self.numbers, self.machine, self.spool_ids, self.first_seqs, ends - self.lengths, ends)
        for values in zip(*(column.tolist() for column in (*columns, self.received_ns)), strict=True):
            number, machine, spool_id, first_seq, begin, end, received_ns = values
            yield JournalRow(number, self.machines[machine], spool_id, first_seq, self.samples[begin:end], received_ns)

    def names(self) -> NDArray[np.uint64]:
        """Hash of the machine's name for each sample (n,)."""
        hashes = np.array([name_hash(machine) for machine in self.machines], np.uint64)
        return np.repeat(hashes[self.machine], self.lengths)

    def chosen(self, rows: Bools) -> JournalRows:
        """Rows (k,) where True."""
        if rows.all():
            return self
        columns = ("lengths", "machine", "numbers", "spool_ids", "first_seqs", "received_ns")
        samples = self.samples.view(RAW_SAMPLE)[np.repeat(rows, self.lengths)].view(SAMPLE_DTYPE)
        return replace(self, samples=samples, **{name: getattr(self, name)[rows] for name in columns})

    def cut(self, kept: Bools, number: int) -> JournalRows:
        """Samples (n,) where True; rows are renumbered from `number`, and split at gaps."""
        if kept.all():
            return replace(self, numbers=np.arange(number, number + len(self)))
        begins = self.pieces(kept)
        row, at = np.repeat(np.arange(len(self)), self.lengths), np.flatnonzero(begins)
        owner, first = row[at], np.cumsum(self.lengths) - self.lengths
        columns = {name: getattr(self, name)[owner] for name in ("machine", "spool_ids", "received_ns")}
        return replace(
            self,
            samples=self.samples.view(RAW_SAMPLE)[kept].view(SAMPLE_DTYPE),
            lengths=np.bincount(np.cumsum(begins)[kept] - 1, minlength=len(at)),
            numbers=np.arange(number, number + len(at)),
            first_seqs=self.first_seqs[owner] + at - first[owner],
            **columns,
        )

    def pieces(self, kept: Bools) -> Bools:
        """Which samples (n,) begin a row of `cut`."""
        starts: Bools = np.zeros(len(self.samples), np.bool_)
        starts[np.cumsum(self.lengths) - self.lengths] = True
        begins: Bools = kept & (starts | ~np.append(False, kept[:-1]))
        return begins

    def first(self, n: int) -> JournalRows:
        """The first `n` rows."""
        return self.chosen(np.arange(len(self)) < n)

    def without(self, machines: frozenset[str]) -> JournalRows:
        """Rows of other machines."""
        others = np.array([machine not in machines for machine in self.machines], np.bool_)
        return self.chosen(others[self.machine])

    def selected(self, selection: Selection) -> tuple[Table, NDArray[np.uint64]]:
        """Corrected samples (m,) in time and place, and hashes of their machines' names (m,)."""
        chosen = selection.includes(self.samples)
        samples, names, machine = self.samples, self.names(), np.repeat(self.machine, self.lengths)
        if not chosen.all():
            samples = samples.view(RAW_SAMPLE)[chosen].view(SAMPLE_DTYPE)
            names, machine = names[chosen], machine[chosen]
        return selection.corrections.applied(samples, self.machines, machine), names


@dataclass(frozen=True)
class Selection:
    """Which rows to read; any with a selected sample, whole and as sent.

    from_ns, to_ns: inclusive. bounds: touched by a row's bounding box. without: excluded machines. corrections: for
    `JournalRows.selected`.
    """

    from_ns: int = 0
    to_ns: int = MAX_STAMP_NS
    bounds: Bounds | None = None
    without: frozenset[str] = frozenset()
    corrections: SampleCorrections = UNCORRECTED

    @classmethod
    def by(cls, facts: Facts, from_ns: int = 0, to_ns: int = MAX_STAMP_NS, bounds: Bounds | None = None) -> Selection:
        """Selection for a map with these facts."""
        return cls(from_ns, to_ns, bounds, facts.excluded, facts.corrections)

    @property
    def everywhere(self) -> bool:
        """Whether no row is excluded by time or place."""
        return (self.from_ns, self.to_ns, self.bounds) == (0, MAX_STAMP_NS, None)

    def includes(self, samples: Table) -> Bools:
        """Which samples (n,) are selected by stamp and place."""
        stamps, x_m, y_m = (samples[name] for name in ("stamp_ns", "x_m", "y_m"))
        chosen: Bools = (stamps >= self.from_ns) & (stamps <= self.to_ns)
        if place := self.bounds:
            chosen &= (x_m >= place.west_m) & (x_m <= place.east_m) & (y_m >= place.south_m) & (y_m <= place.north_m)
        return chosen


ALL = Selection()


@dataclass(frozen=True)
class Watermark:
    """Progress of one spool: last committed sample, declared losses, newest stamp."""

    seq: int = 0
    lost: int = 0
    newest_ns: int = 0


@dataclass(frozen=True)
class StoreIdentity:
    """A store's identity. id: random, kept by copies; descends: of the stores it was made from."""

    id: str
    descends: tuple[str, ...] = ()


@dataclass(frozen=True)
class MachineTotals:
    """Totals of one machine."""

    spools: int = 0
    samples: int = 0
    lost: int = 0
    newest_ns: int = 0


@dataclass(frozen=True)
class Event:
    """Something to remember that is no sample; body: plain values."""

    id: int
    kind: str
    stamp_ns: int
    body: Mapping[str, Any]

    @property
    def text(self) -> str:
        """The body as stored."""
        return json.dumps(self.body, allow_nan=False)

    @property
    def checksum(self) -> int:
        """The checksum as stored."""
        return checksum(self.id, self.kind, self.stamp_ns, self.text)


def extent_checksum(row: int, first_ns: int, last_ns: int, *box: float) -> int:
    """CRC-32 of a row's extent, ten times as fast as `checksum`; -1 for wrong types."""
    try:
        return zlib.crc32(_EXTENT.pack(row, first_ns, last_ns, *box))
    except struct.error:
        return -1


def checksum(*values: object) -> int:
    """CRC-32 of plain values and bytes."""
    return zlib.crc32(repr(values).encode())


class Progress:
    """Watermarks of all spools. samples: of all machines."""

    def __init__(self, watermarks: Mapping[SpoolKey, Watermark]) -> None:
        self._watermarks: dict[SpoolKey, Watermark] = {}
        self._machines: dict[str, MachineTotals] = {}
        self.samples = 0
        for (machine, spool_id), watermark in watermarks.items():
            self.put(machine, spool_id, watermark)

    def watermark(self, machine: str, spool_id: int) -> Watermark:
        """Progress of one spool."""
        return self._watermarks.get((machine, spool_id), Watermark())

    def known(self, spool: SpoolKey) -> Watermark | None:
        """Progress of one spool, or None."""
        return self._watermarks.get(spool)

    def watermarks(self) -> dict[SpoolKey, Watermark]:
        """Progress of all spools."""
        return dict(self._watermarks)

    def machines(self) -> dict[str, MachineTotals]:
        """What each machine sent."""
        return dict(self._machines)

    def put(self, machine: str, spool_id: int, after: Watermark) -> None:
        """Replace a watermark."""
        before, totals = self._watermarks.get((machine, spool_id)), self._machines.get(machine, MachineTotals())
        self._watermarks[machine, spool_id] = after
        known = before or Watermark()
        samples = (after.seq - after.lost) - (known.seq - known.lost)
        self.samples += samples
        self._machines[machine] = MachineTotals(
            spools=totals.spools + (before is None),
            samples=totals.samples + samples,
            lost=totals.lost + after.lost - known.lost,
            newest_ns=max(totals.newest_ns, after.newest_ns),
        )
