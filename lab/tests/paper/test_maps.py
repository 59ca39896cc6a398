"""Maps with known ground and errors: positions, values, corrections."""

import numpy as np
import pytest

from lab.calibration.drives import Scene
from lab.campaign.true_maps import region_of, true_layers
from lab.paper.maps import (
    AS_SENT,
    AS_TRUE,
    OURS,
    PAPERS,
    PLOTTED_ESTIMATES,
    SERVED,
    MadeMaps,
    MapKind,
    make_maps,
    plotted,
    with_true_values,
)
from lab.tests.calibration.scenes import made_scene
from protocol.arrays import Table
from sitegrid.proof.map_score import score

EAST_M, NORTH_M = 6.0, -2.0  # offset of real-time positions


@pytest.fixture(scope="module")
def scene() -> tuple[dict[str, Table], Scene]:
    return made_scene()


@pytest.fixture(scope="module")
def made(scene) -> MadeMaps:
    """Maps of samples with wrong real-time positions and right smoothed ones."""
    rows, true = scene
    live = {name: table.copy() for name, table in rows.items()}
    for table in live.values():
        table["x_m"] += EAST_M
        table["y_m"] += NORTH_M
    return make_maps(live, rows, true)


def wrong(made: MadeMaps, kind: MapKind, true: Scene) -> float:
    return score(region_of(true.truth, made.layers_of(kind)), true_layers(true.truth)).wrong_resistance_pct


def test_true_values_are_those_of_the_true_place_wherever_a_sample_is_put(scene):
    rows, true = scene
    moved = rows["a"].copy()
    moved["x_m"] += 30.0
    here, there = (with_true_values(table, true, "a") for table in (rows["a"], moved))
    np.testing.assert_array_equal(here["c_rr"], there["c_rr"])
    assert set(np.unique(here["c_rr"])) <= {np.float32(c) for c in (0.04, 0.06, 0.25)}
    np.testing.assert_allclose(there["x_m"] - here["x_m"], 30.0)


@pytest.mark.slow
def test_a_plotter_has_the_places_of_at_once_and_a_server_those_of_later(made: MadeMaps, scene):
    _, true = scene
    assert made.errors_m(PAPERS) == made.errors_m(PLOTTED_ESTIMATES) == (pytest.approx(EAST_M), pytest.approx(-NORTH_M))
    assert made.errors_m(OURS) == made.errors_m(SERVED) == (pytest.approx(0.0), pytest.approx(0.0))
    assert wrong(made, OURS, true) < 1.0 < 5.0 < wrong(made, PAPERS, true)


@pytest.mark.slow
def test_the_server_takes_errors_off_about_as_well_as_the_truth(made: MadeMaps, scene):
    _, true = scene
    sent, served, best = (wrong(made, kind, true) for kind in (AS_SENT, SERVED, AS_TRUE))
    assert served < sent / 2
    assert served < best + 1.0


def test_the_newest_of_all_machines_is_written_last(scene):
    rows, true = scene
    first, second = rows["a"][:50].copy(), rows["a"][:50].copy()
    second["stamp_ns"] += 1
    first["c_rr"], second["c_rr"] = 0.02, 0.25
    for named in ({"a": first, "b": second}, {"a": second, "b": first}):
        values = plotted(named, true.truth)["resistance"]
        assert np.unique(values[np.isfinite(values)]) == pytest.approx([0.25])
