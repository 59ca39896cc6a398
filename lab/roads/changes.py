"""Change detection as precision, recall, delay: of segments, and of cells without and with repairs of roads.

The map is read every STEP_S while samples arrive by stamp, so delays measure evidence, not links.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lab.calibration.drives import Scene
from lab.campaign.true_maps import window_of
from lab.ground.truth import true_ground
from lab.roads.drives import RoadDrive
from lab.roads.repairs import UNTOUCHED, SegmentRepairs, ages
from lab.roads.score import Recorded, TrueTrack
from mapserver.change.validity import Pages, valid_pages
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import VISIT_NS, FoldConfig, name_hash
from mapserver.evidence.grid import Grid
from mapserver.evidence.timeline import Ages
from mapserver.query.views import place, read_cells, view_of
from mapserver.roads.passes import MINUTE_NS
from mapserver.roads.repairs import Strips
from mapserver.roads.segments import SegmentTable
from protocol.arrays import Bools, Ints
from protocol.site.geometry import CellWindow
from sim.scenario.file import load_scenario
from sitegrid.proof.figures import Row
from sitegrid.proof.map_score import TRACK_STEP_M

SEGMENTS, CELLS, CELLS_REPAIRS = "segments", "cells", "cells, repairs"
STEP_S = 15.0  # between maps over time
PASSES = (1, 2, 3)  # least passes since a change
ALARM_CELLS = 6  # distance from changed ground within which a reported change is no false alarm
DAY_S = 86_400.0
CELL_M = 1.0


@dataclass(frozen=True)
class Changes:
    """True and reported changes of one recording. kind: of places.

    Lists cover changed places driven before and since. passes: since the change; needed: until shown; minutes: from the
    first, None: never. said: places finally reported; right: of them truly changed. km2_days: known area times
    duration.
    """

    kind: str
    passes: list[int]
    needed: list[int | None]
    minutes: list[float | None]
    said: int
    right: int
    false_alarms: int
    km2_days: float


def pooled(parts: Sequence[Changes]) -> Row:
    """Figures of one kind of place over several recordings."""
    each = [item for part in parts for item in zip(part.passes, part.needed, part.minutes, strict=True)]
    said, alarms = sum(part.said for part in parts), sum(part.false_alarms for part in parts)
    km2_days = sum(part.km2_days for part in parts)
    recalls = {}
    for least in PASSES:
        driven = [needed for passes, needed, _ in each if passes >= least]
        shown = [needed for needed in driven if needed is not None]
        recalls[f"recall_{least}_pct"] = _percent(len(shown), len(driven))
        recalls[f"by_{least}_pct"] = _percent(sum(needed <= least for needed in shown), len(driven))
    return {
        "kind": parts[0].kind,
        "changed": len(each),
        "said": said,
        "precision_pct": _percent(sum(part.right for part in parts), said),
        **recalls,
        "delay_passes": _median([needed for _, needed, _ in each if needed is not None]),
        "delay_min": _median([minutes for _, _, minutes in each if minutes is not None]),
        "false_alarms": alarms,
        "km2_days": km2_days,
        "false_per_km2_day": alarms / km2_days if km2_days else None,
    }


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _percent(part: int, whole: int) -> float | None:
    return 100.0 * part / whole if whole else None


# --- of one recording ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChangedGround:
    """A site's cells. changed (rows, columns): soil changed at half time."""

    window: CellWindow
    changed: Bools

    @classmethod
    def of_drive(cls, drive: RoadDrive, scene: Scene, cache: Path) -> ChangedGround:
        """From a recording."""
        ground = load_scenario(str(drive.folder(cache) / "scenario.toml")).ground
        before, after = true_ground(ground, drive.seed).truth.c_rr, scene.truth.c_rr
        return cls(window_of(scene.truth), np.maximum(before / after, after / before) > UNTOUCHED)


def changes(recorded: Recorded, whole: SegmentTable, seen: SegmentRepairs, ground: ChangedGround) -> list[Changes]:
    """Changes of segments, of cells alone, and of cells as the map reads them, with repairs."""
    half_ns, window = recorded.half_ns, ground.window
    shape = (window.rows, window.columns)
    far = cv2.dilate(ground.changed.astype(np.uint8), np.ones((2 * ALARM_CELLS + 1,) * 2, np.uint8)) == 0
    since_ns = {kind: np.zeros(shape, np.int64) for kind in (CELLS, CELLS_REPAIRS)}
    false: dict[str, Bools] = {kind: np.zeros(shape, np.bool_) for kind in since_ns}
    grid = Grid(CELL_M, FoldConfig())
    for now_ns, said in maps_of_changes(recorded, whole, seen, window, grid):
        for kind, here in said.items():
            since_ns[kind] = np.where(here, np.where(since_ns[kind] > 0, since_ns[kind], now_ns), 0)
            false[kind] |= here if now_ns < half_ns else here & far
    km2_days = _known_km2(grid, window) * (recorded.end_ns - recorded.start_ns) / 1e9 / DAY_S
    passes = CellPasses.of_tracks(recorded.tracks.values(), window)
    return [
        _of_segments(seen, km2_days),
        *(_of_cells(kind, since_ns[kind], false[kind], passes, ground, half_ns, km2_days) for kind in since_ns),
    ]


