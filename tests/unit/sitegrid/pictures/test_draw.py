"""The true map cut to a region; titles of pictures."""

from __future__ import annotations

from argparse import ArgumentParser
from dataclasses import replace

import numpy as np
import pytest

from mapserver.pictures.plotter import DrawnTrack
from protocol.errors import ConfigError, QueryError
from protocol.queries.answers import Region
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import MACHINES
from sim.truth import TruthMap
from sitegrid.commands.plot import add_options
from sitegrid.pictures.draw import _query, _title, truth_layers
from tests.unit.records import version


def region(west: float, south: float, columns: int, rows: int, cell_m: float = 1.0) -> Region:
    x, y = west + (np.arange(columns) + 0.5) * cell_m, south + (np.arange(rows) + 0.5) * cell_m
    return Region(x, y, cell_m, {"resistance": np.zeros((rows, columns), np.float32)}, version(), 0)


@pytest.fixture
def truth() -> TruthMap:
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    return TruthMap(10.0, 20.0, values, values + 100, values + 200)


def test_cells_fall_on_their_places(truth: TruthMap):
    layers = truth_layers(truth, region(11, 21, 2, 2))
    assert layers["resistance"].tolist() == [[5, 6], [9, 10]]
    assert layers["grade_north"].tolist() == [[205, 206], [209, 210]]


def test_beyond_the_simulated_site_nothing_is_known(truth: TruthMap):
    values = truth_layers(truth, region(8, 19, 3, 2))["resistance"]
    assert np.isnan(values[0]).all()
    assert np.isnan(values[1, :2]).all()
    assert values[1, 2] == 0
    assert np.isnan(truth_layers(truth, region(-50, -50, 2, 2))["resistance"]).all()


def test_cells_of_another_size_are_refused(truth: TruthMap):
    with pytest.raises(ConfigError, match="cells of 1 m, the map of 2 m"):
        truth_layers(truth, region(10, 20, 2, 2, cell_m=2.0))


TRACKS = [DrawnTrack("loader-1", np.zeros(2), np.zeros(2))]


@pytest.mark.parametrize(
    ("resistance", "grade", "tracks", "title"),
    [
        (0.1, 0.0, TRACKS, "Rolling resistance"),
        (np.nan, 0.0, TRACKS, "Rolling resistance: unknown, no machine measures drive torque"),
        (np.nan, np.nan, TRACKS, "Rolling resistance: samples follow after 90 s"),
        (np.nan, np.nan, [], "Rolling resistance"),
    ],
)
def test_a_map_without_resistance_says_why(resistance: float, grade: float, tracks: list[DrawnTrack], title: str):
    known = region(0, 0, 2, 2)
    layers = {"resistance": resistance, "grade_east": grade, "grade_north": grade}
    known = Region(
        known.x_m, known.y_m, 1.0, {k: np.full((2, 2), v, np.float32) for k, v in layers.items()}, version(), 0
    )
    assert _title(known, tracks, "samples follow after 90 s") == title


def asked(*words: str):
    parser = ArgumentParser()
    add_options(parser)
    return _query(None, parser.parse_args(words))


def test_a_drive_is_asked_as_the_options_say():
    places = ["0", "1", "30", "40"]
    assert asked() is None
    line = asked("--line", *places, "--machine", "truck", "--mass", "30000")
    truck = replace(MACHINES["truck"], mass_kg=30_000.0)
    assert line == RouteQuery(((0.0, 1.0), (30.0, 40.0)), machine=truck, step_m=5.0)
    assert asked("--between", *places, "--cost", "time") == WayQuery((0.0, 1.0), (30.0, 40.0), cost="time", step_m=5.0)
    coarse = asked("--between", *places, "--step", "10")
    assert coarse == WayQuery((0.0, 1.0), (30.0, 40.0), step_m=10.0)
    long = asked("--line", "0", "0", "60000", "0")
    assert isinstance(long, RouteQuery)
    assert long.step_m == 60.0, "one step a pixel"
    with pytest.raises(ConfigError, match="--mass: is of a drive"):
        asked("--mass", "3")
    with pytest.raises(QueryError, match="parameter `line`: 3 numbers"):
        asked("--line", "0", "1", "2")
