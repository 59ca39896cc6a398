"""Constants of the comparison of machines, for experiments to replace."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrustTuning:
    """Model and limits of the comparison."""

    min_cells: int = 20  # shared cells of about 4 m2; fewer decide nothing
    zero_error: float = 0.003  # bias in c_rr, which matters on hard ground
    scatter: float = 0.1  # deviation of log(c_rr) on one cell, besides the bias
    cells_per_draw: int = 4  # neighbouring cells that count as one: they share samples
    tolerance: float = 0.3  # difference of log(c_rr + 0.01) within which cells agree; dry and wet dirt are 0.34 apart

    pair_sigmas: float = 1.0  # standard errors added to limits of a vote, of which several are needed
    verdict_sigmas: float = 2.0  # standard errors added to limits of a verdict
    alike: float = 0.75  # share of a limit up to which maps agree
    gain_limit: float = 1.15  # ratio of c_rr: agents know mass and torque to 3 %, classes differ from 1.25
    share: float = 0.75  # least share of the ground with a gain, of borders with a shift; a repaved corner has less
    offset_limit_m: float = 1.5  # metres that slow receiver errors leave after hours
    agreement: float = 0.6  # least share of agreeing ground
    stuck_spread: float = 0.25  # share of the others' spread of levels below which a sensor is stuck
    min_spread: float = 0.3  # least spread of the others for this


TUNING = TrustTuning()
