"""Drives of whole scenarios without their sensors, for tests of drivers and worlds."""

from contextlib import closing
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats
from sim.config import SimConfig
from sim.scenario.tables import Scenario
from sim.simulator import Simulator
from sim.state import FleetState, stack

EVERY = 10  # steps between two states that are kept


@dataclass(frozen=True)
class Driven:
    """What happened: states (k, n, ...), payloads (k, n), and how far from its route each joint was (k, n) [m]."""

    scenario: Scenario
    states: FleetState
    payload_kg: Floats
    off_m: Floats
    joint_m: Floats


def drive(config: SimConfig, seconds: float) -> Driven:
    with closing(Simulator(config)) as simulator:
        states, payloads, off, joints = [], [], [], []
        lines = [np.vstack([leg.points for leg in route.legs]) for route, _, _ in simulator.scenario.journeys()]
        for i in range(round(seconds * 100)):
            state = simulator.step()
            if i % EVERY:
                continue
            joint = simulator._crew.joint_m(state)
            states.append(state)
            payloads.append(simulator._drivers.payload_kg)
            joints.append(joint)
            if i % 50 == 0:
                off.append([np.hypot(*(line - at).T).min() for line, at in zip(lines, joint, strict=True)])
        return Driven(simulator.scenario, stack(states), np.array(payloads), np.array(off), np.array(joints))
