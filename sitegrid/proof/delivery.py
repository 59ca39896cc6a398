"""Lost and double samples: agents' records against the server's journal and grid.

Identity is (machine, spool_id, seq), content the hash of the sample's bytes. The journal is folded from scratch and
compared, count by count, with the grid that a server would start with: the last snapshot plus later rows.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agents.delivery.audit import Contents, read_audit
from mapserver.config import ServerConfig
from mapserver.evidence import cells as ev
from mapserver.evidence.grid import REFOLD_ROWS, Grid
from mapserver.evidence.grid_state import GridState, PlacedPage
from mapserver.evidence.pages import Page
from mapserver.ingest.decisions import Decisions
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.journal.history import History, history_rows
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import JournalRow
from mapserver.past.past import StorePast
from protocol.arrays import Ints
from protocol.machine.samples import content_hash
from protocol.site.site_config import SiteConfig

SampleKey = tuple[str, int, int]  # machine, spool_id, seq


@dataclass(frozen=True)
class AuditResult:
    """Outcome of the recorded samples.

    recorded: in the audit files. merged: voted in the grid, or journalled but without a vote (uncertain position,
    untrusted machine). lost: recorded, but missing in the journal with this content, or in the grid. double: repeated
    in the journal by identity or content, or in the grid. unrecorded: in the journal only.
    """

    recorded: int
    merged: int
    lost: int
    double: int
    unrecorded: int


def read_audits(audits: Mapping[str, Path]) -> dict[SampleKey, Contents]:
    """Content hashes of all recorded samples; audits: machine -> file."""
    return {
        (machine, spool, seq): contents
        for machine, path in audits.items()
        for (spool, seq), contents in read_audit(path).items()
    }


def audit_store(audits: Mapping[str, Path], folder: Path, site: SiteConfig, config: ServerConfig) -> AuditResult:
    """Compare audit files with a stopped server's store."""
    location = JournalLocation(folder)
    with location.reader() as journal:
        rows = list(history_rows(History(journal, location.archive)))
        facts = Decisions.of_journal(journal).facts
        folded, grid = StorePast.of_store(folder, site.cell_m, config.fold).newest(journal, facts)
    for row in rows:
        if row.row > folded and row.machine not in facts.excluded:
            _fold(grid, row, facts)
    return compare(read_audits(audits), rows, grid, site, config, facts)


def compare(
    recorded: Mapping[SampleKey, Contents],
    rows: Iterable[JournalRow],
    grid: Grid,
    site: SiteConfig,
    config: ServerConfig,
    facts: Facts = NO_FACTS,
) -> AuditResult:
    """Compare recorded samples with journal rows, and the folded rows with a grid; facts: of the grid."""
    withheld = 0
    refolded = Grid(site.cell_m, config.fold, REFOLD_ROWS)
    hashes: dict[SampleKey, list[str]] = {}
    contents: Counter[tuple[str, str]] = Counter()
    for row in rows:
        if row.machine in facts.excluded:
            withheld += len(row.rows)
        else:
            _fold(refolded, row, facts)
        for i, sample in enumerate(row.rows):
            content = content_hash(sample)
            hashes.setdefault((row.machine, row.spool_id, row.first_seq + i), []).append(content)
            contents[row.machine, content] += 1
    lost = sum(not set(may_be) & set(hashes.get(identity, ())) for identity, may_be in recorded.items())
    by_identity = sum(len(each) - 1 for each in hashes.values())
    by_content = sum(n - 1 for n in contents.values())
    short, over = grid_difference(refolded.state(), grid.state())
    return AuditResult(
        recorded=len(recorded),
        merged=grid.folded + grid.skipped + withheld,
        lost=lost + short,
        double=max(by_identity, by_content) + over,
        unrecorded=sum(identity not in recorded for identity in hashes),
    )


def _fold(grid: Grid, row: JournalRow, facts: Facts) -> None:
    grid.fold(facts.corrections.applied(row.rows, [row.machine], np.zeros(len(row.rows), np.int64)), row.machine)


def grid_difference(expected: GridState, actual: GridState) -> tuple[int, int]:
    """Approximate missing and surplus samples in a grid; 0, 0 only if all counts agree.

    Counts are compared by cell; differences become samples by a mean sample's counts, rounded up.
    """
    per_sample = max(1.0, sum(map(_votes, expected.pages)) / max(1, expected.folded))
    there = {(at.x, at.y, at.tier, at.index): at.page for at in actual.pages}
    missing = surplus = 0
    for at in expected.pages:
        difference = _dense(at.page)
        if page := there.pop((at.x, at.y, at.tier, at.index), None):
            difference -= _dense(page)
        missing += int(difference[difference > 0].sum())
        surplus -= int(difference[difference < 0].sum())
    surplus += sum(int(page.votes["count"].sum(dtype=np.int64)) for page in there.values())
    return math.ceil(missing / per_sample), math.ceil(surplus / per_sample)


def _votes(at: PlacedPage) -> int:
    return int(at.page.votes["count"].sum(dtype=np.int64))


def _dense(page: Page) -> Ints:
    """All counts of a page (COUNTS * 256,)."""
    counts = np.zeros(ev.COUNTS * ev.CELLS, np.int64)
    counts[page.votes["place"]] = page.votes["count"]
    return counts
