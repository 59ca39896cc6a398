"""A grid's content as values: all for snapshots, and in numbers."""

from __future__ import annotations

from dataclasses import dataclass

from mapserver.evidence.pages import Page, Pages, Record


@dataclass(frozen=True)
class PlacedPage:
    """A page with its block's column and row, tier and index."""

    x: int
    y: int
    tier: int
    index: int
    page: Page


@dataclass(frozen=True)
class GridState:
    """What a snapshot keeps; equal grids have equal states.

    blocks: column, row and record, sorted. newest_ns, oldest_ns: of all samples, or 0.
    """

    blocks: tuple[tuple[int, int, Record], ...]
    folded: int
    skipped: int
    newest_ns: int
    oldest_ns: int

    @property
    def pages(self) -> list[PlacedPage]:
        """All pages, unpacked."""
        return [
            PlacedPage(x, y, tier, index, page)
            for x, y, record in self.blocks
            for tier, index, page in Pages.unpacked(record).items()
        ]


@dataclass(frozen=True)
class GridCounts:
    """A grid in numbers.

    folded: samples that vote; skipped: too uncertain of position. cells: with evidence; bounds: first column, first
    row, end column, end row of blocks; both without waiting samples.
    """

    folded: int
    skipped: int
    cells: int
    bounds: tuple[int, int, int, int] | None
