"""Driven and known ground of a window, by age and machine."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mapserver.change.validity import valid_pages
from mapserver.config import ServerConfig
from mapserver.evidence import cells as ev
from mapserver.evidence.grid import chunks
from mapserver.evidence.timeline import Block, evidence
from mapserver.layers import cell_layers
from mapserver.query.cell_reasons import machine_bits
from mapserver.query.views import View
from protocol.arrays import Bools
from protocol.queries.answers import MapVersion
from protocol.queries.coverage import Coverage
from protocol.site.geometry import BLOCK_CELLS, CellWindow

SINCE_S = {"hour": 3600, "day": 86_400, "week": 604_800}
LAYERS = ("visits", "resistance")


def coverage(
    parts: Iterable[tuple[CellWindow | None, View]],
    version: MapVersion,
    stamp_ns: int,
    names: Iterable[str],
    cell_m: float,
    config: ServerConfig,
) -> Coverage:
    """Count cells of windows, each in its view; None: all of it. names: of machines in the map."""
    bits = machine_bits(names)
    since_ns = {name: stamp_ns - seconds * 10**9 for name, seconds in SINCE_S.items()}
    counts = dict.fromkeys(("driven", "known", *since_ns, *(f"by {name}" for name in bits)), 0)
    for window, view in parts:
        first = valid_pages(view.pages, cell_m, config.change, view.ages)
        for some in chunks([block for block in view.pages if window is None or _within(block, window).any()]):
            sums = evidence([view.pages[block] for block in some], [first[block] for block in some])
            layers = cell_layers.read(sums, LAYERS, config.read)
            inside = np.stack([_within(block, window) for block in some])
            driven = (layers["visits"] > 0) & inside
            cells = {"driven": driven, "known": np.isfinite(layers["resistance"]) & inside}
            cells |= {name: driven & (sums.newest_ns >= begin_ns) for name, begin_ns in since_ns.items()}
            machines = sums.bitmaps[..., ev.MACHINES]
            cells |= {f"by {name}": driven & ((machines & bit) > 0) for name, bit in bits.items()}
            counts = {name: counts[name] + int(chosen.sum()) for name, chosen in cells.items()}
    area = {name: count * cell_m**2 for name, count in counts.items()}
    return Coverage(
        store=version.store,
        merged=version.row,
        fact=version.fact,
        stamp_ns=stamp_ns,
        driven_m2=area["driven"],
        known_m2=area["known"],
        driven_since_m2={name: area[name] for name in since_ns},
        machines_m2={name: area[f"by {name}"] for name in bits},
    )


def _within(block: Block, window: CellWindow | None) -> Bools:
    """Cells (256,) of a block in a window, by rows."""
    if window is None:
        return np.ones(BLOCK_CELLS * BLOCK_CELLS, bool)
    column, row = (BLOCK_CELLS * place + np.arange(BLOCK_CELLS) for place in block)
    is_column = (column >= window.column) & (column < window.column + window.columns)
    is_row = (row >= window.row) & (row < window.row + window.rows)
    return np.asarray((is_row[:, None] & is_column).ravel())
