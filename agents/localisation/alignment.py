"""Alignment: how the frame of dead reckoning lies in `map`, and the belief that the filter starts from."""

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

DISTANCE_M = 12.0  # driven before the heading is taken from GPS,
SPREAD_M = 3.0  # and the least spread of the positions around their mean, against slow errors of GPS
MIN_FIXES = 4.0  # of equal weight
MAX_STD_RAD = 0.3  # of a heading that a filter can start from: it linearises
MAX_MISFIT = 2.5  # mean square of residuals over their variance; more, and a first stretch may be off
MIN_SCALE, MAX_SCALE = 0.8, 1.25  # of dead reckoning: wheels of another radius, and slow errors of GPS on a short way
GIVEN_STD_M, GIVEN_STD_RAD = 0.5, 0.02  # of a start that is configured
TO_COMPLEX = np.array([1.0, 1.0j])


@dataclass(frozen=True)
class Alignment:
    """The dead-reckoned frame in `map`: rotation [rad] with its standard deviation, and the place of its origin [m].

    fix_std_m: standard deviation of the origin. wheel_scale: how much further the wheels turn than the fixes go [-], as
    far as these show it. since_ns: stamp of the first fix that counts; 0 where all do.
    """

    rotation_rad: float
    std_rad: float
    origin_m: tuple[float, float]
    fix_std_m: float
    wheel_scale: float = 0.0
    since_ns: int = 0


def align(reckoned_m: Floats, fixes_m: Floats, variance_m2: Floats) -> tuple[Alignment, int] | None:
    """Fit dead-reckoned antenna positions (n, 2) onto fixes (n, 2) by rotation and shift (Umeyama 1991, in 2-D).

    variance_m2: of each fix (n,), slow errors included; they weigh it. Returns the alignment and the index of the first
    fix that counts: 0, unless the residuals say that a first stretch is off; then the rest that shows the heading best
    counts. None where nothing shows it. Points are complex numbers here: with centred d and f and weights w,

        rotation = arg sum w conj(d) f        residuals = sum w |f|^2 + s^2 sum w |d|^2 - 2 s |sum w conj(d) f|

    where s is the scale of dead reckoning, within bounds. The standard deviation takes half the spread for granted, as
    slow errors do not average out, and grows with residuals that are far larger than the variances say (Birge 1932).
    """
    n, weight = len(fixes_m), 1 / variance_m2
    about_d, about_f = reckoned_m[-1], fixes_m[-1]  # sums stay small
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
    """The alignment by absolute fixes, in the order of their stamps; None where they do not show the heading."""
    absolute = [fix for fix in fixes if fix.is_absolute]
    if len(absolute) < MIN_FIXES:
        return None
    antennas = np.array([fix.reckoned_antenna_m for fix in absolute])
    variance_m2 = np.array([float(fix.variance_m2.mean()) for fix in absolute])
    fitted = align(antennas, np.array([fix.position_m for fix in absolute]), np.maximum(variance_m2, MIN_FIX_STD_M**2))
    return replace(fitted[0], since_ns=absolute[fitted[1]].stamp_ns if fitted[1] else 0) if fitted else None


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
    alignment: Alignment,
    step: FilterStep,
    forces_mps2: Sequence[Floats],
    layout: state.Layout,
    turn_error_radps: float,
    tuning: LocalisationTuning = TUNING,
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
