"""Drives of whole scenarios for driver tests, sampled at 10 Hz."""

from __future__ import annotations

import itertools
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats
from sim.config import SimConfig
from sim.scenario.tables import Scenario
from sim.simulator import Simulator
from sim.state import FleetState, stack

EVERY = 10  # steps between kept states


@dataclass(frozen=True)
class Driven:
    """States, payloads and distances (k, n), joints (k, n, 2); distance of joints from their routes (k / 5, n) [m].

    left_m, aim_m: actual and intended lateral offset, positive left.
    """

    scenario: Scenario
    states: FleetState
    payload_kg: Floats
    driven_m: Floats
    joint_m: Floats
    left_m: Floats
    aim_m: Floats
    off_m: Floats

    @property
    def nearest_m(self) -> float:
        """Least distance between two machines' joints."""
        pairs = itertools.combinations(np.moveaxis(self.joint_m, 1, 0), 2)
        return min(float(np.hypot(*(one - other).T).min()) for one, other in pairs)


def drive(config: SimConfig, seconds: float) -> Driven:
    with closing(Simulator(config)) as simulator:
        states, off, columns = [], [], []
        lines = [np.vstack([leg.points for leg in route.legs]) for route, _, _ in simulator.scenario.journeys()]
        for i in range(round(seconds * 100)):
            state = simulator.step()
            if i % EVERY:
                continue
            drivers, joint = simulator._drivers, simulator._crew.joint_m(state)
            nearest, along = simulator._course.at(drivers.leg, drivers.distance_m)
            across = along[:, 0] * (joint - nearest)[:, 1] - along[:, 1] * (joint - nearest)[:, 0]
            left_m = simulator._course.travel[drivers.leg] * across
            states.append(state)
            aim_m = simulator._habits.lateral_m(drivers.driven_m)
            columns.append((drivers.payload_kg, drivers.driven_m, joint, left_m, aim_m))
            if i % (5 * EVERY) == 0:
                off.append([np.hypot(*(line - at).T).min() for line, at in zip(lines, joint, strict=True)])
        kept = map(np.array, zip(*columns, strict=True))
        return Driven(simulator.scenario, stack(states), *kept, np.array(off))
