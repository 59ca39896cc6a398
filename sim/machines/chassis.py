"""Machine figures of both worlds: geometry, weight, lags of hydraulics and engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from protocol.arrays import Bools, Floats
from sim.machines.model import MachineModel
from sim.state import STEP_S

# Traction control: share of the worst soil's traction, torque split by wheel load. At its peak a wheel would spin up
# without bound.
TRACTION_USE = 0.98
STANDSTILL_MPS = 0.03  # rolling resistance fades in over this speed
SETTLE_STEPS = 200  # steps with the brakes on before a world starts


@dataclass(frozen=True)
class Bodies:
    """True empty mass [kg] and wheel radius [m], both (n,), which differ within one kind.

    rolling: factor (n,) or scalar on the tyres' rolling resistance.
    """

    mass_kg: Floats
    wheel_radius_m: Floats
    rolling: Floats | float = 1.0


class Chassis(NamedTuple):
    """Figures of n machines, arrays (n,), named as in `MachineModel`.

    front_share, centre_height: of the empty machine; payload_*: of the payload alone. *_inertia: about the centre,
    empty; *_inertia_gain: per kilogram of payload.
    """

    rear_to_joint_m: Floats
    front_to_joint_m: Floats
    half_track_m: Floats
    rolls_with_front: Bools
    front_share: Floats
    centre_height_m: Floats
    payload_share: Floats
    payload_height_m: Floats
    pitch_inertia_kgm2: Floats
    pitch_inertia_gain_m2: Floats
    roll_inertia_kgm2: Floats
    roll_inertia_gain_m2: Floats
    tyre_stiffness_npm: Floats
    tyre_damping_nspm: Floats
    relaxation_m: Floats
    wheel_inertia_kgm2: Floats
    max_articulation_rad: Floats
    steer_radps: Floats
    steer_gain_per_s: Floats
    steer_lag_s: Floats
    engine_lag_s: Floats
    skid_grip: Floats


class Weight(NamedTuple):
    """Weight of n machines with payload, all (n,); inertias about the centre of mass, front_share on level ground."""

    mass_kg: Floats
    front_share: Floats
    centre_height_m: Floats
    pitch_inertia_kgm2: Floats
    roll_inertia_kgm2: Floats


def chassis_of(models: Sequence[MachineModel]) -> Chassis:
    """Stack one model per machine into arrays."""
    kinds = list(dict.fromkeys(models))
    kind, figures = [kinds.index(model) for model in models], [_figures(model) for model in kinds]
    return Chassis(*(np.array([own[name] for own in figures])[kind] for name in Chassis._fields))


def _figures(model: MachineModel) -> dict[str, Any]:
    inertia, (payload_x_m, _, payload_z_m) = model.weight().inertia_kgm2, model.payload_centre_m
    gain = (model.weight(model.payload_kg).inertia_kgm2 - inertia) / model.payload_kg
    return vars(model) | {
        "half_track_m": 0.5 * model.track_m,
        "rolls_with_front": model.rolls_with_front,
        "front_share": model.front_share(),
        "centre_height_m": model.centre_height_m(),
        "payload_share": payload_x_m / model.wheelbase_m,
        "payload_height_m": payload_z_m,
        "pitch_inertia_kgm2": inertia[1, 1],
        "pitch_inertia_gain_m2": gain[1, 1],
        "roll_inertia_kgm2": inertia[0, 0],
        "roll_inertia_gain_m2": gain[0, 0],
    }


def weigh(chassis: Chassis, bodies: Bodies, payload_kg: Floats) -> Weight:
    """Add payloads (n,) to empty machines."""
    mass = bodies.mass_kg + payload_kg
    share = (bodies.mass_kg * chassis.front_share + payload_kg * chassis.payload_share) / mass
    height = (bodies.mass_kg * chassis.centre_height_m + payload_kg * chassis.payload_height_m) / mass
    pitch = chassis.pitch_inertia_kgm2 + payload_kg * chassis.pitch_inertia_gain_m2
    roll = chassis.roll_inertia_kgm2 + payload_kg * chassis.roll_inertia_gain_m2
    return Weight(mass, share, height, pitch, roll)


def steering_radps(chassis: Chassis, target_rad: Floats, articulation_rad: Floats, rate_radps: Floats) -> Floats:
    """Rate of articulation after one step: lagged, within the hydraulics' limits."""
    most, fastest = chassis.max_articulation_rad, chassis.steer_radps
    target = np.minimum(np.maximum(target_rad, -most), most)
    rate = chassis.steer_gain_per_s * (target - articulation_rad)
    rate = np.minimum(np.maximum(rate, -fastest), fastest)
    return rate_radps + (rate - rate_radps) * (STEP_S / chassis.steer_lag_s)


def drive_force_n(chassis: Chassis, target_n: Floats, drive_n: Floats, most_n: Floats) -> Floats:
    """Drive force after one step: lagged, within the traction limit."""
    follows = drive_n + (target_n - drive_n) * (STEP_S / chassis.engine_lag_s)
    return np.minimum(np.maximum(follows, -most_n), most_n)
