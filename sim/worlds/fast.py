"""The fast world: articulated machines as two-frame kinematics, all at once (numba, no PyBullet).

No axle slips sideways. Along the track: drive force, brakes, rolling resistance, gravity, inertia of body and wheels.
One joint lets all wheels touch, so the rear frame rests on three points: one axle's wheels and the other's centre.
Their plane is its attitude with settled tyres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from protocol.arrays import Floats
from protocol.units import GRAVITY_MPS2
from sim.machines import chassis
from sim.machines.chassis import Bodies
from sim.machines.model import MachineModel
from sim.state import STEP_S, FleetState
from sim.terrain.terrain import C_RR, SLIP_STIFFNESS, TRACTION, Terrain
from sim.worlds import fast_kernels as k

_CONSTANTS = k.Constants(STEP_S, GRAVITY_MPS2, chassis.STANDSTILL_MPS, chassis.TRACTION_USE)
_SOILS = np.array([C_RR, TRACTION, SLIP_STIFFNESS])

# State (n,): fields of `FleetState` and what the next step needs. grip: drive force limit. crab: angle from heading to
# motion, to the left, because side force needs slip. centre, ride: forward acceleration and height of the body's
# centre. *_aim: equilibrium of ride, pitch, roll with the tyre deflection of the empty machine.
_IN_BOTH = [field.name for field in fields(FleetState) if field.name not in ("mass_kg", "payload_kg")]
_BESIDE = ("grip_n", "crab_rad", "centre_mps2", "ride_m", "ride_mps", "ride_aim_m", "pitch_aim_rad", "roll_aim_rad")
_AXES = {"rates_radps": 3, "rates_dot_radps2": 3, "force_mps2": 3, "wheel_radps": 2, "wheel_rad": 2}
STATE = np.dtype([(name, "f8", _AXES.get(name, ())) for name in (*_IN_BOTH, *_BESIDE)])

# Parameters, as in `chassis.Chassis` and `chassis.Weight`. level_*: tyre deflection per axle of the nominal empty
# machine, which stands level.
_OF_TYRES = ("tyre_stiffness_npm", "tyre_damping_nspm", "wheel_radius_m", "wheel_inertia_kgm2")
_OF_BODY = ("rear_to_joint_m", "front_to_joint_m", "half_track_m", "level_front_m", "level_rear_m")
_FIGURES = (*_OF_BODY, *_OF_TYRES, "rolling", "skid_grip", *chassis.Weight._fields)
MACHINE = np.dtype([("rolls_with_front", "?"), *((name, "f8") for name in _FIGURES)])


class FastWorld:
    """n machines on one terrain. starts: x, y [m] and yaw [rad] of each `base_link`, (n, 3)."""

    def __init__(self, terrain: Terrain, models: Sequence[MachineModel], bodies: Bodies, starts: Floats) -> None:
        n = len(models)
        self._terrain, self._bodies, self._chassis = terrain, bodies, chassis.chassis_of(models)
        self._payload_kg = np.zeros(n)
        sunk_m = 0.5 * np.array([m.mass_kg for m in models]) * GRAVITY_MPS2 / self._chassis.tyre_stiffness_npm
        share = self._chassis.front_share
        self._level_m = {"level_front_m": share * sunk_m, "level_rear_m": (1 - share) * sunk_m}
        self._weigh()
        self._rows = np.zeros(n, STATE)
        self._rows["x_m"], self._rows["y_m"], self._rows["yaw_rad"] = starts.T
        k.settle(self._machines, terrain.grid, self._rows)
        for _ in range(chassis.SETTLE_STEPS):
            self.advance(np.zeros(n), np.zeros(n), np.full(n, np.inf))

    def advance(self, steer_rad: Floats, drive_n: Floats, brake_n: Floats) -> FleetState:
        """Advance by STEP_S; all (n,): target articulation, drive force (signed), brake force limit."""
        rows, own = self._rows, self._chassis
        steering = chassis.steering_radps(own, steer_rad, rows["articulation_rad"], rows["articulation_radps"])
        drive = chassis.drive_force_n(own, drive_n, rows["drive_n"], rows["grip_n"])
        brake, machines, ground = np.ascontiguousarray(brake_n, float), self._machines, self._terrain.grid
        self._rows = k.advance(_CONSTANTS, _SOILS, machines, ground, rows, steering, drive, brake)
        in_both = {name: self._rows[name] for name in _IN_BOTH}
        self.state = FleetState(mass_kg=self._weight.mass_kg, payload_kg=self._payload_kg, **in_both)
        return self.state

    def set_payload(self, machine: int, payload_kg: float) -> None:
        """Change one machine's payload."""
        carried = self._payload_kg.copy()  # past states keep theirs
        carried[machine] = payload_kg
        self._payload_kg = carried
        self._weigh()

    def set_terrain(self, terrain: Terrain) -> None:
        """Replace the ground."""
        self._terrain = terrain

    def close(self) -> None:
        """Nothing to free."""

    def _weigh(self) -> None:
        self._weight = chassis.weigh(self._chassis, self._bodies, self._payload_kg)
        values = vars(self._bodies) | self._chassis._asdict() | self._weight._asdict() | self._level_m
        self._machines = np.empty(len(self._payload_kg), MACHINE)
        for name in MACHINE.names or ():
            self._machines[name] = values[name]
