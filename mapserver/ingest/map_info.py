"""`info` of a map and its process; totals of machines, and losses of a store."""

from __future__ import annotations

import logging
import os
import socket
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from mapserver.evidence.grid import Grid
from mapserver.ingest.store_folder import is_in_use
from mapserver.journal.facts import Facts
from mapserver.journal.journal import Journal
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import MachineTotals, Progress
from mapserver.journal.shortfall import KIND, Shortfall, beyond, compare, marked, missing
from mapserver.past.checkpoints import snapshot_rows
from protocol.queries.answers import MapVersion
from protocol.site.site_config import SiteConfig
from protocol.version import package_version

log = logging.getLogger("mapserver.ingest.map_info")


def map_info(
    site: SiteConfig, grid: Grid, facts: Facts, version: MapVersion, newest_ns: int, now_ns: int
) -> dict[str, Any]:
    """Plain values, from counters. newest_ns: the site's now. now_ns: the process's clock."""
    counts = grid.counts()
    return {
        "site": {**asdict(site), "frame": site.frame, "crs": site.crs},
        "store": version.store,
        "merged": version.row,
        "fact": version.fact,
        "corrections": len(facts.corrections),
        "distrusted": sorted(facts.excluded),
        "samples_merged": counts.folded,
        "samples_too_unsure": counts.skipped,
        "cells": counts.cells,
        "bounds": counts.bounds,
        "first_ns": grid.oldest_ns,
        "stamp_ns": newest_ns,
        "wall_ns": now_ns,
        "version": package_version(),
        "server": {"host": socket.gethostname(), "pid": os.getpid()},
    }


def name_shortfalls(journal: Journal, snapshot_rows: Sequence[int]) -> list[Shortfall]:
    """Log acknowledged samples missing from a new journal; returns all shortfalls ever.

    snapshot_rows: one beyond the journal proves a loss.
    """
    shortfall, newest = journal.shortfall, max(snapshot_rows, default=0)
    if newest > max(journal.last_row, shortfall.expected_row if shortfall else 0):
        shortfall = beyond(journal.last_row, newest)
        journal.note_shortfall(shortfall)
    if shortfall:
        log.error("acknowledged samples are missing journal=%s shortfall=%r", journal.where, str(shortfall))
    return [Shortfall.from_event(event) for event in journal.events(KIND)]


def lacking(location: JournalLocation) -> Shortfall | None:
    """The journal's shortfall until a server start logs it; StoreError if unreadable.

    Evidence of its length is read first, so a journal in use is never behind it.
    """
    newest = max(snapshot_rows(location.folder), default=0)
    traces = location.traces(in_use=is_in_use(location.folder))
    with location.reader() as journal:
        last_row, events, watermarks = journal.last_row, journal.events(), journal.watermarks()
    shortfall = compare(traces, marked(last_row, len(events), watermarks))
    return beyond(last_row, newest) if newest > last_row and not shortfall else shortfall


def by_machine(progress: Journal | Progress, shortfalls: Sequence[Shortfall]) -> dict[str, dict[str, int]]:
    """Spools, samples, declared losses, newest stamp, and missing samples of each machine."""
    gone = missing(shortfalls, progress.watermarks()) if shortfalls else Counter()
    sent = progress.machines()
    names = dict.fromkeys([*sent, *gone])
    return {name: {**vars(sent.get(name, MachineTotals())), "missing": gone[name]} for name in names}
