"""The fast world: articulated machines as kinematics of two frames, all at once (numba, no PyBullet).

Neither axle slips sideways. Along the track, drive force and brakes against rolling resistance, gravity and the inertia
of the body and its wheels. One joint lets all wheels touch, so the rear frame rests on three points: one axle's wheels
and the other axle's centre; their plane is its attitude once the tyres have settled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from protocol.arrays import Floats, Table
from protocol.units import GRAVITY_MPS2
from sim.machines.chassis import (
    SETTLE_STEPS,
    STANDSTILL_MPS,
    TRACTION_USE,
    Bodies,
    chassis_of,
    drive_force_n,
    steering_radps,
    weigh,
)
from sim.machines.model import MachineModel
from sim.state import STEP_S, FleetState
from sim.terrain.soil import C_RR, SLIP_STIFFNESS, TRACTION
from sim.terrain.terrain import Terrain
from sim.worlds import fast_kernels as k
from sim.worlds.fast_records import MACHINE, STATE

_CONSTANTS = k.Constants(STEP_S, GRAVITY_MPS2, STANDSTILL_MPS, TRACTION_USE)
_SOILS = np.array([C_RR, TRACTION, SLIP_STIFFNESS])
_IN_BOTH = [field.name for field in fields(FleetState) if field.name in (STATE.names or ())]


class FastWorld:
    """n machines on one terrain. starts: x, y [m] and yaw [rad] of each `base_link`, (n, 3)."""

    def __init__(self, terrain: Terrain, models: Sequence[MachineModel], bodies: Bodies, starts: Floats) -> None:
        n = len(models)
        self._terrain, self._bodies, self._chassis = terrain, bodies, chassis_of(models)
        self._payload_kg = np.zeros(n)
        self._weigh()
        self._rows = np.zeros(n, STATE)
        self._rows["x_m"], self._rows["y_m"], self._rows["yaw_rad"] = starts.T
        k.settle(self._machines, terrain.grid, self._rows)
        for _ in range(SETTLE_STEPS):
            self.advance(np.zeros(n), np.zeros(n), np.full(n, np.inf))

    @property
    def state(self) -> FleetState:
        """The state after the last step."""
        return self._state

    def advance(self, steer_rad: Floats, drive_n: Floats, brake_n: Floats) -> FleetState:
        """Advance by STEP_S; all (n,): articulation to aim at, drive force (signed), most force of the brakes."""
        rows, chassis = self._rows, self._chassis
        steering = steering_radps(chassis, steer_rad, rows["articulation_rad"], rows["articulation_radps"])
        drive = drive_force_n(chassis, drive_n, rows["drive_n"], rows["grip_n"])
        brake, machines, ground = np.ascontiguousarray(brake_n, float), self._machines, self._terrain.grid
        self._rows = k.advance(_CONSTANTS, _SOILS, machines, ground, rows, steering, drive, brake)
        self._state = _state(self._rows, self._weight.mass_kg, self._payload_kg)
        return self._state

    def set_payload(self, machine: int, payload_kg: float) -> None:
        """Change what one machine carries."""
        carried = self._payload_kg.copy()  # past states keep theirs
        carried[machine] = payload_kg
        self._payload_kg = carried
        self._weigh()

    def set_terrain(self, terrain: Terrain) -> None:
        """Change the ground under the machines."""
        self._terrain = terrain

    def close(self) -> None:
        """Nothing to free."""

    def _weigh(self) -> None:
        chassis, bodies = self._chassis, self._bodies
        self._weight = weigh(chassis, bodies, self._payload_kg)
        values = chassis._asdict() | self._weight._asdict() | {"wheel_radius_m": bodies.wheel_radius_m}
        self._machines = np.empty(len(bodies.mass_kg), MACHINE)
        for name in MACHINE.names or ():
            self._machines[name] = values[name]


def _state(rows: Table, mass_kg: Floats, payload_kg: Floats) -> FleetState:
    return FleetState(mass_kg=mass_kg, payload_kg=payload_kg, **{name: rows[name] for name in _IN_BOTH})
