import numpy as np
import pytest

from mapserver.pictures import frame, plotter
from mapserver.pictures.plotter import DrawnTrack, draw_difference, draw_grade, draw_resistance, side_by_side
from protocol.queries.answers import Region
from protocol.site.ground_classes import ZONES
from tests.unit.records import version

NAN = np.float32(np.nan)


def region(columns: int, rows: int, *, west: float = 0.0, south: float = 0.0, cell: float = 1.0, **layers) -> Region:
    x, y = west + (np.arange(columns) + 0.5) * cell, south + (np.arange(rows) + 0.5) * cell
    full = {name: np.broadcast_to(np.asarray(v, np.float32), (rows, columns)).copy() for name, v in layers.items()}
    return Region(x, y, cell, full, version=version(1), stamp_ns=1)


def cell_colour(image: np.ndarray, column: int, row: int, rows: int, cell_px: int) -> tuple[int, ...]:
    """Colour at a cell's centre; row 0 is the southernmost."""
    x = frame.LEFT + column * cell_px + cell_px // 2
    y = frame.TOP + (rows - 1 - row) * cell_px + cell_px // 2
    return tuple(int(v) for v in image[y, x])


def test_each_zone_has_its_colour_filled_gaps_are_pale_and_unknown_is_grey():
    zones = [zone.c_rr for zone in ZONES]
    known, filled = np.array([[*zones, NAN, NAN]]), np.array([[*zones, ZONES[4].c_rr, NAN]])
    image = draw_resistance(region(7, 1, resistance=known, resistance_filled=filled))
    shown = [cell_colour(image, column, 0, 1, plotter.MAX_CELL_PX) for column in range(7)]
    pale = tuple(round(0.42 * part + 0.58 * 255) for part in plotter.GROUND_COLOURS[4])
    assert shown == [*plotter.GROUND_COLOURS, pale, plotter.UNKNOWN_COLOUR]


def test_slope_is_red_uphill_and_downhill():
    east = np.array([[0.0, 0.27, -0.27, 0.1, NAN]])
    image = draw_grade(region(5, 1, grade_east=east, grade_north=0.0))
    corner = [tuple(image[frame.TOP + 3, frame.LEFT + 64 * column + 3]) for column in range(5)]
    flat, slope = plotter.EASY, plotter.HARD
    assert corner == [flat, slope, slope, flat, plotter.UNKNOWN_COLOUR]


def test_wrong_cells_are_loud():
    values = np.array([[0.008, 0.008, 0.25, NAN]])
    image = draw_difference(region(4, 1, resistance=values), {"resistance": np.full((1, 4), 0.008)}, "resistance")
    shown = [cell_colour(image, column, 0, 1, plotter.MAX_CELL_PX) for column in range(4)]
    pale = plotter._pale(plotter.GROUND_COLOURS[0])
    assert shown == [pale, pale, plotter.WRONG_COLOUR, plotter.UNKNOWN_COLOUR]


@pytest.mark.parametrize(
    ("columns", "rows", "cell"), [(1, 1, 1.0), (30, 400, 1.0), (400, 30, 1.0), (1241, 3, 1.0), (9, 5, 0.05)]
)
def test_every_size_fits_a_screen(columns, rows, cell):
    track = DrawnTrack("m" * 63, np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    here = region(columns, rows, west=-90_000.55, south=-90_000.55, cell=cell, resistance=0.04)
    image = draw_resistance(here, [track] * 40, "A long title " * 20)
    assert image.dtype == np.uint8
    assert image.shape[1] <= 1600
    assert (image[:, -4:] == 255).all()  # not cut at the right
    assert (image[-2:] == 255).all()  # nor below


def test_track_has_its_colour_and_a_marker_at_its_end():
    track = DrawnTrack("loader-1", np.array([10.5, 50.5, np.nan, 90.5]), np.array([10.5, 10.5, np.nan, 40.5]))
    image = draw_resistance(region(100, 50, resistance=0.04), [track])
    assert cell_colour(image, 90, 40, 50, 12) == plotter.TRACK_COLOURS[0]
    assert min(cell_colour(image, 30, 10, 50, 12)) > 150  # a thin white line, antialiased
    assert cell_colour(image, 70, 25, 50, 12) == plotter.GROUND_COLOURS[2]  # NaN breaks the line


def test_grade_difference_takes_a_region_as_truth():
    here = region(2, 2, grade_east=0.3, grade_north=0.0)
    truth = region(2, 2, grade_east=0.0, grade_north=-0.3)
    image = draw_difference(here, truth, "grade")
    assert cell_colour(image, 1, 1, 2, 64) == plotter._pale(plotter.HARD)


def test_side_by_side_pads_the_smaller():
    small, large = (np.zeros((size, size, 3), np.uint8) for size in (10, 20))
    pair = side_by_side([small, large])
    assert pair.shape == (20, 30, 3)
    assert (pair[10:, :10] == 255).all()
