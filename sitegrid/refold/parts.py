"""Parts of archives, the unit of reading: a Parquet file, or a range of unarchived journal rows.

They are values for other processes, and other hosts that reach their place. A part's samples are intervals of numbers
by spool, so years of them fit into one process.
"""

from __future__ import annotations

import socket
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mapserver.journal.archive_file import ArchiveFile
from mapserver.journal.history import History, read_history
from mapserver.journal.journal import JournalReader
from mapserver.journal.location import JournalLocation
from mapserver.journal.places import FilePlace
from mapserver.journal.rows import JournalRows, Selection, SpoolKey
from protocol.arrays import Bools, Ints
from protocol.errors import ConfigError, MessageError, StoreError
from protocol.machine.samples import COLUMNS, check_samples
from protocol.site.site_config import MAX_EXTENT_M, SiteConfig
from protocol.wire.keys import check_name

SLICE_ROWS = 20_000  # of a journal: up to two million samples, like a file
HEADS = ("stamp_ns", "x_m", "y_m")  # sample columns that suffice for selection
Interval = tuple[int, int]  # first and last number
Taken = Mapping[SpoolKey, tuple[Interval, ...]]  # disjoint, sorted


@dataclass(frozen=True)
class PartOrigin:
    """A part's own description. identity: hex digits, unique to its contents. site: if known."""

    identity: str
    name: str
    frame: str
    machines: tuple[str, ...]
    stores: tuple[str, ...]
    site: SiteConfig | None


@dataclass(frozen=True)
class FilePart:
    """One archive file."""

    path: Path | FilePlace

    def origin(self) -> PartOrigin:
        """Description from the header."""
        file = ArchiveFile(self.path)
        header = file.header
        identity = f"{file.identity}-{header.store}-{file.first_row}-{file.samples}"
        return PartOrigin(identity, header.site.name, header.frame, header.machines, (header.store,), header.site)

    def read(self, columns: Sequence[str] = COLUMNS) -> Iterator[JournalRows]:
        """Its rows with at least these sample columns; StoreError if damaged."""
        return ArchiveFile(self.path).read_many(columns=columns)

    def __str__(self) -> str:
        return str(self.path)


@dataclass(frozen=True)
class JournalPart:
    """Rows after < row <= until of a store's journal; rows archived meanwhile come from its archive.

    host: the only one that can read it, empty: any; SQLite files in use are unreadable elsewhere.
    """

    location: JournalLocation
    after: int
    until: int
    host: str

    def origin(self) -> PartOrigin:
        """Description from the journal, with a checksum of its rows."""
        with self._reader() as journal:
            store = journal.identity()
            crc32 = 0
            for rows in read_history(History(journal, self.location.archive), self.after, self.until):
                crc32 = zlib.crc32(rows.samples.tobytes(), crc32)
            machines = tuple(sorted({machine for machine, _ in journal.watermarks()}))
            identity = f"{crc32:08x}-{store.id}-{self.after}-{self.until}"
            return PartOrigin(identity, journal.site, journal.frame, machines, (store.id,), None)

    def read(self, columns: Sequence[str] = COLUMNS) -> Iterator[JournalRows]:  # noqa: ARG002 # rows are whole records
        """Its rows; StoreError if damaged."""
        with self._reader() as journal:
            for rows in read_history(History(journal, self.location.archive), self.after, self.until):
                try:
                    check_samples(rows.samples, MAX_EXTENT_M)
                    list(map(check_name, rows.machines, rows.machines))
                except (MessageError, ConfigError) as error:
                    raise StoreError(self, f"is no journal that a map server wrote ({error}); leave it out") from None
                yield rows

    def __str__(self) -> str:
        return f"{self.location}, rows {self.after + 1} to {self.until}"

    def _reader(self) -> JournalReader:
        if self.host and (here := socket.gethostname()) != self.host:
            advice = "fold its archive alone, or fold on that host with --jobs"
            raise StoreError(
                self.location, f"is a journal that {self.host} alone can read, and a worker runs on {here}; {advice}"
            )
        return self.location.reader()


Part = FilePart | JournalPart


