"""The state: the 15 of robot_localization, then slow errors of sensors and map.

Frames (REP-103, REP-105): `map` is east, north, up; `base_link` forward, left, up. map_from_base = Rz(yaw) Ry(pitch)
Rx(roll).
"""

from dataclasses import dataclass
from functools import cached_property

POSITION = slice(0, 3)  # [m], in map
ATTITUDE = slice(3, 6)  # roll, pitch, yaw [rad]
VELOCITY = slice(6, 9)  # [m/s], in base_link
RATE = slice(9, 12)  # [rad/s], in base_link
ACCELERATION = slice(12, 15)  # rate of change of VELOCITY [m/s2], in base_link
X, Y, Z, ROLL, PITCH, YAW, SPEED = range(7)  # SPEED: forward
YAW_RATE = 11
BASE_STATES = 15
ANGLES = (ROLL, PITCH, YAW)
# Zero on a plane: height, tilt, and their rates (two_d_mode of robot_localization).
OFF_PLANE = [Z, ROLL, PITCH, 8, 9, 10, 14]


@dataclass(frozen=True)
class Layout:
    """Position of each error in the state, in this order.

    imus: a yaw gyro bias each [rad/s], and one for another turn sensor. wheel_scale [-]: wheels turn by 1 + scale times
    the distance. receivers: a GPS error each, east and north [m]. references: a heading error each [rad]. lanes: map
    offset and lateral habit. None of them: the paper's 15 states.
    """

    imus: int = 0
    wheel_scale: bool = False
    receivers: int = 0
    references: int = 0
    lanes: bool = False

    def __post_init__(self) -> None:
        if min(self.imus, self.receivers, self.references) < 0:
            raise ValueError("imus, receivers and references must not be negative")

    @cached_property
    def n(self) -> int:
        """Number of states."""
        return BASE_STATES + self.imus + self.wheel_scale + 2 * self.receivers + self.references + 3 * self.lanes

    @cached_property
    def gyro_biases(self) -> slice:
        """One per IMU [rad/s]."""
        return slice(BASE_STATES, BASE_STATES + self.imus)

    @cached_property
    def wheel_scales(self) -> slice:
        """One wheel scale [-], or none."""
        first = self.gyro_biases.stop
        return slice(first, first + self.wheel_scale)

    @cached_property
    def gps_errors(self) -> slice:
        """Two per receiver [m]."""
        first = self.wheel_scales.stop
        return slice(first, first + 2 * self.receivers)

    @cached_property
    def heading_errors(self) -> slice:
        """One per reference [rad]."""
        first = self.gps_errors.stop
        return slice(first, first + self.references)

    @cached_property
    def map_offset(self) -> slice:
        """Map offset, east and north [m]; none without lanes."""
        first = self.heading_errors.stop
        return slice(first, first + 2 * self.lanes)

    @cached_property
    def beside_lane(self) -> slice:
        """Offset to the left of the fleet's lanes [m]; none without lanes."""
        first = self.map_offset.stop
        return slice(first, first + self.lanes)

    @cached_property
    def lane_guards(self) -> slice:
        """Both: the offset, and how far beside."""
        return slice(self.map_offset.start, self.beside_lane.stop)

    def gyro_bias(self, imu: int) -> int:
        """State of one yaw gyro's bias."""
        if not 0 <= imu < self.imus:
            raise IndexError(f"no IMU {imu} among {self.imus}")
        return BASE_STATES + imu

    def gps_error(self, receiver: int) -> slice:
        """States of one receiver's error: east, north."""
        if not 0 <= receiver < self.receivers:
            raise IndexError(f"no receiver {receiver} among {self.receivers}")
        first = self.gps_errors.start + 2 * receiver
        return slice(first, first + 2)
