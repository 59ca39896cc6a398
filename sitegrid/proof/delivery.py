"""Lost and double: what agents recorded, against the server's journal and against its grid.

Identity is (machine, spool_id, seq), content is the hash of the sample's bytes. The journal is folded again from
nothing and compared, count by count, with the grid that a server would start with: that of the last snapshot, and the
rows since, where this one had to end before it could write another.
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
    """What became of the recorded samples.

    recorded: in the audit files; merged: voted in the grid, or journalled but too uncertain of their position to vote,
    or of a machine that is not trusted. lost: recorded, but not in the journal with the same content, or missing in the
    grid; double: more than once in the journal, by identity or by content, or too often in the grid. unrecorded: in the
    journal, but in no audit file.
    """

    recorded: int
    merged: int
    lost: int
    double: int
    unrecorded: int


def read_audits(audits: Mapping[str, Path]) -> dict[SampleKey, Contents]:
    """Content hashes of every recorded sample; audits: machine -> file."""
    return {
        (machine, spool, seq): contents
        for machine, path in audits.items()
        for (spool, seq), contents in read_audit(path).items()
    }


def audit_store(audits: Mapping[str, Path], folder: Path, site: SiteConfig, config: ServerConfig) -> AuditResult:
    """Compare audit files with the store of a server that has ended."""
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
    """Compare recorded samples with journal rows, and those, folded again, with a grid; facts: of the grid."""
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
    """About how many samples are missing in a grid, and how many are too many: 0, 0 only where all counts agree.

    Counts are compared cell by cell; their difference is turned into samples by the counts of a mean sample, rounded
    up.
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
