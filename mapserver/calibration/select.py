"""Which parameters the evidence shows, by which source, and what is applied.

Directions are sums of parameters in units of the prior, observed if their variance is a small share of the prior's.
Others keep the data sheet: their estimate is noise, or the prior's distribution among machines. `MachineErrors` is the
result for one machine; `AppliedPart` is applied, and finds machines beyond their data sheets.
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

WEAK = 0.01  # remaining weight of a data sheet: evidence must be enough
REMEMBERED = "remembered"  # name of earlier evidence as a source
# sources named alone beside the shared ground
NAMED = (src.SAME_GROUND, src.CROSSINGS, src.HEIGHTS, src.EDGES, src.KNOWN_GROUND)
SURE = 2.0  # standard deviations that make a deviation certain
# Deviation of a remembered scale: temperature, tyres and oil change it so far. It counts until contradicted.
REMEMBERED_STD = 0.02
FAULT_SIGMAS = 5.0, 0.3 / SCALE_STD  # data-sheet sigmas of a bias, and of a scale of 30 %, that no sound sensor has


@dataclass(frozen=True)
class CommonScale:
    """Whether the machines' mean scale is observed, its deviation, and why not ("" if it is)."""

    observed: bool
    std: float
    reason: str


@dataclass(frozen=True)
class ObservedPart:
    """The observed part: x (p,), and covariance (p, p) of the remaining errors.

    by: sources of each machine's "zero" and "scale". absolute (m,): the scale itself is observed, not only differences.
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
    """Project on observed directions; returns x, and covariance of the remaining errors.

    share: of the prior's variance that makes a direction observed. With L L' the prior's information, directions are
    eigenvectors of L' P L, whose eigenvalues are variance ratios.
    """
    lower = np.linalg.cholesky(result.prior.matrix)
    ratios, directions = np.linalg.eigh(lower.T @ result.covariance() @ lower)
    shown = ratios < share
    left = np.where(shown, ratios, 1.0)  # relative to the prior's variance
    units = np.linalg.solve(lower.T, directions)
    before = np.linalg.solve(result.prior.matrix, result.prior.vector)
    applied = before + units[:, shown] @ (directions[:, shown].T @ (lower.T @ (result.x - before)))
    return applied, (units * left) @ units.T


def _by_evidence(pb: FleetProblem, result: Estimate) -> Floats:
    """Covariance without data sheets on scales: many together are no evidence."""
    matrix = result.prior.matrix + sum(each.matrix for each in result.information.values())
    return inverse(without_data_sheet(pb, matrix, range(len(pb.names))))


def without_data_sheet(pb: FleetProblem, matrix: Floats, machines: Sequence[int]) -> Floats:
    """Weaken data sheets of these machines' scales in an information matrix (p, p), in place."""
    scales, own = pb.layout.scales, np.array([p.covariance[1][1] for p in pb.priors])
    weak = np.isin(np.arange(len(own)), machines) & (own >= pb.tuning.observed * SCALE_STD**2)
    at = np.arange(scales.start, scales.stop)[weak]
    matrix[at, at] -= (1 - WEAK) / own[weak]
    return matrix


def _by(pb: FleetProblem, result: Estimate) -> dict[str, dict[str, tuple[str, ...]]]:
    """Sources of bias and scale of each machine, each alone beside the shared ground."""
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
    """Sources that cut these variances enough; only the shared ground, if it does."""
    names = [name for name, after in variances.items() if np.mean(after[at] / before[at]) < share]
    return [src.SAME_GROUND] if src.SAME_GROUND in names else names


@dataclass(frozen=True)
class Rolling:
    """Extra rolling of a machine, relative to c_rr, with its deviation.

    is_named: most others agree, or else either of two groups may be odd. work_jpkgs: at the wheels, per kilogram and
    second.
    """

    share: float
    std: float
    is_named: bool
    work_jpkgs: float


@dataclass(frozen=True)
class MachineErrors:
    """Errors of a machine: bias of the newest epoch, scale error k, lateral bias, with deviations.

    zero_by, scale_by: sources, none if only the data sheet is known (scale 0). beyond: data-sheet sigmas that the
    largest bias and the scale surely exceed. rolling: None if normal.
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
    """Whether a remembered scale is more certain than one solved without it."""
    return state is not None and state.scale_std**2 > prior.covariance[1][1]


def remembered_of(shown: Iterable[Correction]) -> dict[str, Prior]:
    """Scales by each machine's last correction. A bias wanders and is not remembered."""
    out = {}
    for one in shown:
        if one.most_share >= ANY_SHARE and one.covariance:
            state = state_of(one)
            variance = max(state.scale_std, REMEMBERED_STD) ** 2
            out[one.machine] = Prior(0.0, state.scale, ((ZERO_STD**2, 0.0), (0.0, variance)))
    return out


def state_of(correction: Correction) -> MachineErrors:
    """State by a solver's correction, before the first solve."""
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
    """What is applied: x (p,), with covariance (p, p) of the remaining errors.

    scaled (m,): has its own scale. beyond (m, 2): see MachineErrors.
    """

    x: Floats
    covariance: Floats
    scaled: Bools
    beyond: Floats


def applied_part(pb: FleetProblem, result: Estimate, observed: ObservedPart, others: CommonScale) -> AppliedPart:
    """Apply scales that are observed, or so far off that any value helps.

    The latter take the whole estimate; but not if slopes contradict each other or half of the machines are far off,
    because the odd one is unknown then.
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
    """Machines known only by differences, too large for sound ones: who is off is unknown. zero, variance: (e,)."""
    machines = len(pb.names)
    known, off = np.zeros(machines, np.bool_), np.zeros(machines)
    np.logical_or.at(known, pb.epochs.machine, variance < pb.tuning.observed * ZERO_STD**2)
    np.maximum.at(off, pb.epochs.machine, np.abs(zero))
    some = np.flatnonzero(~known)
    return some if machines > 1 and (off[some] > pb.tuning.unnamed_sigmas * ZERO_STD).any() else some[:0]


def moved(epochs: Epochs, zero: Floats, variance: Floats) -> Floats:
    """Variance (e,) of a bias within its epoch, from steps to the next ones.

    A step is wrong by all of it until it occurs, a drift by less than half: half is taken, beyond noise.
    """
    machine, number = epochs.machine, epochs.number
    beside = (np.diff(machine) == 0) & (np.diff(number) == 1)
    noise = SURE**2 * (variance[1:] + variance[:-1])
    apart = np.where(beside, np.maximum(np.diff(zero) ** 2 - noise, 0.0) / 4, 0.0)
    return np.asarray(np.maximum(np.append(apart, 0.0), np.append(0.0, apart)), np.float64)


def beyond_data_sheet(pb: FleetProblem, result: Estimate, others_std: float = 0.0) -> Floats:
    """Data-sheet sigmas (m, 2) that the largest bias and the scale surely exceed.

    others_std: of the scale behind the ground.
    """
    std = np.sqrt(np.diag(result.covariance()))
    std[pb.layout.scales] = np.hypot(std[pb.layout.scales], others_std)
    surely = np.maximum(np.abs(result.x) - SURE * std, 0.0)
    zeros = [surely[pb.layout.zeros][pb.epochs.machine == index].max() for index in range(len(pb.names))]
    out: Floats = np.stack([np.array(zeros) / ZERO_STD, surely[pb.layout.scales] / SCALE_STD], axis=1)
    return out
