import dataclasses
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.site.site_config import KnownGround, Projection, SiteConfig
from protocol.site.site_file import load_site

PAPER = SiteConfig("paper", 49.0, 8.4, 110.0)


@given(st.floats(-80, 84), st.floats(-180, 180), st.floats(-20_000, 20_000), st.floats(-20_000, 20_000))
def test_round_trip_within_a_millimetre(lat, lon, x, y):
    projection = Projection(SiteConfig("s", lat, lon, 50.0))
    there = projection.to_map(*projection.to_geodetic(x, y, 5.0))
    assert there == pytest.approx((x, y, 5.0), abs=1e-3)


def test_scale_is_one_at_the_origin_and_near_it():
    from pyproj import Geod

    projection, geod = Projection(PAPER), Geod(ellps="WGS84")
    for x, y in [(100.0, 0.0), (0.0, 100.0), (-70.0, 70.0)]:
        lat, lon, _ = projection.to_geodetic(x, y)
        azimuth, _, metres = geod.inv(8.4, 49.0, lon, lat)
        assert metres == pytest.approx(math.hypot(x, y), abs=1e-4)
        assert azimuth == pytest.approx(math.degrees(math.atan2(x, y)), abs=1e-3)


@pytest.mark.parametrize("change", [{"origin_lat_deg": 49.0001}, {"origin_lon_deg": 8.5}, {"origin_height_m": 0.0}])
def test_frame_tells_origins_apart(change):
    assert dataclasses.replace(PAPER, **change).frame != PAPER.frame


@pytest.mark.parametrize("change", [{"name": "other"}, {"cell_m": 0.5}, {"extent_m": 99.0}, {"clock": "wall"}])
def test_frame_depends_on_nothing_else(change):
    assert re.fullmatch("[0-9a-f]{8}", PAPER.frame)
    assert dataclasses.replace(PAPER, **change).frame == PAPER.frame


@pytest.mark.parametrize(
    "change",
    [
        {"name": "Paper"},
        {"origin_lat_deg": 91.0},
        {"origin_lon_deg": 181.0},
        {"origin_lon_deg": -181.0},
        {"cell_m": 0.0},
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


# --- known ground ----------------------------------------------------------------------------------------------------

SQUARE = KnownGround("pad", 0.012, ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)))
HOOK = KnownGround("hook", 0.012, ((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (6.0, 9.0), (6.0, 3.0), (0.0, 3.0)))


@pytest.mark.parametrize(
    ("area", "place", "metres"),
    [
        (SQUARE, (5.0, 5.0), 5.0),
        (SQUARE, (2.0, 6.0), 2.0),
        (SQUARE, (12.0, 5.0), -2.0),
        (SQUARE, (13.0, 14.0), -5.0),  # off a corner
        (SQUARE, (-1.0, 5.0), -1.0),
        (HOOK, (7.5, 6.0), 1.5),
        (HOOK, (3.0, 1.0), 1.0),
        (HOOK, (3.0, 6.0), -3.0),  # in its crook
        (HOOK, (7.0, 2.0), math.hypot(1.0, 1.0)),  # off the inner corner
    ],
)
def test_how_far_inside_of_known_ground_a_place_is(area, place, metres):
    assert area.inside_m(*place) == pytest.approx(metres)
    for same in (area.outline[::-1], (*area.outline, area.outline[0])):
        assert dataclasses.replace(area, outline=same).inside_m(*place) == pytest.approx(metres)


@given(st.floats(-20, 30), st.floats(-20, 30))
def test_known_ground_has_the_same_inside_as_its_parts(x, y):
    """The hook is two rectangles."""
    inside = (0 < x < 9 and 0 < y < 3) or (6 < x < 9 and 0 < y < 9)
    if abs(HOOK.inside_m(x, y)) > 1e-6:
        assert (HOOK.inside_m(x, y) > 0) == inside


@pytest.mark.parametrize(
    ("change", "named"),
    [({"c_rr": -0.1}, "c_rr"), ({"outline": SQUARE.outline[:2]}, "outline")],
)
def test_known_ground_out_of_range_is_named(change, named):
    with pytest.raises(ValueError, match=named):
        dataclasses.replace(SQUARE, **change)
