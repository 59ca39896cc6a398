"""Alignment: how the frame of dead reckoning lies in `map`, and the belief that the filter starts from."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from agents.localisation.filters import state
from agents.localisation.filters.belief import Belief
from agents.localisation.gps import Fix
from agents.localisation.imu_steps import FilterStep
from protocol.arrays import Floats
from protocol.rotations import wrap_angle
from protocol.units import GRAVITY_MPS2

DISTANCE_M = 12.0  # driven before the heading is taken from GPS,
SPREAD_M = 3.0  # and the least spread of the positions around their mean, against slow errors of GPS
MIN_FIXES = 4
SPEED_STD_MPS = 3.0  # of the first belief: the machine may drive already, and wheels take a moment to show it
GIVEN_STD_M, GIVEN_STD_RAD = 0.5, 0.02  # of a start that is configured
GYRO_BIAS_RADPS = 5e-3  # standard deviations of the first belief: bias of each yaw gyro,
WHEEL_SCALE = 0.03  # and scale of the wheels


@dataclass(frozen=True)
class Alignment:
    """The dead-reckoned frame in `map`: rotation [rad] with its standard deviation, and the place of its origin [m].

    fix_std_m: standard deviation of the origin.
    """

    rotation_rad: float
    std_rad: float
    origin_m: tuple[float, float]
    fix_std_m: float


def align(reckoned_m: Floats, fixes_m: Floats, fix_std_m: float) -> Alignment | None:
    """Fit dead-reckoned antenna positions (n, 2) onto fixes (n, 2) by rotation and shift (Umeyama 1991, in 2-D).

    fix_std_m: error of one fix. Returns None where all positions coincide. The standard deviation takes half the
    spread for granted: slow GPS errors do not average out.
    """
    origin, target = reckoned_m.mean(axis=0), fixes_m.mean(axis=0)
    d, f = reckoned_m - origin, fixes_m - target
    spread_m = float(np.sqrt((d**2).sum(axis=1).mean()))
    if spread_m < 1e-6:
        return None
    rotation = math.atan2(float((d[:, 0] * f[:, 1] - d[:, 1] * f[:, 0]).sum()), float((d * f).sum()))
    shift = target - _turned(rotation, *origin.tolist())
    return Alignment(rotation, fix_std_m / (2 * spread_m), (float(shift[0]), float(shift[1])), fix_std_m)


def align_fixes(fixes: Sequence[Fix], distance_m: float) -> Alignment | None:
    """The alignment by absolute fixes, once the distance driven shows the heading; None before."""
    absolute = [fix for fix in fixes if fix.is_absolute]
    if distance_m < DISTANCE_M or len(absolute) < MIN_FIXES:
        return None
    antennas = np.array([fix.reckoned_antenna_m for fix in absolute])
    if float(np.sqrt(((antennas - antennas.mean(axis=0)) ** 2).sum(axis=1).mean())) < SPREAD_M:
        return None
    std_m = math.sqrt(sum(float(fix.variance_m2.mean()) for fix in absolute) / len(absolute))
    return align(antennas, np.array([fix.position_m for fix in absolute]), std_m)


def align_start(start: Sequence[float], reckoned: DeadReckonedPose) -> Alignment:
    """The alignment where a machine stands at a known x, y [m] and heading [rad]."""
    x, y, heading = start
    rotation = heading - reckoned.angle_rad
    east_m, north_m = _turned(rotation, reckoned.x_m, reckoned.y_m)
    return Alignment(rotation, GIVEN_STD_RAD, (x - east_m, y - north_m), GIVEN_STD_M)


def _turned(angle_rad: float, x: float, y: float) -> tuple[float, float]:
    """A vector, turned to the left."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return c * x - s * y, s * x + c * y


def start_belief(
    alignment: Alignment, step: FilterStep, forces_mps2: Sequence[Floats], layout: state.Layout, turn_error_radps: float
) -> Belief:
    """The belief at the first step. The filter uses the fixes again, so the position is left wide.

    forces_mps2: specific forces (3,) of the accelerometers, which show roll and pitch. turn_error_radps: standard
    deviation of the lasting error of a turn that no IMU measures, 0 where there is none.
    """
    reckoned = step.reckoned
    x, variance = np.zeros(layout.n), np.full(layout.n, 1e-6)
    x[:2] = np.array(alignment.origin_m) + _turned(alignment.rotation_rad, reckoned.x_m, reckoned.y_m)
    x[state.YAW] = wrap_angle(alignment.rotation_rad + reckoned.angle_rad)
    x[state.SPEED] = step.wheels.speed_mps
    if forces_mps2:
        ahead, left, _ = np.mean(forces_mps2, axis=0) / GRAVITY_MPS2
        x[state.ROLL], x[state.PITCH] = math.asin(np.clip(left, -0.7, 0.7)), -math.asin(np.clip(ahead, -0.7, 0.7))
    variance[state.POSITION] = (2 * alignment.fix_std_m) ** 2
    variance[state.ATTITUDE] = 0.1**2
    variance[state.YAW] = min(0.5, 2 * alignment.std_rad + 0.05) ** 2
    variance[state.VELOCITY], variance[state.RATE], variance[state.ACCELERATION] = SPEED_STD_MPS**2, 0.1**2, 1.0
    variance[layout.gyro_biases] = GYRO_BIAS_RADPS**2
    variance[layout.wheel_scales] = WHEEL_SCALE**2
    if layout.imus and turn_error_radps:
        variance[layout.gyro_biases.stop - 1] = turn_error_radps**2
    return Belief(step.stamp_ns, x, np.diag(variance))
