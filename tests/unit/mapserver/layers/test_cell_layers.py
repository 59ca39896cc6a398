from dataclasses import replace

import numpy as np
import pytest

from mapserver.error_model import gradient_variance, resistance_variance
from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.layers.cell_layers import (
    LAYERS,
    SPREAD_SHARE,
    ReadConfig,
    read,
    select,
)
from protocol.errors import Refusal
from protocol.site.ground_classes import SLOPE_LIMIT, ZONES
from tests.unit.mapserver.data import NOW_NS, folded, refused, samples

CELL = 8 * 16 + 8  # the usual sample's, in its block
LOG_STEP = np.log(100) / 23  # between resistance bins
EXACT = {"cov_xx_m2": 0.0, "cov_yy_m2": 0.0}


def value(grid: Grid, layer: str, config: ReadConfig | None = None, now_ns: int = NOW_NS) -> float:
    return float(read(grid.evidence([(0, 0)]), [layer], config or ReadConfig(), now_ns)[layer][0, CELL])


@pytest.mark.parametrize("c_rr", [*ev.RESISTANCE_CENTRES[::8], 0.004, 0.0137, 0.1, 0.4])
def test_constant_resistance_reads_back(c_rr):
    half_step = 0.5 / 256 * LOG_STEP  # votes are split in 1/256 of a bin
    assert value(folded(samples(20, c_rr=c_rr)), "resistance") == pytest.approx(c_rr, rel=1.01 * half_step + 1e-6)


@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (0.125, -0.25), (-0.5, 0.5), (0.25 / 32, -3 / 8192)])
def test_constant_gradient_reads_back_exactly(east, north):
    grid = folded(samples(20, grade_e=east, grade_n=north, distance_m=64.0, **EXACT))
    assert value(grid, "grade_east") == pytest.approx(east, abs=1e-4)
    assert value(grid, "grade_north") == pytest.approx(north, abs=1e-4)
    assert value(grid, "grade") == pytest.approx(np.hypot(east, north), abs=1e-4)


@pytest.mark.parametrize(
    ("layer", "column", "most", "rest", "off"),
    [
        ("resistance", "c_rr", 0.04, 0.4, 1e-8),
        ("grade_east", "grade_e", 0.04, 0.4, 1e-8),
        ("grade_east", "grade_e", 3.3 / 32, 4.9 / 32, 0.01),  # in the last bin but one
    ],
)
def test_a_minority_does_not_move_the_value(layer, column, most, rest, off):
    alone = folded(samples(72, **{column: most}, distance_m=10.0))
    mixed = folded(samples(100, **{column: [most] * 72 + [rest] * 28}, distance_m=10.0))
    assert value(mixed, layer) == pytest.approx(value(alone, layer), abs=off)


def test_a_majority_by_metres_wins_over_a_majority_by_number():
    rows = samples(11, c_rr=[0.04] + [0.25] * 10, distance_m=[20.0] + [0.5] * 10)
    assert value(folded(rows), "resistance") == pytest.approx(0.04, rel=0.01)


@pytest.mark.parametrize(("index", "zone"), list(enumerate(ZONES)))
def test_class_is_that_of_the_zone_and_sure(index, zone):
    grid = folded(samples(20, c_rr=zone.c_rr))
    assert value(grid, "resistance_class") == index
    assert value(grid, "confidence") > 0.85


def deviation(c_rr: float, spread: float) -> float:
    """Std of c_rr for this spread of log votes."""
    return float(np.sqrt((SPREAD_SHARE * spread * c_rr) ** 2 + resistance_variance(c_rr)))


def grade_deviation(grade: float, spread: float) -> float:
    return float(np.sqrt(spread**2 + gradient_variance(grade)))


@pytest.mark.parametrize(("share", "likely"), [(0.7, 0.781), (0.9, 0.964), (1.0, 1.0)])
def test_confidence_is_the_sharpened_share_of_the_leading_class(share, likely):
    """0.7^1.5 / (0.7^1.5 + 0.3^1.5) = 0.781"""
    leading = round(100 * share)
    grid = folded(samples(100, c_rr=[0.25] * leading + [0.008] * (100 - leading), distance_m=10.0))
    assert value(grid, "confidence") == pytest.approx(likely, abs=0.001)
    assert value(grid, "resistance_class") == 4


