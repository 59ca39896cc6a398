"""Figures of roads on data whose result is known, and recordings that can be loaded."""

import numpy as np
import pytest
from scipy.stats import kendalltau

from evaluation.campaign.figures import judge
from evaluation.roads import experiment
from evaluation.roads.drives import BAD, planned
from evaluation.roads.score import kendall
from sim.scenario.file import load_scenario


def test_tau_without_ties_is_that_of_the_library():
    draw = np.random.default_rng(3)
    one = draw.random(40)
    other = one + draw.normal(0, 0.3, 40)
    assert kendall(one, other, 0.0, 0.0) == pytest.approx(kendalltau(one, other).statistic)


def test_tau_with_ties_on_both_sides():
    right = np.array([10.0, 9.9, 5.0, 5.1, 0.0, 0.1])
    assert kendall(right, right[[1, 0, 3, 2, 5, 4]], 0.5, 0.5) == 1.0
    assert kendall(right, -right, 0.5, 0.5) == -1.0
    assert kendall(np.zeros(3), np.arange(3.0), 0.5, 0.5) == 0.0


@pytest.mark.parametrize("scenario", ["haul_road", "paper_site"])
def test_patches_are_drawn_from_the_seed(tmp_path, scenario):
    drives = [planned(scenario, seed, 90.0, repairs=True) for seed in (3, 3, 4)]
    texts = [drive.scenario_toml for drive in drives]
    assert texts[0] == texts[1] != texts[2]
    file = tmp_path / "scenario.toml"
    file.write_text(texts[0])
    made, plain = load_scenario(str(file)), load_scenario(scenario)
    assert len(made.ground.zone) > len(plain.ground.zone) + 5
    assert (made.ground.ramp, made.route, made.fleet) == (plain.ground.ramp, plain.route, plain.fleet)
    bad = {zone.outline for zone in made.ground.zone if zone.soil in BAD}
    assert made.change
    assert all(change.at_s == 45.0 and change.outline in bad for change in made.change)
    assert "change" not in planned(scenario, 3, 90.0).scenario_toml


def test_rows_sum_repairs_and_take_medians_of_the_rest():
    seed = {
        "repairs": 4,
        "seen_2": 3,
        "seen_3": 4,
        "looks": 100,
        "false_alarms": 0,
        "saved_j": 9.0,
        "true_saved_j": 10.0,
    }
    row = experiment.summarise(experiment.CASES[3], [seed, {**seed, "seen_2": 1, "false_alarms": 1}])
    assert (row["repairs"], row["seen_2_pct"], row["seen_3_pct"]) == (8, 50.0, 100.0)
    assert (row["false_per_1000"], row["saved_pct"]) == (5.0, -10.0)
    plain = experiment.summarise(experiment.CASES[0], [{"c_pct": 3.0}, {"c_pct": 9.0}, {"c_pct": 4.0}])
    assert plain["c_pct"] == 4.0
    assert len(plain["by_seed"]) == 3
    assert judge(experiment.GOALS[:1], [plain])[0]["met"]
