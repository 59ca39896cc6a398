"""What tunes the comparison of machines: one frozen set of constants, which experiments replace."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrustTuning:
    """How two maps are compared, and the limits of what sound machines differ by."""

    min_cells: int = 20  # of about 4 m2 that two machines must share; with fewer nothing is decided
    zero_error: float = 0.003  # of c_rr: an accelerometer's bias over g may explain a difference on hard ground
    scatter: float = 0.1  # of log(c_rr) between two machines on one cell, besides that
    cells_per_draw: int = 4  # neighbouring cells share samples and errors: so many count as one
    tolerance: float = 0.3  # of log(c_rr + 0.01), within which cells agree; dry and wet dirt are 0.34 apart

    pair_sigmas: float = 1.0  # standard errors that are added to each limit: of a vote, as several are needed,
    verdict_sigmas: float = 2.0  # and of a verdict
    alike: float = 0.75  # share of the limit up to which maps agree; between it and the limit nothing is said
    gain_limit: float = 1.15  # ratio of coefficients: agents know mass and torque to 3 %, a class is wrong from 1.25
    share: float = 0.75  # of the ground with a gain, and of the borders with a shift: a repaved corner is neither
    offset_limit_m: float = 1.5  # of positions: what slow receiver errors leave after hours
    agreement: float = 0.6  # least share of the ground within the tolerance
    stuck_spread: float = 0.25  # a sensor is stuck where its levels vary by less than this share of the others',
    min_spread: float = 0.3  # if those vary by so much


TUNING = TrustTuning()
