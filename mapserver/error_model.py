"""What the map errs in: one model, from which the intervals of cells, segments, routes and the worklist follow.

More votes take noise off, but not what they all err in alike. With a resistance c and a gradient g of a place:

    variance of c = PLACE_STD^2 + (PLACE_SHARE c)^2        variance of g = UNEVEN_STD^2 + (SLOPE_SHARE g)^2

Bends, bumps, tyres, and an estimator that follows a border late err alike for all machines, over ALIKE_M of way. Of the
resistance's error COMMON_STD and COMMON_SHARE are alike along a whole line: biases and scales after calibration. What
single machines differ by is less: 0.15e-3 among three trucks on a haul road, where places were off by 2e-3.

Errors of positions are no term of their own: a vote spreads over the cells within its covariance, so the spread of a
cell's votes has them.
"""

from __future__ import annotations

import numpy as np

from protocol.arrays import Floats

# Segments of a haul road with three trucks, in real processes, were off by 1.7e-3 below c_rr of 0.015, by 2.3e-3 up to
# 0.03, and by 4.6 % above (root mean squares).
PLACE_STD, PLACE_SHARE = 0.002, 0.05
# The same recordings were off by 0.7e-3 on average. On 13 drives of three others maps were off by 0.1 to 3.5 % along a
# whole line, 2 % in the root mean square.
COMMON_STD, COMMON_SHARE = 0.001, 0.02
ALIKE_M = 25.0  # of way, over which a place's errors are alike
PASS_ALIKE_M = 10.0  # of way, over which the noise of one pass is alike: its estimator settles
# c_rr of ground that was driven on and not measured, from the ground before and behind it, as a share.
GAP_SHARE = 0.35
UNKNOWN_SHARE = 0.5  # of the price of ground where nobody was
UNKNOWN_SLOPE_STD = 0.05  # there too [m/m]: it is taken for as even as the ground around lets it be
# Gradient: unevenness that a machine bridges and sensors that lag [m/m]; how machines sit on slopes, as a share.
UNEVEN_STD, SLOPE_SHARE = 0.0045, 0.05
RESISTANCE_PRIOR_STD = 1.3  # of log(c_rr): anything between 0.004 and 0.4 is equally likely (log 100 / sqrt 12)
GRADE_PRIOR_STD = 0.1  # of one component of the gradient of any ground [m/m]
MACHINE_SHARE = 0.5  # of the variance that a sample states: its machine's zero and scale, the same in all its passes
NINETY = 1.645  # standard deviations to each side that hold 90 %


def resistance_variance(c_rr: Floats) -> Floats:
    """Variance of c_rr (n,) of places, that no further vote takes off."""
    return np.asarray(PLACE_STD**2 + (PLACE_SHARE * c_rr) ** 2, np.float64)


def line_variance(c_rr: float) -> float:
    """Variance of the mean c_rr along a line, however long it is."""
    return COMMON_STD**2 + (COMMON_SHARE * c_rr) ** 2


def gradient_variance(grade: Floats) -> Floats:
    """Variance of one component of gradients of this steepness (n,), that no further vote takes off."""
    return np.asarray(UNEVEN_STD**2 + (SLOPE_SHARE * grade) ** 2, np.float64)
