import cv2
import numpy as np
import pytest

from protocol.site.geometry import Bounds
from protocol.site.site_config import Projection, SiteConfig
from sitegrid.web.xyz import mercator
from sitegrid.web.xyz.mercator import FINE, coding, colour_png, pixels_of, tile_at, value_png


def decoded(png: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(("lat", "lon"), [(49.01, 8.4), (-16.8, 179.99995), (84.0, -40.0), (-80.0, 179.0)])
def test_a_tile_of_any_zoom_has_what_the_map_knows_or_nothing(lat: float, lon: float):
    projection, known, ones = Projection(SiteConfig("pit", lat, lon)), Bounds(-50, -50, 50, 50), np.ones((100, 100))
    world = [(z, x, y) for z in (0, 1) for x in range(2**z) for y in range(2**z)]  # partly beyond the projection
    for place in (*world, (14, *tile_at(lat, lon, 14))):
        pixels = pixels_of(*place, projection)
        shown = pixels.sample(ones, -50, -50, 1.0) == 1
        bounds = pixels.bounds(known, 1.0)
        assert (bounds is not None) == shown.any() == (place[0] == 14)
        assert bounds is None or -51 <= bounds.west_m < bounds.east_m <= 51


def test_values_survive_24_bits():
    for layer, most in (
        ("resistance", 0.4),
        ("grade_east", 0.5),
        ("age_s", 1e6),
        ("visits", 266.0),
        ("weight", 9000.0),
    ):
        low = -most if layer == "grade_east" else 0.0
        values = np.linspace(low, most, 256 * 256).reshape(256, 256)
        values[:, ::7] = np.nan
        image = decoded(value_png(values, layer)).astype(np.int64)
        scale, offset = coding(layer)
        steps = image[..., 2] * 65536 + image[..., 1] * 256 + image[..., 0]
        assert ((steps == 0) == np.isnan(values)).all()
        assert np.nanmax(abs(offset + scale * steps - values)[steps > 0]) <= scale / 2 * 1.001
    assert FINE[0] <= 1e-6


def test_unknown_is_transparent_and_colours_grow_lighter():
    values = np.full((256, 256), np.nan)
    for layer, low, middle, high in (("resistance", 0.006, 0.0424, 0.3), ("grade", 0.0, 0.15, 0.3)):
        values[0, :4] = low, middle, high, 2 * high
        image = decoded(colour_png(values, layer))
        assert (image[..., 3] > 0).sum() == 4
        np.testing.assert_allclose(image[0, :4, :3], mercator.ORDERED[[0, 3, 6, 6]], atol=1)
    assert decoded(mercator.empty_png("colour"))[..., 3].max() == 0
    assert decoded(mercator.empty_png("value")).shape == decoded(value_png(values, "resistance")).shape
