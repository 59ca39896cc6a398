import numpy as np
import pytest

from mapserver.layers.cell_layers import LAYERS, ReadConfig, derive_area, margin_cells
from mapserver.layers.gap_filling import (
    AREA_LAYERS,
    GRADE_PRIOR_STD,
    RESISTANCE_PRIOR_STD,
    fill_by_majority,
    sparse_kernel,
)
from protocol.site.ground_classes import BOUNDARIES, resistance_class

ROWS, COLUMNS = 24, 40
RESISTANCE_STD, GRADE_STD = 0.1, 0.01  # the first of log(c_rr)


def window(c_rr=0.04, grade_e=0.0, grade_n=0.0, known=True, weight=4.0, std=RESISTANCE_STD):
    """Cell layers, NaN where unknown."""
    shape = (ROWS, COLUMNS)
    layers = {
        "resistance": np.broadcast_to(c_rr, shape),
        "resistance_std": np.broadcast_to(std, shape) * c_rr,
        "resistance_class": resistance_class(np.broadcast_to(c_rr, shape)),
        "grade_east": np.broadcast_to(grade_e, shape),
        "grade_north": np.broadcast_to(grade_n, shape),
        "grade_std": np.full(shape, GRADE_STD),
        "weight": np.broadcast_to(weight, shape),
    }
    return {name: np.where(known, values, np.nan).astype(np.float32) for name, values in layers.items()}


def columns(*spans):
    mask = np.zeros((ROWS, COLUMNS), bool)
    for first, end in spans:
        mask[:, first:end] = True
    return mask


def fill(cells, *names, cell_m=1.0, config=None):
    made = derive_area(names, cells, cell_m, config or ReadConfig())
    return made[names[0]] if len(names) == 1 else made


