"""Slopes between known ground."""

import numpy as np
import pytest

from mapserver.routes.prices import COARSE, Rises, heights, slopes

SIZE = 15 * COARSE


def even_slopes(east: np.ndarray, north: np.ndarray, known: np.ndarray) -> list[np.ndarray]:
    """Of all cells: the outermost coarse ones as those beside them."""
    inner = slopes(heights(Rises.of_slopes(east, north, known)))
    return [np.pad(part, COARSE, mode="edge") for part in inner]


def hill() -> tuple[np.ndarray, np.ndarray]:
    north, east = np.gradient(3.0 * np.exp(-(((np.mgrid[:SIZE, :SIZE] - SIZE / 2) / 30.0) ** 2).sum(axis=0)))
    return east, north


def test_a_plane_goes_on_between_what_is_known_of_it() -> None:
    known = np.ones((SIZE, SIZE), bool)
    known[30:90, 36:84] = False
    east, north = even_slopes(np.full((SIZE, SIZE), 0.05), np.full((SIZE, SIZE), -0.02), known)
    inner = slice(36, 84), slice(42, 78)
    assert east[inner] == pytest.approx(np.full((48, 36), 0.05), abs=0.002)
    assert north[inner] == pytest.approx(np.full((48, 36), -0.02), abs=0.002)


def test_whoever_leaves_a_road_climbs_what_the_road_climbs() -> None:
    """A road over a step of 6 m, known alone: far beside it the ground rises by as much."""
    known = np.zeros((SIZE, SIZE), bool)
    known[57:63] = True
    known[:, :6] = known[:, -6:] = True
    east = np.zeros((SIZE, SIZE))
    east[57:63, 40:80] = 0.15
    slope, _ = even_slopes(east, np.zeros((SIZE, SIZE)), known)
    for row in (20, 60, 100):
        assert slope[row, 6:-6].sum() == pytest.approx(6.0, rel=0.1)
    assert abs(slope[20]).max() < 0.12, "nothing says that it is as steep there"


def test_a_known_hill_is_met_by_its_gap_and_nothing_known_is_even() -> None:
    east, north = hill()
    known = np.hypot(*(np.mgrid[:SIZE, :SIZE] - SIZE / 2)) > 14
    found_east, found_north = even_slopes(np.where(known, east, np.nan), np.where(known, north, np.nan), known)
    line = slice(30, 60)
    assert found_east[60, line].sum() == pytest.approx(east[60, line].sum(), rel=0.5)
    assert found_north[line, 60].sum() == pytest.approx(north[line, 60].sum(), rel=0.5)
    nothing = even_slopes(east, north, np.zeros((SIZE, SIZE), bool))
    assert np.abs(nothing).max() < 1e-9
