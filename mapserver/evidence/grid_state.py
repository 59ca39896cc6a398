"""What a grid holds, as values: all of it for snapshots, and in numbers."""

from __future__ import annotations

from dataclasses import dataclass

from mapserver.evidence.pages import Page, Pages, Record


@dataclass(frozen=True)
class PlacedPage:
    """A page, and where it belongs: the block's column and row, the tier of its timeline and the index there."""

    x: int
    y: int
    tier: int
    index: int
    page: Page


@dataclass(frozen=True)
class GridState:
    """Everything that a snapshot keeps; equal grids have equal states.

    blocks: column, row and record of each block, in the order of places. newest_ns, oldest_ns: of all samples, or 0.
    """

    blocks: tuple[tuple[int, int, Record], ...]
    folded: int
    skipped: int
    newest_ns: int
    oldest_ns: int

    @property
    def pages(self) -> list[PlacedPage]:
        """All pages, one by one."""
        return [
            PlacedPage(x, y, tier, index, page)
            for x, y, record in self.blocks
            for tier, index, page in Pages.unpacked(record).items()
        ]


@dataclass(frozen=True)
class GridCounts:
    """What a grid holds, in numbers.

    folded: samples that vote; skipped: those too uncertain of their position. cells: how many have evidence; bounds:
    first column, first row, end column, end row of all blocks with evidence; both without the samples that wait.
    """

    folded: int
    skipped: int
    cells: int
    bounds: tuple[int, int, int, int] | None
