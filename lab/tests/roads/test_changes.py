"""Change detection on tracks and roads with known results."""

import numpy as np
import pytest

from lab.roads.changes import CELLS, CELLS_REPAIRS, SEGMENTS, CellPasses, ChangedGround, Changes, changes, pooled
from lab.roads.repairs import SegmentRepairs, TrueRepair, shown_at
from lab.roads.score import Recorded, TrueTrack, roads
from mapserver.roads.passes import MINUTE_NS
from protocol.site.geometry import CellWindow
from sitegrid.proof.figures import rounded
from tests.unit.mapserver.roads.drives import START_NS, along, passes

LINE = along([(10, 20), (250, 20)])
WINDOW = CellWindow(0, 0, 260, 40)
OLD, NEW = 0.06, 0.02
REPAIRED_M = 100.0, 160.0  # along x
HALF_S = 600.0  # a pass takes 48 s, the next starts 20 s later


def changed_ground() -> ChangedGround:
    changed = np.zeros((WINDOW.rows, WINDOW.columns), np.bool_)
    changed[:, round(REPAIRED_M[0]) : round(REPAIRED_M[1])] = True
    return ChangedGround(WINDOW, changed)


def drive(later: int, *, repaired: bool = True) -> Recorded:
    """Two machines with eight passes before half time, `later` after."""
    rows, tracks = {}, {}
    for i, name in enumerate("ab"):
        halves = ((8, 0.0), (later, HALF_S))
        table = np.concatenate([passes(LINE, count, OLD, i, from_s + 30.0 * i) for count, from_s in halves])
        after = table["stamp_ns"] >= START_NS + HALF_S * 1e9
        inside = (table["x_m"] >= REPAIRED_M[0]) & (table["x_m"] < REPAIRED_M[1])
        table["c_rr"][after & inside & repaired] = NEW
        rows[name] = table
        n = len(table)
        place = np.stack([table["x_m"], table["y_m"]], axis=1)
        true = (table["heading_rad"], np.full(n, 0.5), table["c_rr"], np.zeros(n), np.full(n, 4e4), table["c_rr"])
        tracks[name] = TrueTrack(table["stamp_ns"], place, *(np.asarray(each, np.float64) for each in true))
    return Recorded(rows, tracks, START_NS, START_NS + round(2 * HALF_S * 1e9))


def judged(recorded: Recorded) -> tuple[SegmentRepairs, dict[str, Changes]]:
    whole = roads(recorded.rows)
    seen = SegmentRepairs.of_recording(recorded, whole)
    return seen, {each.kind: each for each in changes(recorded, whole, seen, changed_ground())}


@pytest.mark.slow
def test_a_repaired_stretch_has_the_figures_that_are_stored():
    """A segment's cells include those beyond the repaired stretch, hence the figures of `cells, repairs`."""
    _, each = judged(drive(7))
    rows = {kind: rounded(pooled([part]), 1) for kind, part in each.items()}
    kept = ("changed", "said", "precision_pct", "recall_1_pct", "by_2_pct", "delay_passes", "false_alarms")
    assert {kind: [row[name] for name in kept] for kind, row in rows.items()} == {
        SEGMENTS: [2, 3, 100.0, 100.0, 100.0, 2.0, 0],
        CELLS: [120, 236, 100.0, 98.3, 1.7, 3.0, 0],
        CELLS_REPAIRS: [120, 374, 79.9, 100.0, 98.3, 1.0, 1],
    }


@pytest.mark.slow
def test_a_change_that_nothing_shows_is_found_nowhere():
    _, each = judged(drive(3, repaired=False))
    for part in each.values():
        assert (part.said, part.right, part.false_alarms) == (0, 0, 0)
    assert set(each[CELLS].needed) == {None}
    assert each[SEGMENTS].passes == []
    assert pooled([each[CELLS]])["recall_1_pct"] == 0.0
    assert pooled([each[SEGMENTS]])["recall_1_pct"] is None


def track(*points: tuple[float, float, float]) -> TrueTrack:
    """A machine at x, y after seconds, straight in between."""
    second, x, y = np.array(points).T
    step = np.hypot(np.diff(x, prepend=x[0]), np.diff(y, prepend=y[0]))
    none = np.zeros(len(x))
    return TrueTrack((second * 1e9).astype(np.int64), np.stack([x, y], axis=1), none, step, none, none, none, none)


def test_what_a_machine_drives_on_a_cell_within_a_minute_is_one_pass():
    line = track((0, 0.5, 0.5), (10, 4.5, 0.5), (20, 0.5, 0.5), (30, 4.5, 0.5), (200, 4.5, 0.5), (240, 0.5, 0.5))
    over = CellPasses.of_tracks([line], CellWindow(0, 0, 4, 1))
    assert over.cell.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert over.begin_ns[over.cell == 0] / 1e9 == pytest.approx([0, 235], abs=1)
    assert over.end_ns[over.cell == 0] / 1e9 == pytest.approx([21.25, 240], abs=1)


def test_figures_are_of_all_places_of_all_recordings():
    one = Changes("cells", [1, 2, 3, 5], [1, None, 3, 2], [0.0, None, 4.0, 2.0], 10, 8, 1, 0.25)
    other = Changes("cells", [3], [None], [None], 0, 0, 0, 0.25)
    assert pooled([one, other]) == {
        "kind": "cells",
        "changed": 5,
        "said": 10,
        "precision_pct": 80.0,
        "recall_1_pct": 60.0,
        "by_1_pct": 20.0,
        "recall_2_pct": 50.0,
        "by_2_pct": 25.0,
        "recall_3_pct": 100.0 * 2 / 3,
        "by_3_pct": 100.0 * 2 / 3,
        "delay_passes": 2.0,
        "delay_min": 2.0,
        "false_alarms": 1,
        "km2_days": 0.5,
        "false_per_km2_day": 2.0,
    }
    nothing = pooled([other])
    assert (nothing["precision_pct"], nothing["delay_passes"], nothing["recall_3_pct"]) == (None, None, 0.0)


def test_a_change_needs_the_passes_until_the_one_that_showed_it():
    later = {"a": np.array([10, 40]) * MINUTE_NS, "b": np.array([11, 20]) * MINUTE_NS + 7, "c": np.array([], np.int64)}
    stamps = np.sort(np.concatenate(list(later.values())))

    def needed(machines, seen):
        return TrueRepair(0, stamps, shown_at(later, machines, seen and (seen + 1) * MINUTE_NS)).needed

    assert needed(["b"], 11) == 2  # without later drives in that minute
    assert needed(["b"], 19) == 3  # started in that minute, ended later
    assert needed(["a"], 40) == 4
    assert needed(["c"], 11) == 2  # never over half of the segment
    assert needed([], None) is None
