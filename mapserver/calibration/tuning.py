"""What tunes calibration: one frozen set of constants, which experiments replace."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CalibrationTuning:
    """How sure each source of evidence is, what data sheets do not say, and when an estimate counts."""

    # Standard deviations of one stay: of c_rr, which grows with it, and of the slope, which grows with the slope.
    c_std: float = 0.004
    c_share: float = 0.08
    slope_std: float = 0.006
    slope_share: float = 0.3
    same: float = 0.25  # of the variance, repeated where a machine passes again, by its place in the lane
    rise_std_m: float = 0.02  # of the rise of a link, which grows with the slope
    rise_share_m: float = 0.3
    bend_share: float = 0.16  # of its length times the change of its slope, across a bend, which is near its middle
    known_std: float = 0.001  # of c_rr that the site states
    inside_m: float = 6.0  # of a cell's centre in such an area: two standard deviations of a position, and 3 m

    # An edge compares stays so far apart, with the bend of the slope in the middle.
    edge_m: float = 20.0
    settle_m: float = 7.0  # on either side, in which the estimate of c_rr follows a change
    bend: float = 0.1  # least change of the slope that is an edge
    step: float = 0.05  # from stay to stay, of a slope that is not settled
    place_m: float = 15.0  # what one place steps by on its own, however often it is passed:
    place_std: float = 0.004  # a border of two soils lies near many ramps

    # Edges are believed where the ground itself does not change with the slope, neither everywhere nor in many places.
    ramps_std: float = 0.07  # prior of c_rr per slope that all ramps of a site differ by, 0.02 at 15 degrees
    ramps_limit: float = 0.015  # c_rr per slope, 0.004 at 15 degrees, and so many standard deviations
    ramps_sigmas: float = 2.0
    step_limit: float = 0.008  # c_rr, in this share of the places
    stepped_share: float = 0.3

    # Machines that roll unlike the others, as a share of the ground's c_rr.
    rolls_std: float = 0.5  # priors: of the share, and of what a brake costs on any ground [c_rr]
    drags_std: float = 0.02
    unlike: float = 0.06  # by so much machines of one kind may differ: tyres, loads, masses known to 3 %
    alike: float = 0.1  # so near to each other they are not told apart
    rolls_floor: float = 0.02  # error of the model

    # When an estimate counts. Sigmas are standard deviations of the data sheet.
    observed: float = 0.25  # of the prior's variance: half its standard deviation
    faulty_sigmas: float = 3.0  # a scale so far off is worse than anything that a slope may hide
    # Where only differences of machines are known, nothing is applied to any that is further off: one case in 200 of
    # two sound machines.
    unnamed_sigmas: float = 2.0
    zero_floor: float = 0.0004  # errors of the model: no evidence makes a zero surer,
    scale_floor: float = 0.004  # nor a scale


TUNING = CalibrationTuning()
