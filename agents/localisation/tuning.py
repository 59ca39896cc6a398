"""What tunes localisation: one frozen set of constants, which experiments replace."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)  # hashed by identity, as the filter looks up what it has made of one at each step
class LocalisationTuning:
    """Process noises, standard deviations, gates and memories of the filter and of the errors of its sensors.

    Standard deviations of sensors hold where neither a reading nor the configuration states one.
    """

    # Process noise. The distance driven is unsure by its square root [m/sqrt(m)], so a machine at rest does not slip.
    slip_along: float = 0.02
    slip_across: float = 0.03
    height_walk: float = 0.02  # [m/sqrt(s)], as all walks [unit/sqrt(s)]
    tilt_walk: float = 5e-3  # [rad], roll and pitch
    heading_walk: float = 1e-3  # [rad], also of the heading that an attitude reference counts from
    velocity_walk: float = 0.05  # [m/s]
    rate_walk: float = 0.3  # [rad/s]
    acceleration_walk: float = 1.0  # [m/s2]
    gyro_bias_walk: float = 5e-5  # [rad/s]
    wheel_scale_walk: float = 2e-4
    slip_std: float = 0.08  # of the wheels' slip per traction, which the speed is corrected by
    slip_s: float = 5.0  # correlation time of that: how long a ground stays the same
    load_doubt: float = 0.5  # standard deviation of the slip, over the slip, with an unknown load up to the empty mass
    bend_s: float = 60.0  # correlation time of an odometry's turn rate: a wrong scale errs differently in every bend
    turn_s: float = 3.0  # correlation time of a turn that no sensor shows;
    curvature: float = 0.1  # its standard deviation per metre driven [rad/m],
    max_turn_radps: float = 0.3  # and the limits of it
    least_turn_radps: float = 0.005

    # Standard deviations of the first belief.
    first_speed_mps: float = 3.0  # the machine may drive already, and wheels take a moment to show it
    first_gyro_bias_radps: float = 5e-3
    first_wheel_scale: float = 0.03

    # Standard deviations of measurements.
    rate_radps: float = 0.005  # angular rate of an IMU, mean over a filter step
    force_mps2: float = 2.0  # specific force of an IMU, with its bias and mounting error, which do not average out
    turn_radps: float = 0.02  # turn rate of odometry, and its lasting error at first; that of steering per m/s
    steering_rad: float = 0.01  # steering angle: resolution, play, tyres that do not roll where they point
    steered_s: float = 1.0  # correlation time of that: drivers hold an angle
    speed_mps: float = 0.04  # of wheels
    side_mps: float = 0.04  # sideways slide of a machine
    still_mps: float = 0.005  # of a machine at rest
    rolling_s: float = 0.5  # time constant of the low-pass on the rolling resistance, by which wheels slip more

    # Gates, in standard deviations.
    gate_sigma: float = 6.0  # wide, as mounting and slip are not Gaussian
    rest_sigma: float = 3.0  # of a standstill that wheels do not show
    gps_gate_sigma: float = 4.0  # of fixes, and of differences of receivers: reflections make outliers
    relock: int = 15  # refusals in a row after which a sensor is accepted again: the filter is lost, not the sensor
    unplaced_s: float = 5.0  # without GPS, after which wheels and IMUs teach neither place, heading nor bias

    # Slow errors of receivers.
    restated: float = 4.0  # a variance that is stated so many times as large or small is that of another error
    faded: float = 15.0  # correlation times after which a jump is forgotten
    adapting_s: float = 45.0  # in which a variance follows the innovations: not some slow errors, a wrong statement
    least_factor: float = 0.25  # of a stated variance: smoothed outputs do not show slow errors
    most_factor: float = 16.0
    clipped_nis: float = 4.0  # of one innovation, per component: an outlier is no statement
    shared_s: float = 1800.0  # memory of differences of receivers: what they share changes from place to place
    compared_s: float = 10.0  # between two of these: white noise, which receivers know badly, must not count

    # Errors of absolute headings. Data sheets state 1 to 2 degrees, of a clean magnetic field; machines are of steel.
    least_heading_rad: float = math.radians(3)  # standard deviation, unless it is configured
    heading_white: float = 0.1  # white share of the variance
    heading_s: float = 300.0  # correlation time, between a disturbance by the road (seconds) and the steel (for ever)
    heading_due_s: float = 0.5  # between two that are used: a slow error shows nothing new


TUNING = LocalisationTuning()
