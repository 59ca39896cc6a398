"""Valid pages: for every cell, those since its last credible change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from typing import TypeVar

import numpy as np

from mapserver.change.detection import (
    TUNING,
    ChangeConfig,
    ChangeTuning,
    Cuts,
    Known,
    credible,
    cuts,
    known,
    reach_blocks,
)
from mapserver.evidence.timeline import Ages, Block, TimedPages
from protocol.arrays import AnyArray, Ints
from protocol.site.geometry import BLOCK_CELLS

Pages = Mapping[Block, TimedPages]
T = TypeVar("T")


def valid_pages(
    pages: Pages,
    cell_m: float,
    config: ChangeConfig,
    ages: Ages | None = None,
    tuning: ChangeTuning = TUNING,
    only: Iterable[Block] | None = None,
) -> dict[Block, Ints]:
    """First valid page (256,) of each block's cells, 0 for no change.

    Edge cells lack context: pass `reach_blocks` more on every side, and the wanted blocks as `only`. ages: changes
    known otherwise.
    """
    last = {block: _cuts(pages[block], config, tuning) for block in (pages if only is None else only)}
    changed = [block for block, cut in last.items() if cut.has_change]
    valid = {block: cut.first for block, cut in last.items()}
    reach = reach_blocks(cell_m, config)
    for some in clusters(changed, reach):
        near = {block for one in some for block in around(one, reach) if block in pages}
        images, corner = _images(Cuts, {block: _cuts(pages[block], config, tuning) for block in near})
        cells, _ = _images(Known, {block: _known(pages[block], tuning) for block in near})
        holds = credible(images, cells, cell_m, config, tuning)
        for block in some:
            valid[block] = np.where(cells_of(holds, corner, block), valid[block], 0)
    for block in (ages or {}).keys() & valid.keys():
        valid[block] = np.maximum(valid[block], _since(pages[block], ages[block]))  # type: ignore[index]
    return valid


def has_change(pages: TimedPages, config: ChangeConfig) -> bool:
    """Whether a block has a possible change; neighbours decide."""
    return _cuts(pages, config, TUNING).has_change


def _since(pages: TimedPages, age_ns: Ints) -> Ints:
    """First page (256,) with evidence that begins within a cell's age.

    If there is none, the page in which the age begins: mixed evidence is better than none.
    """
    whole, part = np.zeros((2, len(age_ns)), np.int64)
    for index, timed in reversed(list(enumerate(pages))):  # reading any page expands all
        known = np.zeros(len(age_ns), np.bool_)
        known[timed.page.cells["cell"]] = age_ns[timed.page.cells["cell"]] > 0
        whole[known & (timed.first_ns >= age_ns)] = index
        part[known & (timed.end_ns > age_ns)] = index
    return np.where(whole > 0, whole, part)


def clusters(blocks: Iterable[Block], reach: int) -> list[list[Block]]:
    """Group blocks with those nearby, to keep images small."""
    left, parts = set(blocks), []
    while left:
        part = [left.pop()]
        for block in part:  # grows meanwhile
            near = left.intersection(around(block, 2 * reach))
            left -= near
            part += sorted(near)
        parts.append(part)
    return parts


def _cuts(pages: TimedPages, config: ChangeConfig, tuning: ChangeTuning) -> Cuts:
    return _derived(pages, cuts, (config, tuning), lambda: cuts(pages, config, tuning))


def _known(pages: TimedPages, tuning: ChangeTuning) -> Known:
    return _derived(pages, known, tuning, lambda: known(pages, tuning))


def _derived(pages: TimedPages, what: object, by: object, derive: Callable[[], T]) -> T:
    """Result of `derive`, cached for one configuration, which is compared, not hashed."""
    kept = pages.derived.get(what)
    if kept is None or kept[0] != by:
        kept = pages.derived[what] = by, derive()
    value: T = kept[1]
    return value


def around(block: Block, reach: int) -> list[Block]:
    """A block and its neighbours within `reach`."""
    x, y = block
    steps = range(-reach, reach + 1)
    return [(x + dx, y + dy) for dy in steps for dx in steps]


def _images(kind: type[T], blocks: Mapping[Block, T]) -> tuple[T, Block]:
    """Values of blocks as images by field; 0 or NaN elsewhere."""
    images = {}
    corner = (0, 0)
    for field in fields(kind):  # type: ignore[arg-type]
        values = {block: getattr(each, field.name) for block, each in blocks.items()}
        nothing = 0 if next(iter(values.values())).dtype.kind == "i" else np.nan
        images[field.name], corner = image_of(values, nothing)
    return kind(**images), corner


def image_of(blocks: Mapping[Block, AnyArray], nothing: float) -> tuple[AnyArray, Block]:
    """Values (256,) of blocks as one image (rows, columns), and its first block; `nothing` elsewhere."""
    columns, rows = zip(*blocks, strict=True)
    left, bottom, right, top = min(columns), min(rows), max(columns), max(rows)
    n, kind = BLOCK_CELLS, next(iter(blocks.values())).dtype
    image = np.full(((top - bottom + 1) * n, (right - left + 1) * n), nothing, kind)
    for (x, y), cells in blocks.items():
        image[(y - bottom) * n : (y - bottom + 1) * n, (x - left) * n : (x - left + 1) * n] = cells.reshape(n, n)
    return image, (left, bottom)


def cells_of(image: AnyArray, corner: Block, block: Block) -> AnyArray:
    """Inverse of `image_of` for one block: (256,)."""
    n, x, y = BLOCK_CELLS, block[0] - corner[0], block[1] - corner[1]
    return image[y * n : (y + 1) * n, x * n : (x + 1) * n].ravel()
