"""Rolling resistance and grade by recursive least squares with one forgetting factor per parameter.

Vahidi, Stefanopoulou, Peng, "Recursive least squares with forgetting for online estimation of vehicle mass and road
grade", Vehicle System Dynamics 43 (2005): what changes slowly, the mass, forgets slowly; what changes at once, the
ground, forgets fast; and the gains of all share one denominator. With regressors h_i, gains and covariances are

    L_i = (P_i h_i / lambda_i) / (1 + sum_j P_j h_j^2 / lambda_j)      P_i <- (1 - L_i h_i) P_i / lambda_i

where L_i in the second equation is computed as if the other parameters were known. Forgetting factors are per second
here, f in lambda = f^dt, so that they mean the same at any rate.
"""

import math

import numpy as np

from agents.estimation.balance import BalanceStep
from agents.estimation.tuning import TUNING
from protocol.arrays import Floats

NEAR_NS = 500_000_000  # a stamp this far from a usable step has no estimate
FIRST_SCALE_VARIANCE = 1e-3  # in units of the noise, as that of c_rr, which is 1
MAX_VARIANCE = np.array([1e-2, 1.0])  # of scale and c_rr: what is not excited must not be forgotten without end
# Share of the past that still counts a second later: the ground changes at once, the load at stops minutes apart.
FORGET = 0.6
FORGET_MASS = 0.995
FORGET_GRADE = 0.2
MAX_GRADE_SINE = 0.9


class MultipleForgetting:
    """The algorithm: parameters (k,), variances (k,) in units of the noise, factors per second (k,)."""

    def __init__(self, start: Floats, variance: Floats, forget: Floats, most: Floats) -> None:
        self.parameters, self.variance = start.astype(float), variance.astype(float)
        self._forget, self._most = forget, most

    def update(self, dt_s: float, y: float, h: Floats) -> None:
        """Add one measurement y = h . parameters + noise."""
        factor = self._forget**dt_s
        weight = self.variance * h / factor
        gain = weight / (1 + weight @ h)
        self.parameters = self.parameters + gain * (y - h @ self.parameters)
        alone = weight / (1 + weight * h)
        self.variance = np.minimum((1 - alone * h) * self.variance / factor, self._most)


class RecursiveResistance:
    """c_rr, and the scale error of drive force over mass where the mass is to be estimated."""

    def __init__(self, *, estimates_mass: bool = False) -> None:
        variance = np.array([FIRST_SCALE_VARIANCE if estimates_mass else 0.0, 1.0])
        forget, most = np.array([FORGET_MASS, FORGET]), MAX_VARIANCE * [estimates_mass, 1]
        self._squares = MultipleForgetting(np.array([0.0, TUNING.first_c_rr]), variance, forget, most)
        self._stamp_ns = 0
        self._force = (0.0, 1.0)  # share and regressor of the last step

    @property
    def scale(self) -> float:
        """The scale error of drive force over mass [-]; 0 where it is not estimated."""
        return float(self._squares.parameters[0])

    def update(self, step: BalanceStep) -> None:
        """Add a step."""
        self._force = (step.share, step.regressor)
        self._squares.update(step.dt_s, step.raw, np.array([step.share, step.regressor]))
        self._stamp_ns = step.stamp_ns

    def stand(self, *, changes_load: bool) -> None:
        """Forget the mass faster for once, if the load may change."""
        if changes_load:
            self._squares.variance[0] = min(10 * self._squares.variance[0], MAX_VARIANCE[0])

    def recalibrate(self, zero: float, scale: float) -> None:
        """The calibration that raw values have applied has changed by so much."""
        share, regressor = self._force
        self._squares.parameters[1] -= (zero + scale * share) / regressor

    def at(self, stamp_ns: int) -> tuple[float, float] | None:
        """The newest c_rr and its variance; None where no step was usable near the stamp.

        The variance is that of a mean of white noise with exponential weights: half the share forgotten per second.
        """
        if not self._stamp_ns or self._stamp_ns < stamp_ns - NEAR_NS:
            return None
        return float(self._squares.parameters[1]), TUNING.noise**2 * -math.log(FORGET) / 2


class RecursiveGrade:
    """Slope ahead [rad] from gravity's share of the specific force."""

    def __init__(self) -> None:
        self._squares = MultipleForgetting(np.zeros(1), np.ones(1), np.array([FORGET_GRADE]), np.ones(1))

    def update(self, dt_s: float, sine: float) -> float:
        """Add the sine of the slope by the accelerometer; returns the slope."""
        self._squares.update(dt_s, sine, np.ones(1))
        return math.asin(max(-MAX_GRADE_SINE, min(MAX_GRADE_SINE, float(self._squares.parameters[0]))))
