"""Drives for the paper's tables: one machine per set of sensors, and fleets; in full, or quickly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lab.calibration.drives import Agent, planned
from lab.campaign.experiment import Task, replay_task
from lab.campaign.recordings import PAPER, PlannedDrive, Setup
from lab.paper.maps import Fleet
from lab.positions.configurations import HEADLINE, PROFILES, Configuration, configurations
from lab.positions.published import PLOTTING, POSITIONS

FLEET_SHARE = 0.75  # of other recordings' length: 900 s
MACHINES = 4
RECOMMENDED = Configuration("ukf", 2, 1, "default")  # the paper's choice of sensors with our filter


@dataclass(frozen=True)
class MapSource:
    """Source of maps: a recording and its machines' configuration.

    preset: of sensors. machines: all of the recording.
    """

    scenario: str
    preset: str
    machines: int
    configuration: Configuration

    @property
    def agents(self) -> tuple[Agent, ...]:
        """Default agents; a lone one with the configured sensors."""
        if self.machines == 1:
            return (Agent(0, closed_tours=True, configuration=self.configuration),)
        return tuple(Agent(index, closed_tours=True) for index in range(self.machines))

    def drive(self, seed: int, plan: Plan) -> PlannedDrive:
        """Recording of a seed."""
        if self.machines == 1:
            return PlannedDrive(seed, plan.seconds, self.preset, plan.setup)
        count = self.machines if self.scenario == PAPER.scenario else 0
        return planned(self.scenario, seed, FLEET_SHARE * plan.seconds, count, self.preset, plan.setup.world)

    def runs(self, seed: int, plan: Plan) -> list[Task[Agent]]:
        """Tasks before its maps."""
        return [replay_task(agent, self.drive(seed, plan)) for agent in self.agents]

    def maps(self, seed: int, plan: Plan) -> Task[Fleet]:
        """Task of its maps."""
        return replay_task(Fleet(self.agents), self.drive(seed, plan))


ALONE = tuple(
    MapSource(PAPER.scenario, PAPER.preset, 1, Configuration(*group, profile))
    for group in PLOTTING
    for profile in PROFILES
)
FLEETS = tuple(
    MapSource(scenario, preset, MACHINES, RECOMMENDED)
    for scenario, preset in ((PAPER.scenario, PAPER.preset), (PAPER.scenario, "dgps"), ("loading", "dgps"))
)


@dataclass(frozen=True)
class Plan:
    """Scope: seeds, seconds per recording of one machine, rows of both tables, setup."""

    seeds: Sequence[int]
    seconds: float
    positions: tuple[Configuration, ...] = tuple(row for row in configurations() if row.group in POSITIONS)
    sources: tuple[MapSource, ...] = (*ALONE, *FLEETS)
    setup: Setup = PAPER


# Smoke test of a minute in the fast world, reproducible.
QUICK = Plan(
    seeds=(0,),
    seconds=60.0,
    positions=tuple(configurations(HEADLINE[1:2])),
    sources=(*ALONE[-2:], FLEETS[0]),
    setup=replace(PAPER, world="fast"),
)
