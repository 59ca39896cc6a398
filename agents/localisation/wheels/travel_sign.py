"""Direction of travel: changes of speed against the accelerometer's force ahead.

Over spans of a second, a: mean acceleration by speed, f: mean specific force ahead less the gyro's tilt change, both
less recent means, which hold slope and bias:

    a = k f + noise        k = 1, or -1 if the speed has the wrong sign

The regression forgets; steady speed shows nothing.
"""

import math

from protocol.units import GRAVITY_MPS2

SPAN_S = 1.0  # shorter spans show noise, longer ones hide starts and stops
MAX_SPAN_S = 2.5  # longest span that shows acceleration
TILT_S = 5.0  # memory of tilt: a bias of 0.5 degrees per second adds 2.5 degrees
MEAN_S = 10.0  # memory of slope and bias
MEMORY_S = 60.0  # memory of the regression: machines start or stop within it
GAINS = 0.5, 2.0  # bounds of its gain; changing slopes reduce it
MIN_SIGMA = 4.0  # gain over its standard deviation
MIN_SPANS = 2.0  # a single shock decides nothing
NOISE_MPS2, NOISE_SPANS = 0.2, 4.0  # prior noise, a Doppler of 0.14 m/s, and its weight in spans


class TravelSign:
    """The sign of one speed source; input in stamp order."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Restart, as the sign may have changed."""
        self._tilt_rad = 0.0
        self._force_mps, self._force_s = 0.0, 0.0  # integral of force over the span, and its time
        self._last: tuple[int, float] | None = None  # at the span's begin
        self._means: tuple[float, float] | None = None  # of acceleration and force
        self._count = self._aa = self._af = self._ff = 0.0

    def add_force(self, ahead_mps2: float, nose_up_radps: float, dt_s: float) -> None:
        """Add mean specific force ahead, with gravity, and mean pitch rate over dt_s."""
        if not 0 < dt_s <= MAX_SPAN_S:  # a pause
            self._tilt_rad, self._last = 0.0, None
            return
        self._tilt_rad += dt_s * (nose_up_radps - self._tilt_rad / TILT_S)
        self._force_mps += (ahead_mps2 - GRAVITY_MPS2 * self._tilt_rad) * dt_s
        self._force_s += dt_s

    def add_speed(self, stamp_ns: int, speed_mps: float) -> None:
        """Add a speed of unknown sign."""
        since_s = (stamp_ns - self._last[0]) * 1e-9 if self._last else math.inf
        if 0 <= since_s < 0.95 * SPAN_S:
            return
        if self._last and since_s <= MAX_SPAN_S and abs(self._force_s - since_s) < 0.2 * since_s:
            self._add_span((speed_mps - self._last[1]) / since_s, self._force_mps / self._force_s, since_s)
        self._last = stamp_ns, speed_mps
        self._force_mps = self._force_s = 0.0

    def _add_span(self, accel_mps2: float, force_mps2: float, dt_s: float) -> None:
        mean_accel, mean_force = self._means or (accel_mps2, force_mps2)
        a, f, share = accel_mps2 - mean_accel, force_mps2 - mean_force, min(dt_s / MEAN_S, 1.0)
        self._means = mean_accel + share * a, mean_force + share * f
        fade = math.exp(-dt_s / MEMORY_S)
        self._count = fade * self._count + 1
        self._aa, self._af, self._ff = fade * self._aa + a * a, fade * self._af + a * f, fade * self._ff + f * f

    @property
    def sign(self) -> int:
        """1 if the speed has the sign of the motion, -1 if the other, 0 if unknown."""
        if self._count <= MIN_SPANS or not self._ff:
            return 0
        gain = self._af / self._ff
        unexplained = max(self._aa - gain * self._af, 0.0) + NOISE_SPANS * NOISE_MPS2**2
        variance = unexplained / (self._count - 1 + NOISE_SPANS) / self._ff
        is_shown = GAINS[0] <= abs(gain) <= GAINS[1] and gain**2 >= MIN_SIGMA**2 * variance
        return int(math.copysign(1, gain)) if is_shown else 0
