"""Repaved ground with known answers: passes, driven share, detection."""

from dataclasses import replace

import numpy as np
import pytest

from lab.calibration.drives import Scene
from lab.cooperation.drives import FOUR, REPAVED, lines, planned
from lab.cooperation.maps import Timeline
from lab.cooperation.repaved import driven_pct, inside, passes, repaved_rows
from lab.ground.truth import true_ground
from lab.tests.cooperation.samples import driving, track
from mapserver.journal.facts import NO_FACTS
from sim.scenario.ground import with_zone
from sim.simulator import START_NS
from sim.truth import truth_map

DRIVE = planned(3, 400.0, FOUR, "fast", repaves=True)


def test_a_pass_counts_that_began_after_the_change_and_is_over():
    there = np.array([1, 1, 0, 0, 1, 1, 0, 1, 1], bool)
    own = track(np.zeros((9, 2)), step_s=1.0)
    assert ((passes(own, there, START_NS - 1) - START_NS) / 1e9).tolist() == [1.0, 5.0]
    assert ((passes(own, there, START_NS) - START_NS) / 1e9).tolist() == [5.0]
    assert len(passes(own, there, START_NS + 4 * 10**9)) == 0


def test_repaved_ground_is_shown_once_enough_of_its_cells_have_the_new_class():
    """A machine crosses the west's ground every 100 s and measures the change, at 200 s, in its second pass."""
    line_m = np.roll(lines()["west"].points, 100, axis=0)  # starts on this ground
    there_m = line_m[inside(REPAVED["west"], line_m, 1.0)]
    n = len(there_m)
    lap_m = np.concatenate([there_m, np.full((200 - n, 2), 5.0)])  # half a second between points
    own = track(np.concatenate([lap_m] * 5))
    terrain = true_ground(DRIVE.ground, 3).terrain
    for change in DRIVE.changes.values():
        terrain = with_zone(terrain, change.zone)
    true = Scene(truth_map(terrain, 200.0, 150.0), {"loader-1": own})
    parts = []
    for number, c_rr in enumerate((0.008, 0.008, 0.008, 0.02, 0.02)):
        rows = driving(0, n, c_rr=c_rr)
        rows["stamp_ns"] = own.stamp_ns[200 * number : 200 * number + n]
        rows["x_m"], rows["y_m"] = there_m.T
        parts.append(np.repeat(rows, 1 if c_rr == 0.008 else 8))  # newer ones dominate
    samples = np.concatenate(parts)
    known = Timeline(samples, np.zeros(len(samples), int), ("loader-1",), samples["stamp_ns"], ((0, NO_FACTS),))
    late = replace(known, time_ns=known.time_ns + 60 * 10**9)
    shared, west = repaved_rows(DRIVE, known, late, true, ["loader-1"])
    assert (west["ground"], west["passes"]) == ("west", 2)
    assert west["by_pass_pct"][0] == 0.0
    assert west["by_pass_pct"][1] > 95.0
    assert west["least_passes"] == 1  # its line covers these cells
    assert west["driven_by_pass_pct"][0] > 95.0
    left_s = (inside(REPAVED["west"], there_m).sum() - 1) / 2  # of its line
    assert west["minutes"] * 60 == pytest.approx(100.0 + left_s, abs=1.0)
    assert west["arrived_min"] == pytest.approx(west["minutes"] + 1.0, abs=0.05)
    assert (shared["ground"], shared["passes"], shared["by_pass_pct"]) == ("shared", None, [])


def test_a_place_is_driven_once_a_load_centre_was_near_it_after_the_change():
    along = track(np.stack([np.arange(10.0), np.zeros(10)], axis=1), step_s=1.0)
    beside = track(np.stack([np.arange(10.0), np.full(10, 3.0)], axis=1), step_s=1.0)
    places = np.array([[2.0, 0.9], [6.0, 0.9], [6.0, 3.0], [6.0, 1.5]])
    changed_ns, end_ns = START_NS + 3 * 10**9, START_NS + 8 * 10**9
    assert driven_pct([along], places, changed_ns, end_ns) == 25.0
    assert driven_pct([along, beside], places, changed_ns, end_ns) == 50.0
    assert driven_pct([along, beside], places, changed_ns, changed_ns + 10**9) == 0.0
