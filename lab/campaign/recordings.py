"""Recordings of one machine on one route, cached so that all configurations see the same.

Names digest the code and options that made them.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lab.campaign.code import code_version, digest
from protocol.machine.log_folder import open_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from protocol.site.site_config import SiteConfig
from sim.config import SimConfig
from sim.recorder import record
from sim.scenario.file import load_scenario
from sim.scenario.tables import FleetConfig, Scenario
from sitegrid.proof.tracks import Truth, read_track

MACHINE = "loader"
_scenario = cache(load_scenario)
RECORDER = "sim.recorder"  # code that recordings depend on


@dataclass(frozen=True)
class Setup:
    """Common to an experiment's drives: scenario, routes in turn by seed, sensors.

    The machine is otherwise the first of the scenario's first fleet. world: overrides the scenario's. preset: default
    of drives.
    """

    scenario: str
    routes: tuple[str, ...]
    gps: tuple[int, ...]
    imu: tuple[int, ...]
    attitude: tuple[int, ...] = ()
    world: str | None = None
    preset: str = "paper"


# IMUs 3 and 4 are on the rear frame, `base_link`; 1 is on the front frame.
PAPER = Setup("paper_site", ("west", "east", "middle"), gps=(1, 2, 3), imu=(3, 4, 1), attitude=(3, 4, 1))
DRIVEN = replace(PAPER, scenario="paper_site_driven", preset="paper_shared")
HAUL_ROAD = replace(PAPER, scenario="haul_road_driven", routes=("haul",), preset="dgps_shared")
SETUPS = {setup.scenario: setup for setup in (PAPER, DRIVEN, HAUL_ROAD)}


@dataclass(frozen=True)
class PlannedDrive:
    """A recording to make: one machine on one route."""

    seed: int
    seconds: float
    preset: str = "paper"
    setup: Setup = PAPER

    @property
    def tour(self) -> str:
        """Route name."""
        return self.setup.routes[self.seed % len(self.setup.routes)]

    @property
    def fleet(self) -> FleetConfig:
        """Machine, route and sensors."""
        s = self.setup
        first = replace(_scenario(s.scenario).fleet[0], name=MACHINE, count=None, other_way=False)
        return replace(first, routes=(self.tour,), preset=self.preset, gps=s.gps, imu=s.imu, attitude=s.attitude)

    @property
    def scenario_toml(self) -> str:
        """Scenario file."""
        setup = self.setup
        top = {"base": setup.scenario, "world": setup.world}
        return f"{toml_of(top)}\n\n[[fleet]]\n{toml_of(vars(self.fleet))}\n"

    @property
    def scenario(self) -> Scenario:
        """Scenario; its ground is for evaluation only."""
        alone = replace(_scenario(self.setup.scenario), fleet=(self.fleet,), fault=(), names=())
        return replace(alone, world=self.setup.world or alone.world, seed=self.seed, seconds=self.seconds)

    @property
    def machine(self) -> MachineConfig:
        """What an agent may know of the machine."""
        return self.scenario.rigs()[0].machine

    def folder(self, cache_dir: Path) -> Path:
        """Recording folder; differs by simulator code."""
        key = digest(repr(self), self.scenario_toml, code_version(RECORDER))
        return cache_dir / f"{self.preset}-seed{self.seed}-{self.seconds:g}s-{key}"


@dataclass(frozen=True)
class RecordedDrive:
    """A recording in memory: what the agent may know and read, and the truth."""

    site: SiteConfig
    machine: MachineConfig
    readings: tuple[Reading, ...]
    truth: Truth
    start: tuple[float, float, float]  # x, y [m], heading [rad]


def make(drive: PlannedDrive, cache_dir: Path) -> Path:
    """Record a drive unless done; returns its folder, complete or missing."""
    folder = drive.folder(cache_dir)
    if folder.exists():
        return folder
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    scenario = part / "scenario.toml"
    scenario.write_text(drive.scenario_toml, encoding="utf-8")
    config = SimConfig(scenario=str(scenario), seed=drive.seed, seconds=drive.seconds)
    record(config, part / "logs", part / "truth")
    part.rename(folder)
    return folder


@lru_cache(maxsize=1)  # tasks are grouped by recording
def load(folder: Path) -> RecordedDrive:
    """Read what `make` wrote, with all sensors."""
    log = open_log(folder / "logs" / MACHINE)
    track = track_file(folder)
    first = np.genfromtxt(track, delimiter=",", names=True, max_rows=1)
    start = (float(first["x"]), float(first["y"]), float(first["yaw"]))
    return RecordedDrive(log.site, log.machine, tuple(log.readings()), read_track(track), start)


def track_file(folder: Path) -> Path:
    """The machine's true track in a recording."""
    return folder / "truth" / "tracks" / f"{MACHINE}.csv"


def toml_of(values: Mapping[str, Any]) -> str:
    """Plain values as TOML keys, without None."""
    return "\n".join(f"{name} = {json.dumps(value)}" for name, value in values.items() if value is not None)
