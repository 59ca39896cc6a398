"""Geometry across the 180th meridian is cut: no part crosses it, together they are the whole."""

import numpy as np
import pytest

from sitegrid.features.meridian import geometry


def placed(ring: list[tuple[float, float]]) -> list[list[float]]:
    """Closed corners east of the meridian and north of the equator [deg], as longitude and latitude."""
    return [[180 + x if x < 0 else x - 180, y] for x, y in [*ring, ring[0]]]


def area(ring: np.ndarray) -> float:
    x, y = np.asarray(ring).T
    x, y = x % 360 - 180, y
    return abs(float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) / 2)


COMB = [(-3, 0), (2, 0), (2, 1), (-1, 1), (-1, 2), (2, 2), (2, 3), (-1, 3), (-1, 4), (2, 4), (2, 5), (-3, 5)]
SQUARE = [(-3, 0), (3, 0), (3, 6), (-3, 6)]
CASES = {  # rings, and numbers of parts and holes on either side
    "a square": ([SQUARE], 2, 0),
    "the other way round": ([SQUARE[::-1]], 2, 0),
    "begun in the east": ([SQUARE[1:] + SQUARE[:1]], 2, 0),
    "three teeth": ([COMB], 4, 0),
    "a hole across": ([SQUARE, [(-1, 2), (-1, 4), (1, 4), (1, 2)]], 2, 0),
    "a hole across, the same way round": ([SQUARE, [(-1, 2), (1, 2), (1, 4), (-1, 4)]], 2, 0),
    "a hole to the west": ([SQUARE, [(-2, 2), (-2, 4), (-1, 4), (-1, 2)]], 2, 1),
    "a hole in a tooth": ([COMB, [(1, 4.2), (1, 4.8), (1.5, 4.8), (1.5, 4.2)]], 4, 1),
    "corners on it": ([[(-3, 0), (0, 0), (3, 3), (0, 6), (-3, 6)]], 2, 0),
}


@pytest.mark.parametrize("name", CASES)
def test_an_area_across_is_cut_into_areas_that_are_the_whole(name):
    rings, parts, holes = CASES[name]
    cut = geometry("Polygon", [placed(ring) for ring in rings])
    assert (cut["type"], len(cut["coordinates"])) == ("MultiPolygon", parts)
    assert sum(len(one) - 1 for one in cut["coordinates"]) == holes
    for ring in (ring for one in cut["coordinates"] for ring in one):
        assert np.ptp(np.array(ring)[:, 0]) < 180
        assert ring[0] == ring[-1]
    size = [area(outline) - sum(map(area, inner)) for outline, *inner in cut["coordinates"]]
    outline, *inner = map(placed, rings)
    assert sum(size) == pytest.approx(area(outline) - sum(map(area, inner)))


def test_a_line_across_is_cut_and_what_is_not_stays():
    line = geometry("LineString", [[179.0, 0.0], [-179.0, 2.0], [179.5, 4.0]])
    parts = [[[179.0, 0.0], [180.0, 1.0]], [[-180.0, 1.0], [-179.0, 2.0], [-180.0, 3.33333333]]]
    assert line["coordinates"] == [*parts, [[180.0, 3.33333333], [179.5, 4.0]]]
    for kind, places in (("Point", [179.0, 1.0]), ("LineString", [[-179.0, 0.0], [-178.0, 1.0]])):
        assert geometry(kind, places) == {"type": kind, "coordinates": places}
    near = [[[179.0, 0.0], [180.0, 0.0], [180.0, 1.0], [179.0, 0.0]]]
    assert geometry("Polygon", near) == {"type": "Polygon", "coordinates": near}
