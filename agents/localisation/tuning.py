"""Tuning of localisation: one frozen set of constants, which experiments replace."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)  # hashed by identity, as the filter looks up derived values at each step
class LocalisationTuning:
    """Tuning of filter and sensor errors; a sensor's own or configured standard deviation has precedence."""

    # Process noise. Distance errors grow with its square root [m/sqrt(m)].
    slip_along: float = 0.02
    slip_across: float = 0.03
    height_walk: float = 0.02  # [m/sqrt(s)], like all walks [unit/sqrt(s)]
    tilt_walk: float = 5e-3  # [rad], roll and pitch
    heading_walk: float = 1e-3  # [rad], also of an attitude reference's anchor
    velocity_walk: float = 0.05  # [m/s]
    rate_walk: float = 0.3  # [rad/s]
    acceleration_walk: float = 1.0  # [m/s2]
    gyro_bias_walk: float = 5e-5  # [rad/s]
    wheel_scale_walk: float = 2e-4
    slip_std: float = 0.08  # of wheel slip per traction, by which speed is corrected
    slip_s: float = 5.0  # its correlation time: how long ground stays the same
    load_doubt: float = 0.5  # relative deviation of slip with an unknown load
    bend_s: float = 60.0  # correlation time of odometry's turn error: it errs per bend
    turn_s: float = 3.0  # correlation time of an unobserved turn;
    curvature: float = 0.1  # its deviation per metre [rad/m],
    max_turn_radps: float = 0.3  # and its limits
    least_turn_radps: float = 0.005

    # Standard deviations of the first belief.
    first_speed_mps: float = 3.0  # it may drive already
    first_gyro_bias_radps: float = 5e-3
    first_wheel_scale: float = 0.03

    # Standard deviations of measurements.
    rate_radps: float = 0.005  # angular rate of an IMU, mean over a step
    force_mps2: float = 2.0  # specific force of an IMU, with bias and mounting error
    turn_radps: float = 0.02  # turn rate of odometry, and its lasting error at first; steering's per m/s
    steering_rad: float = 0.01  # resolution, play, tyre slip angle
    steered_s: float = 1.0  # its correlation time: drivers hold an angle
    speed_mps: float = 0.04  # of wheels
    side_mps: float = 0.04  # sideways
    still_mps: float = 0.005  # at rest
    joint_radps: float = 0.0035  # joint rate that turns a standing machine: three standard deviations of its noise
    rolling_s: float = 0.5  # time constant of rolling resistance

    # Gates, in standard deviations.
    gate_sigma: float = 6.0  # wide: mounting and slip are not Gaussian
    rest_sigma: float = 3.0  # of a standstill without wheels
    gps_gate_sigma: float = 4.0  # of fixes and their differences: reflections are outliers
    relock: int = 15  # refusals in a row after which a sensor is accepted again: the filter is lost, not the sensor
    unplaced_s: float = 5.0  # time without GPS, after which wheels and IMUs update neither place, heading nor bias

    # Slow errors of receivers.
    restated: float = 4.0  # ratio of stated variances that means a new error
    faded: float = 15.0  # correlation times after which a jump is forgotten
    adapting_s: float = 45.0  # time constant of the variance factor: longer than slow errors
    least_factor: float = 0.25  # bounds: smoothed outputs hide slow errors
    most_factor: float = 16.0
    clipped_nis: float = 4.0  # cap per component of one innovation against outliers
    shared_s: float = 1800.0  # memory of receiver differences: shares change with place
    compared_s: float = 10.0  # interval of those: poorly stated white noise must not count

    # Errors of absolute headings. Data sheets say 1 to 2 degrees in a clean field; machines are of steel.
    least_heading_rad: float = math.radians(3)  # floor, unless configured
    heading_white: float = 0.1  # white share of the variance
    heading_s: float = 300.0  # correlation time, between roadside disturbances (seconds) and own steel
    heading_due_s: float = 0.5  # interval of used headings


TUNING = LocalisationTuning()