def test_boundaries_of_the_read_options_make_the_classes():
    grid = folded(samples(100, c_rr=[0.04] * 60 + [0.008] * 40, distance_m=10.0))
    for boundaries, number, confidence in (((0.02,), 1, 0.6475), ((0.1,), 0, 1.0)):
        config = ReadConfig(boundaries=boundaries)
        assert value(grid, "resistance_class", config) == number
        assert value(grid, "confidence", config) == pytest.approx(confidence, abs=1e-3)


REFUSED = {
    "boundaries": [(), (0.03, 0.03), (0.0, 0.03), (float("nan"),)],
    "fill_reach_m": [0.0, 50.1, float("nan")],
    "min_weight_m": [-0.1],
}


@pytest.mark.parametrize("name", REFUSED)
def test_read_options_that_make_no_sense_are_refused_by_name(name):
    for value in REFUSED[name]:
        with pytest.raises(ValueError, match=name):
            ReadConfig(**{name: value})


@pytest.mark.parametrize("start", np.linspace(0, 1, 5))
@pytest.mark.parametrize("noise", [0.002, 0.008])
def test_noise_does_not_bias_the_gradient(start, noise):
    true, draw = start / 32, np.random.default_rng(3)
    half = draw.normal(0.0, noise, 400)
    grid = folded(samples(800, grade_e=true + np.concatenate([half, -half])))
    assert value(grid, "grade_east") == pytest.approx(true, abs=0.0012)


def test_what_all_votes_err_in_is_a_larger_share_of_firm_ground():
    stds = [value(folded(samples(30, c_rr=c_rr)), "resistance_std") / c_rr for c_rr in (0.008, 0.04, 0.25)]
    assert stds == pytest.approx([0.255, 0.0707, 0.0506], abs=0.003)


