"""Notebook answers keep values, places, units and frame."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from protocol.queries.answers import ChangesAnswer, GroundChange, Region
from protocol.queries.roads import decode_segments, decode_worklist
from protocol.site.site_config import Projection, SiteConfig
from sitegrid.client import Client
from sitegrid.notebook import MapRegion, to_geopandas, unit_of
from tests.paths import GOLDEN
from tests.unit.records import map_info, site_info, version

pytest.importorskip("xarray")
geopandas = pytest.importorskip("geopandas")
SITE = SiteConfig("pit", 48.0, 11.0)
VALUES = np.array([[1.0, np.nan, 3.0], [np.nan, np.nan, 6.0]], np.float32)


@pytest.fixture
def region() -> MapRegion:
    x_m, y_m = np.arange(3) * 2.0 - 9.0, np.arange(2) * 2.0 + 11.0
    layers = {"resistance": VALUES, "age_s": VALUES * 10}
    return MapRegion.from_region(
        Region(x_m, y_m, 2.0, layers, version(17, 3), 5), lambda: site_info(SITE), lambda: "the map lies elsewhere"
    )


def test_a_dataset_has_values_places_units_and_the_frame(region):
    dataset = region.to_xarray()
    assert dataset["resistance"].sel(x=-5.0, y=13.0) == 6.0
    assert np.array_equal(dataset["age_s"], VALUES * 10, equal_nan=True)
    assert dataset["age_s"].attrs == {"units": "s", "grid_mapping": "spatial_ref"}
    frame = dataset["spatial_ref"].attrs
    assert frame["grid_mapping_name"] == "transverse_mercator"
    assert (frame["latitude_of_projection_origin"], frame["longitude_of_central_meridian"]) == (48.0, 11.0)
    assert dataset.attrs["journal_row"] == 17


def test_a_table_has_a_row_for_each_known_cell(region):
    table = region.to_pandas()
    assert table[["x_m", "y_m", "resistance"]].to_numpy().tolist() == [[-9, 11, 1], [-5, 11, 3], [-5, 13, 6]]


def test_a_place_lies_where_pyproj_and_the_transform_say(region):
    cell, _, west, _, rows, south = region.transform
    assert (west + 2.5 * cell, south + 1.5 * rows) == (-5.0, 13.0)
    lat_deg, lon_deg, _ = Projection(SITE).to_geodetic(-5.0, 13.0)
    from pyproj import Transformer

    there = Transformer.from_crs("EPSG:4326", region.crs).transform(lat_deg, lon_deg)
    assert there == pytest.approx((-5.0, 13.0), abs=1e-6)


def test_it_says_what_it_is_and_draws_itself(region):
    assert repr(region) == "<3 x 2 cells of 2 m at -10..-4, 10..14 m, 50% known: resistance, age_s>"
    assert "<td>resistance</td><td>50%</td><td>1</td><td>3.333</td><td>6</td>" in region._repr_html_()
    empty = replace(region, layers={"resistance": np.full_like(VALUES, np.nan)})
    assert repr(empty).endswith("0% known: resistance; the map lies elsewhere>")
    axes = region.plot("age_s")
    assert axes.get_title() == "pit: age_s"
    assert axes.images[0].get_extent() == [-10.0, -4.0, 10.0, 14.0]
    assert [unit_of(name) for name in ("grade_std", "slope_class", "visits", "weight")] == ["m/m", "1", "1", "m"]


def test_roads_and_changes_are_tables_with_geometries_in_the_frame_of_the_site():
    segments = decode_segments((GOLDEN / "segments.bin").read_bytes())
    worklist = decode_worklist((GOLDEN / "worklist.bin").read_bytes())
    change = GroundChange(1, 5, 6, (0.0, 0.0, 1.0, 2.0), 7, 0.25, None, None, None)
    for answer, count in ((segments, len(segments.segments)), (worklist, 1), (ChangesAnswer((change,), version()), 1)):
        table = to_geopandas(answer, SITE.crs)
        assert len(table) == count
        assert table.crs.equals(SITE.crs)
    assert to_geopandas(ChangesAnswer((), version()), SITE.crs).empty
    assert to_geopandas(worklist, SITE.crs)["kwh_ph_low"][0] == worklist.rows[0].kwh_ph[1]
    first = to_geopandas(segments, SITE.crs).iloc[0]
    assert [*first.geometry.coords] == [tuple(map(float, place)) for place in segments.segments[0].line]
    assert first["passes_ph_back"] == segments.segments[0].passes_ph[1]


class Info:
    """A client that knows its site and now."""

    info, site_info = (lambda _: map_info(SITE, stamp_ns=10**18)), (lambda _: site_info(SITE))
    stamp, to_map, to_geodetic, _projection = Client.stamp, Client.to_map, Client.to_geodetic, Client._projection


def test_times_and_places_are_taken_as_people_have_them():
    client = Info()
    assert client.stamp("-1h") == 10**18 - 3600 * 10**9
    assert client.stamp(datetime(2026, 1, 1, tzinfo=UTC)) == client.stamp("2026-01-01") == 1_767_225_600 * 10**9
    assert client.stamp(17) == 17
    with pytest.raises(ValueError, match="'soon' is no time"):
        client.stamp("soon")
    x_m, y_m = client.to_map(48.0001, 11.0001)
    assert client.to_geodetic(x_m, y_m) == pytest.approx((48.0001, 11.0001), abs=1e-9)
    assert (x_m, y_m) == pytest.approx((7.46, 11.12), abs=0.01)
