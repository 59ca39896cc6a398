import numpy as np
import pytest
from mapserver_data import NOW_NS, folded, samples

from mapserver import evidence as ev
from mapserver.grid import Grid
from mapserver.layers import LAYERS, ReadConfig, read, select
from mapserver.votes import FoldConfig
from protocol.errors import QueryError, Refusal
from protocol.ground import BOUNDARIES, ZONES

CELL = 8 * 16 + 8  # of the usual sample in its block
EXACT = {"cov_xx_m2": 0.0, "cov_yy_m2": 0.0}


def value(grid: Grid, layer: str, config: ReadConfig | None = None) -> float:
    return float(read(grid.evidence([(0, 0)]), [layer], config or ReadConfig())[layer][0, CELL])


@pytest.mark.parametrize("c_rr", [zone.c_rr for zone in ZONES] + [0.004, 0.0137, 0.1, 0.4])
def test_constant_resistance_reads_back(c_rr):
    half_step = 0.5 / 256 * np.log(100) / 23  # a vote is split in 1/256 of a bin
    assert value(folded(samples(20, c_rr=c_rr)), "resistance") == pytest.approx(c_rr, rel=1.01 * half_step + 1e-6)


@pytest.mark.parametrize("c_rr", ev.RESISTANCE_CENTRES[::4])
def test_resistance_at_a_centre_reads_back_exactly(c_rr):
    assert value(folded(samples(20, c_rr=c_rr)), "resistance") == pytest.approx(c_rr, rel=1e-6)


@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (0.125, -0.25), (-0.5, 0.5), (0.25 / 32, -3 / 8192)])
def test_constant_gradient_reads_back_exactly(east, north):
    grid = folded(samples(20, grade_e=east, grade_n=north, distance_m=64.0, **EXACT))
    assert value(grid, "grade_east") == pytest.approx(east, abs=1e-4)
    assert value(grid, "grade_north") == pytest.approx(north, abs=1e-4)
    assert value(grid, "grade") == pytest.approx(np.hypot(east, north), abs=1e-4)


@pytest.mark.parametrize(("layer", "column"), [("resistance", "c_rr"), ("grade_east", "grade_e")])
def test_a_minority_does_not_move_the_value(layer, column):
    alone = folded(samples(60, **{column: 0.04}))
    mixed = folded(samples(100, **{column: [0.04] * 60 + [0.4] * 40}))
    assert value(mixed, layer) == pytest.approx(value(alone, layer), rel=1e-6)


def test_a_majority_by_metres_wins_over_a_majority_by_number():
    rows = samples(11, c_rr=[0.04] + [0.25] * 10, distance_m=[20.0] + [0.5] * 10)
    assert value(folded(rows), "resistance") == pytest.approx(0.04, rel=0.01)


@pytest.mark.parametrize(("index", "zone"), list(enumerate(ZONES)))
def test_class_is_that_of_the_zone_and_sure(index, zone):
    grid = folded(samples(20, c_rr=zone.c_rr))
    assert value(grid, "resistance_class") == index
    assert value(grid, "confidence") > 0.85


def test_confidence_is_the_share_of_the_leading_class():
    grid = folded(samples(100, c_rr=[0.25] * 70 + [0.008] * 30, distance_m=10.0))
    assert value(grid, "confidence") == pytest.approx(0.7, abs=0.001)
    assert value(grid, "resistance_class") == 4


def test_class_boundaries_share_the_votes_of_their_bin():
    for boundary in BOUNDARIES:
        grid = folded(samples(20, c_rr=boundary, distance_m=10.0))
        assert 0.3 < value(grid, "confidence") < 0.7


def test_visits_are_counted():
    for n in (1, 3, 8):
        rows = samples(n, stamp_ns=NOW_NS + np.arange(n) * 60 * 10**9)
        assert value(folded(rows), "visits") == pytest.approx(n, abs=1)
    grid = Grid(1.0, FoldConfig())
    for machine in ("a", "b", "c"):
        grid.fold(samples(5), machine)
    assert value(grid, "visits") == 3


def test_a_full_bitmap_of_visits_is_finite():
    grid = folded(samples(1))
    grid._bitmaps[..., ev.VISITS] = np.uint64(2**64 - 1)
    assert value(grid, "visits") == 266


def test_unknown_is_nan_in_every_layer():
    grid = folded(samples(5))
    values = read(grid.evidence([(0, 0), (9, 9)]), list(LAYERS), ReadConfig())
    for name, layer in values.items():
        assert layer.dtype == np.float32
        assert layer.shape == (2, 256)
        assert np.isnan(layer[1]).all(), name
        assert np.isnan(layer[0, 0]), name
        assert np.isfinite(layer[0, CELL]), name


def test_what_a_cell_has_no_votes_for_is_nan():
    no_grade = folded(samples(5, grade_e=np.nan, grade_n=np.nan, grade_var=np.nan))
    assert np.isnan(value(no_grade, "grade"))
    assert value(no_grade, "resistance_class") == 2
    no_resistance = folded(samples(5, c_rr=np.nan, c_rr_var=np.nan))
    assert all(np.isnan(value(no_resistance, name)) for name in ("resistance", "resistance_class", "confidence"))
    assert value(no_resistance, "grade_east") == pytest.approx(0.1, abs=1e-3)


def test_cells_with_too_little_evidence_are_unknown():
    grid = folded(samples(1, distance_m=0.05, **EXACT))
    assert np.isnan(value(grid, "resistance"))
    assert np.isnan(value(grid, "resistance", ReadConfig(min_weight_m=0.06)))
    assert np.isfinite(value(grid, "resistance", ReadConfig(min_weight_m=0.02)))
    wide = folded(samples(9, cov_xx_m2=1.0, cov_yy_m2=1.0))
    layers = [read(wide.evidence([(0, 0)]), ["grade"], ReadConfig(least))["grade"] for least in (0.0, 0.1, 0.5)]
    known = [np.isfinite(layer).sum() for layer in layers]
    assert wide.known_cells() == known[0] > known[1] > known[2] > 0


def test_negative_least_weight_is_refused():
    with pytest.raises(ValueError, match="min_weight_m"):
        ReadConfig(-0.1)


def test_no_names_mean_all_layers_and_an_unknown_one_is_named():
    assert select([]) == tuple(LAYERS)
    assert select(["grade", "visits"]) == ("grade", "visits")
    with pytest.raises(QueryError, match=r"`colour`.*resistance_class") as caught:
        select(["grade", "colour"])
    assert caught.value.reason == Refusal.UNKNOWN_LAYER
