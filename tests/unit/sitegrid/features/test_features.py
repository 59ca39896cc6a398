import json
from dataclasses import replace
from typing import Any
from zlib import compress

import numpy as np
import pytest

from protocol.queries.answers import GroundChange, MapVersion
from protocol.queries.map_tiles import PLANES, TILE_CELLS, MapTile, TilesAnswer
from protocol.site.ground_classes import BOUNDARIES
from protocol.site.site_config import Projection, SiteConfig
from protocol.wire.messages import Pose
from sitegrid.features import kinds
from sitegrid.features import zones as module
from sitegrid.features.feature import Collection, geojson
from sitegrid.features.zones import zones as zones_of
from sitegrid.web.encoding import pieces

SITE = SiteConfig("pit", 49.01, 8.4)
PROJECTION = Projection(SITE)


def answer(c_rr: np.ndarray, x: int = 0, y: int = 0) -> TilesAnswer:
    planes = np.zeros((len(PLANES), TILE_CELLS, TILE_CELLS), np.uint8)
    planes[0] = PLANES["resistance"].quantised(c_rr)
    return TilesAnswer(
        MapVersion("s", 1, 0), 1, 1.0, whole=True, tiles=(MapTile(x, y, 1, 0, 1, compress(planes.tobytes())),)
    )


def features(collection: Collection) -> list[dict[str, Any]]:
    """As sent by the web server."""
    return json.loads(b"".join(pieces(geojson(collection, PROJECTION))))["features"]


def area_m2(ring: list[list[float]]) -> float:
    xy = np.array([PROJECTION.to_map(lat, lon, 0)[:2] for lon, lat in ring])
    return float(abs(np.sum(xy[:-1, 0] * xy[1:, 1] - xy[1:, 0] * xy[:-1, 1])) / 2)


def test_areas_follow_the_edges_of_cells_with_their_holes():
    ground = np.full((64, 64), np.nan)
    ground[10:30, 20:40] = 0.02
    ground[15:20, 25:30] = 0.25
    zones = features(zones_of(answer(ground, -1, 2), BOUNDARIES))
    assert [zone["properties"]["name"] for zone in zones] == ["gravel", "sand"]
    gravel, sand = (zone["geometry"]["coordinates"] for zone in zones)
    assert len(gravel) == 2, "an outline and a hole"
    assert area_m2(gravel[0]) == pytest.approx(400, rel=1e-4)
    assert area_m2(gravel[1]) == pytest.approx(25, abs=0.6), "the corners of a hole are cut"
    assert area_m2(sand[0]) == pytest.approx(25, rel=0.01)
    xs, ys = zip(*[PROJECTION.to_map(lat, lon, 0)[:2] for lon, lat in gravel[0]], strict=True)
    assert (min(xs), max(xs)) == pytest.approx((-64 + 20, -64 + 40), abs=1e-3)
    assert (min(ys), max(ys)) == pytest.approx((128 + 10, 128 + 30), abs=1e-3)
    assert gravel[0][0] == gravel[0][-1], "closed"


@pytest.mark.parametrize("far", [[(0, 0), (9000, -9000)], [(i, i) for i in range(90)], [(0, 0), (1, 0), (40, 0)]])
def test_zones_cost_what_is_known_wherever_it_lies(far: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch):
    whole = answer(np.full((64, 64), 0.02)).tiles[0]
    tiles = tuple(replace(whole, x=x, y=y) for x, y in far)
    cells = 0
    classes = module._classes

    def counted(*given: Any) -> Any:
        nonlocal cells
        image, corner = classes(*given)
        cells += image.size
        return image, corner

    monkeypatch.setattr(module, "_classes", counted)
    zones = features(zones_of(replace(answer(np.zeros((64, 64))), tiles=tiles), BOUNDARIES))
    assert sum(area_m2(zone["geometry"]["coordinates"][0]) for zone in zones) == pytest.approx(
        64**2 * len(far), rel=0.2
    )
    assert cells <= 64**2 * 32 * len(far)


def test_a_change_is_a_rectangle_with_its_times():
    change = GroundChange(3, 10**9, 2 * 10**9, (0.0, 0.0, 10.0, 20.0), 200, 0.02, None, None, None)
    (feature,) = features(Collection(kinds.CHANGE, [change]))
    assert area_m2(feature["geometry"]["coordinates"][0]) == pytest.approx(200, rel=1e-4)
    assert feature["properties"]["first_time"] == "1970-01-01T00:00:01.000000000Z"
    assert feature["properties"]["resistance_after"] is None


def test_a_track_is_a_line_in_the_order_of_time():
    poses = [Pose("loader-1", 10**9 * i, 10.0 * i, 0.0, 0.0, 3.0, 1.0, 0.0, 1.0) for i in range(1, 4)]
    (feature,) = features(kinds.tracks({"loader-1": poses, "loader-2": poses[:1]}))
    line = [PROJECTION.to_map(lat, lon, 0)[0] for lon, lat in feature["geometry"]["coordinates"]]
    assert line == pytest.approx([10.0, 20.0, 30.0], abs=1e-3)
    assert feature["properties"]["machine"] == "loader-1"
    assert feature["properties"]["last_time"] == "1970-01-01T00:00:03.000000000Z"
