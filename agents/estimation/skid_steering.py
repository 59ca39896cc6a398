"""Whether a machine steers by skidding, and when: wheels or tracks slide sideways in every turn.

The effort looks like rolling resistance: on asphalt a Clearpath Husky shows c_rr 0.012 straight on, 0.06 to 0.08 in
turns. A turn on the spot shows it: the sides roll in opposite directions, and the gyro turns. A joint or steered axle
cannot do that.
"""

from agents.dead_reckoning import DeadReckoning
from agents.estimation.balance import Balance
from agents.estimation.plausibility import AXLES_M
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Encoder, Odometry, Reading, WheelReading

ON_SPOT_RAD = 1.5  # turn on the spot that shows it; a bending loader turns by 0.6
SPOT_SHARE = 0.25  # radius below which a turn is on the spot, in wheelbases
# Angle of an axle's wheels to their path; a tyre resists by ten times its square, 0.01 of the load.
MAX_SIDE_RAD = 0.03
MIN_TURN_RADPS = 0.02  # below it may be gyro bias
TURN_S = 0.5  # time constant of the turn rate


class SkidSteering:
    """Follows one machine's wheels. is_so: as configured, else as the wheels show."""

    def __init__(self, machine: MachineConfig) -> None:
        self.is_so = machine.skid_steers or False
        self._looks = machine.skid_steers is None
        self._axles_m = machine.wheelbase_m or AXLES_M
        self._last: tuple[Reading, float] | None = None  # of the first wheel sensor, and the machine's angle then
        self._ways = (0.0, 0.0)  # signs of each wheel's last non-zero ticks
        self._turned_rad = 0.0
        self._yaw_radps = 0.0  # low-passed

    def update(self, reading: Reading, sensor: SensorConfig, dead_reckoning: DeadReckoning) -> None:
        """Add a reading, after dead reckoning."""
        if self.is_so or not self._looks or not isinstance(reading, WheelReading):
            return
        last, self._last = self._last, (reading, dead_reckoning.angle_rad)
        if last is None or last[0].sensor != reading.sensor:
            return
        spins = self._spins(last[0], reading, sensor)
        if spins is not None:
            self._turned_rad = self._turned_rad + dead_reckoning.angle_rad - last[1] if spins else 0.0
        self.is_so = abs(self._turned_rad) > ON_SPOT_RAD

    def turns(self, balance: Balance) -> bool:
        """Whether wheels slide sideways in this step."""
        self._yaw_radps += min(balance.dt_s / TURN_S, 1.0) * (balance.yaw_radps - self._yaw_radps)
        rate = abs(self._yaw_radps)
        return (
            self.is_so and rate > MIN_TURN_RADPS and 0.5 * self._axles_m * rate > MAX_SIDE_RAD * abs(balance.speed_mps)
        )

    def _spins(self, last: Reading, reading: Reading, sensor: SensorConfig) -> bool | None:
        """Whether wheels turn the machine on the spot; None at rest."""
        if isinstance(reading, Encoder) and isinstance(last, Encoder):
            left, right = reading.left_ticks - last.left_ticks, reading.right_ticks - last.right_ticks
            self._ways = (left or self._ways[0], right or self._ways[1])
            return self._ways[0] * self._ways[1] < 0 if left or right else None
        if isinstance(reading, Odometry) and sensor.provides("rate") and sensor.provides("speed"):
            rate, speed = abs(reading.rate_z_radps), abs(reading.speed_x_mps)
            return speed < SPOT_SHARE * self._axles_m * rate if rate or speed else None
        return None
