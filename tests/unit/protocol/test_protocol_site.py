import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.site import Projection, SiteConfig, load_site

PAPER = SiteConfig("paper", 49.0, 8.4, 110.0)


@given(st.floats(-80, 84), st.floats(-180, 180), st.floats(-20_000, 20_000), st.floats(-20_000, 20_000))
def test_round_trip_within_a_millimetre(lat, lon, x, y):
    projection = Projection(SiteConfig("s", lat, lon, 50.0))
    there = projection.to_map(*projection.to_geodetic(x, y, 5.0))
    assert there == pytest.approx((x, y, 5.0), abs=1e-3)


def test_origin_is_zero():
    assert Projection(PAPER).to_map(49.0, 8.4, 112.0) == pytest.approx((0.0, 0.0, 2.0), abs=1e-6)


def test_scale_is_one_at_the_origin_and_near_it():
    from pyproj import Geod

    projection, geod = Projection(PAPER), Geod(ellps="WGS84")
    for x, y in [(100.0, 0.0), (0.0, 100.0), (-70.0, 70.0)]:
        lat, lon, _ = projection.to_geodetic(x, y)
        _, _, metres = geod.inv(8.4, 49.0, lon, lat)
        assert metres == pytest.approx(math.hypot(x, y), abs=1e-4)


def test_east_and_north_grow_as_they_should():
    projection = Projection(PAPER)
    assert projection.to_map(49.0, 8.401, 110.0)[0] == pytest.approx(73.2, abs=0.5)
    assert projection.to_map(49.001, 8.4, 110.0)[1] == pytest.approx(111.2, abs=0.5)


@pytest.mark.parametrize("change", [{"origin_lat_deg": 49.0001}, {"origin_lon_deg": 8.5}, {"origin_height_m": 0.0}])
def test_frame_tells_origins_apart(change):
    assert dataclasses.replace(PAPER, **change).frame != PAPER.frame


@pytest.mark.parametrize("change", [{"name": "other"}, {"cell_m": 0.5}, {"extent_m": 99.0}, {"clock": "wall"}])
def test_frame_depends_on_nothing_else(change):
    assert dataclasses.replace(PAPER, **change).frame == PAPER.frame


@pytest.mark.parametrize("number", [int, np.float64, np.int64])
def test_frame_does_not_depend_on_the_type_of_a_number(number):
    assert SiteConfig("s", number(49), number(8), number(110)).frame == SiteConfig("s", 49.0, 8.0, 110.0).frame


def test_frame_is_eight_hex_digits():
    assert len(PAPER.frame) == 8
    int(PAPER.frame, 16)


@pytest.mark.parametrize(
    "change",
    [
        {"name": "Paper"},
        {"name": ""},
        {"name": "a/b"},
        {"origin_lat_deg": 91.0},
        {"origin_lon_deg": 181.0},
        {"origin_lat_deg": math.nan},
        {"cell_m": 0.0},
        {"cell_m": math.nan},
        {"tile_cells": 63},
        {"extent_m": 0.0},
        {"extent_m": math.inf},
        {"clock": "sun"},
        {"clock_tolerance_s": -1.0},
    ],
)
def test_value_out_of_range_is_named(change):
    with pytest.raises(ValueError, match=next(iter(change)).removesuffix("_lat_deg").removesuffix("_lon_deg")):
        dataclasses.replace(PAPER, **change)


def test_site_file(tmp_path):
    path = tmp_path / "site.toml"
    path.write_text('name = "paper"\norigin_lat_deg = 49\norigin_lon_deg = 8.4\norigin_height_m = 110\n')
    assert load_site(path) == PAPER
    path.write_text('name = "paper"\norigin_lat_deg = 149\norigin_lon_deg = 8.4\n')
    with pytest.raises(ConfigError, match=r"site\.toml: origin_lat_deg"):
        load_site(path)