def maps_of_changes(
    recorded: Recorded, whole: SegmentTable, seen: SegmentRepairs, window: CellWindow, grid: Grid
) -> Iterator[tuple[int, dict[str, Bools]]]:
    """Fold a recording; every STEP_S yields a stamp and the cells (rows, columns) reported as changed."""
    config, strips = ServerConfig(), Strips(whole, CELL_M)
    rows = np.concatenate(list(recorded.rows.values()))
    hashes = np.array([name_hash(name) for name in recorded.rows], np.uint64)
    names = np.repeat(hashes, [len(table) for table in recorded.rows.values()])
    order = np.argsort(rows["stamp_ns"], kind="stable")
    rows, names, done = rows[order], names[order], 0
    step_ns = round(STEP_S * 1e9)
    for now_ns in range(recorded.start_ns + step_ns, recorded.end_ns + step_ns, step_ns):
        end = int(np.searchsorted(rows["stamp_ns"], now_ns, side="right"))
        grid.fold_all(rows[done:end], names[done:end])
        done = end
        pages = view_of(grid, window, config).pages
        known = {CELLS: {}, CELLS_REPAIRS: ages(strips, [one for one in seen.shown if one.seen_ns <= now_ns])}
        yield now_ns, {kind: _said(pages, window, since, config) for kind, since in known.items()}


def _known_km2(grid: Grid, window: CellWindow) -> float:
    config = ServerConfig()
    layers = read_cells(view_of(grid, window, config), window, ("resistance",), CELL_M, config)
    return int(np.isfinite(layers["resistance"]).sum()) * CELL_M**2 / 1e6


def _said(pages: Pages, window: CellWindow, known: Ages, config: ServerConfig) -> Bools:
    """Cells with a value of `changed_s`."""
    out = np.zeros((window.rows, window.columns), np.float32)
    for block, first in valid_pages(pages, CELL_M, config.change, known).items():
        place({"changed": out}, window, block, {"changed": first > 0})
    return out > 0


def _of_segments(seen: SegmentRepairs, km2_days: float) -> Changes:
    driven = [each for each in seen.true if len(each.passes_ns)]
    return Changes(
        kind=SEGMENTS,
        passes=[len(each.passes_ns) for each in driven],
        needed=[each.needed for each in driven],
        minutes=[
            None if each.shown_ns is None else (each.shown_ns - int(each.passes_ns[0])) / MINUTE_NS for each in driven
        ],
        said=len(seen.shown),
        right=len(seen.shown) - len(seen.false),
        false_alarms=len(seen.false),
        km2_days=km2_days,
    )


def _of_cells(
    kind: str, since_ns: Ints, false: Bools, passes: CellPasses, ground: ChangedGround, half_ns: int, km2_days: float
) -> Changes:
    """since_ns (rows, columns): start of the final report of change; 0: none."""
    since, later = since_ns.ravel(), passes.begin_ns >= half_ns
    driven = [np.bincount(passes.cell[some], minlength=len(since)) for some in (~later, later)]
    until = later & (passes.end_ns <= since[passes.cell])
    needed = np.maximum(np.bincount(passes.cell[until], minlength=len(since)), 1)  # a neighbour's evidence may lead
    first_ns = np.full(len(since), np.iinfo(np.int64).max)
    np.minimum.at(first_ns, passes.cell[later], passes.end_ns[later])
    cells = np.flatnonzero(ground.changed.ravel() & (driven[0] > 0) & (driven[1] > 0))
    shown = since[cells] >= half_ns
    minutes = np.maximum(since - first_ns, 0)[cells] / MINUTE_NS
    areas, _ = cv2.connectedComponents(false.astype(np.uint8), connectivity=8)
    return Changes(
        kind=kind,
        passes=driven[1][cells].tolist(),
        needed=[count if known else None for count, known in zip(needed[cells].tolist(), shown, strict=True)],
        minutes=[value if known else None for value, known in zip(minutes.tolist(), shown, strict=True)],
        said=int((since > 0).sum()),
        right=int((ground.changed.ravel() & (since >= half_ns)).sum()),
        false_alarms=areas - 1,
        km2_days=km2_days,
    )


@dataclass(frozen=True)
class CellPasses:
    """True passes (n,) over cells: cell number, row by row; arrival and departure of a load centre.

    A machine's drives on a cell within a minute are one pass, as in the map's visits.
    """

    cell: Ints
    begin_ns: Ints
    end_ns: Ints

    @classmethod
    def of_tracks(cls, tracks: Iterable[TrueTrack], window: CellWindow) -> CellPasses:
        """Passes of machines in a window."""
        parts = [_passes(track, window) for track in tracks]
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _passes(track: TrueTrack, window: CellWindow) -> tuple[Ints, Ints, Ints]:
    """One machine's passes: stays on cells, joined within a minute."""
    driven_m = np.cumsum(track.step_m)
    at_m = np.arange(0.0, driven_m[-1] + TRACK_STEP_M, TRACK_STEP_M)
    column, row = (
        np.floor(np.interp(at_m, driven_m, values) / CELL_M).astype(np.int64) - corner
        for values, corner in zip(track.place_m.T, (window.column, window.row), strict=True)
    )
    stamps = np.interp(at_m, driven_m, track.stamp_ns - track.stamp_ns[0]).astype(np.int64) + track.stamp_ns[0]
    inside = (row >= 0) & (row < window.rows) & (column >= 0) & (column < window.columns)
    cell = np.where(inside, row * window.columns + column, -1)
    begins = np.flatnonzero(np.diff(cell, prepend=-2))
    ends = np.append(begins[1:], len(cell)) - 1
    order = np.lexsort((begins, cell[begins]))
    begins, ends = begins[order], ends[order]
    again = np.diff(cell[begins], prepend=-2) == 0
    again[1:] &= stamps[begins[1:]] - stamps[ends[:-1]] <= VISIT_NS
    first = np.flatnonzero(~again)
    last = np.append(first[1:], len(begins)) - 1
    own = cell[begins[first]] >= 0
    return cell[begins[first]][own], stamps[begins[first]][own], stamps[ends[last]][own]
