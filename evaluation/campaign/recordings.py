"""Recordings of one machine on one route each, kept so that every configuration sees the same."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.positions.replay import Truth, read_track
from protocol.machine.log_folder import open_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from protocol.site.site_config import SiteConfig
from sim.config import SimConfig
from sim.recorder import record
from sim.scenario.file import load_scenario
from sim.scenario.tables import FleetConfig, Scenario
from sim.sensors.presets import load_preset

ROOT = Path(__file__).parents[2]
MACHINE = "loader"


@dataclass(frozen=True)
class Setup:
    """What all drives of an experiment share: a scenario, routes that take turns with the seeds, and sensors.

    Everything else of the machine is as the scenario's first fleet has it. world: over the scenario's.
    """

    scenario: str
    routes: tuple[str, ...]
    gps: tuple[int, ...]
    imu: tuple[int, ...]
    attitude: tuple[int, ...] = ()
    world: str | None = None


# IMUs 3 and 4 sit under the rear frame, which is `base_link`, 1 under the front one.
PAPER = Setup("paper_site", ("west", "east", "middle"), gps=(1, 2, 3), imu=(3, 4, 1), attitude=(3, 4, 1))


@dataclass(frozen=True)
class Drive:
    """What is recorded: one machine on one route."""

    seed: int
    seconds: float
    preset: str = "paper"
    setup: Setup = PAPER

    @property
    def tour(self) -> str:
        """Name of the route."""
        return self.setup.routes[self.seed % len(self.setup.routes)]

    @property
    def fleet(self) -> FleetConfig:
        """The machine, its route and sensors."""
        s = self.setup
        first = replace(_scenario(s.scenario).fleet[0], name=MACHINE, count=None, other_way=False)
        return replace(first, routes=(self.tour,), preset=self.preset, gps=s.gps, imu=s.imu, attitude=s.attitude)

    @property
    def scenario_toml(self) -> str:
        """The scenario file of this drive."""
        setup = self.setup
        top = {"base": setup.scenario, "world": setup.world}
        return f"{_toml(top)}\n\n[[fleet]]\n{_toml(vars(self.fleet))}\n"

    @property
    def scenario(self) -> Scenario:
        """The scenario of this drive; its ground is what an evaluation may know."""
        alone = replace(_scenario(self.setup.scenario), fleet=(self.fleet,), fault=(), names=())
        return replace(alone, world=self.setup.world or alone.world, seed=self.seed, seconds=self.seconds)

    @property
    def machine(self) -> MachineConfig:
        """What an agent may know of the machine."""
        return self.scenario.rigs()[0].machine

    def folder(self, cache_dir: Path) -> Path:
        """Where the recording lies; another simulator, another folder."""
        key = digest(repr(self), self.scenario_toml, code_version("sim", "protocol"))
        return cache_dir / f"{self.preset}-seed{self.seed}-{self.seconds:g}s-{key}"


@dataclass(frozen=True)
class Recording:
    """A recording in memory: what the agent may know and read, and the truth."""

    site: SiteConfig
    machine: MachineConfig
    readings: tuple[Reading, ...]
    truth: Truth
    start: tuple[float, float, float]  # where it begins: x, y [m], heading [rad]


def make(drive: Drive, cache_dir: Path) -> Path:
    """Record a drive unless that has been done; returns its folder, which is whole or not there."""
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


def load(folder: Path) -> Recording:
    """Read what `make` wrote, all sensors of it."""
    log = open_log(folder / "logs" / MACHINE)
    track = track_file(folder)
    first = np.genfromtxt(track, delimiter=",", names=True, max_rows=1)
    start = (float(first["x"]), float(first["y"]), float(first["yaw"]))
    return Recording(log.site, log.machine, tuple(log.readings()), read_track(track), start)


def track_file(folder: Path) -> Path:
    """Where a recording keeps the machine's true way."""
    return folder / "truth" / "tracks" / f"{MACHINE}.csv"


def gps_error(preset: str) -> dict[str, Any]:
    """How slow the GPS errors of a preset are: on white noise every filter looks wonderful."""
    gps = load_preset(preset).gps
    slow, white = gps.drift_std_m**2, gps.white_std_m**2
    return {
        "preset": preset,
        "rms_2d_m": round((2 * (slow + white)) ** 0.5 * gps.scale, 3),
        "slow_variance_share": round(slow / (slow + white), 3),
        "correlation_time_s": gps.drift_time_s,
        "rate_hz": gps.rate_hz,
        "shared": gps.shared,
        "outage_s": gps.outage_s,
        "outage_period_s": gps.outage_period_s,
    }


@cache
def code_version(*names: str) -> str:
    """Hash of the sources of packages or modules, as paths from the project's root."""
    files = sorted(path for name in names for path in _sources(ROOT / name))
    return digest(*(f"{path.relative_to(ROOT)}\n{path.read_text(encoding='utf-8')}" for path in files))


def digest(*texts: str) -> str:
    """Ten hex digits that tell texts apart."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:10]


@cache
def _scenario(name: str) -> Scenario:
    return load_scenario(name)


def _toml(values: Mapping[str, Any]) -> str:
    """Plain values as TOML keys, those that are None left out."""
    return "\n".join(f"{name} = {json.dumps(value)}" for name, value in values.items() if value is not None)


def _sources(path: Path) -> Iterable[Path]:
    if path.is_file():
        return [path]
    return (p for p in path.rglob("*") if p.suffix in (".py", ".toml", ".urdf"))
