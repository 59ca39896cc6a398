"""A site's evidence by definition: sample by sample, cell by cell, without packing or kernels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import TABLE, TABLE_LAST, TABLE_PER_UNIT, WEIGHT_SHIFT, FoldConfig, is_foldable
from mapserver.evidence.grid import Grid
from mapserver.evidence.timeline import Tiers
from protocol.arrays import Table
from tests.reference.votes import prepare

Cell = tuple[int, int]  # column and row on the site
Span = tuple[int, int]  # tier and index


@dataclass
class CellEvidence:
    """Evidence of one cell and span."""

    counts: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(ev.COUNTS, np.uint64))
    visits: int = 0
    machines: int = 0
    newest_ns: int = 0

    def add(self, other: CellEvidence) -> None:
        """Saturated sum."""
        self.counts = np.minimum(self.counts + other.counts, np.uint64(ev.COUNT_MAX))
        self.visits |= other.visits
        self.machines |= other.machines
        self.newest_ns = max(self.newest_ns, other.newest_ns)

    def plain(self) -> tuple[bytes, int, int, int]:
        """For comparison."""
        return self.counts.tobytes(), self.visits, self.machines, self.newest_ns


Evidence = dict[Cell, dict[Span, CellEvidence]]


def folded(batches: Iterable[tuple[str, Table]], cell_m: float, config: FoldConfig) -> Evidence:
    """Evidence of all cells by buckets."""
    evidence: Evidence = defaultdict(lambda: defaultdict(CellEvidence))
    for machine, rows in batches:
        votes = prepare(rows[is_foldable(rows, config)], machine, cell_m, config)
        for k in range(len(votes.weight)):
            planes = _planes(votes.bins[k], votes.shares[k], int(votes.sector[k]))
            for cell, share in _shares(votes, k).items():
                one = CellEvidence(visits=int(votes.bits[k, 0]), machines=int(votes.bits[k, 1]))
                one.newest_ns = int(votes.stamp_ns[k])
                for plane, part in planes:
                    above = share * part >> 8
                    one.counts[plane] += np.uint64(share - above)
                    if part >= 0 and plane < ev.HEADING.start:
                        one.counts[plane + 1] += np.uint64(above)
                doubt = int(votes.doubt[k]) if votes.bins[k, 0] >= 0 else 0
                for plane, part in ((ev.DOUBT, doubt), (ev.AIDED, int(votes.aided[k]))):
                    one.counts[plane] += np.uint64((share * part + ev.SHARE_ONE // 2) >> 8)
                evidence[cell][0, int(votes.bucket[k])].add(one)
    return evidence


def by_definition(batches: Iterable[tuple[str, Table]], cell_m: float, config: FoldConfig) -> Evidence:
    """Expected content of a grid."""
    return settled(folded(batches, cell_m, config), config)


def settled(evidence: Evidence, config: FoldConfig) -> Evidence:
    """Merge spans older than each tier's newest."""
    tiers = Tiers.from_config(config)
    spans, keeps = tiers.spans_ns.tolist(), tiers.keeps.tolist()
    kept: Evidence = {}
    for cell, by_span in evidence.items():
        here = {span: replace(one, counts=one.counts.copy()) for span, one in by_span.items()}
        for tier, keep in enumerate(keeps[:-1]):
            old = sorted((index for at, index in here if at == tier), reverse=True)[keep:]
            for index in old:
                above = spans[tier + 1]
                to = (tier + 1, index * spans[tier] // above if above else 0)
                here.setdefault(to, CellEvidence()).add(here.pop((tier, index)))
        kept[cell] = here
    return kept


def of_grid(grid: Grid) -> Evidence:
    """Content of a grid."""
    evidence: Evidence = defaultdict(dict)
    for at in grid.state().pages:
        plane, place = np.divmod(at.page.votes["place"].astype(np.int64), ev.CELLS)
        for number, visits, machines, newest_ns in at.page.cells.tolist():
            one = CellEvidence(visits=visits, machines=machines, newest_ns=newest_ns)
            here = place == number
            one.counts[plane[here]] = at.page.votes["count"][here]
            cell = (at.x * 16 + number % 16, at.y * 16 + number // 16)
            assert (at.tier, at.index) not in evidence[cell], "a span twice"
            evidence[cell][at.tier, at.index] = one
    return evidence


def plain(evidence: Evidence) -> dict[Cell, dict[Span, tuple[bytes, int, int, int]]]:
    """For comparison."""
    return {cell: {span: one.plain() for span, one in spans.items()} for cell, spans in evidence.items()}


def _planes(bins: NDArray[np.int64], shares: NDArray[np.int64], sector: int) -> list[tuple[int, int]]:
    """Lower bin of each known value, and the share (of 256) of the next; the sector without one."""
    parts = zip((ev.RESISTANCE, ev.GRADE_EAST, ev.GRADE_NORTH), bins.tolist(), shares.tolist(), strict=True)
    return [
        *((part.start + lower, share) for part, lower, share in parts if lower >= 0),
        (ev.HEADING.start + sector, 0),
    ]


def _shares(votes: object, k: int) -> dict[Cell, int]:
    """Integer shares of a sample's weight by cell; the rounding remainder goes to the middle."""
    (px, py), (xx, xy, yy) = votes.place[k].tolist(), votes.inverse[k].tolist()  # type: ignore[attr-defined]
    reach, weight = int(votes.reach[k]), int(votes.weight[k])  # type: ignore[attr-defined]
    column, row = int(np.floor(px)), int(np.floor(py))
    raw: dict[Cell, int] = {}
    for y in range(row - reach, row + reach + 1):
        dy = (y + 0.5) - py
        b, c = xy * dy, yy * dy * dy
        for x in range(column - reach, column + reach + 1):
            dx = (x + 0.5) - px
            d2 = (xx * dx + b) * dx + c
            raw[x, y] = int(TABLE[int(min(d2 * TABLE_PER_UNIT, TABLE_LAST))])
    factor = (weight << WEIGHT_SHIFT) // max(sum(raw.values()), 1)
    shares = {cell: value * factor >> WEIGHT_SHIFT for cell, value in raw.items()}
    shares[column, row] += weight - sum(shares.values())
    return {cell: share for cell, share in shares.items() if share}
