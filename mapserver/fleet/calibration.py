"""From ledgers to corrections: machines in the map together, and each of the others against the ground of these.

What trust excludes has no say in the common ground, but has a correction of its own: a machine whose only fault is its
gain may then be let in again.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver.fleet.correction import ANY_SHARE, DIGITS, LAST_NS, LEVEL_SHARE, Correction
from mapserver.fleet.ledger import EPOCH_NS
from mapserver.fleet.observability import CommonScale, Observed, observe
from mapserver.fleet.solver import SCALE_STD, ZERO_STD, Estimate, Prior, Problem, against, estimate, problem
from protocol.arrays import Floats, Table
from protocol.site.site_config import KnownGround

# Errors of the model: no evidence makes a zero or a scale surer than this.
ZERO_FLOOR, SCALE_FLOOR = 0.0004, 0.004
FAULTY_SIGMAS = 3.0  # of the data sheet: a scale so far off is worse than anything that a slope may hide


@dataclass(frozen=True)
class MachineState:
    """What is known of one machine: zero of its newest epoch, scale error k, lateral zero, and standard deviations.

    zero_by, scale_by: the sources that show them, none where the data sheet has to do. beyond: how many standard
    deviations of the data sheet zero and scale are off.
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

    ledgers: stays by machine, as `Ledger.stays` has them. excluded: machines without a say. areas: whose
    c_rr the site states. priors: of machines of which more is known than their data sheet.
    """
    priors = priors or {}
    trusted = {name: table for name, table in ledgers.items() if name not in excluded and len(table)}
    if not trusted:
        return Calibration((), {}, CommonScale(False, SCALE_STD, "no_machine"))
    pb = problem(trusted, areas, priors)
    result = estimate(pb)
    observed = observe(pb, result)
    corrections, states = _corrections(pb, result, observed), _states(pb, observed)
    for name in sorted(set(excluded) & set(ledgers)):
        if not len(ledgers[name]):
            continue
        own = problem({name: ledgers[name]}, areas, priors)
        alone = against(own, pb, result)
        shown = observe(own, alone)
        corrections, states = corrections + _corrections(own, alone, shown), states | _states(own, shown)
    return Calibration(tuple(corrections), dict(sorted(states.items())), observed.common)


def _corrections(pb: Problem, result: Estimate, observed: Observed) -> list[Correction]:
    """One correction for each epoch; the newest of a machine holds on."""
    layout, epochs = pb.layout, pb.epochs
    x = observed.x
    out = []
    for epoch, (machine, number) in enumerate(zip(epochs.machine.tolist(), epochs.number.tolist(), strict=True)):
        at = np.array([epoch, layout.scales.start + machine, layout.lateral.start + machine])
        newest = epoch + 1 == len(epochs.number) or epochs.machine[epoch + 1] != machine
        zero, k, across = x[at].tolist()
        far = abs(result.x[at[1]]) > FAULTY_SIGMAS * SCALE_STD
        out.append(
            Correction(
                machine=pb.names[machine],
                from_ns=number * EPOCH_NS,
                to_ns=LAST_NS if newest else (number + 1) * EPOCH_NS,
                zero=round(zero, DIGITS),
                scale=round(k / (1 + k), DIGITS) if observed.absolute[machine] or far else 0.0,
                across=round(across, DIGITS),
                covariance=_covariance(observed.covariance[np.ix_(at, at)]),
                most_share=ANY_SHARE if observed.absolute[machine] or far else LEVEL_SHARE,
            )
        )
    return out


def _covariance(covariance: Floats) -> tuple[tuple[float, ...], ...]:
    """With the floors of zero, scale and lateral zero, rounded to what a fact keeps."""
    floored = covariance + np.diag(np.square([ZERO_FLOOR, SCALE_FLOOR, ZERO_FLOOR]))
    return tuple(tuple(float(f"{value:.4g}") for value in row) for row in floored.tolist())


def _states(pb: Problem, observed: Observed) -> dict[str, MachineState]:
    """States of the machines of a problem."""
    layout = pb.layout
    std = np.sqrt(np.diag(observed.covariance))
    out = {}
    for index, name in enumerate(pb.names):
        epoch = int(np.flatnonzero(pb.epochs.machine == index)[-1])
        scale, across = layout.scales.start + index, layout.lateral.start + index
        zeros = np.abs(observed.x[layout.zeros][pb.epochs.machine == index])
        by = observed.by[name]
        out[name] = MachineState(
            zero=float(observed.x[epoch]),
            zero_std=float(np.hypot(std[epoch], ZERO_FLOOR)),
            scale=float(observed.x[scale]),
            scale_std=float(np.hypot(std[scale], SCALE_FLOOR)),
            across=float(observed.x[across]),
            across_std=float(np.hypot(std[across], ZERO_FLOOR)),
            zero_by=by["zero"],
            scale_by=by["scale"],
            beyond=(float(zeros.max() / ZERO_STD), float(abs(observed.x[scale]) / SCALE_STD)),
        )
    return out
