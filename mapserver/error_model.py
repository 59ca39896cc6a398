"""The map's error model, for intervals of cells, segments, routes and the worklist.

More votes reduce noise, but not the common error. With resistance c and gradient g of a place:

    variance of c = PLACE_STD^2 + (PLACE_SHARE c)^2        variance of g = UNEVEN_STD^2 + (SLOPE_SHARE g)^2

Bends, bumps, tyres, and estimators that lag at borders err alike for all machines, over ALIKE_M. COMMON_STD and
COMMON_SHARE are alike along a line: biases and scales after calibration. Machines differ less: 0.15e-3 among three
trucks on a haul road with places 2e-3 off. Position errors are in the votes' spread, as votes spread over cells by
covariance.
"""

from __future__ import annotations

import numpy as np

from protocol.arrays import Floats

# Segments of a haul road with three trucks, in real processes, were 1.7e-3 off below c_rr 0.015, 2.3e-3 to 0.03, 4.6 %
# above (RMS).
PLACE_STD, PLACE_SHARE = 0.002, 0.05
# The same recordings were 0.7e-3 off on average; whole lines of 13 drives of three others 0.1 to 3.5 %, RMS 2 %.
COMMON_STD, COMMON_SHARE = 0.001, 0.02
ALIKE_M = 25.0  # metres over which errors of places correlate
PASS_ALIKE_M = 10.0  # metres over which a pass's noise correlates, as its estimator settles
# relative deviation of unmeasured ground, interpolated along a line
GAP_SHARE = 0.35
UNKNOWN_SHARE = 0.5  # relative deviation of the price of unknown ground
UNKNOWN_SLOPE_STD = 0.05  # deviation of unknown slopes [m/m], as even as known ground permits
# unevenness that machines bridge and sensors' lag [m/m]; machines' pitch on slopes, relative
UNEVEN_STD, SLOPE_SHARE = 0.0045, 0.05
RESISTANCE_PRIOR_STD = 1.3  # deviation of log(c_rr), uniform from 0.004 to 0.4 (log 100 / sqrt 12)
GRADE_PRIOR_STD = 0.1  # deviation of a gradient component of any ground [m/m]
MACHINE_SHARE = 0.5  # share of a sample's stated variance that all passes of its machine have in common: bias and scale
NINETY = 1.645  # standard deviations on each side of a 90 % interval


def resistance_variance(c_rr: Floats) -> Floats:
    """Variance of c_rr (n,) that more votes do not reduce."""
    return np.asarray(PLACE_STD**2 + (PLACE_SHARE * c_rr) ** 2, np.float64)


def line_variance(c_rr: float) -> float:
    """Variance of the mean c_rr along a line of any length."""
    return COMMON_STD**2 + (COMMON_SHARE * c_rr) ** 2


def gradient_variance(grade: Floats) -> Floats:
    """Variance of a gradient component by steepness (n,), which more votes do not reduce."""
    return np.asarray(UNEVEN_STD**2 + (SLOPE_SHARE * grade) ** 2, np.float64)
