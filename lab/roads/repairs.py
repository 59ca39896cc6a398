"""Repairs of segments: detected ones, true passes needed, work saved, cells."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lab.roads.score import TARGET, Recorded, TrueTraffic, grid_of, tally_of, true_passes, true_traffic
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import name_hash
from mapserver.evidence.timeline import Ages
from mapserver.query.views import read_cells, view_of
from mapserver.roads.ledger import Ledgers
from mapserver.roads.loss import losses
from mapserver.roads.passes import MINUTE_NS, PassTally
from mapserver.roads.repair_facts import NO_REPAIRS
from mapserver.roads.repairs import Repair, Strips, repairs
from mapserver.roads.segments import SegmentTable
from mapserver.roads.tally import Tally
from protocol.arrays import Floats, Ints
from protocol.machine.readings import MAX_STAMP_NS
from protocol.site.geometry import BLOCK_CELLS, CellWindow

CHANGED = (1.5, 4.0)  # judged factors of c_rr
UNTOUCHED = 1.1  # smaller factors are no change: border effects
SEEN = (2, 3)  # passes after which a repair should be detected


@dataclass(frozen=True)
class TrueRepair:
    """A segment repaired at half time.

    passes_ns: machines' passes since, sorted. shown_ns: end of the revealing pass, None: never.
    """

    segment: int
    passes_ns: Ints
    shown_ns: int | None

    @property
    def needed(self) -> int | None:
        """True passes up to the revealing one."""
        return None if self.shown_ns is None else int((self.passes_ns <= self.shown_ns).sum())


@dataclass(frozen=True)
class SegmentRepairs:
    """True and reported changes of segments at half time.

    shown: changes by segment; false: untrue ones; looks: checked passes. halves: truth of both halves.
    """

    shown: list[Repair]
    false: list[Repair]
    looks: int
    true: list[TrueRepair]
    halves: tuple[TrueTraffic, TrueTraffic]

    @classmethod
    def of_recording(cls, recorded: Recorded, whole: SegmentTable) -> SegmentRepairs:
        """From a recording, on its final roads."""
        ledgers, kept = Ledgers(whole), PassTally()
        for name, table in recorded.rows.items():
            kept.add(table, np.full(len(table), name_hash(name), np.uint64))
        passes = kept.passes(ledgers)
        shown, looks = repairs(passes)
        half_ns, tracks = recorded.half_ns, tuple(recorded.tracks.values())
        before, after = (true_traffic(tracks, ledgers, TARGET, *half) for half in ((0, half_ns), (half_ns, 2**62)))
        factor = np.maximum(before.c_rr / after.c_rr, after.c_rr / before.c_rr)
        first_ns = (half_ns // MINUTE_NS - 1) * MINUTE_NS
        seen_by = {each.segment: each.seen_ns for each in reversed(shown) if each.first_ns >= first_ns}
        names = sorted(recorded.rows, key=name_hash)  # in the order of their numbers
        true = []
        for segment in np.flatnonzero((factor >= CHANGED[0]) & (factor <= CHANGED[1])).tolist():
            later = {name: true_passes(track, ledgers, segment, half_ns) for name, track in recorded.tracks.items()}
            seen = seen_by.get(segment)
            last = (passes.segment == segment) & ((passes.minute + 1) * MINUTE_NS == (-1 if seen is None else seen))
            stamps = np.sort(np.concatenate(list(later.values())))
            true.append(TrueRepair(segment, stamps, shown_at(later, [names[i] for i in passes.machine[last]], seen)))
        false = [each for each in shown if factor[each.segment] < UNTOUCHED or each.first_ns < first_ns]
        return cls(shown, false, looks, true, (before, after))


def shown_at(later: Mapping[str, Ints], machines: Collection[str], seen_ns: int | None) -> int | None:
    """End of the true pass by one of these machines that proved a change in the minute before seen_ns, or that.

    later: each machine's pass stamps after the change.
    """
    if seen_ns is None:
        return None
    ends_ns = [stamp for name in machines for stamp in later[name].tolist() if stamp >= seen_ns - MINUTE_NS]
    return min(ends_ns, default=seen_ns)


def repair_figures(recorded: Recorded, whole: SegmentTable, seen: SegmentRepairs) -> dict[str, float]:
    """Counts of repairs and false alarms; hourly work saved [J], known and true."""
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
    """Cells of judged segments, and those closer to the repaired than to the former truth.

    changed: read by changes of cells only; since: also by those of segments.
    """
    grid, config = grid_of(recorded.rows), ServerConfig()
    strips = Strips(whole, 1.0)
    blocks = ages(strips, [Repair(segment, 1, 1, 1, 0.0, 0.0) for segment in judged])
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
    for name, known in (("cells_changed", {}), ("cells_since", ages(strips, shown))):
        view = replace(view_of(grid, window, config), ages=known)
        c_rr = read_cells(view, window, ("resistance",), 1.0, config)["resistance"]
        values = c_rr[places[:, 1] - bottom, places[:, 0] - left].astype(np.float64)
        before, after = (values_of[own] for values_of in true)
        out[name] = float((np.abs(values - after) < np.abs(values - before)).sum())
        out["cells"] = float(np.isfinite(values).sum())
    return out


def ages(strips: Strips, changes: Iterable[Repair]) -> Ages:
    """Ages of cells once these changes are journalled."""
    return NO_REPAIRS.after(strips.located(changes, MAX_STAMP_NS)).ages
