"""From pages to evidence that holds now: what a read of the map begins with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mapserver.change.detection import ChangeConfig, credible, cuts, kinds, reach_blocks
from mapserver.evidence import cells as ev
from mapserver.evidence.pages import pick
from mapserver.evidence.timeline import Block, TimedPage
from protocol.arrays import AnyArray, Ints
from protocol.site.geometry import BLOCK_CELLS

Pages = Mapping[Block, Sequence[TimedPage]]


def valid_pages(pages: Pages, cell_m: float, config: ChangeConfig) -> dict[Block, Ints]:
    """For each block, index (256,) of the first page that holds now in each of its cells, 0 where nothing changed.

    Cells at the edge of the blocks see no further: give `reach_blocks` more to every side than are wanted.
    """
    found = {block: cuts(of_block, config) for block, of_block in pages.items()}
    first = {block: cut.first for block, cut in found.items()}
    changed = [block for block, cut in found.items() if cut.first.any()]
    if not changed:
        return first
    reach = reach_blocks(cell_m, config)
    near = {block for one in changed for block in around(one, reach) if block in found}
    image, corner = image_of({block: first[block] > 0 for block in near}, False)
    kind, _ = image_of({block: found[block].kind for block in near}, np.nan)
    now, _ = image_of({block: kinds(pages[block]) for block in near}, np.nan)
    holds = credible(image, kind, now, cell_m, config)
    for block in changed:
        first[block][~cells_of(holds, corner, block)] = 0
    return first


def around(block: Block, reach: int) -> list[Block]:
    """A block and its neighbours, `reach` blocks to every side."""
    x, y = block
    steps = range(-reach, reach + 1)
    return [(x + dx, y + dy) for dy in steps for dx in steps]


def evidence(pages: Sequence[Sequence[TimedPage]], first: Sequence[Ints] | None = None) -> ev.Evidence:
    """Sum the pages of blocks, from the first that holds on in each cell; all of them where `first` is not given."""
    counts = np.zeros((len(pages), ev.COUNTS, ev.CELLS), np.uint64)
    bitmaps = np.zeros((len(pages), ev.CELLS, 2), np.uint64)
    newest_ns = np.zeros((len(pages), ev.CELLS), np.int64)
    changed_ns = np.zeros((len(pages), ev.CELLS), np.int64)
    for i, of_block in enumerate(pages):
        start = first[i] if first else np.zeros(ev.CELLS, np.int64)
        _sum(of_block, start, counts[i].reshape(-1), bitmaps[i], newest_ns[i])
        if start.any():
            changed_ns[i] = _changed_ns(of_block, start)
    return ev.Evidence(counts.transpose(0, 2, 1), bitmaps, newest_ns, changed_ns)


def _sum(
    pages: Sequence[TimedPage], start: Ints, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints
) -> None:
    last = int(start.max(initial=0))
    for index, timed in enumerate(pages):
        page = timed.page if index >= last else pick(timed.page, start <= index)
        page.add_to(counts, bitmaps, newest_ns)


def _changed_ns(pages: Sequence[TimedPage], start: Ints) -> Ints:
    """When each cell (256,) changed, 0 where it did not: after its last old sample, and within the first new span."""
    changed_ns = np.zeros(ev.CELLS, np.int64)
    for index, timed in enumerate(pages):
        begins = start == index
        changed_ns[begins & (start > 0)] = np.maximum(changed_ns, timed.first_ns)[begins & (start > 0)]
        cells = timed.page.cells
        old = start[cells["cell"]] > index
        at = cells["cell"][old]
        changed_ns[at] = np.maximum(changed_ns[at], cells["newest_ns"][old])
    return changed_ns


def image_of(blocks: Mapping[Block, AnyArray], nothing: float) -> tuple[AnyArray, Block]:
    """Values (256,) of blocks as one image (rows, columns), `nothing` elsewhere; and its first block column and row."""
    left, bottom = (min(block[axis] for block in blocks) for axis in (0, 1))
    right, top = (max(block[axis] for block in blocks) for axis in (0, 1))
    n, kind = BLOCK_CELLS, next(iter(blocks.values())).dtype
    image = np.full(((top - bottom + 1) * n, (right - left + 1) * n), nothing, kind)
    for (x, y), cells in blocks.items():
        image[(y - bottom) * n : (y - bottom + 1) * n, (x - left) * n : (x - left + 1) * n] = cells.reshape(n, n)
    return image, (left, bottom)


def cells_of(image: AnyArray, corner: Block, block: Block) -> AnyArray:
    """Undo `image_of` for one block: (256,)."""
    n, x, y = BLOCK_CELLS, block[0] - corner[0], block[1] - corner[1]
    return image[y * n : (y + 1) * n, x * n : (x + 1) * n].ravel()
