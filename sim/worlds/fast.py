"""The fast world: articulated machines as kinematics of two frames, all at once (numba, no PyBullet).

Neither axle slips sideways. Along the way, drive force and brakes against rolling resistance, gravity and the inertia
of the body and its wheels. One joint lets all wheels touch, so the rear frame rests on three points: one axle's wheels
and the other axle's centre; their plane is its attitude once the tyres have settled.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Floats
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

_CONSTANTS = k.Constants(STEP_S, GRAVITY_MPS2, STANDSTILL_MPS, TRACTION_USE)
_SOILS = np.array([C_RR, TRACTION, SLIP_STIFFNESS])


class Fleet:
    """n machines on one terrain. starts: x, y [m] and yaw [rad] of each `base_link`, (n, 3)."""

    def __init__(self, terrain: Terrain, models: Sequence[MachineModel], bodies: Bodies, starts: Floats) -> None:
        n = len(models)
        self._terrain, self._bodies, self._chassis = terrain, bodies, chassis_of(models)
        self._payload_kg = np.zeros(n)
        self._weigh()
        self._rows = np.zeros((k.ROWS, n))
        self._rows[[k.X, k.Y, k.YAW]] = np.transpose(starts)
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
        steering = steering_radps(chassis, steer_rad, rows[k.BEND], rows[k.STEERING])
        drive = drive_force_n(chassis, drive_n, rows[k.DRIVE], rows[k.GRIP])
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
        values = (
            chassis.rear_to_joint_m,
            chassis.front_to_joint_m,
            chassis.half_track_m,
            chassis.rolls_with_front,
            *self._weight,
            chassis.tyre_stiffness_npm,
            chassis.tyre_damping_nspm,
            bodies.wheel_radius_m,
            chassis.wheel_inertia_kgm2,
        )
        self._machines = np.array(values, float)  # rows of `kernels.Machine`


def _state(rows: Floats, mass_kg: Floats, payload_kg: Floats) -> FleetState:
    return FleetState(
        x_m=rows[k.X],
        y_m=rows[k.Y],
        z_m=rows[k.Z],
        yaw_rad=rows[k.YAW],
        pitch_rad=rows[k.PITCH],
        roll_rad=rows[k.ROLL],
        speed_mps=rows[k.SPEED],
        accel_mps2=rows[k.ACCEL],
        pitch_radps=rows[k.PITCHING],
        roll_radps=rows[k.ROLLING],
        rates_radps=rows[k.RATES : k.RATES + 3].T,
        rates_dot_radps2=rows[k.RATES_DOT : k.RATES_DOT + 3].T,
        force_mps2=rows[k.FORCE : k.FORCE + 3].T,
        articulation_rad=rows[k.BEND],
        articulation_radps=rows[k.STEERING],
        articulation_radps2=rows[k.STEERING_DOT],
        drive_n=rows[k.DRIVE],
        torque_nm=rows[k.TORQUE],
        load_n=rows[k.LOAD],
        mass_kg=mass_kg,
        payload_kg=payload_kg,
        wheel_radps=rows[k.SPIN : k.SPIN + 2].T,
        wheel_rad=rows[k.TURNED : k.TURNED + 2].T,
        c_rr=rows[k.C_RR],
        grade_e=rows[k.GRADE_E],
        grade_n=rows[k.GRADE_N],
    )
