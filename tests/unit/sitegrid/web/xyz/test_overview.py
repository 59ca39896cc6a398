"""Tiles with pixels larger than cells, on synthetic maps of any size and place."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from protocol.queries.map_tiles import TILE_CELLS
from protocol.site.geometry import Bounds
from protocol.site.site_config import Projection, SiteConfig
from sitegrid.web.xyz import mercator, overview

PLACES = [(49.01, 8.4), (-16.8, 179.9998), (70.0, -180.0), (-16.8, -179.9999)]


@dataclass
class Map:
    """A client of a map with known rectangles of one value each."""

    known: dict[tuple[float, float, float, float], float]
    cell_m: float = 1.0
    asked: list[Bounds] = field(default_factory=list)

    @property
    def tiles(self) -> set[tuple[int, int]]:
        edge_m = TILE_CELLS * self.cell_m
        ranges = (np.floor(np.array(known) / edge_m).astype(int).tolist() for known in self.known)
        return {(x, y) for w, s, e, n in ranges for x in range(w, e + 1) for y in range(s, n + 1)}

    def region(self, bounds: Bounds, layers: tuple[str], *, resolution_m: float | None) -> Any:
        self.asked.append(bounds)
        edge_m = resolution_m or self.cell_m
        ends = (
            (bounds.west_m, bounds.east_m),
            (bounds.south_m, bounds.north_m),
        )  # widened to whole cells, like a map
        x_m, y_m = ((np.arange(low // edge_m, -(-high // edge_m)) + 0.5) * edge_m for low, high in ends)
        values = np.full((len(y_m), len(x_m)), np.nan, np.float32)
        half = edge_m / 2
        for (w, s, e, n), value in self.known.items():
            columns, rows = (x_m + half > w) & (x_m - half < e), (y_m + half > s) & (y_m - half < n)
            values[np.ix_(rows, columns)] = value
        return type("Region", (dict,), {"x_m": x_m, "y_m": y_m})({layers[0]: values})


def shown(ground: Map, projection: Projection, z: int, at: tuple[float, float], layer: str = "grade") -> np.ndarray:
    lat, lon, _ = projection.to_geodetic(*at)
    x, y = mercator.tile_at(lat, lon, z)
    return overview.draw(ground, ground.tiles, layer, (z, x % 2**z, y), ground.cell_m, projection)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("z", [0, 1, 2, 5, 8, 10, 11, 12, 13, 14])
def test_ground_of_a_few_metres_is_seen_at_every_zoom(place: tuple[float, float], z: int):
    projection = Projection(SiteConfig("pit", *place))
    for at in ((-80.0, 3.0), (60.0, -3.0)):
        ground = Map({(*at, at[0] + 8, at[1] + 8): 0.25})
        for layer in ("grade", "slope_class"):
            values = shown(ground, projection, z, at, layer)
            assert 1 <= np.isfinite(values).sum() <= 16
            assert np.nanmean(values) == pytest.approx(0.25)


def test_a_large_site_has_no_gaps_and_costs_what_is_known():
    projection = Projection(SiteConfig("pit", 49.01, 8.4))
    site = (-3000.0, -3000.0, 3000.0, 3000.0)
    ground = Map({site: 0.1, (18_000.0, 18_000.0, 18_010.0, 18_010.0): 0.3})
    for z in (9, 10, 11, 12, 13, 14):
        ground.asked.clear()
        values = shown(ground, projection, z, (1.0, 1.0))
        inside = mercator.pixels_of(z, *mercator.tile_at(49.01, 8.4, z), projection)
        margin = 2 * mercator.pixel_m(z, 49.01)
        known = (abs(inside.x_m) < 3000 - margin) & (abs(inside.y_m) < 3000 - margin)
        assert np.isfinite(values[known]).all()
        assert values[known] == pytest.approx(0.1)
        assert len(ground.asked) <= 8 * 8 + 1
        assert all(b.east_m - b.west_m <= 1024 for b in ground.asked)
