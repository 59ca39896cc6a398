"""The log of ground changes: where, when, from what to what; it grows as machines pass.

Large changes appear piece by piece. A change next to another of about the same time extends it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from mapserver.change.detection import ChangeConfig, cuts
from mapserver.change.validity import image_of, valid_pages
from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.evidence.timeline import Block, TimedPages, evidence
from mapserver.layers import cell_layers
from protocol.arrays import Bools, Floats32, Ints
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.queries.answers import GroundChange
from protocol.site.geometry import BLOCK_CELLS
from protocol.units import HOUR_NS

KIND = "change"  # kind of the journal's events
SAME_NS = 6 * HOUR_NS  # span within which adjacent changes are one
# tolerance of a change's time, besides the length of its pages, which grows as they are summed
SETTLES_NS = 2 * HOUR_NS
NEAR_CELLS = 8.0
_BEFORE_AFTER = ("resistance", "grade")


class ChangeLog:
    """Changes of one site. kept: earlier ones as plain values, the newest of each number last."""

    def __init__(
        self, cell_m: float, change: ChangeConfig, read: cell_layers.ReadConfig, kept: Iterable[Mapping[str, Any]] = ()
    ) -> None:
        self._cell_m, self._config, self._read = cell_m, change, read
        self._changes = {change.id: change for change in map(change_of, kept)}
        self._logged: dict[Block, Ints] = {}  # changed_ns of cells already in a change
        self._members: dict[int, set[tuple[int, int]]] = {number: set() for number in self._changes}

    def changes(self, after: int = 0) -> list[GroundChange]:
        """Changes numbered above `after`."""
        return [change for number, change in sorted(self._changes.items()) if number > after]

    def look(self, blocks: Collection[Block], pages: Mapping[Block, TimedPages]) -> list[GroundChange]:
        """Examine blocks, given pages of them and their neighbours; returns new and extended changes."""
        blocks = [block for block in blocks if block in pages]
        first = valid_pages(pages, self._cell_m, self._config, only=blocks)
        changed = [block for block in blocks if first[block].any()]
        if not changed:
            return []
        now = evidence([pages[block] for block in changed], [first[block] for block in changed])
        fresh = {
            block: self._fresh(block, pages[block], first[block], now.changed_ns[i]) for i, block in enumerate(changed)
        }
        old_pages = [_older(pages[block], first[block]) for block in changed]
        old = evidence(old_pages, [cuts(older, self._config).first for older in old_pages])
        values = _before_and_after(old, now, self._read)
        image, (left, bottom) = image_of(fresh, False)
        count, areas = cv2.connectedComponents(image.astype(np.uint8), connectivity=8)
        images = {name: image_of(dict(zip(changed, part, strict=True)), np.nan)[0] for name, part in values.items()}
        stamps, _ = image_of({block: now.changed_ns[i] for i, block in enumerate(changed)}, 0)
        grown: dict[int, GroundChange] = {}
        for area in range(1, count):
            row, column = _of_one_time(areas == area, stamps)
            medians = {name: _median(part[row, column]) for name, part in images.items()}
            place = (row + bottom * BLOCK_CELLS, column + left * BLOCK_CELLS)
            if change := self._add(*place, stamps[row, column], medians):
                grown[change.id] = change
        return list(grown.values())

    def _fresh(self, block: Block, pages: TimedPages, first: Ints, changed_ns: Ints) -> Bools:
        """Changed cells (256,) not yet in a change."""
        logged = self._logged.setdefault(block, np.zeros(ev.CELLS, np.int64))
        spans_ns = np.array([timed.end_ns - timed.first_ns for timed in pages])
        settled_ns = logged + np.maximum(spans_ns[first], SETTLES_NS)
        fresh = (changed_ns > 0) & ((logged == 0) | (changed_ns > settled_ns))
        logged[fresh] = changed_ns[fresh]
        return np.asarray(fresh, np.bool_)

    def _add(
        self, row: Ints, column: Ints, changed_ns: Ints, medians: Mapping[str, float | None]
    ) -> GroundChange | None:
        """Extend a nearby change by an area, or add a new one; None if known."""
        cells = set(zip(row.tolist(), column.tolist(), strict=True))
        area = GroundChange(
            id=max(self._changes, default=0) + 1,
            first_ns=int(changed_ns.min()),
            last_ns=int(changed_ns.max()),
            bounds=tuple(  # type: ignore[arg-type]
                float(v) * self._cell_m for v in (column.min(), row.min(), column.max() + 1, row.max() + 1)
            ),
            cells=len(cells),
            **medians,
        )
        same = next((c for c in self._changes.values() if self._is_near(c, area)), None)
        if same is None:
            self._changes[area.id], self._members[area.id] = area, cells
            return area
        members = self._members[same.id]
        members |= cells
        if len(members) <= same.cells:  # known, after a restart
            return None
        boxes = zip(same.bounds, area.bounds, (min, min, max, max), strict=True)
        grown = replace(
            same,
            first_ns=min(same.first_ns, area.first_ns),
            last_ns=max(same.last_ns, area.last_ns),
            bounds=tuple(choose(one, other) for one, other, choose in boxes),  # type: ignore[arg-type]
            cells=len(members),
        )
        self._changes[same.id] = grown
        return grown

    def _is_near(self, one: GroundChange, other: GroundChange) -> bool:
        reach_m = NEAR_CELLS * self._cell_m
        (west, south, east, north), (w, s, e, n) = one.bounds, other.bounds
        apart = w > east + reach_m or e < west - reach_m or s > north + reach_m or n < south - reach_m
        return not apart and other.first_ns <= one.last_ns + SAME_NS and other.last_ns >= one.first_ns - SAME_NS


def change_of(values: Mapping[str, Any]) -> GroundChange:
    """Inverse of an event's plain values."""
    return GroundChange(**{**values, "bounds": tuple(values["bounds"])})


