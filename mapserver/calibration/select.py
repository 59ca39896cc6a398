"""What of the parameters the evidence shows, and by what; and the part of an estimate that may be applied.

A direction is a sum of parameters, each in units of its prior. Directions whose variance is below a share of the
prior's are observed. All others stay at the data sheet: there an estimate would be the noise of weak evidence, or what
the prior shares out among the machines.

`MachineErrors` is what comes of it for one machine, of which a scale is remembered once its evidence is gone;
`AppliedPart` is the part of an estimate that is applied, and names who is beyond what a data sheet may mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver.calibration import sources as src
from mapserver.calibration.correction import ANY_SHARE, Correction
from mapserver.calibration.passages import Epochs
from mapserver.calibration.solver import Estimate, FleetProblem, Prior, inverse
from protocol.arrays import Bools, Floats, Ints
from protocol.machine.samples import SCALE_STD, ZERO_STD

WEAK = 0.01  # of the weight of data sheets: evidence has to do without
REMEMBERED = "remembered"  # an earlier solve showed it
# By which a source is named: each alone, beside the ground that all share.
NAMED = (src.SAME_GROUND, src.CROSSINGS, src.HEIGHTS, src.EDGES, src.KNOWN_GROUND)
SURE = 2.0  # standard deviations by which an estimate must be beyond a limit
# Of a scale that was observed once, and is not seen any more: temperature, tyres and oil change it by so much. Surer
# than what counts as observed, so that it counts until something contradicts it.
REMEMBERED_STD = 0.02
FAULT_SIGMAS = 5.0, 0.3 / SCALE_STD  # of the data sheet: a zero, and a scale of 30 %, that no sensor of its kind has


@dataclass(frozen=True)
class CommonScale:
    """Whether the mean scale of all machines is observed, its standard deviation, and why it is not, "" if it is."""

    observed: bool
    std: float
    reason: str


@dataclass(frozen=True)
class ObservedPart:
    """An estimate's part that may be applied: x (p,), and the covariance (p, p) of what is left of the errors then.

    by: for each machine and each of "zero" and "scale" the sources that show it. absolute (m,): whether the evidence
    shows a machine's scale, not only that it differs from the others'. common: see CommonScale.
    """

    x: Floats
    covariance: Floats
    by: Mapping[str, Mapping[str, tuple[str, ...]]]
    absolute: Bools
    common: CommonScale


def observe(pb: FleetProblem, result: Estimate) -> ObservedPart:
    """Split an estimate into what is observed and what is not."""
    layout = pb.layout
    x, covariance = observed_part(result, pb.tuning.observed)
    evidence = _by_evidence(pb, result)
    least = pb.tuning.observed * SCALE_STD**2
    absolute = np.diag(evidence)[layout.scales] < least
    std = float(np.sqrt(evidence[layout.scales, layout.scales].mean()))
    observed = std**2 < least
    common = CommonScale(observed, min(std, SCALE_STD), "" if observed else result.edges or "no_slope_both_ways")
    return ObservedPart(x, covariance, _by(pb, result), absolute, common)


def observed_part(result: Estimate, share: float) -> tuple[Floats, Floats]:
    """The estimate projected on observed directions, from what is known beforehand; the covariance of what it leaves.

    share: of the prior's variance, below which a direction is observed.
    With L L' the prior's information, directions are eigenvectors of L' P L, whose eigenvalues are ratios of variances.
    """
    lower = np.linalg.cholesky(result.prior.matrix)
    ratios, directions = np.linalg.eigh(lower.T @ result.covariance() @ lower)
    shown = ratios < share
    left = np.where(shown, ratios, 1.0)  # of the prior's variance
    units = np.linalg.solve(lower.T, directions)
    before = np.linalg.solve(result.prior.matrix, result.prior.vector)
    applied = before + units[:, shown] @ (directions[:, shown].T @ (lower.T @ (result.x - before)))
    return applied, (units * left) @ units.T


def _by_evidence(pb: FleetProblem, result: Estimate) -> Floats:
    """Covariance without the data sheets' word on scales: that of many machines together is no evidence."""
    matrix = result.prior.matrix + sum(each.matrix for each in result.information.values())
    return inverse(without_data_sheet(pb, matrix, range(len(pb.names))))


def without_data_sheet(pb: FleetProblem, matrix: Floats, machines: Sequence[int]) -> Floats:
    """An information matrix (p, p), which is changed, without the data sheets' word on the scales of machines."""
    scales, own = pb.layout.scales, np.array([p.covariance[1][1] for p in pb.priors])
    weak = np.isin(np.arange(len(own)), machines) & (own >= pb.tuning.observed * SCALE_STD**2)
    at = np.arange(scales.start, scales.stop)[weak]
    matrix[at, at] -= (1 - WEAK) / own[weak]
    return matrix


def _by(pb: FleetProblem, result: Estimate) -> dict[str, dict[str, tuple[str, ...]]]:
    """Which sources show zero and scale of each machine, each source alone beside the ground that all share."""
    layout, share = pb.layout, pb.tuning.observed
    present = [name for name in NAMED if name in result.information]
    variances = {name: np.diag(result.covariance(*{name, src.SAME_GROUND})) for name in present}
    before = np.diag(inverse(result.prior.matrix))
    data_sheet = {"zero": ZERO_STD**2, "scale": SCALE_STD**2}
    out = {}
    for index, name in enumerate(pb.names):
        epochs = np.flatnonzero(pb.epochs.machine == index)
        shown = {"zero": epochs, "scale": np.array([layout.scales.start + index])}
        own = dict(zip(shown, np.diag(pb.priors[index].covariance).tolist(), strict=True))
        out[name] = {
            what: (*[REMEMBERED] * (own[what] < share * data_sheet[what]), *_shown(variances, before, at, share))
            for what, at in shown.items()
        }
    return out