def random_map(seed, known_share=0.25):
    draw = np.random.default_rng(seed)
    patches = (
        draw.choice([0.008, 0.02, 0.04, 0.06, 0.25], (ROWS // 8, COLUMNS // 8)).repeat(8, axis=0).repeat(8, axis=1)
    )
    return window(
        c_rr=patches * np.exp(draw.normal(0, 0.02, patches.shape)),
        grade_e=draw.normal(0, 0.1, patches.shape),
        grade_n=draw.normal(0, 0.1, patches.shape),
        known=draw.random(patches.shape) < known_share,
        weight=draw.uniform(0.1, 9.0, patches.shape),
    )


def test_known_cells_keep_what_they_have():
    cells = random_map(0)
    made = fill(cells, *AREA_LAYERS)
    known = np.isfinite(cells["resistance"])
    for filled, source in (("resistance_filled", "resistance"), ("resistance_class_filled", "resistance_class"),
                           ("grade_east_filled", "grade_east"), ("grade_north_filled", "grade_north")):  # fmt: skip
        assert np.array_equal(made[filled][known], cells[source][known]), filled
    for filled, source in (("resistance_filled_std", "resistance_std"), ("grade_filled_std", "grade_std")):
        np.testing.assert_allclose(made[filled][known], cells[source][known], rtol=1e-6)


@pytest.mark.parametrize("name", list(AREA_LAYERS))
def test_gaps_are_filled_within_reach_and_not_beyond(name):
    cells = window(known=columns((0, 10)))
    values = fill(cells, name)[12]
    assert np.isfinite(values[:14]).all()
    assert np.isnan(values[15:]).all()
    shorter = fill(cells, name, cell_m=0.5, config=ReadConfig(fill_reach_m=2.5))[12]
    assert np.isfinite(shorter[:14]).all()
    assert np.isnan(shorter[15:]).all()


def test_between_concrete_and_sand_no_dirt_is_invented():
    gap = columns((0, 18), (22, COLUMNS))
    cells = window(c_rr=np.where(columns((0, 20)), 0.008, 0.25), known=gap)
    made = fill(cells, "resistance_filled", "resistance_class_filled")
    assert set(np.unique(made["resistance_class_filled"])) == {0.0, 4.0}
    assert np.isclose(made["resistance_filled"][..., None], [0.008, 0.25], rtol=1e-5).any(axis=-1).all()
    assert (made["resistance_class_filled"][:, :20] == 0).all()
    assert (made["resistance_class_filled"][:, 20:] == 4).all()


def test_filled_class_follows_the_boundaries_of_the_read_options():
    cells = window(c_rr=np.where(columns((0, 20)), 0.02, 0.03), known=columns((0, 19), (21, COLUMNS)))
    split = fill(cells, "resistance_class_filled", config=ReadConfig(boundaries=(0.01, 0.015, 0.025)))
    assert split[12, 19:21].tolist() == [2.0, 3.0]
    together = fill(cells, "resistance_filled", config=ReadConfig(boundaries=(0.1,)))
    assert together[12, 19] == pytest.approx(np.exp(np.average(np.log([0.02, 0.03]), weights=[0.65, 0.35])), rel=0.06)


def test_more_and_surer_evidence_has_the_say():
    west = columns((0, 10))
    sides = west | columns((11, COLUMNS))
    c_rr = np.where(west, 0.25, 0.008)  # not the class that wins ties
    for better in (
        window(c_rr=c_rr, known=sides, weight=np.where(west, 9.0, 0.2)),
        window(c_rr=c_rr, known=sides, std=np.where(west, 0.1, 2.0)),
    ):
        assert fill(better, "resistance_filled")[12, 10] == pytest.approx(0.25, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "known", "prior"),
    [
        ("resistance_filled_std", RESISTANCE_STD * 0.04, RESISTANCE_PRIOR_STD * 0.04),
        ("grade_filled_std", GRADE_STD, GRADE_PRIOR_STD),
    ],
)
def test_uncertainty_grows_with_distance_up_to_the_prior(name, known, prior):
    std = fill(window(known=columns((0, 10))), name)[12]
    assert std[:10] == pytest.approx(known, rel=1e-5)
    assert (np.diff(std[9:14]) > 0).all()
    assert known < std[10] < 0.3 * prior
    assert 0.9 * prior < std[13] <= prior


def test_a_plane_is_filled_between_its_sides():
    cells = window(grade_e=np.linspace(-0.2, 0.2, COLUMNS), grade_n=0.05, known=columns((0, 18), (22, COLUMNS)))
    made = fill(cells, "grade_east_filled", "grade_north_filled", "grade_filled")
    true = np.linspace(-0.2, 0.2, COLUMNS)[18:22]
    assert made["grade_east_filled"][12, 18:22] == pytest.approx(true, abs=0.03)
    assert made["grade_north_filled"][12, 18:22] == pytest.approx(0.05, abs=1e-6)
    steepness = np.hypot(made["grade_east_filled"], made["grade_north_filled"])
    np.testing.assert_allclose(made["grade_filled"], steepness, rtol=1e-6)


@pytest.mark.parametrize("cell_m", [1.0, 0.4])
def test_a_window_with_its_margin_gives_what_a_larger_one_gives(cell_m):
    assert margin_cells(list(LAYERS), cell_m, ReadConfig()) == 0
    cells, config, names = random_map(9), ReadConfig(fill_reach_m=2.0), list(AREA_LAYERS)
    whole = fill(cells, *names, cell_m=cell_m, config=config)
    margin = margin_cells(names, cell_m, config)
    top, left, rows, cols = 7, 11, 6, 9
    wide = (slice(top - margin, top + rows + margin), slice(left - margin, left + cols + margin))
    part = fill({name: values[wide] for name, values in cells.items()}, *names, cell_m=cell_m, config=config)
    for name in names:
        cropped = part[name][margin : margin + rows, margin : margin + cols]
        np.testing.assert_allclose(cropped, whole[name][top : top + rows, left : left + cols], rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("size", [9, 33])
def test_a_tie_goes_to_the_firmer_ground_whatever_the_window(size):
    values = np.full((size, size), np.nan)
    values[:, size // 2 - 1], values[:, size // 2 + 1] = np.log(0.02), np.log(0.25)
    weights = np.where(np.isfinite(values), 0.7, 0.0)
    filled = fill_by_majority(values, weights, sparse_kernel(5.0, 1.0), np.log(BOUNDARIES).tolist())
    assert filled[:, size // 2] == pytest.approx(np.log(0.02))
