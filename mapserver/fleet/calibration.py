"""From ledgers to corrections: machines in the map together, and each of the others against the ground of these.

What trust excludes has no say in the common ground, but has a correction of its own: a machine whose only fault is its
gain may then be let in again.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver.fleet.correction import ANY_SHARE, DIGITS, LAST_NS, LEVEL_SHARE, NO_SHARE, Correction
from mapserver.fleet.ledger import EPOCH_NS
from mapserver.fleet.observability import CommonScale, Observed, observe
from mapserver.fleet.passages import Epochs, sound
from mapserver.fleet.solver import SCALE_STD, ZERO_STD, Estimate, Prior, Problem, against, estimate, problem
from protocol.arrays import Bools, Floats, Table
from protocol.site.site_config import KnownGround

# Errors of the model: no evidence makes a zero or a scale surer than this.
ZERO_FLOOR, SCALE_FLOOR = 0.0004, 0.004
FAULTY_SIGMAS = 3.0  # of the data sheet: a scale so far off is worse than anything that a slope may hide
FAULT_SIGMAS = 5.0, 0.3 / SCALE_STD  # of the data sheet: a zero, and a scale of 30 %, that no sensor of its kind has
SURE = 2.0  # standard deviations by which an estimate must be beyond a limit
KNOWN = CommonScale(True, 0.0, "")  # of machines that are solved together: what their estimate says is all there is
# A sensor that measures less than half or more than twice of the drive force has no gain: it is stuck, or on its head.
LEAST_GAIN, MOST_GAIN = 0.5, 2.0


@dataclass(frozen=True)
class MachineState:
    """What is known of one machine: zero of its newest epoch, scale error k, lateral zero, and standard deviations.

    zero_by, scale_by: the sources that show them, none where the data sheet has to do; the scale is 0 then. beyond:
    how many standard deviations of the data sheet the largest zero and the scale are off, for sure.
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


@dataclass(frozen=True)
class Calibration:
    """What a solve says: corrections in the order of stamps, states of all machines, and their common scale."""

    corrections: tuple[Correction, ...]
    machines: Mapping[str, MachineState]
    common: CommonScale


def calibrate(
    ledgers: Mapping[str, Table],
    excluded: Collection[str] = (),
    areas: Sequence[KnownGround] = (),
    priors: Mapping[str, Prior] | None = None,
) -> Calibration:
    """Solve for all machines.

    ledgers: stays by machine, as `Ledger.stays` has them. excluded: machines without a say, beside those that are at
    fault. areas: whose c_rr the site states. priors: of machines of which more is known than their data sheet.
    """
    priors = priors or {}
    known = {name: stays for name, table in ledgers.items() if len(stays := sound(table))}
    trusted = {name: table for name, table in known.items() if name not in excluded}
    if not trusted:
        return Calibration((), {}, CommonScale(False, SCALE_STD, "no_machine"))
    pb, result = _common_ground(trusted, areas, priors)
    observed = observe(pb, result)
    corrections, states = _said(pb, result, observed)
    for name in sorted(set(known) - set(pb.names)):
        own = problem({name: known[name]}, areas, priors)
        alone = against(own, pb, result)
        more, state = _said(own, alone, observe(own, alone), observed.common)
        corrections, states = corrections + more, states | state
    return Calibration(tuple(corrections), dict(sorted(states.items())), observed.common)


def _common_ground(
    trusted: Mapping[str, Table], areas: Sequence[KnownGround], priors: Mapping[str, Prior]
) -> tuple[Problem, Estimate]:
    """The ground of all machines but those that are at fault: one alone can put the slopes of a whole site in doubt.

    Without the oddest machine, and the next, as long as there is one and most remain; as if there were none where that
    does not end the doubt.
    """
    left = dict(trusted)
    first = pb, result = _estimated(left, areas, priors)
    while odd := _oddest(pb, result):
        del left[odd]
        if 2 * len(left) <= len(trusted):
            return first
        pb, result = _estimated(left, areas, priors)
    return first if result.edges else (pb, result)


def _estimated(
    ledgers: Mapping[str, Table], areas: Sequence[KnownGround], priors: Mapping[str, Prior]
) -> tuple[Problem, Estimate]:
    pb = problem(ledgers, areas, priors)
    return pb, estimate(pb)


def _oddest(pb: Problem, result: Estimate) -> str:
    """The machine that is furthest beyond what its data sheet may mean, "" for none."""
    far = _beyond(pb, result) / ((FAULT_SIGMAS[0], FAULTY_SIGMAS) if result.edges else FAULT_SIGMAS)
    worst = int(np.argmax(far.max(axis=1)))
    return pb.names[worst] if far[worst].max() > 1 else ""


def _beyond(pb: Problem, result: Estimate, others_std: float = 0.0) -> Floats:
    """By how many standard deviations of the data sheet the largest zero and the scale (m, 2) are off, for sure.

    others_std: of the scale of those against whose ground the machine was solved.
    """
    std = np.sqrt(np.diag(result.covariance()))
    std[pb.layout.scales] = np.hypot(std[pb.layout.scales], others_std)
    surely = np.maximum(np.abs(result.x) - SURE * std, 0.0)
    zeros = [surely[pb.layout.zeros][pb.epochs.machine == index].max() for index in range(len(pb.names))]
    out: Floats = np.stack([np.array(zeros) / ZERO_STD, surely[pb.layout.scales] / SCALE_STD], axis=1)
    return out