def _of_one_time(area: Bools, changed_ns: Ints) -> tuple[Ints, Ints]:
    """Rows and columns of an area, without the few cells that changed long ago and are seen only now."""
    typical_ns = np.median(changed_ns[area])
    row, column = np.nonzero(area & (np.abs(changed_ns - typical_ns) <= SAME_NS))
    return row, column


def _older(pages: TimedPages, first: Ints) -> TimedPages:
    """Pages before a block's change, or most of its changes."""
    return pages.older(int(np.median(first[first > 0])))


def _before_and_after(old: ev.Evidence, now: ev.Evidence, config: cell_layers.ReadConfig) -> dict[str, Floats32]:
    """Layers (blocks, 256) before a change and now."""
    layers = {}
    for when, part in (("before", old), ("after", now)):
        for name, values in cell_layers.read(part, _BEFORE_AFTER, config).items():
            layers[f"{name}_{when}"] = values
    return layers


def _median(values: Floats32) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def warm_up(config: FoldConfig) -> None:
    """Compile the kernels of changes, or load them, with a change of ground."""
    log, grid, n = ChangeLog(1.0, ChangeConfig(), cell_layers.ReadConfig()), Grid(1.0, config), BLOCK_CELLS
    rows = np.zeros(n * n, SAMPLE_DTYPE)
    rows["x_m"], rows["y_m"] = np.arange(n * n) % n + 0.5, np.arange(n * n) // n + 0.5
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.04
    rows["distance_m"], rows["c_rr_var"] = 1.0, 1e-6
    for hour, c_rr in enumerate((0.02, 0.02, 0.2)):
        rows["stamp_ns"], rows["c_rr"] = (hour + 1) * HOUR_NS, c_rr
        grid.fold(rows, "")
    log.look([(0, 0)], {(0, 0): grid.pages([(0, 0)])[0]})
