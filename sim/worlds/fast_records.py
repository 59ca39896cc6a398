"""The fast world's records: one machine's state, and its parameters, with a name for every number."""

from __future__ import annotations

from typing import Any

import numpy as np

# One machine in the state array (n,): what `state.FleetState` explains, and what the next step needs beside it.
# grip: the most drive force. crab: how far a machine moves off its heading to the left, because tyres push sideways
# only while they slip sideways. ride: how high the body's centre is. *_aim: where ride, pitch and roll would settle.
STATE = np.dtype(
    [
        ("x_m", "f8"),
        ("y_m", "f8"),
        ("z_m", "f8"),
        ("yaw_rad", "f8"),
        ("pitch_rad", "f8"),
        ("roll_rad", "f8"),
        ("speed_mps", "f8"),
        ("accel_mps2", "f8"),
        ("pitch_radps", "f8"),
        ("roll_radps", "f8"),
        ("rates_radps", "f8", 3),
        ("rates_dot_radps2", "f8", 3),
        ("force_mps2", "f8", 3),
        ("articulation_rad", "f8"),
        ("articulation_radps", "f8"),
        ("articulation_radps2", "f8"),
        ("drive_n", "f8"),
        ("torque_nm", "f8"),
        ("load_n", "f8"),
        ("wheel_radps", "f8", 2),
        ("wheel_rad", "f8", 2),
        ("c_rr", "f8"),
        ("grade_e", "f8"),
        ("grade_n", "f8"),
        ("grip_n", "f8"),
        ("crab_rad", "f8"),
        ("ride_m", "f8"),
        ("ride_mps", "f8"),
        ("ride_aim_m", "f8"),
        ("pitch_aim_rad", "f8"),
        ("roll_aim_rad", "f8"),
    ]
)

# One machine's parameters, as `chassis.Chassis` and `chassis.Weight` explain them.
MACHINE = np.dtype(
    [
        ("rear_to_joint_m", "f8"),
        ("front_to_joint_m", "f8"),
        ("half_track_m", "f8"),
        ("rolls_with_front", "?"),
        ("mass_kg", "f8"),
        ("front_share", "f8"),
        ("centre_height_m", "f8"),
        ("pitch_inertia_kgm2", "f8"),
        ("roll_inertia_kgm2", "f8"),
        ("tyre_stiffness_npm", "f8"),
        ("tyre_damping_nspm", "f8"),
        ("wheel_radius_m", "f8"),
        ("wheel_inertia_kgm2", "f8"),
    ]
)
Record = Any  # one element of an array of these types: numba reads and writes its fields as attributes