@dataclass(frozen=True)
class _Applied:
    """The part of an estimate that is applied: x (p,), and the covariance (p, p) of what is left.

    scaled (m,): whether a machine has a scale of its own. beyond (m, 2): see MachineState.
    """

    x: Floats
    covariance: Floats
    scaled: Bools
    beyond: Floats


def _said(
    pb: Problem, result: Estimate, observed: Observed, others: CommonScale = KNOWN
) -> tuple[list[Correction], dict[str, MachineState]]:
    """Corrections and states of the machines of a problem. others: of those whose ground it was solved against."""
    applied = _applied(pb, result, observed, others)
    return _corrections(pb, applied), _states(pb, applied, observed.by)


def _applied(pb: Problem, result: Estimate, observed: Observed, others: CommonScale) -> _Applied:
    """Scales count where the evidence shows them, and where they are so far off that any value is better than none.

    There the estimate itself is taken: what is not observed of it is no more than what the data sheet leaves open. But
    not where slopes contradict each other: nobody knows then who is far off.
    """
    scales = np.arange(pb.layout.scales.start, pb.layout.scales.stop)
    absolute = observed.absolute & others.observed
    covariance, beyond = result.covariance(), _beyond(pb, result, 0.0 if others.observed else others.std)
    if result.edges:
        beyond[:, 1] *= absolute
    far = beyond[:, 1] > FAULTY_SIGMAS
    x, left = observed.x.copy(), observed.covariance.copy()
    x[scales] = np.where(absolute, x[scales], np.where(far, result.x[scales], 0.0))
    for index, at in enumerate(scales.tolist()):
        if not absolute[index]:
            left[at, :] = left[:, at] = 0.0
            left[at, at] = covariance[at, at] if far[index] else SCALE_STD**2
    zeros = np.arange(len(pb.epochs.number))
    left[zeros, zeros] += moved(pb.epochs, x[zeros], left[zeros, zeros])
    return _Applied(x, left, absolute | far, beyond)


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


def _corrections(pb: Problem, applied: _Applied) -> list[Correction]:
    """One correction for each epoch; the newest of a machine holds on. What measures no force has no scale."""
    layout, epochs = pb.layout, pb.epochs
    out = []
    for epoch, (machine, number) in enumerate(zip(epochs.machine.tolist(), epochs.number.tolist(), strict=True)):
        at = np.array([epoch, layout.scales.start + machine, layout.lateral.start + machine])
        newest = epoch + 1 == len(epochs.number) or epochs.machine[epoch + 1] != machine
        zero, k, across = applied.x[at].tolist()
        most_share = ANY_SHARE if applied.scaled[machine] else LEVEL_SHARE
        if not LEAST_GAIN < 1 + k < MOST_GAIN:
            k, most_share = 0.0, NO_SHARE
        out.append(
            Correction(
                machine=pb.names[machine],
                from_ns=number * EPOCH_NS,
                to_ns=LAST_NS if newest else (number + 1) * EPOCH_NS,
                zero=round(zero, DIGITS),
                scale=round(k / (1 + k), DIGITS),
                across=round(across, DIGITS),
                covariance=_covariance(applied.covariance[np.ix_(at, at)]),
                most_share=most_share,
            )
        )
    return out


def _covariance(covariance: Floats) -> tuple[tuple[float, ...], ...]:
    """With the floors of zero, scale and lateral zero, rounded to what a fact keeps."""
    floored = covariance + np.diag(np.square([ZERO_FLOOR, SCALE_FLOOR, ZERO_FLOOR]))
    return tuple(tuple(float(f"{value:.4g}") for value in row) for row in floored.tolist())


def _states(
    pb: Problem, applied: _Applied, shown: Mapping[str, Mapping[str, tuple[str, ...]]]
) -> dict[str, MachineState]:
    """States of the machines of a problem. shown: by which sources."""
    layout = pb.layout
    x, std = applied.x, np.sqrt(np.diag(applied.covariance))
    out = {}
    for index, name in enumerate(pb.names):
        epoch = int(np.flatnonzero(pb.epochs.machine == index)[-1])
        scale, across = layout.scales.start + index, layout.lateral.start + index
        out[name] = MachineState(
            zero=float(x[epoch]),
            zero_std=float(np.hypot(std[epoch], ZERO_FLOOR)),
            scale=float(x[scale]),
            scale_std=float(np.hypot(std[scale], SCALE_FLOOR)),
            across=float(x[across]),
            across_std=float(np.hypot(std[across], ZERO_FLOOR)),
            zero_by=shown[name]["zero"],
            scale_by=shown[name]["scale"],
            beyond=(float(applied.beyond[index, 0]), float(applied.beyond[index, 1])),
        )
    return out


def state_of(correction: Correction) -> MachineState:
    """What a correction by the solver says of its machine, where nothing has been solved yet."""
    k = correction.scale / (1 - correction.scale)
    zero_std, scale_std, across_std = np.sqrt(np.diag(correction.covariance)).tolist()
    return MachineState(
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
