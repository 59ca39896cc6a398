"""Why a cell has its value: its votes, before and since its last change, and their machines."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np

from mapserver.change.validity import valid_pages
from mapserver.config import ServerConfig
from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import name_hash
from mapserver.evidence.timeline import NO_PAGES, evidence
from mapserver.layers import cell_layers
from mapserver.query.views import View
from protocol.arrays import AnyArray
from protocol.queries.reasons import CellReasons, Votes
from protocol.site.geometry import BLOCK_CELLS

LAYERS = tuple(name for name in cell_layers.LAYERS if name not in ("age_s", "changed_s"))  # they follow from stamps
MACHINE_SHIFT = 58  # the top six bits of a name's hash choose its bit


def reasons(
    view: View, cell: tuple[int, int], names: Iterable[str], cell_m: float, config: ServerConfig
) -> CellReasons:
    """What is known of one cell (column, row).

    names: of machines in the map; they share 64 bits, so with many machines one may be listed wrongly.
    """
    block = cell[0] // BLOCK_CELLS, cell[1] // BLOCK_CELLS
    pages, all_pages = view.pages.get(block, NO_PAGES), np.zeros(ev.CELLS, np.int64)
    first = valid_pages(view.pages, cell_m, config.change, view.ages, only=view.pages.keys() & {block})
    place = cell[1] % BLOCK_CELLS * BLOCK_CELLS + cell[0] % BLOCK_CELLS
    sums = _cell(evidence([pages, pages], [first.get(block, all_pages), all_pages]), place)
    sums.counts[1] -= sums.counts[0]  # what holds, and what was before its change
    values, before = _values(sums, config)
    bits = sums.bitmaps[0, 0, ev.MACHINES]
    return CellReasons(
        store=view.version.store,
        merged=view.version.row,
        fact=view.version.fact,
        stamp_ns=view.stamp_ns,
        x_m=(cell[0] + 0.5) * cell_m,
        y_m=(cell[1] + 0.5) * cell_m,
        cell_m=cell_m,
        values=values,
        before=before,
        metres=float(sums.weight[0, 0]) / ev.WEIGHT_UNITS_PER_M,
        newest_ns=int(sums.newest_ns[0, 0]),
        changed_ns=int(sums.changed_ns[0, 0]),
        resistance=_votes(sums, ev.RESISTANCE, ev.RESISTANCE_CENTRES),
        grade_east=_votes(sums, ev.GRADE_EAST, ev.GRADE_CENTRES),
        grade_north=_votes(sums, ev.GRADE_NORTH, ev.GRADE_CENTRES),
        sectors=_metres(sums, ev.HEADING)[0],
        machines=tuple(sorted(name for name, bit in machine_bits(names).items() if bits & bit)),
    )


def machine_bits(names: Iterable[str]) -> dict[str, np.uint64]:
    """Bit of each machine in a cell."""
    known = list(names)
    hashes = np.array(list(map(name_hash, known)), np.uint64)
    return dict(zip(known, np.uint64(1) << (hashes >> np.uint64(MACHINE_SHIFT)), strict=True))


def _cell(sums: ev.Evidence, place: int) -> ev.Evidence:
    """One cell of blocks, arrays (blocks, 1, ...)."""
    parts = {item.name: getattr(sums, item.name)[:, place : place + 1] for item in dataclasses.fields(sums)}
    return ev.Evidence(**parts)


def _values(sums: ev.Evidence, config: ServerConfig) -> list[dict[str, float | None]]:
    layers = cell_layers.read(sums, LAYERS, config.read)
    rows = np.stack([layer[:, 0] for layer in layers.values()], axis=1).astype(np.float64).tolist()
    return [
        {name: None if math.isnan(value) else value for name, value in zip(layers, row, strict=True)} for row in rows
    ]


def _votes(sums: ev.Evidence, part: slice, centres: AnyArray) -> Votes:
    return Votes(tuple(np.asarray(centres).tolist()), *_metres(sums, part))


def _metres(sums: ev.Evidence, part: slice) -> tuple[tuple[float, ...], ...]:
    """Metres of votes, of each block's cell."""
    return tuple(map(tuple, (sums.counts[:, 0, part].astype(np.float64) / ev.WEIGHT_UNITS_PER_M).tolist()))
