"""Cells of the road network, and figures of known maps."""

import numpy as np
import pytest

from lab.cooperation.drives import SITE, TOURS, lines
from lab.cooperation.network import FIGURES, Network, break_distance, figures, network
from lab.ground.truth import true_ground
from sim.scenario.file import load_scenario
from sitegrid.proof.tracks import LoadTrack


@pytest.fixture(scope="module")
def cells() -> Network:
    ground = true_ground(load_scenario(SITE).ground, 3)
    tracks = []
    for leg in lines().values():
        points = np.vstack([leg.points, leg.points[:1]])
        dense = np.stack(
            [np.interp(np.arange(0, len(points) - 1, 0.2), np.arange(len(points)), c) for c in points.T], 1
        )
        driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(dense, axis=0).T))])
        stamps = np.arange(len(dense), dtype=np.int64)
        tracks.append(LoadTrack(stamps, dense, np.zeros(len(dense)), np.full((len(dense), 2), 0.01), driven))
    return network(ground, tracks)


def perfect(cells: Network) -> dict:
    layers = {name: np.full((150, 200), np.nan) for name in ("resistance", "grade_east", "grade_north")}
    at = cells.row, cells.column
    layers["resistance"][at], layers["grade_east"][at], layers["grade_north"][at] = cells.c_rr, *cells.plane.T
    return {**layers, "confidence": np.ones((150, 200)), "resistance_class": np.zeros((150, 200))}


def test_the_network_is_the_cells_of_all_tours_each_once(cells: Network):
    assert len(set(zip(cells.row.tolist(), cells.column.tolist(), strict=True))) == len(cells.row)
    assert set(cells.tour) == set(range(len(TOURS)))
    assert 1000 < len(cells.row) < 1400  # 1060 m of tours
    assert np.hypot(*cells.direction.T) == pytest.approx(1.0)
    assert np.isfinite(cells.plane).mean() > 0.98
    assert cells.plane[np.isfinite(cells.plane)] == pytest.approx(0.01)
    assert {round(float(value), 3) for value in cells.c_rr} == {0.008, 0.02, 0.04, 0.06, 0.25}


def test_a_map_that_is_right_has_no_errors(cells: Network):
    got = figures(perfect(cells), cells)
    assert list(got) == list(FIGURES)
    assert got["covered_pct"] == got["known_pct"] == 100.0
    assert (got["wrong_pct"], got["c_rr_pct"], got["c_rr_all_pct"], got["grade_all_pct"]) == (0.0, 0.0, 0.0, 0.0)


def test_errors_are_what_they_were_made(cells: Network):
    layers = perfect(cells)
    layers["resistance"] *= 1.1
    layers["grade_east"] += 0.003
    got = figures(layers, cells)
    assert got["c_rr_pct"] == pytest.approx(10.0)
    assert got["c_rr_all_pct"] == pytest.approx(10.0)
    assert np.hypot(got["grade_pct"], got["grade_across_pct"]) == pytest.approx(0.3)


def test_distance_from_a_break_of_slope_counts_from_the_ramps_foot():
    slope = np.zeros((5, 40, 2))
    slope[:, 20:, 0] = 0.1
    distance = break_distance(slope, 1.0)
    assert distance[2, 19] == distance[2, 20] == 0.5
    assert distance[2, 10] == 9.5
    slope[:, 20:, 0] = 0.002  # less than a slope step
    assert np.isinf(break_distance(slope, 1.0)).all()
