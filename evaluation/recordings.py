"""Recordings of the paper's site, one machine on one tour each, kept so that every configuration sees the same."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.replay import Truth, read_track
from protocol.logfolder import open_log
from protocol.machine import MachineConfig
from protocol.readings import Reading
from protocol.site import SiteConfig
from sim.config import SimConfig, resolve
from sim.presets import load_preset
from sim.recorder import record

ROOT = Path(__file__).parents[1]
SCENARIO, MACHINE = "paper_site", "loader"
TOURS = ("west", "east", "middle")
GPS, IMU = (1, 2, 3), (3, 4, 1)  # IMUs 3 and 4 sit under the rear frame, which is `base_link`, 1 under the front one
FLEET = """base = "{scenario}"

[[fleet]]
name = "{machine}"
routes = ["{tour}"]
preset = "{preset}"
gps = {gps}
imu = {imu}
attitude = {imu}
"""


@dataclass(frozen=True)
class Drive:
    """What is recorded: one machine with all sensors on one tour; tours take turns with the seeds."""

    seed: int
    seconds: float
    preset: str = "paper"

    @property
    def tour(self) -> str:
        """Name of the route."""
        return TOURS[self.seed % len(TOURS)]

    @property
    def scenario_toml(self) -> str:
        """The scenario file of this drive."""
        tour, preset = self.tour, self.preset
        return FLEET.format(scenario=SCENARIO, machine=MACHINE, tour=tour, preset=preset, gps=list(GPS), imu=list(IMU))

    @property
    def machine(self) -> MachineConfig:
        """What an agent may know of the machine."""
        every = SimConfig(SCENARIO, machines=1, names=(MACHINE,), preset=self.preset, gps=GPS, imu=IMU, attitude=IMU)
        return resolve(every).rigs()[0].machine

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
    track = folder / "truth" / "tracks" / f"{MACHINE}.csv"
    first = np.genfromtxt(track, delimiter=",", names=True, max_rows=1)
    start = (float(first["x"]), float(first["y"]), float(first["yaw"]))
    return Recording(log.site, log.machine, tuple(log.readings()), read_track(track), start)


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


def _sources(path: Path) -> Iterable[Path]:
    if path.is_file():
        return [path]
    return (p for p in path.rglob("*") if p.suffix in (".py", ".toml", ".urdf"))
