"""Backups of a live store: made, verified, restored.

A backup is a store's folder without caches: the journal at one commit, the archive files up to the journal's first row,
and the files that identify the site. It is written beside its place and renamed once read back whole.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mapserver.ingest.decisions import ground_decisions
from mapserver.ingest.map_info import lacking
from mapserver.ingest.store_folder import hold_place, is_in_use
from mapserver.journal import archived_decisions
from mapserver.journal.history import History, read_history
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.rows import SpoolKey, Watermark
from protocol.errors import ConfigError, StoreError
from protocol.files import sync_folder

BESIDE = ("site.toml", "server.toml")  # copied if present


@dataclass(frozen=True)
class BackupReport:
    """Contents that were verified: rows with samples, events, archive files, spools."""

    store: str
    rows: int
    samples: int
    lost: int
    events: int
    archive_files: int
    spools: int
    machines: int
    newest_ns: int


def backup(store: Path, out: Path) -> BackupReport:
    """Copy a store, even while its server writes, and verify the copy; StoreError, ConfigError."""
    with _making(store, out) as (source, part):
        _require_whole(source)
        with source.file_reader() as journal:
            journal.copy_to(part / JOURNAL_FILE)
        with JournalLocation(part).reader() as copied:  # rows that move to the archive from now on are in the copy
            archived, decisions = copied.archived_row, ground_decisions(copied)
            identity = copied.identity().id
        _copy_archive(source, part, archived)
        if archived and decisions:
            archived_decisions.save(JournalLocation(part).archive.folder, identity, decisions)
        return _examined(JournalLocation(part), live=False)


def restore(copy: Path, store: Path) -> BackupReport:
    """Make a store from a backup; verified before and after."""
    if is_in_use(copy):
        raise ConfigError(copy, "is the store of a server that runs, and no backup; make one of it: sitegrid backup")
    verify(copy)
    with _making(copy, store) as (source, part):
        with source.file_reader() as journal:
            journal.copy_to(part / JOURNAL_FILE)
            archived = journal.archived_row
        _copy_archive(source, part, archived)
        if (decisions := source.archive.folder / archived_decisions.FILE).exists():
            _copy(decisions, JournalLocation(part).archive.folder)
        return _examined(JournalLocation(part), live=False)


def verify(store: Path) -> BackupReport:
    """Read a whole store or backup; StoreError names the first deviation."""
    location = _journal_of(store)
    _require_whole(location)
    return _examined(location, live=is_in_use(store))


def _require_whole(location: JournalLocation) -> None:
    """StoreError if acknowledged samples are missing and no server start has recorded it."""
    if shortfall := lacking(location):
        advice = "restore a backup, or start a map server on it once: it keeps a note of that, and goes on"
        raise StoreError(location, f"lacks what was acknowledged: {shortfall}; {advice}")


def _examined(location: JournalLocation, *, live: bool) -> BackupReport:
    """Read everything. live: batches arrive meanwhile, so rows and watermarks are not compared."""
    rows, samples, reached = 0, Counter[SpoolKey](), Counter[SpoolKey]()
    with location.file_reader() as journal:
        journal.require_sound()
        journal.check()
        watermarks, events, last_row = journal.watermarks(), journal.events(), journal.last_row
        ground_decisions(journal)
        for some in read_history(History(journal, location.archive), until=last_row):
            rows += len(some)
            columns = (some.machine, some.spool_ids, some.first_seqs, some.lengths)
            for machine, spool_id, first, n in zip(*(column.tolist() for column in columns), strict=True):
                spool = some.machines[machine], spool_id
                samples[spool] += n
                reached[spool] = max(reached[spool], first + n - 1)
        identity, files = journal.identity().id, list(location.archive.cover(journal.archived_row))
    archived_decisions.load(location.archive.folder)
    for spool in () if live else samples.keys() | watermarks.keys():
        mark = watermarks.get(spool, Watermark())
        if reached[spool] > mark.seq or samples[spool] != mark.seq - mark.lost:
            problem = f"has other samples of {spool[0]}, spool {spool[1]:016x}, than its watermark says"
            raise StoreError(location, f"{problem}; restore a backup")
    lost = sum(mark.lost for mark in watermarks.values())
    newest_ns = max((mark.newest_ns for mark in watermarks.values()), default=0)
    machines = len({name for name, _ in watermarks})
    counts = (rows, samples.total(), lost, len(events), len(files), len(watermarks), machines)
    return BackupReport(identity, *counts, newest_ns)


def _journal_of(store: Path) -> JournalLocation:
    location = JournalLocation(store)
    if not location.exists():
        raise ConfigError(
            store, f"holds no {JOURNAL_FILE}; a journal in PostgreSQL is backed up by pg_dump (docs/operation.md)"
        )
    return location


@contextmanager
def _making(source: Path, out: Path) -> Iterator[tuple[JournalLocation, Path]]:
    """A folder beside its place, renamed at the end, removed after an error."""
    location, out = _journal_of(source), out.absolute()
    part = out.with_name(f"{out.name}.part")
    with hold_place(part):
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise ConfigError(out, "exists and is not empty; choose another --out")
        try:
            if part.exists():
                shutil.rmtree(part)  # left by a killed run
            part.mkdir()
            yield location, part
            for name in BESIDE:
                if (source / name).is_file():
                    _copy(source / name, part)
            sync_folder(part)
            part.replace(out)
            sync_folder(out.parent)
        except OSError as error:
            raise StoreError(out, f"cannot be written: {error.strerror or error}") from None
        finally:
            shutil.rmtree(part, ignore_errors=True)  # nothing, after the rename


def _copy_archive(source: JournalLocation, part: Path, until: int) -> None:
    """Copy archive files with rows up to `until`; they never change."""
    if until:
        folder = JournalLocation(part).archive.folder
        folder.mkdir()
        for path in source.archive.cover(until):
            _copy(path, folder)


def _copy(path: Path, folder: Path) -> None:
    """Copy and sync, because the server may forget the original once there is a backup."""
    shutil.copy2(path, folder)
    with (folder / path.name).open("rb") as file:
        os.fsync(file.fileno())
    sync_folder(folder)


def lines(store: Path, examined: BackupReport) -> list[str]:
    """The report for people."""
    e = examined
    return [
        f"{store}: store {e.store}, all as it was written",
        f"  {e.rows} journal rows with {e.samples} samples of {e.machines} machines, {e.lost} declared lost",
        f"  {e.archive_files} files of the archive, {e.events} events, {e.spools} watermarks",
    ]
