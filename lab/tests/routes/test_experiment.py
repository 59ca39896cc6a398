"""Figures of routes with known results; drawn maps for ways."""

import numpy as np
import pytest

from lab.routes import ways
from lab.routes.maps import true_squares
from mapserver.routes.route import route
from protocol.units import GRAVITY_MPS2
from sim.truth import TruthMap


@pytest.mark.slow
def test_ways_on_few_drawn_maps(monkeypatch):
    monkeypatch.setattr(ways, "MAPS", dict.fromkeys(ways.MAPS, 2))
    rows = {row["case"]: row for row in ways.rows(3)}
    assert ways.rows(3) == list(rows.values())
    assert rows["way_even"]["over_worst_pct"] == pytest.approx(0, abs=1e-6)
    assert rows["way_random"]["over_worst_pct"] < 2
    assert rows["way_random"]["back_median_pct"] > 1
    assert rows["way_sand"]["of_straight_median_pct"] < 100
    assert rows["way_unknown"]["maps"] == 2


def test_the_true_map_costs_what_it_must():
    flat = np.zeros((30, 50), np.float32)
    truth = TruthMap(0.0, 0.0, flat + 0.04, flat + 0.01, flat)
    _, totals = route(np.array([[5.0, 10.0], [45.0, 10.0]]), true_squares(truth), ways.SLOW, stops=(False, False))
    assert totals.energy_j == pytest.approx(ways.SLOW.mass_kg * GRAVITY_MPS2 * 0.05 * 40, rel=1e-5)
    assert totals.energy_high_j - totals.energy_low_j < 0.15 * totals.energy_j  # of drives, and of maps at their best
    with pytest.raises(ValueError, match="begins at the origin"):
        true_squares(TruthMap(1.0, 0.0, flat, flat, flat))
