"""What is recorded of fleets on buses."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.can.experiment import CASES
from sim.scenario.file import load_scenario
from sim.scenario.tables import Scenario

SECONDS = 60.0


def scenario(name: str, tmp_path: Path) -> Scenario:
    case = next(case for case in CASES if case.name == name)
    path = tmp_path / f"{name}.toml"
    path.write_text(case.drive(3, SECONDS).scenario_toml, encoding="utf-8")
    return load_scenario(str(path))


@pytest.mark.parametrize("kind", ["trucks", "loaders"])
def test_wheels_and_bus_differ_in_nothing_but_how_torque_and_speed_are_read(kind: str, tmp_path: Path) -> None:
    wheels, bus = scenario(f"{kind}_wheels", tmp_path), scenario(f"{kind}_bus", tmp_path)
    assert (wheels.ground, wheels.route, wheels.world) == (bus.ground, bus.route, "fast")
    for plain, on_bus in zip(wheels.rigs(), bus.rigs(), strict=True):
        kinds = [{sensor.kind for sensor in rig.machine.sensors} for rig in (plain, on_bus)]
        assert kinds[0] - kinds[1] == {"torque", "encoder"}
        assert {"engine", "fuel_rate", "odometry"} <= kinds[1] - kinds[0]


def test_one_truck_of_several_states_a_wrong_reference_torque(tmp_path: Path) -> None:
    faults = [rig.faults.torque_scale for rig in scenario("trucks_reference", tmp_path).rigs()]
    assert sorted(faults) == [1.0] * (len(faults) - 1) + [1.1]


def test_agents_that_are_blind_for_a_pump_hear_the_same_recording(tmp_path: Path) -> None:
    known, blind = (
        {case.name: case for case in CASES}[name].drive(3, SECONDS) for name in ("loaders_bus", "loaders_blind")
    )
    assert known.folder(tmp_path) == blind.folder(tmp_path)
    assert known.agent(0).name != blind.agent(0).name
