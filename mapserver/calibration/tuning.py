"""Constants of calibration, for experiments to replace."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CalibrationTuning:
    """Certainty of sources, gaps of data sheets, and when an estimate counts."""

    # deviations of one stay, constant and relative
    c_std: float = 0.004
    c_share: float = 0.08
    slope_std: float = 0.006
    slope_share: float = 0.3
    same: float = 0.25  # share of variance that repeats with the place in the lane
    rise_std_m: float = 0.02  # deviation of a link's rise [m], constant and relative to slope
    rise_share_m: float = 0.3
    bend_share: float = 0.16  # deviation across a bend, relative to length times change of slope
    known_std: float = 0.001  # deviation of stated c_rr
    inside_m: float = 6.0  # metres from an area's border to cell centres: two deviations of a position, and 3 m

    # metres between an edge's stays, the bend in the middle
    edge_m: float = 20.0
    settle_m: float = 7.0  # metres on each side in which c_rr follows a change
    bend: float = 0.1  # least change of an edge's slope
    step: float = 0.05  # largest change between stays on a steady slope
    place_m: float = 15.0  # size of a place [m], which has one step, however often passed
    place_std: float = 0.004  # prior of a place's step: soil borders lie near many ramps

    # Edges need ground that does not change with slope, everywhere or at many places.
    ramps_std: float = 0.07  # prior of c_rr per slope, common to all ramps: 0.02 at 15 degrees
    ramps_limit: float = 0.015  # limit of c_rr per slope, 0.004 at 15 degrees; and in deviations
    ramps_sigmas: float = 2.0
    step_limit: float = 0.008  # limit of steps [c_rr], and share of places beyond it
    stepped_share: float = 0.3

    # rolling differently, relative to c_rr
    rolls_std: float = 0.5  # priors, relative and constant [c_rr]
    drags_std: float = 0.02
    unlike: float = 0.06  # normal difference: tyres, loads, masses to 3 %
    alike: float = 0.1  # difference below which machines are alike
    rolls_floor: float = 0.02  # model error

    # when an estimate counts; sigmas of the data sheet
    observed: float = 0.25  # share of the prior's variance: half its deviation
    faulty_sigmas: float = 3.0  # a scale worse than anything a slope may hide
    # largest, of machines known only by differences: of two sound ones 1 in 200
    unnamed_sigmas: float = 2.0
    zero_floor: float = 0.0004  # model error of a bias
    scale_floor: float = 0.004  # model error of a scale


TUNING = CalibrationTuning()
