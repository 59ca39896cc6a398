"""Figures of roads with known results, and loadable recordings."""

import numpy as np
import pytest
from scipy.stats import kendalltau

from lab.campaign.goals import goals
from lab.roads import experiment
from lab.roads.drives import BAD, planned
from lab.roads.score import Recorded, kendall, kept_after, roads
from sim.scenario.file import load_scenario
from tests.unit.mapserver.roads.drives import along, passes


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


def test_names_are_those_of_the_day_before_where_the_same_roads_are_driven():
    line, elsewhere = along([(10, 10), (210, 60)]), along([(10, 300), (210, 330)])

    def recorded(place, seed):
        return Recorded({"a": passes(place, 4, seed=seed)}, {}, 0, 1)

    first = recorded(line, 1)
    whole = roads(first.rows)
    assert kept_after(first, recorded(line, 2), whole) > 95
    assert kept_after(first, recorded(elsewhere, 2), whole) == 100.0
    assert first.rows["a"]["stamp_ns"].max() < 1_770_000_000 * 10**9  # nothing was modified in place


def test_a_day_after_is_judged_with_the_next_seed_and_what_is_judged_is_kept(tmp_path, monkeypatch):
    """Tasks only, without recordings and agents."""
    asked = []

    class Runner:
        cache = tmp_path

        def run(self, what, tasks):
            asked.extend((what.name, task.variant.name, task.seed, getattr(task.variant, "other", 0)) for task in tasks)
            return [experiment.Judged({"c_pct": 1.0}) for _ in tasks]

    monkeypatch.setattr(experiment, "goals", lambda _: goals("roads")[:1])
    report, _ = experiment.run(Runner(), [4, 5, 6], 90.0, experiment.CASES[:1])
    assert [each for each in asked if each[0] == "roads"] == [
        ("roads", "haul_road", 4, 5),
        ("roads", "haul_road", 5, 6),
        ("roads", "haul_road", 6, 4),
    ]
    assert report["rows"][0]["c_pct"] == 1.0
    tasks = [
        experiment.replay_task(experiment.Judging(experiment.CASES[0], 90.0, other), planned("haul_road", 4, 90.0))
        for other in (5, None)
    ]
    names = {experiment.EXPERIMENT.file(task, tmp_path).name for task in tasks}
    assert len(names) == 2
