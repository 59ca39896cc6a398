"""Alignment: the dead-reckoned frame in `map`, and the filter's first belief."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from agents.ground_speed import MIN_FIX_STD_M
from agents.localisation.filters import state
from agents.localisation.filters.belief import Belief
from agents.localisation.fix import Fix
from agents.localisation.imu_steps import FilterStep
from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats
from protocol.rotations import wrap_angle
from protocol.units import GRAVITY_MPS2

DISTANCE_M = 12.0  # distance before GPS gives the heading
SPREAD_M = 3.0  # least spread of positions, against slow GPS errors
MIN_FIXES = 4.0  # in equal weights
MAX_STD_RAD = 0.3  # bound of heading deviation for a linearising filter
MAX_MISFIT = 2.5  # mean squared residual beyond which a first stretch may be off
MIN_SCALE, MAX_SCALE = 0.8, 1.25  # bounds of dead reckoning's scale: wheel radius, slow GPS errors
GIVEN_STD_M, GIVEN_STD_RAD = 0.5, 0.02  # of a configured start
TO_COMPLEX = np.array([1.0, 1.0j])


@dataclass(frozen=True)
class Alignment:
    """The dead-reckoned frame in `map`: rotation and its deviation [rad], origin and its deviation fix_std_m.

    wheel_scale: wheel travel over fix travel, less 1. since_ns: stamp of the first fix that counts; 0 for all.
    """

    rotation_rad: float
    std_rad: float
    origin_m: tuple[float, float]
    fix_std_m: float
    wheel_scale: float = 0.0
    since_ns: int = 0


def align(reckoned_m: Floats, fixes_m: Floats, variance_m2: Floats) -> tuple[Alignment, int] | None:
    """Fit dead-reckoned antennas (n, 2) to fixes (n, 2) by rotation and shift (Umeyama 1991, in 2-D).

    variance_m2: of each fix (n,), with slow errors. Returns the alignment and the index of the first fix that counts:
    0, unless residuals show a bad first stretch; then the remainder that shows the heading best. None if nothing does.
    Complex points, centred d and f, weights w:

        rotation = arg sum w conj(d) f        residuals = sum w |f|^2 + s^2 sum w |d|^2 - 2 s |sum w conj(d) f|

    s: bounded scale of dead reckoning. The standard deviation uses half the spread, as slow errors do not average out,
    and grows with excessive residuals (Birge 1932).
    """
    n, weight = len(fixes_m), 1 / variance_m2
    about_d, about_f = reckoned_m[-1], fixes_m[-1]
    d, f = (reckoned_m - about_d) @ TO_COMPLEX, (fixes_m - about_f) @ TO_COMPLEX
    columns = (
        weight,
        weight**2,
        weight * d,
        weight * f,
        weight * d.conj() * f,
        weight * abs(d) ** 2,
        weight * abs(f) ** 2,
    )
    total, squares, sum_d, sum_f, product, d_d, f_f = (np.cumsum(c[::-1])[::-1] for c in columns)  # from each fix on
    product = product - sum_d.conj() * sum_f / total
    d_d, f_f = (d_d - abs(sum_d) ** 2 / total).real, (f_f - abs(sum_f) ** 2 / total).real
    scale = np.clip(abs(product) / np.maximum(d_d, 1e-9), MIN_SCALE, MAX_SCALE)
    residuals = np.maximum(f_f + scale**2 * d_d - 2 * scale * abs(product), 0.0)
    misfit = residuals / np.maximum(2.0 * np.arange(n, 0, -1) - 4, 1.0)
    fix_std_m, spread_m = np.sqrt(total / squares), np.sqrt(np.maximum(d_d, 0.0) / total)
    inflation = np.sqrt(np.where(misfit > MAX_MISFIT, misfit, 1.0))
    std_rad = fix_std_m * inflation / (2 * np.maximum(spread_m, 1e-9))
    shows = (spread_m >= SPREAD_M) & (total**2 / squares >= MIN_FIXES * (1 - 1e-9)) & (std_rad <= MAX_STD_RAD)
    if misfit[0] <= MAX_MISFIT:
        shows[1:] = False
    if not shows.any():
        return None
    first = int(np.argmin(np.where(shows, std_rad, np.inf)))
    rotation = float(np.angle(product[first]))
    mean_d, mean_f = sum_d[first] / total[first], sum_f[first] / total[first]
    from_d, to_f = complex(*about_d) + mean_d, complex(*about_f) + mean_f
    origin = to_f - from_d * complex(math.cos(rotation), math.sin(rotation))
    wheel_scale = float(d_d[first] / max(abs(product[first]), 1e-9)) - 1
    place = (origin.real, origin.imag)
    return Alignment(rotation, float(std_rad[first]), place, float(fix_std_m[first]), wheel_scale), first


def align_fixes(fixes: Sequence[Fix]) -> Alignment | None:
    """Alignment by absolute fixes in stamp order; None if they do not show the heading."""
    absolute = [fix for fix in fixes if fix.is_absolute]
    if len(absolute) < MIN_FIXES:
        return None
    antennas = np.array([fix.reckoned_antenna_m for fix in absolute])
    variance_m2 = np.array([float(fix.variance_m2.mean()) for fix in absolute])
    fitted = align(antennas, np.array([fix.position_m for fix in absolute]), np.maximum(variance_m2, MIN_FIX_STD_M**2))
    return replace(fitted[0], since_ns=absolute[fitted[1]].stamp_ns if fitted[1] else 0) if fitted else None


def align_start(start: Sequence[float], reckoned: DeadReckonedPose) -> Alignment:
    """Alignment of a machine at a known x, y [m] and heading [rad]."""
    x, y, heading = start
    rotation = heading - reckoned.angle_rad
    east_m, north_m = _turned(rotation, reckoned.x_m, reckoned.y_m)
    return Alignment(rotation, GIVEN_STD_RAD, (x - east_m, y - north_m), GIVEN_STD_M)


def _turned(angle_rad: float, x: float, y: float) -> tuple[float, float]:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return c * x - s * y, s * x + c * y


def start_belief(
    alignment: Alignment,
    step: FilterStep,
    forces_mps2: Sequence[Floats],
    layout: state.Layout,
    turn_error_radps: float,
    tuning: LocalisationTuning = TUNING,
) -> Belief:
    """The belief at the first step; its position is wide, as the fixes count again.

    forces_mps2: specific forces (3,), which show roll and pitch. turn_error_radps: of the lasting turn error without
    IMU.
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
    variance[state.VELOCITY], variance[state.RATE], variance[state.ACCELERATION] = (
        tuning.first_speed_mps**2,
        0.1**2,
        1.0,
    )
    variance[layout.gyro_biases] = tuning.first_gyro_bias_radps**2
    variance[layout.wheel_scales] = tuning.first_wheel_scale**2
    if layout.imus and turn_error_radps:
        variance[layout.gyro_biases.stop - 1] = turn_error_radps**2
    return Belief(step.stamp_ns, x, np.diag(variance))
