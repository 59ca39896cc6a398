"""Figures of synthetic samples on ground with known borders, steps and slopes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.ground.comparison import Comparison, cell_means, compare, crossings, lags, place
from lab.ground.figures import figures, soils
from lab.ground.truth import TrueGround, true_ground
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.site.ground_classes import UNKNOWN
from sim.scenario.ground import GroundConfig, RampConfig, ZoneConfig
from sitegrid.proof.map_score import border_distance
from sitegrid.proof.tracks import LoadTrack, read_load_track

SPEED_MPS, EVERY_M = 2.0, 0.5
BORDER_M = 20.0
START_NS = 10**15
LAG_S = 0.5
WET = ZoneConfig("wet dirt", ((BORDER_M, 0.0), (60.0, 0.0), (60.0, 20.0), (BORDER_M, 20.0)))


def ground(*zones: ZoneConfig, ramp: tuple[RampConfig, ...] = (), roughness_m: float = 0.0) -> TrueGround:
    return true_ground(GroundConfig(60.0, 20.0, "dry dirt", zone=zones, ramp=ramp, roughness_m=roughness_m), seed=1)


def drive_east() -> LoadTrack:
    """From x = 0 at constant speed, 10 rows per second."""
    x = np.arange(0.0, 40.0 + 1e-9, SPEED_MPS / 10)
    stamps = START_NS + np.round(x / SPEED_MPS * 1e9).astype(np.int64)
    place_m = np.stack([x, np.full(len(x), 10.5)], axis=-1)
    return LoadTrack(stamps, place_m, np.zeros(len(x)), np.zeros((len(x), 2)), x)


def samples_of(track: LoadTrack, c_rr=0.04, every_m: float = EVERY_M, **columns) -> np.ndarray:
    """A sample every half metre, centred in its interval."""
    x = np.arange(every_m / 2, track.driven_m[-1], every_m)
    rows = np.zeros(len(x), SAMPLE_DTYPE)
    rows["stamp_ns"] = START_NS + np.round(x / SPEED_MPS * 1e9).astype(np.int64)
    rows["distance_m"], rows["c_rr_var"], rows["grade_var"] = every_m, 0.002**2, 1e-6
    rows["c_rr"] = c_rr(x) if callable(c_rr) else c_rr
    for name, values in columns.items():
        rows[name] = values(x) if callable(values) else values
    return rows


def steps_at(border_m: float, off: float = 0.0):
    return lambda x: np.where(x < border_m, 0.04, 0.06) + off


EAST, HERE = drive_east(), ground(WET)


def compared(c_rr=0.04, here: TrueGround = HERE, track: LoadTrack = EAST, **columns) -> Comparison:
    return compare(samples_of(track, c_rr, **columns), track, here, LAG_S, START_NS)


@pytest.mark.slow
def test_a_right_estimate_has_right_figures():
    row = figures(compared(steps_at(BORDER_M)))
    assert row["right_class_pct"] == row["dirt_flat_right_pct"] == 100.0
    assert row["wrong_cells_pct"] == row["wrong_cells_interior_pct"] == row["wrong_slope_cells_pct"] == 0.0
    assert (row["cells"], row["judged_samples"], row["changes"]) == (40, 80, 1)
    assert row["grade_bias_deg"] == row["grade_std_deg"] == row["grade_excluded_pct"] == 0.0
    assert row["normalised_error"] == pytest.approx(0.0, abs=1e-5)


def test_an_estimate_that_comes_late_is_wrong_right_behind_the_border():
    """3 m late: six samples and three of forty cells; one of them more than 2 m inside."""
    judged = compared(steps_at(BORDER_M + 3.0))
    row = figures(judged)
    assert row["right_class_pct"] == pytest.approx(100 * 74 / 80)
    assert row["wrong_cells_pct"] == pytest.approx(100 * 3 / 40)
    assert row["wrong_cells_interior_pct"] == pytest.approx(100 * 1 / 36)
    assert row["place_off_m"] == pytest.approx(3.25, abs=0.03)  # of the first sample beyond, centred in its interval
    assert row["lag_m"] == pytest.approx(3.25 + LAG_S * SPEED_MPS, abs=0.03)
    assert row["lag_s"] == pytest.approx((3.25 + LAG_S * SPEED_MPS) / SPEED_MPS, abs=0.02)
    wet = next(soil for soil in soils(judged.cells) if soil["name"] == "wet dirt")
    assert (wet["cells"], wet["right_pct"], wet["taken_for"]) == (20, 85.0, {"dry dirt": 3})


def test_a_change_that_is_never_noticed_has_no_lag_and_one_that_is_noticed_before_does_not_count():
    changes = crossings(EAST, HERE, START_NS)
    assert [(c.old, c.new) for c in changes] == [(0.04, 0.06)]
    assert changes[0].driven_m == pytest.approx(BORDER_M, abs=0.03)
    assert np.isinf(lags(samples_of(EAST, 0.04), EAST, changes, LAG_S)).all()
    assert lags(samples_of(EAST, 0.06), EAST, changes, LAG_S).shape == (0, 3)
    assert np.isnan(figures(compared(0.04))["lag_s"])


def test_cells_take_the_mean_over_the_distance_that_samples_stand_for():
    """1 m at 0.03 and 3 m at 0.06 give 0.0525: wet dirt; the plain mean would be dry."""
    rows = samples_of(EAST)[:2]
    rows["c_rr"], rows["distance_m"] = (0.03, 0.06), (1.0, 3.0)
    cells = cell_means(place(rows, EAST, HERE), HERE)
    assert (cells.estimated.tolist(), cells.true.tolist()) == ([3], [2])


def test_gradients_are_compared_along_the_true_heading():
    """Facing north, 1 degree too steep ahead, 2 degrees to the left (west)."""
    track = replace(EAST, yaw_rad=np.full(201, np.pi / 2))
    one, two = np.tan(np.radians([1.0, 2.0]))
    row = figures(compared(here=ground(), track=track, grade_n=one, grade_e=-two))
    assert row["grade_bias_deg"] == pytest.approx(1.0, abs=1e-4)
    assert row["across_bias_deg"] == pytest.approx(2.0, abs=1e-4)
    assert row["grade_std_deg"] == pytest.approx(0.0, abs=1e-4)


def test_slopes_have_cells_and_edges_of_their_own():
    """15 degrees from x = 20 to 30; foot and crown are rounded over 2 m, and excluded with 2 m around."""
    rise = 10 * np.tan(np.radians(15))
    ramped = ground(ramp=(RampConfig((20.0, 0.0), (30.0, 0.0), rise),))
    track = replace(EAST, gradient=ramped.slope(EAST.place_m))
    seen = track.gradient[:, 0]
    row = figures(compared(here=ramped, track=track, grade_e=lambda x: np.interp(x, track.driven_m, seen)))
    assert row["wrong_slope_cells_pct"] == 0.0
    assert row["grade_excluded_pct"] == pytest.approx(100 * 2 * 6 / 40, abs=3)
    assert row["grade_std_deg"] == pytest.approx(0.0, abs=0.05)
    flat = figures(compared(here=ramped, track=track))
    assert flat["wrong_slope_cells_pct"] == pytest.approx(100 * 10 / 40)


def test_borders_are_as_far_as_the_other_zone_is():
    classes = np.array([[1, 1, 1, 2, 2, UNKNOWN]])
    np.testing.assert_allclose(border_distance(classes, 2.0), [[5.0, 3.0, 1.0, 1.0, 3.0, np.inf]])
    assert np.isinf(border_distance(np.ones((2, 2), np.int64), 1.0)).all()
    distances = HERE.border_m(np.array([[12.1, 10.0], [19.9, 10.0], [20.1, 10.0], [25.1, 10.0]]))
    np.testing.assert_allclose(distances, [7.9, 0.1, 0.1, 5.1], atol=0.13)


def test_a_track_is_read_as_that_of_the_load_centre(tmp_path: Path):
    (tmp_path / "a.csv").write_text(
        f"stamp_ns,x,y,yaw,grade_e,grade_n\n{START_NS},0.0,0.0,3.1,0.1,0.2\n{START_NS + 10**8},1.0,0.0,-3.1,0.1,0.4\n"
    )
    track = read_load_track(tmp_path / "a.csv", 2.0)
    middle = track.at(np.array([START_NS + 5 * 10**7, START_NS - 1]))
    assert np.cos(middle.yaw_rad[0]) == pytest.approx(-1.0)  # through pi, not 0
    np.testing.assert_allclose(middle.place_m[0], [0.5 + 2 * np.cos(3.1), 0.0], atol=1e-9)
    np.testing.assert_allclose(middle.gradient[0], [0.1, 0.3])
    assert np.isnan(middle.driven_m[1])
