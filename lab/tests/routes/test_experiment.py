"""Figures of routes on data whose result is known; maps of ways that are drawn from a seed."""

import numpy as np
import pytest

from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.routes import experiment, ways
from lab.routes.legs import seed_figures
from lab.routes.maps import true_squares
from mapserver.routes.route import route
from protocol.units import GRAVITY_MPS2
from sim.truth import TruthMap

LEG = {
    "length_m": 500.0,
    "energy": 0.03,
    "time": -0.01,
    "model": 0.02,
    "steady": -0.1,
    "map": 0.01,
    "back": -0.04,
    "energy_inside": 1.0,
    "time_inside": 0.0,
    "back_inside": 1.0,
    "width": 0.2,
    "drive": 0.0,
}


def test_figures_of_a_seed_and_of_all():
    seed = seed_figures([LEG, {**LEG, "energy": -0.04, "energy_inside": 0.0}])
    other = {**LEG, "drive": 1.0}
    three = seed_figures([LEG, {**LEG, "energy_inside": 0.0}, other])
    assert (three["drives"], three["drives_inside_pct"], seed["drives"]) == (2, 75.0, 1)
    assert seed["energy_pct"] == pytest.approx(100 * np.sqrt((0.03**2 + 0.04**2) / 2))
    assert (seed["energy_mean_pct"], seed["energy_worst_pct"]) == (pytest.approx(-0.5), pytest.approx(4.0))
    assert (seed["energy_inside_pct"], seed["legs"], seed["km"]) == (50.0, 2, 1.0)
    row = experiment.row_of("haul_road", [seed, {**seed, "back_pct": 9.0}, seed])
    assert (row["legs"], row["back_pct"], row["max_back_pct"]) == (6, 4.0, 9.0)
    met = {(goal["name"], goal["met"]) for goal in judge(goals("routes")[:6], [row])}
    assert met == {
        ("energy_pct", True),
        ("max_energy_pct", True),
        ("back_pct", True),
        ("max_back_pct", False),
        ("time_pct", True),
        ("max_time_pct", True),
    }


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
