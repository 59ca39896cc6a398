"""A base's receiver stands still, and shares the site's part of the errors with the machines, and no other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.config import load_agent
from protocol.machine.readings import Gps
from protocol.site.site_config import Projection
from sim.config import SimConfig, resolve, write_configs
from sim.scenario.file import load_scenario
from sim.simulator import Simulator


def fixes(seed: int = 3, seconds: float = 60.0) -> tuple[list[Gps], Simulator]:
    simulator = Simulator(SimConfig(scenario="base_station", machines=1, seed=seed, seconds=seconds, world="fast"))
    made = [r for _ in range(simulator.bundles or 0) for r in simulator.advance()["base-1"]]
    assert all(isinstance(r, Gps) for r in made)
    return made, simulator  # type: ignore[return-value]


@pytest.mark.slow
def test_base_stands_still_and_errs_as_its_preset_says() -> None:
    made, simulator = fixes()
    projection, (station,) = Projection(simulator.site), simulator.scenario.base_station
    off = np.array([projection.to_map(r.lat_deg, r.lon_deg, r.height_m)[:2] for r in made]) - station.place_m
    noise = simulator.scenario.preset(station.preset).gps
    assert np.sqrt((off**2).mean()) < 3 * noise.scale * np.hypot(noise.drift_std_m, noise.white_std_m)
    assert np.std(np.diff(off, axis=0)) == pytest.approx(noise.scale * noise.white_std_m * np.sqrt(2), rel=0.3)
    assert len(made) == pytest.approx(60 * noise.rate_hz * 0.9, abs=6)  # silent for 1 s in 10
    assert [r.stamp_ns for r in made] == sorted({r.stamp_ns for r in made})


@pytest.mark.slow
def test_machines_read_the_same_beside_a_base(tmp_path: Path) -> None:
    def readings(scenario: str) -> list:
        simulator = Simulator(SimConfig(scenario=scenario, machines=1, seed=3, seconds=5.0, world="fast"))
        return [
            r
            for _ in range(simulator.bundles or 0)
            for name, rs in simulator.advance().items()
            if name != "base-1"
            for r in rs
        ]

    text = (Path(__file__).parents[4] / "sim" / "scenario" / "base_station.toml").read_text(encoding="utf-8")
    start, end = text.index("[[base_station]]"), text.index("[[fleet]]")
    (tmp_path / "alone.toml").write_text(text[:start] + text[end:], encoding="utf-8")
    assert readings("base_station") == readings(str(tmp_path / "alone.toml"))


def test_agents_get_a_base_with_its_place_and_machines_that_name_it(tmp_path: Path) -> None:
    config = SimConfig(scenario="base_station", machines=2)
    machines = write_configs(config, tmp_path)
    assert [path.stem for path in machines] == ["loader-1", "loader-2"]
    for path in machines:
        machine, options = load_agent(path)
        assert machine
        assert machine.base
        assert (machine.base.name, options.role) == ("base-1", "machine")
    base, options = load_agent(tmp_path / "base-1.toml")
    assert base
    assert (base.name, options.role, [s.kind for s in base.sensors]) == ("base-1", "base", ["gps"])
    scenario = resolve(config)
    x, y, _ = Projection(scenario.site).to_map(*options.place, 0.0)  # type: ignore[call-arg]
    assert (x, y) == pytest.approx(scenario.base_station[0].place_m, abs=1e-3)


def test_survey_that_is_off_is_what_the_agent_is_given(tmp_path: Path) -> None:
    scenario = load_scenario("base_station")
    (station,) = scenario.base_station
    assert replace(station, survey_off_m=(3.0, -4.0)).surveyed_m == (63.0, 56.0)
    for wrong in ({"place_m": (float("nan"), 0.0)}, {"survey_off_m": (500.0, 0.0)}, {"name": "Base 1"}):
        with pytest.raises(ValueError, match=r"base|survey_off_m|name"):
            replace(station, **wrong)
    with pytest.raises(ValueError, match="two machine or base stations are named 'loader-1'"):
        replace(scenario, base_station=(replace(station, name="loader-1"),))
