"""Foreign tools at the web server: GDAL reads tiles and features like QGIS; schemathesis looks for faults."""

from __future__ import annotations

import gzip
import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
from rasterio.warp import transform
from rasterio.windows import Window

from protocol.arrays import AnyArray
from protocol.site.ground_classes import BOUNDARIES, ZONES
from protocol.site.site_config import Projection
from protocol.site.site_file import load_site
from sitegrid.client import Client
from sitegrid.web.resources import RESOURCES
from tests.integration.web_site import NAME, WebSite
from tests.patience import PATIENCE_S, until

pytestmark = [
    pytest.mark.processes,
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),  # a tile's address is its place
    pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning"),  # rasterio's own
]
ZOOM, SIDE_PX = 20, 256  # pixels of 10 cm
TMS = """<GDAL_WMS>
  <Service name="TMS"><ServerUrl>{url}</ServerUrl></Service>
  <DataWindow>
    <UpperLeftX>-20037508.342789244</UpperLeftX><UpperLeftY>20037508.342789244</UpperLeftY>
    <LowerRightX>20037508.342789244</LowerRightX><LowerRightY>-20037508.342789244</LowerRightY>
    <TileLevel>{zoom}</TileLevel><TileCountX>1</TileCountX><TileCountY>1</TileCountY><YOrigin>top</YOrigin>
  </DataWindow>
  <Projection>EPSG:3857</Projection>
  <BlockSizeX>256</BlockSizeX><BlockSizeY>256</BlockSizeY><BandsCount>3</BandsCount>
</GDAL_WMS>"""


@pytest.fixture(autouse=True)
def _newest_map(web: WebSite) -> None:
    journalled = web.client.info().journalled
    until(lambda: f'-{journalled}-0"' in web.get("xyz/resistance.json").headers["etag"], "the newest map")
    until(lambda: "bounds" in web.get("xyz/resistance.json").json, "a look at what is folded")


@pytest.fixture
def projection(web: WebSite) -> Projection:
    return Projection(load_site(web.folder / "site.toml"))


def driven(client: Client, layer: str) -> AnyArray:
    """Centres (n, 2) of cells with a value."""
    region = client.region((0, 0, 300, 300), [layer])
    rows, columns = np.nonzero(~np.isnan(region[layer]))
    return np.column_stack([region.x_m[columns], region.y_m[rows]])