def _shown(variances: Mapping[str, Floats], before: Floats, at: Ints, share: float) -> Sequence[str]:
    """Sources by which the variance of these parameters falls enough, on average; what all share needs no other."""
    names = [name for name, after in variances.items() if np.mean(after[at] / before[at]) < share]
    return [src.SAME_GROUND] if src.SAME_GROUND in names else names


@dataclass(frozen=True)
class Rolling:
    """How much harder a machine rolls than the others, as a share of the ground's c_rr, and the standard deviation.

    is_named: whether most others agree; else two groups differ, or two machines, and either may be the odd one.
    work_jpkgs: what that costs at the wheels, per kilogram and second of driving.
    """

    share: float
    std: float
    is_named: bool
    work_jpkgs: float


@dataclass(frozen=True)
class MachineErrors:
    """What is known of one machine: zero of its newest epoch, scale error k, lateral zero, and standard deviations.

    zero_by, scale_by: the sources that show them, none where the data sheet has to do; the scale is 0 then. beyond:
    how many standard deviations of the data sheet the largest zero and the scale are off, for sure. rolling: None of a
    machine that rolls like the others, as far as anything shows.
    """

    zero: float
    zero_std: float
    scale: float
    scale_std: float
    across: float
    across_std: float
    zero_by: tuple[str, ...]
    scale_by: tuple[str, ...]
    beyond: tuple[float, float]
    rolling: Rolling | None = None


def is_surer(prior: Prior, state: MachineErrors | None) -> bool:
    """Whether what is remembered of a scale is surer than what a solve without it says."""
    return state is not None and state.scale_std**2 > prior.covariance[1][1]


def remembered_of(shown: Iterable[Correction]) -> dict[str, Prior]:
    """What evidence showed of scales, by the last correction of each machine. A zero wanders, and is not remembered."""
    out = {}
    for one in shown:
        if one.most_share >= ANY_SHARE and one.covariance:
            state = state_of(one)
            variance = max(state.scale_std, REMEMBERED_STD) ** 2
            out[one.machine] = Prior(0.0, state.scale, ((ZERO_STD**2, 0.0), (0.0, variance)))
    return out


def state_of(correction: Correction) -> MachineErrors:
    """What a correction by the solver says of its machine, where nothing has been solved yet."""
    k = correction.scale / (1 - correction.scale)
    zero_std, scale_std, across_std = np.sqrt(np.diag(correction.covariance)).tolist()
    return MachineErrors(
        zero=correction.zero,
        zero_std=zero_std,
        scale=k,
        scale_std=scale_std,
        across=correction.across,
        across_std=across_std,
        zero_by=(),
        scale_by=(),
        beyond=(
            max(abs(correction.zero) - SURE * zero_std, 0.0) / ZERO_STD,
            max(abs(k) - SURE * scale_std, 0.0) / SCALE_STD,
        ),
    )


@dataclass(frozen=True)
class AppliedPart:
    """The part of an estimate that is applied: x (p,), and the covariance (p, p) of what is left.

    scaled (m,): whether a machine has a scale of its own. beyond (m, 2): see MachineErrors.
    """

    x: Floats
    covariance: Floats
    scaled: Bools
    beyond: Floats


def applied_part(pb: FleetProblem, result: Estimate, observed: ObservedPart, others: CommonScale) -> AppliedPart:
    """Scales count where the evidence shows them, and where they are so far off that any value is better than none.

    There the estimate itself is taken: what is not observed of it is no more than what the data sheet leaves open. But
    not where slopes contradict each other, or half of the machines are far off: nobody knows then who is.
    """
    scales = np.arange(pb.layout.scales.start, pb.layout.scales.stop)
    absolute = observed.absolute & others.observed
    covariance, beyond = result.covariance(), beyond_data_sheet(pb, result, 0.0 if others.observed else others.std)
    if result.edges:
        beyond[:, 1] *= absolute
    far = beyond[:, 1] > pb.tuning.faulty_sigmas
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
    return AppliedPart(x, left, absolute | far, beyond)


def _unnamed(pb: FleetProblem, zero: Floats, variance: Floats) -> Ints:
    """Machines of which only differences are known, too large ones for sound machines: who is off cannot be said.

    zero, variance: of all epochs (e,).
    """
    machines = len(pb.names)
    known, off = np.zeros(machines, np.bool_), np.zeros(machines)
    np.logical_or.at(known, pb.epochs.machine, variance < pb.tuning.observed * ZERO_STD**2)
    np.maximum.at(off, pb.epochs.machine, np.abs(zero))
    some = np.flatnonzero(~known)
    return some if machines > 1 and (off[some] > pb.tuning.unnamed_sigmas * ZERO_STD).any() else some[:0]


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


def beyond_data_sheet(pb: FleetProblem, result: Estimate, others_std: float = 0.0) -> Floats:
    """By how many standard deviations of the data sheet the largest zero and the scale (m, 2) are off, for sure.

    others_std: of the scale of those against whose ground the machine was solved.
    """
    std = np.sqrt(np.diag(result.covariance()))
    std[pb.layout.scales] = np.hypot(std[pb.layout.scales], others_std)
    surely = np.maximum(np.abs(result.x) - SURE * std, 0.0)
    zeros = [surely[pb.layout.zeros][pb.epochs.machine == index].max() for index in range(len(pb.names))]
    out: Floats = np.stack([np.array(zeros) / ZERO_STD, surely[pb.layout.scales] / SCALE_STD], axis=1)
    return out
