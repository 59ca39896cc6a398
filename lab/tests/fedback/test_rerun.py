"""A rerun without lanes reproduces the filter; another day's map helps."""

import numpy as np
import pytest

from lab.campaign.recordings import make
from lab.fedback import maps
from lab.fedback.days import day
from lab.fedback.experiment import FedbackCase, figures_of_day
from lab.fedback.maps import MAPS, Scene, days_ago, free, lane_map, moved, reshaped
from lab.fedback.nodes import Machine, watch
from lab.fedback.rerun import placed_again, rerun

SECONDS = 130.0


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    drive = day("driven", 3, SECONDS)
    return watch(make(drive, tmp_path_factory.mktemp("fedback")), Machine(drive.names[0]))


@pytest.mark.slow
def test_a_drive_filtered_again_is_the_same(nodes):
    again = rerun(nodes, lambda _: None, aids=False)
    assert np.abs(again.live_m + nodes.true_m - nodes.x[:, :2]).max() < 1e-6
    assert np.abs(again.live_m2 - nodes.P[:, :2, :2]).max() < 1e-6
    known_ns = nodes.stamp_ns[:-91]  # for later nodes the smoother already knows the end of the drive
    _, at, of_rows = np.intersect1d(known_ns, nodes.rows["stamp_ns"], return_indices=True)
    rows, heading = nodes.rows[of_rows], nodes.rows["heading_rad"][of_rows].astype(float)
    places = again.smoothed_m[at] + nodes.true_m[at] + nodes.ahead_m * np.stack([np.cos(heading), np.sin(heading)], 1)
    assert len(at) > 3
    assert np.abs(places - np.stack([rows["x_m"], rows["y_m"]], 1)).max() < 1e-4


@pytest.mark.slow
def test_guards_without_lanes_change_nothing(nodes):
    again, guarded = rerun(nodes, lambda _: None, aids=False), rerun(nodes, lambda _: None)
    assert np.allclose(again.live_m, guarded.live_m, atol=1e-9)
    assert np.allclose(again.smoothed_m2, guarded.smoothed_m2, atol=1e-9)
    assert not guarded.counts


@pytest.mark.slow
def test_maps_are_what_their_names_say(nodes):
    rows = [("machine-1", nodes.rows)]
    scene = Scene([*rows, ("machine-2", nodes.rows)], rows, int(nodes.stamp_ns[0]), SECONDS)
    assert {tile.machines for tile in MAPS["others"](scene)("machine-1")(0).tiles.values()} == {1}
    assert np.allclose(np.hypot(*(moved(rows, 3.0)[0][1][n] - nodes.rows[n] for n in ("x_m", "y_m"))), 3.0)
    (_, other), (_, bare) = (reshaped(rows, by_m)[0] for by_m in (100.0, np.nan))
    np.testing.assert_array_equal(other["grade_e"][200:], nodes.rows["grade_e"][:-200])
    assert np.isnan(bare["grade_n"]).all()
    first, last = nodes.stamp_ns[0], nodes.stamp_ns[-1]
    for name, make_maps in MAPS.items():
        maps_of = make_maps(scene)("machine-1")
        if name in maps.GROWING:
            assert maps_of(first) is None
        else:
            assert maps_of(last).tiles
    assert len(free(5)) == 4


@pytest.mark.slow
def test_places_that_lanes_moved_say_so(nodes):
    lanes = lane_map(days_ago([("machine-1", nodes.rows)], 1))
    without, aided = rerun(nodes, lambda _: None, aids=False), rerun(nodes, lambda _: lanes)
    again = placed_again(nodes, without, aided)
    went_m = np.hypot(*(again[name] - nodes.rows[name] for name in ("x_m", "y_m")))
    assert aided.counts["lanes_used"] > 3
    assert 0.1 < again["aid_share"].max() < 1.0
    assert not again["aid_share"].min() < 0
    assert went_m.max() < 2.0
    assert not placed_again(nodes, without, without)["aid_share"].any()


@pytest.mark.slow
def test_one_machine_from_an_empty_map_is_neither_helped_nor_harmed(nodes):
    one = {"machine-1": nodes}
    figures, windows = figures_of_day(FedbackCase("driven", "alone"), one, one, SECONDS)
    assert figures["smoothed_m2"] == pytest.approx(figures["without_smoothed_m2"], rel=1e-9)
    assert not windows["lanes_used"]
