"""Options of a simulation run (`config/sim.toml`), and the configuration files for its agents."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from agents.drivers.can.buses import split_bus
from protocol.config import from_table, require_between
from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.machine.machine_config import machine_toml
from protocol.site.site_config import NAME, site_toml
from sim.can.live import address_of, bus_toml
from sim.can.node import SIGNALS
from sim.receivers.ports import driver_toml
from sim.receivers.receiver import WRITERS, wire
from sim.scenario.file import check, load_scenario
from sim.scenario.tables import MAX_MACHINES, FleetConfig, Scenario

T = TypeVar("T", FleetConfig, Scenario)
log = logging.getLogger("sim.config")


@dataclass(frozen=True)
class SimConfig:
    """A scenario, this run's changes to it, and the pace. None: as in the scenario.

    scenario: name in `sim/scenario/`, or path of a TOML file. machines: in the first fleet. names: of all machines.
    seconds: 0: endless. preset, drive_mps, gps, imu, attitude, payload: for every fleet. speed: multiple of real time,
    0: as fast as possible. receivers: protocol on the ports, `ubx` or `nmea`; empty: readings travel in bundles. can:
    bus of the first machine (`virtual://site`, `can0`), the others count on; empty: drive trains in bundles, or on the
    scenario's buses.
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
    receivers: str = ""
    can: str = ""

    def __post_init__(self) -> None:
        require_between(self, 0, 1000, "speed")
        require_between(self, 1, MAX_MACHINES, "machines")
        if self.receivers not in ("", *WRITERS):
            raise ValueError(f"receivers: {self.receivers!r} is none of {', '.join(WRITERS)}")
        if self.receivers and self.speed != 1:
            raise ValueError(f"speed: receivers state the time, so with them it is 1, not {self.speed:g}")
        if self.can:
            split_bus(self.can)
        if self.can and not self.receivers:
            raise ValueError("can: a bus states no time, so receivers must: set `receivers` (--ports)")
        for name in (self.site, *(self.names or ())):
            if name is not None and not NAME.fullmatch(name):
                raise ValueError(f"site, names: {name!r} is not a name (lower-case letters, digits, - and _)")


def load_sim(path: Path) -> SimConfig:
    """Read a `sim.toml`."""
    return from_table(SimConfig, load_toml(path), str(path))


def resolve(config: SimConfig) -> Scenario:
    """The scenario with the run's options; ConfigError where they do not fit."""
    scenario = load_scenario(config.scenario)
    where = f"scenario {config.scenario}"
    names = ("preset", "drive_mps", "gps", "imu", "attitude", "payload")
    said = {"doppler": config.receivers, "can": config.can}
    given = _given(config, *names) | {name: True for name, value in said.items() if value}
    fleets = tuple(_replace(fleet, where, **given) for fleet in scenario.fleet)
    if config.machines is not None:
        fleets = (_replace(fleets[0], where, count=config.machines), *fleets[1:])
    count = sum(fleet.size for fleet in fleets)
    if config.names is not None and len(config.names) != count:
        raise ConfigError(where, f"names: {len(config.names)} names for {count} machines")
    site = scenario.site if config.site is None else replace(scenario.site, name=config.site)
    options = _given(config, "seed", "seconds", "names") | {"world": _world(config.world, scenario)}
    scenario = _replace(scenario, where, fleet=fleets, site=site, **options)
    check(scenario, where)
    return scenario


def write_configs(config: SimConfig, folder: Path, ports: Path | None = None) -> list[Path]:
    """Write `site.toml` and the agents' `<machine>.toml`, without the truth; returns the machines' files.

    ports: folder of the receivers' ports.
    """
    scenario = resolve(config)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "site.toml").write_text(site_toml(scenario.site), encoding="utf-8")
    paths = []
    for index, rig in enumerate(scenario.rigs()):
        path, wirings = folder / f"{rig.machine.name}.toml", wire(rig, config.receivers) if ports else []
        added = tuple(sensor for wiring in wirings for sensor in wiring.added)
        text = machine_toml(replace(rig.machine, sensors=(*rig.machine.sensors, *added)))
        text += driver_toml(ports, wirings, rig) if ports else ""
        text += bus_toml(address_of(config.can, index), rig.feeds, SIGNALS) if config.can else ""
        path.write_text(text, encoding="utf-8")
        paths.append(path)
    return paths


def _world(asked: str | None, scenario: Scenario) -> str:
    if asked or scenario.world == "fast" or find_spec("pybullet"):
        return asked or scenario.world
    log.warning("the fast world takes the place of PyBullet, which has wheels for Python 3.11 on x86-64 alone")
    return "fast"


def _given(config: SimConfig, *names: str) -> dict[str, Any]:
    return {name: value for name in names if (value := getattr(config, name)) is not None}


def _replace(old: T, where: str, **values: Any) -> T:
    try:
        return replace(old, **values)
    except ValueError as error:
        raise ConfigError(where, str(error)) from None