@pytest.mark.parametrize("layer", ["resistance", "grade_east", "visits", "confidence"])
def test_gdal_reads_the_right_value_at_the_right_place_also_over_a_border(web: WebSite, projection, layer):
    table = web.get(f"xyz/{layer}.json", {"kind": "value"}).json
    url = table["tiles"][0].replace("{", "${")
    with rasterio.open(TMS.format(url=url, zoom=ZOOM)) as tiles:
        border = _border(tiles, driven(web.client, layer), projection)
        window = Window(border[0] - 20, border[1] - 20, 40, 40)
        red, green, blue = tiles.read(window=window).astype(np.int64)
        steps = 65536 * red + 256 * green + blue
        read = np.where(steps == table["unknown"], np.nan, table["offset"] + table["scale"] * steps)
        at = tiles.window_transform(window)
    rows, columns = np.divmod(np.arange(0, 1600, 23), 40)  # on both sides of the border
    lon, lat = transform("EPSG:3857", "EPSG:4326", *(at @ (columns + 0.5, rows + 0.5)))
    ours = [
        web.client.point(*projection.to_map(*place, 0.0)[:2], [layer]).values[layer]
        for place in zip(lat, lon, strict=True)
    ]
    assert read[rows, columns] == pytest.approx(ours, abs=table["scale"] * 0.51 + 1e-6, nan_ok=True)
    assert np.isfinite(ours).sum() > 10
    assert (
        len(
            {(x // SIDE_PX, y // SIDE_PX) for x, y in zip(border[0] - 20 + columns, border[1] - 20 + rows, strict=True)}
        )
        == 4
    )


def _border(tiles: rasterio.DatasetReader, places: AnyArray, projection: Projection) -> tuple[int, int]:
    """Corner of four tiles nearest to driven ground: column and row of its pixel."""
    geodetic = [projection.to_geodetic(x, y) for x, y in places]
    east, north = transform("EPSG:4326", "EPSG:3857", [g[1] for g in geodetic], [g[0] for g in geodetic])
    columns, rows = ~tiles.transform @ (np.array(east), np.array(north))
    corners = [SIDE_PX * np.rint(pixels / SIDE_PX) for pixels in (columns, rows)]
    nearest = int(np.argmin(np.hypot(columns - corners[0], rows - corners[1])))
    return int(corners[0][nearest]), int(corners[1][nearest])


def test_gdal_shows_nothing_where_nobody_drove(web: WebSite):
    table = web.get("xyz/resistance.json", {"kind": "value"}).json
    with rasterio.open(TMS.format(url=table["tiles"][0].replace("{", "${"), zoom=ZOOM)) as tiles:
        assert not tiles.read(window=Window(0, 0, 20, 20)).any()
    for kind, bands in (("colour", 4), ("value", 3)):  # like tiles with content
        with rasterio.open(io.BytesIO(web.get(f"xyz/{kind}/resistance/12/0/0.png").body)) as png:
            shown = png.read(4) if kind == "colour" else png.read()
            assert (png.count, shown.any()) == (bands, False)


def test_tilejson_is_valid_and_its_template_leads_to_tiles(web: WebSite, projection):
    for kind, bands in (("colour", 4), ("value", 3)):
        table = web.get("xyz/resistance.json", {"kind": kind}).json
        assert table["tilejson"] == "3.0.0"
        west, south, east, north = table["bounds"]
        assert -180 <= west < east <= 180
        assert -90 <= south < north <= 90
        assert 0 <= table["minzoom"] <= table["maxzoom"] <= 30
        lat, lon, _ = projection.to_geodetic(*driven(web.client, "resistance")[0])
        for z in (0, 7, 10, 13, 16):  # the site is one pixel, or a few
            x, y = int((lon + 180) / 360 * 2**z), int((1 - np.arcsinh(np.tan(np.radians(lat))) / np.pi) / 2 * 2**z)
            with rasterio.open(io.BytesIO(web.get(f"xyz/{kind}/resistance_class/{z}/{x}/{y}.png").body)) as tile:
                assert tile.read(4 if kind == "colour" else None).any(), z
        assert west <= lon <= east
        assert south <= lat <= north
        (template,) = table["tiles"]
        x, y = int((lon + 180) / 360 * 2**ZOOM), int((1 - np.arcsinh(np.tan(np.radians(lat))) / np.pi) / 2 * 2**ZOOM)
        with rasterio.open(template.format(z=ZOOM, x=x, y=y)) as tile:
            assert (tile.driver, tile.count, tile.width, tile.height) == ("PNG", bands, SIDE_PX, SIDE_PX)
            assert tile.read().any()


def test_gdal_opens_zones_that_are_valid_and_hold_what_they_name(web: WebSite, projection):
    _, _, geometry, (_, names) = pyogrio.raw.read(f"{web.url}api/v1/sites/{NAME}/features/zones")
    assert len(geometry) > 3
    assert set(names) <= {zone.name for zone in ZONES}
    areas = web.get("features/zones").json["features"]
    assert len(areas) == len(geometry)
    valid = "SELECT * FROM zones WHERE ST_IsValid(geometry)"
    file = web.folder / "zones.geojson"
    file.write_bytes(web.get("features/zones").body)
    assert len(pyogrio.raw.read(file, sql=valid, sql_dialect="SQLITE")[2]) == len(geometry)
    seen = set()
    for x_m, y_m in driven(web.client, "resistance")[::29]:
        lat, lon, _ = projection.to_geodetic(x_m, y_m)
        here = f"SELECT class FROM zones WHERE ST_Contains(geometry, MakePoint({lon:.9f}, {lat:.9f}, 4326))"
        ours = web.client.point(x_m, y_m, ["resistance"]).values["resistance"]
        kinds = {int(np.digitize(ours * factor, BOUNDARIES)) for factor in (0.98, 1.02)}  # the tiles' 8 bits: 1.8 %
        kinds_here = pyogrio.raw.read(file, sql=here, sql_dialect="SQLITE")[3][0].tolist()
        assert len(kinds_here) <= 1, "zones overlap"
        assert set(kinds_here) <= kinds
        seen |= set(kinds_here)
    assert len(seen) > 1


FEATURES = [name for name in RESOURCES if name.startswith("features/")]


@pytest.mark.parametrize("name", FEATURES)
def test_flat_geobuf_has_the_features_of_geojson_and_names_its_columns_though_it_is_empty(web: WebSite, name):
    url, plain = f"{web.url}api/v1/sites/{NAME}/{name}?format=fgb", web.get(name).json["features"]
    meta, _, shapes, columns = pyogrio.raw.read(url)
    assert web.get(name, {"format": "fgb"}).headers["content-type"] == "application/flatgeobuf"
    assert meta["geometry_type"] in ("Point", "MultiLineString", "MultiPolygon")
    assert (meta["crs"], len(shapes), len(columns)) == ("EPSG:4326", len(plain), len(meta["fields"]))
    assert [set(one["properties"]) for one in plain] == [set(meta["fields"])] * len(plain)
    assert len(meta["fields"]) > 1
    assert web.get(name, {"format": "kml"}).status == 400


def test_text_is_deflated_for_who_takes_it_and_tiles_are_not_deflated_twice(web: WebSite):
    plain, deflated = (web.get("features/zones", **words) for words in ({}, {"Accept_Encoding": "gzip"}))
    assert deflated.headers["content-encoding"] == "gzip"
    assert gzip.decompress(deflated.body) == plain.body
    for path in ("tiles", "xyz/value/resistance/18/137194/90017.png", "region?bounds=0,0,200,200&format=npz"):
        answer = web.get(path, Accept_Encoding="gzip")
        assert (answer.status, answer.headers.get("content-encoding")) == (200, None)


@pytest.mark.nightly
def test_a_fuzzer_that_reads_the_description_makes_nothing_fail(web: WebSite, tmp_path: Path):
    """Queries drawn from the API's description: every answer is a promised one."""
    checks = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance"
    drawn = "--max-time 10 --seed 1 --max-examples 40 --phases coverage,fuzzing --generation-database :memory:"
    options = ["--checks", checks, *drawn.split(), *["--suppress-health-check", "all", "--no-color", "--workers", "1"]]
    url = f"{web.url}api/v1/openapi.json"
    command = [sys.executable, "-m", "schemathesis.cli", "run", url, *options]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    counts = web.get("/metrics").body.decode()
    assert 'event="status_500"' not in counts
    assert 'event="status_200"' in counts
