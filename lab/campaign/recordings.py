"""Recordings of one machine on one route each, kept so that every configuration sees the same.

What is kept is named by digests of the code and the options that it was made with.
"""

from __future__ import annotations

import ast
import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

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
ROOT = Path(__file__).parents[2]
SUFFIXES = (".py", ".toml", ".urdf")  # of sources
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
# Of the protocol, what machines and their simulation know: a change of the map's queries leaves recordings as they are.
MACHINES_PROTOCOL = (
    *(f"protocol/{folder}" for folder in ("machine", "site", "wire")),
    *(f"protocol/{module}.py" for module in ("arrays", "config", "errors", "files", "rotations", "units")),
)


@dataclass(frozen=True)
class Setup:
    """What all drives of an experiment share: a scenario, routes that take turns with the seeds, and sensors.

    Everything else of the machine is as the scenario's first fleet has it. world: over the scenario's. preset: of a
    drive where its experiment names no other.
    """

    scenario: str
    routes: tuple[str, ...]
    gps: tuple[int, ...]
    imu: tuple[int, ...]
    attitude: tuple[int, ...] = ()
    world: str | None = None
    preset: str = "paper"


# IMUs 3 and 4 sit under the rear frame, which is `base_link`, 1 under the front one.
PAPER = Setup("paper_site", ("west", "east", "middle"), gps=(1, 2, 3), imu=(3, 4, 1), attitude=(3, 4, 1))
DRIVEN = replace(PAPER, scenario="paper_site_driven", preset="paper_shared")
HAUL_ROAD = replace(PAPER, scenario="haul_road_driven", routes=("haul",), preset="dgps_shared")
SETUPS = {setup.scenario: setup for setup in (PAPER, DRIVEN, HAUL_ROAD)}


@dataclass(frozen=True)
class PlannedDrive:
    """What is to be recorded: one machine on one route."""

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
        return f"{toml_of(top)}\n\n[[fleet]]\n{toml_of(vars(self.fleet))}\n"

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
        key = digest(repr(self), self.scenario_toml, code_version("sim", *MACHINES_PROTOCOL))
        return cache_dir / f"{self.preset}-seed{self.seed}-{self.seconds:g}s-{key}"


@dataclass(frozen=True)
class RecordedDrive:
    """A recording in memory: what the agent may know and read, and the truth."""

    site: SiteConfig
    machine: MachineConfig
    readings: tuple[Reading, ...]
    truth: Truth
    start: tuple[float, float, float]  # where it begins: x, y [m], heading [rad]


def make(drive: PlannedDrive, cache_dir: Path) -> Path:
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


@lru_cache(maxsize=1)  # tasks come recording by recording
def load(folder: Path) -> RecordedDrive:
    """Read what `make` wrote, all sensors of it."""
    log = open_log(folder / "logs" / MACHINE)
    track = track_file(folder)
    first = np.genfromtxt(track, delimiter=",", names=True, max_rows=1)
    start = (float(first["x"]), float(first["y"]), float(first["yaw"]))
    return RecordedDrive(log.site, log.machine, tuple(log.readings()), read_track(track), start)


def track_file(folder: Path) -> Path:
    """Where a recording keeps the machine's true track."""
    return folder / "truth" / "tracks" / f"{MACHINE}.csv"


@cache
def code_version(*names: str) -> str:
    """Digest of the sources of packages or modules, as paths from the project's root; raises FileNotFoundError.

    Comments, docstrings and layout do not count, so that results outlive what is only said in another way.
    """
    files = sorted(path for name in names for path in _sources(ROOT / name))
    return digest(*(f"{path.relative_to(ROOT)}\n{what_counts(path)}" for path in files))


def what_counts(path: Path) -> str:
    """The text of a source that results depend on: of Python its syntax tree, without docstrings."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return text
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree)


def digest(*texts: str) -> str:
    """Ten hex digits that tell texts apart."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:10]


def toml_of(values: Mapping[str, Any]) -> str:
    """Plain values as TOML keys; None is none."""
    return "\n".join(f"{name} = {json.dumps(value)}" for name, value in values.items() if value is not None)


def _sources(path: Path) -> Iterable[Path]:
    if path.is_dir():
        return (inner for inner in path.rglob("*") if inner.suffix in SUFFIXES)
    return [path]  # reading it raises where it is not there
