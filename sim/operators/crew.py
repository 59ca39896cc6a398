"""Figures of machines that their drivers know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from protocol.arrays import Floats
from sim.machines.model import MachineModel
from sim.state import FleetState


@dataclass(frozen=True)
class Crew:
    """Figures of the machines of n drivers, all (n,), named as in `MachineModel`."""

    rear_to_joint_m: Floats
    front_to_joint_m: Floats
    max_articulation_rad: Floats
    mass_kg: Floats
    max_drive_n: Floats
    max_brake_n: Floats
    max_power_w: Floats

    def joint_m(self, state: FleetState) -> Floats:
        """Position (n, 2) of the articulation joint, which follows the route."""
        x = state.x_m + self.rear_to_joint_m * np.cos(state.yaw_rad)
        return np.stack([x, state.y_m + self.rear_to_joint_m * np.sin(state.yaw_rad)], axis=-1)


def crew_of(models: Sequence[MachineModel]) -> Crew:
    """One driver per machine."""
    return Crew(*(np.array([getattr(model, field.name) for model in models]) for field in fields(Crew)))
