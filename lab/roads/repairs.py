"""Repairs of segments: which were seen, after how many true passes, the work that they save, and their cells."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lab.roads.score import TARGET, Recorded, TrueTraffic, grid_of, tally_of, true_passes, true_traffic
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import name_hash
from mapserver.query.views import read_cells, view_of
from mapserver.roads.ledger import Ledgers
from mapserver.roads.loss import losses
from mapserver.roads.passes import MINUTE_NS, PassTally
from mapserver.roads.repairs import Repair, ages, repairs
from mapserver.roads.segments import SegmentTable
from mapserver.roads.tally import Tally
from protocol.arrays import Floats, Ints
from protocol.site.geometry import BLOCK_CELLS, CellWindow

CHANGED = (1.5, 4.0)  # factors of c_rr that a repair is judged by
UNTOUCHED = 1.1  # less is no change: its share of a segment lies at a border
SEEN = (2, 3)  # passes after which a repair should be seen


@dataclass(frozen=True)
class TrueRepair:
    """A segment whose ground was repaired at half time.

    passes_ns: when machines had passed since, in order; shown_ns: when the pass ended that showed it, None for never.
    """

    segment: int
    passes_ns: Ints
    shown_ns: int | None

    @property
    def needed(self) -> int | None:
        """How many true passes there were until, and with, the one that showed it."""
        return None if self.shown_ns is None else int((self.passes_ns <= self.shown_ns).sum())


@dataclass(frozen=True)
class SegmentRepairs:
    """What happened to the ground of segments at half time, and what was shown.

    shown: changes, by segment; false: those where there was none; looks: at passes. halves: what is true of both.
    """

    shown: list[Repair]
    false: list[Repair]
    looks: int
    true: list[TrueRepair]
    halves: tuple[TrueTraffic, TrueTraffic]

    @classmethod
    def of_recording(cls, recorded: Recorded, whole: SegmentTable) -> SegmentRepairs:
        """Those of a recording, on the roads of all of it."""
        ledgers, kept = Ledgers(whole), PassTally()
        for name, table in recorded.rows.items():
            kept.add(table, np.full(len(table), name_hash(name), np.uint64))
        passes = kept.passes(ledgers)
        shown, looks = repairs(passes)
        half_ns, tracks = recorded.half_ns, tuple(recorded.tracks.values())
        before, after = (true_traffic(tracks, ledgers, TARGET, *half) for half in ((0, half_ns), (half_ns, 2**62)))
        factor = np.maximum(before.c_rr / after.c_rr, after.c_rr / before.c_rr)
        first_minute = half_ns // MINUTE_NS - 1
        seen_by = {each.segment: each.seen for each in reversed(shown) if each.minute >= first_minute}
        names = sorted(recorded.rows, key=name_hash)  # in the order of their numbers
        true = []
        for segment in np.flatnonzero((factor >= CHANGED[0]) & (factor <= CHANGED[1])).tolist():
            later = {name: true_passes(track, ledgers, segment, half_ns) for name, track in recorded.tracks.items()}
            seen = seen_by.get(segment)
            last = (passes.segment == segment) & (passes.minute == (-1 if seen is None else seen))
            stamps = np.sort(np.concatenate(list(later.values())))
            true.append(TrueRepair(segment, stamps, shown_at(later, [names[i] for i in passes.machine[last]], seen)))
        false = [each for each in shown if factor[each.segment] < UNTOUCHED or each.minute < first_minute]
        return cls(shown, false, looks, true, (before, after))


def shown_at(later: Mapping[str, Ints], machines: Collection[str], seen: int | None) -> int | None:
    """When the true pass ended that showed a change: in this minute, by one of these; the minute's end where none did.

    later: stamps at which each machine had passed, after the change.
    """
    if seen is None:
        return None
    ends_ns = [stamp for name in machines for stamp in later[name].tolist() if stamp >= seen * MINUTE_NS]
    return min(ends_ns, default=(seen + 1) * MINUTE_NS)


def repair_figures(recorded: Recorded, whole: SegmentTable, seen: SegmentRepairs) -> dict[str, float]:
    """Counts of repairs and of false alarms, and the work that they save an hour [J], known and true."""
    before, after = seen.halves
    judged = [each for each in seen.true if len(each.passes_ns) > SEEN[-1]]
    repaired = [each.segment for each in seen.true]
    halves = recorded.part(0, recorded.half_ns), recorded.part(recorded.half_ns)
    saved = [
        losses(Ledgers(whole).ledger(tally_of(part).table(), Tally().slot_ns), whole, TARGET).work_j for part in halves
    ]
    return {
        "repairs": len(judged),
        **{f"seen_{most}": sum(each.needed is not None and each.needed <= most for each in judged) for most in SEEN},
        "looks": seen.looks,
        "false_alarms": len(seen.false),
        **_cells_shown(recorded, whole, seen.shown, (before.c_rr, after.c_rr), [each.segment for each in judged]),
        "saved_j": float((saved[0] - saved[1])[repaired].sum()),
        "true_saved_j": float((before.work_j - after.work_j)[repaired].sum()),
    }


def _cells_shown(
    recorded: Recorded, whole: SegmentTable, shown: Sequence[Repair], true: tuple[Floats, Floats], judged: Sequence[int]
) -> dict[str, float]:
    """How many cells judged segments have, and how many are nearer to what is true after the repair than to before.

    changed: read by changes of cells alone; since: as well as by those of segments.
    """
    grid, config = grid_of(recorded.rows), ServerConfig()
    everything = [Repair(segment, 1, 1, 0.0, 0.0) for segment in judged]
    blocks = ages(whole, everything, 1.0)
    out = {"cells": 0.0, "cells_changed": 0.0, "cells_since": 0.0}
    if not blocks:
        return out
    n = BLOCK_CELLS
    places = np.concatenate([np.argwhere(own.reshape(n, n))[:, ::-1] + n * np.array(at) for at, own in blocks.items()])
    left, bottom = places.min(axis=0).tolist()
    columns, rows = (places.max(axis=0) + 1 - places.min(axis=0)).tolist()
    window = CellWindow(left, bottom, columns, rows)
    middles = np.concatenate([whole.line(i) for i in judged])
    owner = np.repeat(judged, [len(whole.line(i)) for i in judged])
    own = owner[cKDTree(middles).query(places + 0.5)[1]]
    for name, known in (("cells_changed", {}), ("cells_since", ages(whole, shown, 1.0))):
        view = replace(view_of(grid, window, config), ages=known)
        c_rr = read_cells(view, window, ("resistance",), 1.0, config)["resistance"]
        values = c_rr[places[:, 1] - bottom, places[:, 0] - left].astype(np.float64)
        before, after = (values_of[own] for values_of in true)
        out[name] = float((np.abs(values - after) < np.abs(values - before)).sum())
        out["cells"] = float(np.isfinite(values).sum())
    return out
