"""Which part of an estimate is applied, and who is beyond what a data sheet may mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapserver.fleet.machine_state import SURE
from mapserver.fleet.observability import OBSERVED, CommonScale, Observed
from mapserver.fleet.passages import Epochs
from mapserver.fleet.solver import SCALE_STD, ZERO_STD, Estimate, Problem
from protocol.arrays import Bools, Floats, Ints

FAULTY_SIGMAS = 3.0  # of the data sheet: a scale so far off is worse than anything that a slope may hide
FAULT_SIGMAS = 5.0, 0.3 / SCALE_STD  # of the data sheet: a zero, and a scale of 30 %, that no sensor of its kind has
# Where only the difference of machines is known, nobody can be named: then none may be further off than this, in
# standard deviations of the data sheet, or nothing is applied. Between two sound machines that is one case in 200.
UNNAMED_SIGMAS = 2.0


@dataclass(frozen=True)
class Applied:
    """The part of an estimate that is applied: x (p,), and the covariance (p, p) of what is left.

    scaled (m,): whether a machine has a scale of its own. beyond (m, 2): see MachineState.
    """

    x: Floats
    covariance: Floats
    scaled: Bools
    beyond: Floats


def applied_part(pb: Problem, result: Estimate, observed: Observed, others: CommonScale) -> Applied:
    """Scales count where the evidence shows them, and where they are so far off that any value is better than none.

    There the estimate itself is taken: what is not observed of it is no more than what the data sheet leaves open. But
    not where slopes contradict each other, or half of the machines are far off: nobody knows then who is.
    """
    scales = np.arange(pb.layout.scales.start, pb.layout.scales.stop)
    absolute = observed.absolute & others.observed
    covariance, beyond = result.covariance(), beyond_data_sheet(pb, result, 0.0 if others.observed else others.std)
    if result.edges:
        beyond[:, 1] *= absolute
    far = beyond[:, 1] > FAULTY_SIGMAS
    if 2 * far.sum() >= len(far) > 1:
        beyond[:, 1] *= absolute
        far &= absolute
    x, left = observed.x.copy(), observed.covariance.copy()
    x[scales] = np.where(absolute, x[scales], np.where(far, result.x[scales], 0.0))
    for index, at in enumerate(scales.tolist()):
        if not absolute[index]:
            left[at, :] = left[:, at] = 0.0
            left[at, at] = covariance[at, at] if far[index] else SCALE_STD**2
    zeros = np.arange(len(pb.epochs.number))
    if len(unnamed := _unnamed(pb, x[zeros], np.diag(covariance)[zeros])):
        at = np.flatnonzero(np.isin(pb.epochs.machine, unnamed))
        x[at], beyond[unnamed, 0] = 0.0, 0.0
        left[at, :] = left[:, at] = 0.0
        left[at, at] = ZERO_STD**2
    left[zeros, zeros] += moved(pb.epochs, x[zeros], left[zeros, zeros])
    return Applied(x, left, absolute | far, beyond)


def _unnamed(pb: Problem, zero: Floats, variance: Floats) -> Ints:
    """Machines of which only differences are known, too large ones for sound machines: who is off cannot be said.

    zero, variance: of all epochs (e,).
    """
    machines = len(pb.names)
    known, off = np.zeros(machines, np.bool_), np.zeros(machines)
    np.logical_or.at(known, pb.epochs.machine, variance < OBSERVED * ZERO_STD**2)
    np.maximum.at(off, pb.epochs.machine, np.abs(zero))
    some = np.flatnonzero(~known)
    return some if machines > 1 and (off[some] > UNNAMED_SIGMAS * ZERO_STD).any() else some[:0]


def moved(epochs: Epochs, zero: Floats, variance: Floats) -> Floats:
    """Variance (e,) of a zero within its epoch, by how far it is from those of the epochs beside it.

    One that steps is off by the whole difference until it steps, one that drifts by less than half: half is taken, of
    what is more than the estimates' own noise.
    """
    machine, number = epochs.machine, epochs.number
    beside = (np.diff(machine) == 0) & (np.diff(number) == 1)
    noise = SURE**2 * (variance[1:] + variance[:-1])
    apart = np.where(beside, np.maximum(np.diff(zero) ** 2 - noise, 0.0) / 4, 0.0)
    return np.asarray(np.maximum(np.append(apart, 0.0), np.append(0.0, apart)), np.float64)


def beyond_data_sheet(pb: Problem, result: Estimate, others_std: float = 0.0) -> Floats:
    """By how many standard deviations of the data sheet the largest zero and the scale (m, 2) are off, for sure.

    others_std: of the scale of those against whose ground the machine was solved.
    """
    std = np.sqrt(np.diag(result.covariance()))
    std[pb.layout.scales] = np.hypot(std[pb.layout.scales], others_std)
    surely = np.maximum(np.abs(result.x) - SURE * std, 0.0)
    zeros = [surely[pb.layout.zeros][pb.epochs.machine == index].max() for index in range(len(pb.names))]
    out: Floats = np.stack([np.array(zeros) / ZERO_STD, surely[pb.layout.scales] / SCALE_STD], axis=1)
    return out
