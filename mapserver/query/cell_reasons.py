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
    pages = view.pages.get(block, NO_PAGES)
    first = valid_pages(view.pages, cell_m, config.change, view.ages).get(block)
    place = cell[1] % BLOCK_CELLS * BLOCK_CELLS + cell[0] % BLOCK_CELLS
    holds = _one(evidence([pages], None if first is None else [first]), place)
    everything = _one(evidence([pages]), place)
    before = dataclasses.replace(everything, counts=everything.counts - holds.counts)
    bits = int(holds.bitmaps[0, 0, ev.MACHINES])
    return CellReasons(
        store=view.version.store,
        merged=view.version.row,
        fact=view.version.fact,
        stamp_ns=view.stamp_ns,
        x_m=(cell[0] + 0.5) * cell_m,
        y_m=(cell[1] + 0.5) * cell_m,
        cell_m=cell_m,
        values=_values(holds, config),
        before=_values(before, config),
        metres=float(holds.weight[0, 0]) / ev.WEIGHT_UNITS_PER_M,
        newest_ns=int(holds.newest_ns[0, 0]),
        changed_ns=int(holds.changed_ns[0, 0]),
        resistance=_votes(holds, before, ev.RESISTANCE, ev.RESISTANCE_CENTRES),
        grade_east=_votes(holds, before, ev.GRADE_EAST, ev.GRADE_CENTRES),
        grade_north=_votes(holds, before, ev.GRADE_NORTH, ev.GRADE_CENTRES),
        sectors=_metres(holds, ev.HEADING),
        machines=tuple(sorted(name for name in names if bits >> machine_bit(name) & 1)),
    )


def machine_bit(name: str) -> int:
    """Bit of a machine in a cell."""
    return name_hash(name) >> MACHINE_SHIFT


def _one(sums: ev.Evidence, place: int) -> ev.Evidence:
    """One cell of one block, arrays (1, 1, ...)."""
    parts = {item.name: getattr(sums, item.name)[:, place : place + 1] for item in dataclasses.fields(sums)}
    return ev.Evidence(**parts)


def _values(sums: ev.Evidence, config: ServerConfig) -> dict[str, float | None]:
    layers = cell_layers.read(sums, LAYERS, config.read)
    values = {name: float(layer[0, 0]) for name, layer in layers.items()}
    return {name: None if math.isnan(value) else value for name, value in values.items()}


def _votes(holds: ev.Evidence, before: ev.Evidence, part: slice, centres: AnyArray) -> Votes:
    return Votes(tuple(np.asarray(centres).tolist()), _metres(holds, part), _metres(before, part))


def _metres(sums: ev.Evidence, part: slice) -> tuple[float, ...]:
    return tuple((sums.counts[0, 0, part].astype(np.float64) / ev.WEIGHT_UNITS_PER_M).tolist())
