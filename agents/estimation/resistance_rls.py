"""Rolling resistance and grade by recursive least squares with one forgetting factor per parameter.

Vahidi, Stefanopoulou, Peng, "Recursive least squares with forgetting for online estimation of vehicle mass and road
grade", Vehicle System Dynamics 43 (2005): mass forgets slowly, ground fast; gains share a denominator:

    L_i = (P_i h_i / lambda_i) / (1 + sum_j P_j h_j^2 / lambda_j)      P_i <- (1 - L_i h_i) P_i / lambda_i

h_i: regressors; the second L_i takes other parameters as known. Here factors f are per second, lambda = f^dt.
"""

import math

import numpy as np

from agents.estimation.balance import BalanceStep
from agents.estimation.tuning import TUNING
from protocol.arrays import Floats

NEAR_NS = 500_000_000  # age at which a step gives no estimate
FIRST_SCALE_VARIANCE = 1e-3  # relative to the noise
MAX_VARIANCE = np.array([1e-2, 1.0])  # bounds of scale and c_rr: without excitation, forgetting must end
# Weight after a second: ground changes at once, load at stops minutes apart.
FORGET = 0.6
FORGET_MASS = 0.995
FORGET_GRADE = 0.2
MAX_GRADE_SINE = 0.9


class MultipleForgetting:
    """Parameters (k,), variances (k,) relative to the noise, factors per second (k,)."""

    def __init__(self, start: Floats, variance: Floats, forget: Floats, most: Floats) -> None:
        self.parameters, self.variance = start.astype(float), variance.astype(float)
        self._forget, self._most = forget, most

    def update(self, dt_s: float, y: float, h: Floats) -> None:
        """Add a measurement y = h . parameters + noise."""
        factor = self._forget**dt_s
        weight = self.variance * h / factor
        gain = weight / (1 + weight @ h)
        self.parameters = self.parameters + gain * (y - h @ self.parameters)
        alone = weight / (1 + weight * h)
        self.variance = np.minimum((1 - alone * h) * self.variance / factor, self._most)


class RecursiveResistance:
    """c_rr, and the scale error of drive force over mass if estimated."""

    def __init__(self, *, estimates_mass: bool = False) -> None:
        variance = np.array([FIRST_SCALE_VARIANCE if estimates_mass else 0.0, 1.0])
        forget, most = np.array([FORGET_MASS, FORGET]), MAX_VARIANCE * [estimates_mass, 1]
        self._squares = MultipleForgetting(np.array([0.0, TUNING.first_c_rr]), variance, forget, most)
        self._stamp_ns = 0
        self._force = (0.0, 1.0)

    @property
    def scale(self) -> float:
        """Scale error of drive force over mass [-]; 0 if not estimated."""
        return float(self._squares.parameters[0])

    def update(self, step: BalanceStep) -> None:
        """Add a step."""
        self._force = (step.share, step.regressor)
        self._squares.update(step.dt_s, step.raw, np.array([step.share, step.regressor]))
        self._stamp_ns = step.stamp_ns

    def stand(self, *, changes_load: bool) -> None:
        """Forget mass faster once, if the load may change."""
        if changes_load:
            self._squares.variance[0] = min(10 * self._squares.variance[0], MAX_VARIANCE[0])

    def recalibrate(self, zero: float, scale: float) -> None:
        """Apply a change of the calibration."""
        share, regressor = self._force
        self._squares.parameters[1] -= (zero + scale * share) / regressor

    def at(self, stamp_ns: int) -> tuple[float, float] | None:
        """The newest c_rr and its variance, of an exponentially weighted mean of white noise; None if too old."""
        if not self._stamp_ns or self._stamp_ns < stamp_ns - NEAR_NS:
            return None
        return float(self._squares.parameters[1]), TUNING.noise**2 * -math.log(FORGET) / 2


class RecursiveGrade:
    """Slope ahead [rad] from gravity's share of the specific force."""

    def __init__(self) -> None:
        self._squares = MultipleForgetting(np.zeros(1), np.ones(1), np.array([FORGET_GRADE]), np.ones(1))

    def update(self, dt_s: float, sine: float) -> float:
        """Add the sine by the accelerometer; returns the slope."""
        self._squares.update(dt_s, sine, np.ones(1))
        return math.asin(max(-MAX_GRADE_SINE, min(MAX_GRADE_SINE, float(self._squares.parameters[0]))))
