"""What of the parameters the evidence shows, and by what; and the part of an estimate that may be applied.

A direction is a sum of parameters, each in units of its prior. Directions whose variance is below OBSERVED of the
prior's are observed. All others stay at the data sheet: there an estimate would be the noise of weak evidence, or what
the prior shares out among the machines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver.fleet import sources as src
from mapserver.fleet.solver import SCALE_STD, ZERO_STD, Estimate, Problem, inverse
from protocol.arrays import Bools, Floats, Ints

OBSERVED = 0.25  # of the prior's variance: half its standard deviation
WEAK = 0.01  # of the weight of data sheets: evidence has to do without
REMEMBERED = "remembered"  # an earlier solve showed it
# By which a source is named: each alone, beside the ground that all share.
NAMED = (src.SAME_GROUND, src.CROSSINGS, src.HEIGHTS, src.EDGES, src.KNOWN_GROUND)


@dataclass(frozen=True)
class CommonScale:
    """Whether the mean scale of all machines is observed, its standard deviation, and why it is not, "" if it is."""

    observed: bool
    std: float
    reason: str


@dataclass(frozen=True)
class Observed:
    """An estimate's part that may be applied: x (p,), and the covariance (p, p) of what is left of the errors then.

    by: for each machine and each of "zero" and "scale" the sources that show it. absolute (m,): whether the evidence
    shows a machine's scale, not only that it differs from the others'. common: see CommonScale.
    """

    x: Floats
    covariance: Floats
    by: Mapping[str, Mapping[str, tuple[str, ...]]]
    absolute: Bools
    common: CommonScale


def observe(pb: Problem, result: Estimate) -> Observed:
    """Split an estimate into what is observed and what is not."""
    layout = pb.layout
    x, covariance = observed_part(result)
    evidence = _by_evidence(pb, result)
    absolute = np.diag(evidence)[layout.scales] < OBSERVED * SCALE_STD**2
    std = float(np.sqrt(evidence[layout.scales, layout.scales].mean()))
    observed = std**2 < OBSERVED * SCALE_STD**2
    common = CommonScale(observed, min(std, SCALE_STD), "" if observed else result.edges or "no_slope_both_ways")
    return Observed(x, covariance, _by(pb, result), absolute, common)


def observed_part(result: Estimate) -> tuple[Floats, Floats]:
    """The estimate projected on observed directions, from what is known beforehand; the covariance of what it leaves.

    With L L' the prior's information, directions are eigenvectors of L' P L, whose eigenvalues are ratios of variances.
    """
    lower = np.linalg.cholesky(result.prior.matrix)
    ratios, directions = np.linalg.eigh(lower.T @ result.covariance() @ lower)
    shown = ratios < OBSERVED
    left = np.where(shown, ratios, 1.0)  # of the prior's variance
    units = np.linalg.solve(lower.T, directions)
    before = np.linalg.solve(result.prior.matrix, result.prior.vector)
    applied = before + units[:, shown] @ (directions[:, shown].T @ (lower.T @ (result.x - before)))
    return applied, (units * left) @ units.T


def _by_evidence(pb: Problem, result: Estimate) -> Floats:
    """Covariance without the data sheets' word on scales: that of many machines together is no evidence."""
    scales, own = pb.layout.scales, np.array([p.covariance[1][1] for p in pb.priors])
    matrix = result.prior.matrix + sum(each.matrix for each in result.information.values())
    stated = own < OBSERVED * SCALE_STD**2
    at = np.arange(scales.start, scales.stop)[~stated]
    matrix[at, at] -= (1 - WEAK) / own[~stated]
    return inverse(matrix)


def _by(pb: Problem, result: Estimate) -> dict[str, dict[str, tuple[str, ...]]]:
    """Which sources show zero and scale of each machine, each source alone beside the ground that all share."""
    layout = pb.layout
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
            what: (*([REMEMBERED] if own[what] < OBSERVED * data_sheet[what] else []), *_shown(variances, before, at))
            for what, at in shown.items()
        }
    return out


def _shown(variances: Mapping[str, Floats], before: Floats, at: Ints) -> Sequence[str]:
    """Sources by which the variance of these parameters falls enough, on average; what all share needs no other."""
    names = [name for name, after in variances.items() if np.mean(after[at] / before[at]) < OBSERVED]
    return [src.SAME_GROUND] if src.SAME_GROUND in names else names