@dataclass(frozen=True)
class Contents:
    """Wanted contents of one part.

    rows, samples: kept. first_ns: first row received. intervals: of kept samples. reached: each spool's last number,
    kept or not. newest_ns: each spool's newest kept stamp. excluded: omitted samples by reason.
    """

    part: Part
    origin: PartOrigin
    first_ns: int = 0
    rows: int = 0
    samples: int = 0
    intervals: Mapping[SpoolKey, tuple[Interval, ...]] = field(default_factory=dict)
    reached: Mapping[SpoolKey, int] = field(default_factory=dict)
    newest_ns: Mapping[SpoolKey, int] = field(default_factory=dict)
    excluded: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class LookTask:
    """Task: survey a part. selection: machines and stamps. taken: numbers in other parts."""

    part: Part
    selection: Selection
    taken: Taken = field(default_factory=dict)


def look(task: LookTask) -> Contents:
    """Survey a part; StoreError if damaged."""
    origin = task.part.origin()
    first_ns, rows_kept, samples = 0, 0, 0
    excluded: Counter[str] = Counter(machine=0, time=0, twice=0)
    reached: Counter[SpoolKey] = Counter()
    newest_ns: Counter[SpoolKey] = Counter()
    runs: defaultdict[SpoolKey, list[Interval]] = defaultdict(list)
    for rows in task.part.read(HEADS):
        first_ns = first_ns or int(rows.received_ns[0])
        kept, reasons = chosen(rows, task.selection, task.taken)
        excluded.update(reasons)
        rows_kept += int(rows.pieces(kept).sum())
        samples += int(kept.sum())
        for spool, seqs, of_spool in by_spool(rows):
            reached[spool] = max(reached[spool], int(seqs.max()))
            if (wanted := kept[of_spool]).any():
                newest_ns[spool] = max(newest_ns[spool], int(rows.samples["stamp_ns"][of_spool][wanted].max()))
                runs[spool] += _intervals(seqs[wanted])
    intervals = {spool: _joined(task.part, spool, some) for spool, some in runs.items()}
    return Contents(task.part, origin, first_ns, rows_kept, samples, intervals, reached, newest_ns, excluded)


def chosen(rows: JournalRows, selection: Selection, taken: Taken) -> tuple[Bools, Counter[str]]:
    """Mask of kept samples (n,), and counts of others by reason: machine, time, twice."""
    of_others = np.array([machine not in selection.without for machine in rows.machines], np.bool_)
    wanted = np.repeat(of_others[rows.machine], rows.lengths)
    in_time = selection.includes(rows.samples)
    new: Bools = np.ones(len(wanted), np.bool_)
    if taken:
        for spool, seqs, of_spool in by_spool(rows):
            for first, last in taken.get(spool, ()):
                new[of_spool[(seqs >= first) & (seqs <= last)]] = False
    reasons = Counter(
        machine=int((~wanted).sum()), time=int((wanted & ~in_time).sum()), twice=int((wanted & in_time & ~new).sum())
    )
    return wanted & in_time & new, reasons


def by_spool(rows: JournalRows) -> Iterator[tuple[SpoolKey, Ints, Ints]]:
    """Spools of rows: sample numbers, and their indices in the table."""
    starts = np.cumsum(rows.lengths) - rows.lengths
    seqs = np.arange(len(rows.samples)) + np.repeat(rows.first_seqs - starts, rows.lengths)
    pairs = np.rec.fromarrays([rows.machine, rows.spool_ids])
    unique, number = np.unique(pairs, return_inverse=True)
    of_sample = np.repeat(number, rows.lengths)
    order = np.argsort(of_sample, kind="stable")
    ends = np.cumsum(np.bincount(number, rows.lengths, len(unique)).astype(np.int64))
    for (machine, spool_id), end, begin in zip(unique.tolist(), ends, [0, *ends[:-1]], strict=True):
        at = order[begin:end]
        yield (rows.machines[machine], spool_id), seqs[at], at


def _intervals(seqs: Ints) -> list[Interval]:
    """Numbers as intervals; a repeated number starts a new one."""
    seqs = np.sort(seqs)
    edges = np.flatnonzero(np.diff(seqs) != 1)
    firsts, lasts = np.append(0, edges + 1), np.append(edges, len(seqs) - 1)
    return list(zip(seqs[firsts].tolist(), seqs[lasts].tolist(), strict=True))


def _joined(part: Part, spool: SpoolKey, intervals: list[Interval]) -> tuple[Interval, ...]:
    """Merge touching intervals, sorted; StoreError if two overlap."""
    out: list[Interval] = []
    for first, last in sorted(intervals):
        if out and first <= out[-1][1]:
            raise StoreError(part, f"holds sample {first} of {spool[0]}, spool {spool[1]:016x}, twice; leave it out")
        if out and first == out[-1][1] + 1:
            out[-1] = out[-1][0], last
        else:
            out.append((first, last))
    return tuple(out)
