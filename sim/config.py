"""Options of a simulation run, as `config/sim.toml` describes them: a scenario, what differs from it, and the pace."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.site.site_config import NAME
from sim.scenario.file import check, load_scenario
from sim.scenario.tables import MAX_MACHINES, FleetConfig, Scenario

T = TypeVar("T", FleetConfig, Scenario)


@dataclass(frozen=True)
class SimConfig:
    """What is simulated, and how fast. Options that are None are as the scenario says.

    scenario: a name of `sim/scenario/`, or the path of a TOML file. machines: of the scenario's first fleet. names: of
    all machines. seconds: simulated time, 0 runs until stopped. preset, drive_mps, gps, imu, attitude, payload: of
    every fleet. speed: times real time, 0 as fast as possible.
    """

    scenario: str = "paper_site"
    site: str | None = None
    world: str | None = None
    machines: int | None = None
    names: tuple[str, ...] | None = None
    seed: int | None = None
    seconds: float | None = None
    preset: str | None = None
    drive_mps: float | None = None
    gps: tuple[int, ...] | None = None
    imu: tuple[int, ...] | None = None
    attitude: tuple[int, ...] | None = None
    payload: bool | None = None
    speed: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.speed <= 1000:  # also false for NaN
            raise ValueError(f"speed: {self.speed!r} is not between 0 and 1000")
        if self.machines is not None and not 1 <= self.machines <= MAX_MACHINES:
            raise ValueError(f"machines: {self.machines} is not between 1 and {MAX_MACHINES}")
        for name in (*([self.site] if self.site is not None else []), *(self.names or ())):
            if not NAME.fullmatch(name):
                raise ValueError(f"site, names: {name!r} is not a name (lower-case letters, digits, - and _)")


def load_sim(path: Path) -> SimConfig:
    """Read a `sim.toml`."""
    return from_table(SimConfig, load_toml(path), str(path))


def resolve(config: SimConfig) -> Scenario:
    """The scenario with the options of this run; a ConfigError says what does not fit."""
    scenario = load_scenario(config.scenario)
    where = f"scenario {config.scenario}"
    over = {name: getattr(config, name) for name in ("world", "seed", "seconds", "names")}
    fleets = tuple(_fleet(fleet, config) for fleet in scenario.fleet)
    if config.machines is not None:
        fleets = (_replace(fleets[0], where, count=config.machines), *fleets[1:])
    count = sum(fleet.size for fleet in fleets)
    if config.names is not None and len(config.names) != count:
        raise ConfigError(where, f"names: {len(config.names)} names for {count} machines")
    site = scenario.site if config.site is None else replace(scenario.site, name=config.site)
    kept = {name: value for name, value in over.items() if value is not None}
    scenario = _replace(scenario, where, fleet=fleets, site=site, **kept)
    check(scenario, where)
    return scenario


def _fleet(fleet: FleetConfig, config: SimConfig) -> FleetConfig:
    over = {name: getattr(config, name) for name in ("preset", "drive_mps", "gps", "imu", "attitude", "payload")}
    kept = {name: value for name, value in over.items() if value is not None}
    return _replace(fleet, f"scenario {config.scenario}", **kept)


def _replace(old: T, where: str, **values: Any) -> T:
    try:
        return replace(old, **values)
    except ValueError as error:
        raise ConfigError(where, str(error)) from None
