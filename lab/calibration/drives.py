"""Recordings of fleets, and the samples of each agent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from agents.estimation.ground import EstimationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import Samples, joined
from lab.campaign.experiment import Experiment, Task
from lab.campaign.recordings import PlannedDrive, Setup, toml_of
from lab.positions.configurations import Configuration
from protocol.arrays import Table
from protocol.machine.log_folder import open_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, Reading, Torque
from protocol.site.site_config import SiteConfig
from sim.recorder import TRACKS_FOLDER
from sim.scenario.file import load_scenario
from sim.truth import MAP_FILE, TruthMap
from sitegrid.logs.sensors import select
from sitegrid.proof.tracks import LoadTrack, read_load_track

CHUNK = 5000  # readings per pipeline step


@dataclass(frozen=True)
class FleetDrive(PlannedDrive):
    """All machines of a scenario. count: in its first fleet, 0: as in the scenario."""

    count: int = 0

    @property
    def scenario_toml(self) -> str:
        """Scenario file."""
        top = {"base": self.setup.scenario, "world": self.setup.world}
        if not self.count:
            return f"{toml_of(top)}\n"
        first = replace(load_scenario(self.setup.scenario).fleet[0], count=self.count, preset=self.preset)
        return f"{toml_of(top)}\n\n[[fleet]]\n{toml_of(vars(first))}\n"

    @property
    def machines(self) -> int:
        """Number of machines."""
        return self.count or sum(fleet.size for fleet in load_scenario(self.setup.scenario).fleet)


def planned(
    scenario: str, seed: int, seconds: float, count: int = 0, preset: str = "", world: str | None = None
) -> FleetDrive:
    """Drive of a scenario; sensors and world default to the scenario's."""
    preset = preset or load_scenario(scenario).fleet[0].preset
    return FleetDrive(seed, seconds, preset, Setup(scenario, (), (), (), world=world), count)


@dataclass(frozen=True)
class Agent:
    """One machine of a drive, by index.

    calibrates: by its work; closed_tours: also by these. first_s: used part of the recording. bad: see `spoiled`.
    blind: unaware of hydraulic engine load. configuration: filter and sensors, None: its own.
    """

    index: int
    calibrates: bool = True
    closed_tours: bool = False
    first_s: float = 0.0
    bad: bool = False
    blind: bool = False
    configuration: Configuration | None = None

    @property
    def name(self) -> str:
        """Short unique name."""
        first = f"-{self.first_s:g}s" * (self.first_s > 0)
        return (
            f"machine{self.index}"
            + "-plain" * (not self.calibrates)
            + "-tours" * self.closed_tours
            + "-bad" * self.bad
            + "-blind" * self.blind
            + first
            + (f"-{self.configuration.name}" if self.configuration else "")
        )


@dataclass(frozen=True)
class AgentSamples:
    """An agent's samples. live: the same (n,) at real-time positions."""

    samples: Table
    live: Table


@dataclass(frozen=True)
class Scene:
    """Truth of a drive: ground, and all machines' tracks by name."""

    truth: TruthMap
    tracks: Mapping[str, LoadTrack]


@lru_cache(maxsize=4)  # the cases of a drive follow one another
def scene(drive: PlannedDrive, cache: Path) -> Scene:
    """Truth of a recorded drive."""
    folder = drive.folder(cache)
    tracks = {
        logs.name: read_load_track(
            folder / "truth" / TRACKS_FOLDER / f"{logs.name}.csv", open_log(logs).machine.load_centre_m
        )
        for logs in _logs(folder)
    }
    return Scene(TruthMap.load(folder / "truth" / MAP_FILE), tracks)


def _logs(folder: Path) -> list[Path]:
    """Log folders of all machines, by name."""
    return sorted(path for path in (folder / "logs").iterdir() if path.is_dir())


# --- in the worker processes -----------------------------------------------------------------------------------------


def _samples(task: Task[Agent], cache: Path) -> AgentSamples:
    assert task.drive
    site, machine, readings = _read(_logs(task.drive.folder(cache))[task.variant.index])
    if task.variant.first_s:
        end_ns = readings[0].stamp_ns + round(task.variant.first_s * 1e9)
        readings = tuple(reading for reading in readings if reading.stamp_ns <= end_ns)
    if task.variant.bad:
        machine, readings = spoiled(machine, readings)
    if task.variant.blind and machine.powertrain:
        machine = replace(machine, powertrain=replace(machine.powertrain, idle_pressure_pa=0.0))
    estimation = EstimationConfig(calibrate=task.variant.calibrates, closed_tours=task.variant.closed_tours)
    options = PipelineConfig(estimation=estimation)
    if chosen := task.variant.configuration:
        machine = select(machine, chosen.gps, chosen.imu)
        options = replace(chosen.options, estimation=estimation)
    made = all_samples(Pipeline(site, machine, options), readings)
    return AgentSamples(np.asarray(made.final), np.asarray(made.pending))


def all_samples(pipeline: Pipeline, readings: Sequence[Reading]) -> Samples:
    """All samples of a pipeline, live and final."""
    made = [pipeline.step(readings[i : i + CHUNK]) for i in range(0, len(readings), CHUNK)]
    return joined([*made, pipeline.finish()])


@lru_cache(maxsize=1)  # one machine's configurations follow one another
def _read(folder: Path) -> tuple[SiteConfig, MachineConfig, tuple[Reading, ...]]:
    """What a machine's agent may know and read."""
    log = open_log(folder)
    return log.site, log.machine, tuple(log.readings())


def spoiled(machine: MachineConfig, readings: Iterable[Reading]) -> tuple[MachineConfig, tuple[Reading, ...]]:
    """Apply the faults of scenario `bad_machine` to any recording.

    A displaced antenna equals a configuration that states a wrong mount.
    """
    (fault,) = load_scenario("bad_machine").fault
    off = np.array(fault.antenna_off_m)
    sensors = tuple(
        replace(each, mount=replace(each.mount, xyz_m=tuple((each.mount.xyz_m - off).tolist())))
        if each.kind == Gps.kind
        else each
        for each in machine.sensors
    )
    scaled = (
        replace(each, torque_nm=fault.torque_scale * each.torque_nm) if isinstance(each, Torque) else each
        for each in readings
    )
    return replace(machine, sensors=sensors), tuple(scaled)


EXPERIMENT = Experiment("fleet", AgentSamples, _samples)
