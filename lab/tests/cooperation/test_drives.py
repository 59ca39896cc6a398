"""Drives: tours in turn by one machine, or at once by several."""

from pathlib import Path

import pytest

from lab.cooperation.drives import EIGHT, FOUR, MIXED, ONE, REPAVED, TOURS, TWO, length_m, planned
from sim.config import SimConfig, resolve


@pytest.mark.parametrize("crews", [ONE, TWO, FOUR, EIGHT, MIXED])
def test_every_crew_can_drive_its_tours(crews, tmp_path: Path):
    drive = planned(3, 100.0, crews, "fast", repaves=True)
    path = tmp_path / "scenario.toml"
    path.write_text(drive.scenario_toml)
    scenario = resolve(SimConfig(scenario=str(path), seed=3, seconds=100.0))
    assert scenario.machine_names == drive.machines
    assert scenario.world == "fast"
    assert [change.at_s for change in scenario.change] == [50.0] * len(REPAVED)


def test_a_lone_machine_drives_what_all_others_would_and_no_more():
    alone = length_m(tuple(TOURS))
    assert alone == pytest.approx(sum(length_m((name,)) for name in TOURS), rel=0.001)
    (whole,) = planned(0, 1.0, ONE, None).tours.values()
    assert whole == tuple(TOURS)
    halves = planned(0, 1.0, TWO, None).tours.values()
    assert sorted(name for half in halves for name in half) == sorted(TOURS)