@pytest.mark.parametrize("start", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("noise_bins", [0.6, 1.5])
def test_noise_of_the_votes_is_their_spread(start, noise_bins):
    z = np.random.default_rng(8).normal(size=(3, 3000))
    z /= z.std(axis=1, keepdims=True)
    columns = {
        "c_rr": 0.03 * np.exp(LOG_STEP * (start + noise_bins * z[0])),
        "grade_e": (start + noise_bins * z[1]) / 32,
        "grade_n": (2 + start + noise_bins * z[2]) / 32,
    }
    grid = folded(samples(3000, **columns))
    c_rr = 0.03 * np.exp(LOG_STEP * start)
    assert value(grid, "resistance_std") == pytest.approx(deviation(c_rr, noise_bins * LOG_STEP), rel=0.07)
    slope = np.hypot(start, 2 + start) / 32
    assert value(grid, "grade_std") == pytest.approx(grade_deviation(slope, noise_bins / 32), rel=0.05)


def test_a_minority_does_not_widen_the_spread():
    z = np.random.default_rng(8).normal(size=2000)
    alone = samples(2000, c_rr=0.04 * np.exp(0.15 * z))
    mixed = alone.copy()
    mixed["c_rr"][::5] = 0.3
    assert value(folded(mixed), "resistance_std") == pytest.approx(value(folded(alone), "resistance_std"), rel=0.1)


@pytest.mark.parametrize("degrees", [-80.0, 0.0, 33.75, 88.0])
def test_heading_is_the_axis_driven_both_ways(degrees):
    angle = np.radians(degrees)
    there = np.tile([angle, angle + np.pi, angle - np.pi], 20)
    axis = value(folded(samples(60, heading_rad=there)), "heading")
    off = (axis - angle + np.pi / 2) % np.pi - np.pi / 2
    assert abs(off) <= np.pi / 16 + 1e-6
    assert -np.pi / 2 <= axis <= np.float32(np.pi / 2)


@pytest.mark.parametrize("headings", [np.arange(16) * np.pi / 8, np.array([0.0, np.pi / 2]), np.array([0.3, 1.9])])
def test_a_cell_driven_all_ways_has_no_heading(headings):
    assert np.isnan(value(folded(samples(len(headings) * 4, heading_rad=np.tile(headings, 4))), "heading"))


def test_age_is_the_time_since_the_newest_sample():
    grid = folded(samples(3, stamp_ns=NOW_NS - np.array([40, 90, 65]) * 10**9))
    assert value(grid, "age_s") == pytest.approx(40.0)
    assert value(grid, "age_s", now_ns=NOW_NS - 60 * 10**9) == 0.0
    assert np.isnan(value(grid, "age_s", now_ns=0))


@pytest.mark.parametrize(("steepness", "expected"), [(SLOPE_LIMIT - 0.005, 0), (SLOPE_LIMIT + 0.005, 1)])
@pytest.mark.parametrize("angle", [0.0, 4.0])
def test_slope_class_is_by_steepness(steepness, expected, angle):
    grid = folded(samples(9, grade_e=steepness * np.cos(angle), grade_n=steepness * np.sin(angle)))
    assert value(grid, "slope_class") == expected


def test_visits_are_counted():
    for n in (1, 3, 8):
        rows = samples(n, stamp_ns=NOW_NS + np.arange(n) * 60 * 10**9)
        assert value(folded(rows), "visits") == pytest.approx(n, abs=1)
    grid = Grid(1.0, FoldConfig())
    for machine in ("a", "b", "c", "a"):
        grid.fold(samples(5), machine)
    assert (value(grid, "visits"), value(grid, "machines")) == (3, 3)
    evidence = grid.evidence([(0, 0)])
    full = replace(evidence, bitmaps=np.full_like(evidence.bitmaps, 2**64 - 1))
    values = read(full, ["visits", "machines"], ReadConfig())
    assert (values["visits"][0, CELL], values["machines"][0, CELL]) == (266, 266), "a full bitmap is finite"


def test_unknown_is_nan_in_every_layer():
    grid = folded(samples(5))
    values = read(grid.evidence([(0, 0), (9, 9)]), list(LAYERS), ReadConfig(), NOW_NS)
    for name, layer in values.items():
        assert layer.dtype == np.float32
        assert layer.shape == (2, 256)
        assert np.isnan(layer[1]).all(), name
        assert np.isnan(layer[0, 0]), name
        assert np.isfinite(layer[0, CELL]) == (name != "changed_s"), name


RESISTANCE_LAYERS = {"resistance", "resistance_std", "resistance_class", "confidence"}
GRADE_LAYERS = {"grade", "grade_std", "grade_east", "grade_north", "slope_class"}


@pytest.mark.parametrize(
    ("columns", "unknown"),
    [(("grade_e", "grade_n", "grade_var"), GRADE_LAYERS), (("c_rr", "c_rr_var"), RESISTANCE_LAYERS)],
)
def test_what_a_cell_has_no_votes_for_is_nan(columns, unknown):
    grid = folded(samples(5, **dict.fromkeys(columns, np.nan)))
    assert {name for name in LAYERS if np.isnan(value(grid, name))} == {*unknown, "changed_s"}


def test_where_machines_could_measure_nothing_a_cell_is_driven_and_not_known():
    nothing = dict.fromkeys(("c_rr", "c_rr_var", "grade_e", "grade_n", "grade_var"), np.nan)
    grid = folded(samples(5, **nothing))
    known = {name for name in LAYERS if np.isfinite(value(grid, name))}
    assert known == {"weight", "visits", "machines", "heading", "age_s"}
    grid.fold(samples(1, distance_m=0.05, **EXACT), "a")  # little measured distance in a much driven cell
    assert np.isnan(value(grid, "resistance"))
    assert np.isnan(value(grid, "grade_east"))
    assert value(grid, "resistance", ReadConfig(min_weight_m=0.02)) == pytest.approx(0.04, rel=0.01)


def test_cells_with_too_little_evidence_are_unknown():
    grid = folded(samples(1, distance_m=0.05, **EXACT))
    assert value(grid, "weight", ReadConfig(min_weight_m=0.0)) == pytest.approx(0.05, abs=0.002)
    assert np.isnan(value(grid, "resistance", ReadConfig(min_weight_m=0.06)))
    assert np.isfinite(value(grid, "resistance", ReadConfig(min_weight_m=0.02)))
    wide = folded(samples(9, cov_xx_m2=1.0, cov_yy_m2=1.0))
    layers = [read(wide.evidence([(0, 0)]), ["grade"], ReadConfig(least))["grade"] for least in (0.0, 0.1, 0.5)]
    known = [np.isfinite(layer).sum() for layer in layers]
    assert wide.known_cells() == known[0] > known[1] > known[2] > 0


def test_no_names_mean_all_layers_of_cells_and_an_unknown_one_is_named():
    assert select([]) == tuple(LAYERS)
    assert select(["grade", "resistance_filled", "visits"]) == ("grade", "resistance_filled", "visits")
    with refused(Refusal.UNKNOWN_LAYER, r"`colour`.*resistance_class.*resistance_filled"):
        select(["grade", "colour"])
