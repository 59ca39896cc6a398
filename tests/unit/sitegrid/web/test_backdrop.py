from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.errors import ConfigError
from protocol.site.site_config import Projection, SiteConfig
from sitegrid.web.backdrop import Backdrop, load_backdrops
from sitegrid.web.values import RequestProblem
from sitegrid.web.xyz.mercator import tiles_at

SITE = SiteConfig("pit", 49.01, 8.4)
SQUARE = [[8.40, 49.01], [8.41, 49.01], [8.41, 49.02], [8.40, 49.01]]
TILES = "https://tiles.example/ortho/{z}/{x}/{y}.png"


def loaded(folder: Path, toml: str, outline: Any = None) -> Backdrop:
    (folder / "web.toml").write_text(f"[pit]\n{toml}\n")
    (folder / "site.geojson").write_text(json.dumps(outline))
    (folder / "site.png").write_bytes(b"")
    return load_backdrops(folder / "web.toml")["pit"]


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "Polygon", "coordinates": [SQUARE]},
        {"type": "MultiPolygon", "coordinates": [[SQUARE]]},
        {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [SQUARE]}},
        {"type": "FeatureCollection", "features": [{"geometry": {"type": "Polygon", "coordinates": [SQUARE]}}]},
        {"type": "GeometryCollection", "geometries": [{"type": "Polygon", "coordinates": [SQUARE]}]},
    ],
)
def test_an_outline_of_any_form_of_geojson_comes_in_metres(tmp_path: Path, shape: Any) -> None:
    described = loaded(tmp_path, 'outline = "site.geojson"', shape).described(SITE, Projection(SITE), "")
    expected = [Projection(SITE).to_map(lat, lon, 0.0)[:2] for lon, lat in SQUARE]
    assert np.allclose(described["outline"][0], expected, atol=1e-3)
    assert described["base_map"] is None


def test_metres_stay_as_they_are(tmp_path: Path) -> None:
    toml = 'outline = "site.geojson"\nbase_map = "site.png"\nbounds = [0, 1, 20, 31]\nunits = "metres"'
    shape = {"type": "Polygon", "coordinates": [[[0, 0], [5, 0], [5, 5]]]}
    described = loaded(tmp_path, toml, shape).described(SITE, Projection(SITE), "/picture")
    assert described["outline"] == [[[0, 0], [5, 0], [5, 5]]]
    assert described["base_map"] == {"picture": "/picture", "corners": [[0, 31], [20, 31], [0, 1]]}


@pytest.mark.parametrize("latitude", [0.0, 49.01, -70.0])
def test_tiles_lie_where_their_places_are(latitude: float) -> None:
    site = SiteConfig("pit", latitude, 179.99)
    projection = Projection(site)
    base_map = Backdrop(base_map=TILES).described(site, projection, "")["base_map"]
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-20e3, 20e3, 5)] * 2))
    lat, lon, _ = projection.to_geodetic_many(x, y, np.zeros_like(x))
    u, v = tiles_at(lat, np.where(lon < 0, lon + 360, lon), 0)
    p, q = base_map["metres"] * (u - base_map["origin"][0]), base_map["metres"] * (base_map["origin"][1] - v)
    fitted = np.array(base_map["fit"]) @ [np.ones_like(p), p, q, p * p, p * q, q * q]
    most_m = np.abs(fitted - [x, y]).max()
    print(f"{most_m:.3f} m off at {latitude} degrees")
    assert most_m < 0.5


@pytest.mark.parametrize(
    ("address", "source"),
    [
        (TILES, "https://tiles.example/ortho/"),
        ("http://10.0.0.5:8000/a{z}/{x}/{y}", "http://10.0.0.5:8000/"),
        ("https://tiles.example/wmts?z={z}&x={x}&y={y}", "https://tiles.example/"),
    ],
)
def test_pages_may_load_pictures_from_the_tiles_folder_alone(address: str, source: str) -> None:
    assert Backdrop(base_map=address).source == source


@pytest.mark.parametrize(
    ("toml", "problem"),
    [
        ('outline = "none.geojson"', "none.geojson: cannot be read"),
        ('base_map = "none.png"\nbounds = [0, 0, 1, 1]', "neither an address nor a file .png"),
        ('base_map = "site.tif"', "neither an address nor a file .png"),
        ('base_map = "site.png"', "a picture needs [west, south, east, north]"),
        ('base_map = "site.png"\nbounds = [8, 49, 7, 50]', "a picture needs [west, south, east, north]"),
        ('base_map = "https://tiles.example/{z}/{x}.png"', "is no http address with {z}, {x}, {y}"),
        ('base_map = "https://{s}.example/{z}/{x}/{y}.png"', "is no http address"),
        ("base_map = \"https://a.example/{z}/{x}/{y}; script-src 'self'\"", "is no http address"),
        ('base_map = "ftp://tiles.example/{z}/{x}/{y}.png"', "is no http address"),
        ("max_zoom = 40", "not between 0 and 24"),
        ('units = "feet"', "neither"),
        ('color = "red"', "unknown key `color`"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(tmp_path: Path, toml: str, problem: str) -> None:
    with pytest.raises(ConfigError) as refused:
        loaded(tmp_path, toml)
    assert problem in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("shape", "problem"),
    [
        ([1], "is no GeoJSON"),
        ({"type": "Polygon", "coordinates": [[["a", "b"]]]}, "is no GeoJSON"),
        ({"type": "Polygon"}, "is no GeoJSON"),
        ({"type": "Point", "coordinates": [8, 49]}, "holds no polygon"),
        ({"type": "Polygon", "coordinates": [SQUARE[:2]]}, "fewer than three corners"),
    ],
)
def test_an_outline_that_is_none_is_refused_in_a_line(tmp_path: Path, shape: Any, problem: str) -> None:
    with pytest.raises(ConfigError, match=r"site\.geojson") as refused:
        loaded(tmp_path, 'outline = "site.geojson"', shape)
    assert problem in str(refused.value)


def test_an_outline_of_elsewhere_is_named(tmp_path: Path) -> None:
    in_metres = [[0, 0], [900, 0], [900, 400]]
    backdrop = loaded(tmp_path, 'outline = "site.geojson"', {"type": "Polygon", "coordinates": [in_metres]})
    with pytest.raises(RequestProblem, match="100 km off the site"):
        backdrop.described(SITE, Projection(SITE), "")


def test_the_sample_has_every_option_with_its_default() -> None:
    backdrop = load_backdrops(Path("config/web.toml"))["paper"]
    assert backdrop == Backdrop()
