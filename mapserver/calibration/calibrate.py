"""From ledgers to corrections: machines in the map are solved together, others against their ground.

A machine excluded by trust has no influence, but gets a correction: with it, it may return.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapserver.calibration.correction import ANY_SHARE, DIGITS, LAST_NS, LEVEL_SHARE, NO_SHARE, Correction
from mapserver.calibration.ledger import EPOCH_NS, EPOCHS, Stated, newest, stated
from mapserver.calibration.passages import sound
from mapserver.calibration.rolling import rolling
from mapserver.calibration.select import (
    FAULT_SIGMAS,
    AppliedPart,
    CommonScale,
    MachineErrors,
    ObservedPart,
    Rolling,
    applied_part,
    beyond_data_sheet,
    is_surer,
    observe,
)
from mapserver.calibration.solver import Estimate, FleetProblem, Prior, against, estimate, problem
from mapserver.calibration.tuning import TUNING, CalibrationTuning
from protocol.arrays import Floats, Table
from protocol.machine.samples import SCALE_STD
from protocol.site.site_config import KnownGround

KNOWN = CommonScale(True, 0.0, "")  # common scale of machines solved together
# Beyond half to twice the drive force there is no gain: the sensor is stuck or upside down.
LEAST_GAIN, MOST_GAIN = 0.5, 2.0
# Newest epochs and machines per solve: time grows with the cube and memory with the square of unknowns (100 machines: 6
# s, 0.5 GB).
MOST_EPOCHS, MOST_MACHINES = 1000, 100
# Share of the machines removed at once for faults, to limit the solves of a large fleet.
AT_ONCE = 0.1


@dataclass(frozen=True)
class Solution:
    """Corrections by stamp, states of all machines, and their common scale.

    stated: by machine and epoch, what it applied itself. remembered: machines with scales from earlier evidence.
    begins_ns: earliest sample of each machine.
    """

    corrections: tuple[Correction, ...]
    machines: Mapping[str, MachineErrors]
    common: CommonScale
    stated: Mapping[str, Mapping[int, Stated]] = field(default_factory=dict)
    remembered: frozenset[str] = frozenset()
    begins_ns: Mapping[str, int] = field(default_factory=dict)


def calibrate(
    ledgers: Mapping[str, Table],
    excluded: Collection[str] = (),
    areas: Sequence[KnownGround] = (),
    remembered: Mapping[str, Prior] | None = None,
    tuning: CalibrationTuning = TUNING,
) -> Solution:
    """Solve for all machines.

    ledgers: stays by machine, MOST_MACHINES at most. excluded: without influence, as are those at fault. areas: of
    stated c_rr. remembered: earlier scales, used where these stays are less certain.
    """
    sane = {name: stays for name, table in ledgers.items() if len(stays := sound(table))}
    known = {name: newest(table, epochs_of_each(len(sane))) for name, table in sane.items()}
    if not set(known) - set(excluded):
        return Solution((), {}, CommonScale(False, SCALE_STD, "no_machine"))
    solved = _solved(known, excluded, areas, {}, tuning)
    states = solved.machines
    silent = {name: prior for name, prior in (remembered or {}).items() if is_surer(prior, states.get(name))}
    if silent:
        solved = _solved(known, excluded, areas, silent, tuning)
    own = {name: stated(table) for name, table in known.items()}
    return replace(solved, stated=own, remembered=frozenset(silent))


def epochs_of_each(machines: int) -> int:
    """Epochs per machine in a solve."""
    return min(EPOCHS, MOST_EPOCHS // max(min(machines, MOST_MACHINES), 1))


def groups(machines: Iterable[str]) -> list[tuple[str, ...]]:
    """As few groups as needed, each solved alone."""
    names = sorted(machines)
    count = max(1, math.ceil(len(names) / MOST_MACHINES))
    return [tuple(names[first::count]) for first in range(count)]


def joined(parts: Sequence[Solution]) -> Solution:
    """Join the solves of groups; the common scale is the least certain."""
    states = {name: state for part in parts for name, state in part.machines.items()}
    applied = {name: of_machine for part in parts for name, of_machine in part.stated.items()}
    corrections = tuple(one for part in parts for one in part.corrections)
    common = max((part.common for part in parts), key=lambda common: (not common.observed, common.std))
    remembered = frozenset(name for part in parts for name in part.remembered)
    begins_ns = {name: begin_ns for part in parts for name, begin_ns in part.begins_ns.items()}
    return Solution(corrections, dict(sorted(states.items())), common, applied, remembered, begins_ns)


def _solved(
    known: Mapping[str, Table],
    excluded: Collection[str],
    areas: Sequence[KnownGround],
    priors: Mapping[str, Prior],
    tuning: CalibrationTuning,
) -> Solution:
    trusted = {name: table for name, table in known.items() if name not in excluded}
    pb, result, unlike = _with_rolling(*_common_ground(trusted, areas, priors, tuning))
    observed = observe(pb, result)
    corrections, states = _said(pb, result, observed, unlike)
    states |= {pb.names[i]: replace(states[pb.names[i]], rolling=one) for i, one in unlike.items()}
    for name in sorted(set(known) - set(pb.names)):
        own = problem({name: known[name]}, areas, priors, tuning)
        alone = against(own, pb, result)
        more, state = _said(own, alone, observe(own, alone), {}, observed.common)
        corrections, states = corrections + more, states | state
    return Solution(tuple(corrections), dict(sorted(states.items())), observed.common)


def _common_ground(
    trusted: Mapping[str, Table],
    areas: Sequence[KnownGround],
    priors: Mapping[str, Prior],
    tuning: CalibrationTuning,
) -> tuple[FleetProblem, Estimate]:
    """The ground of all machines except those at fault: one alone can discredit all slopes.

    While slopes are in doubt, limits are lower. If no removal ends the doubt, the ground is the cause, and only clear
    faults count; none if most machines seem at fault.
    """

    def solved(some: Mapping[str, Table]) -> tuple[FleetProblem, Estimate]:
        pb = problem(some, areas, priors, tuning)
        return pb, estimate(pb)

    all_of_them = solved(trusted)
    most_seem = all_of_them[1].edges and 2 * len(_odd(*all_of_them, FAULT_SIGMAS)) >= len(trusted)
    others = all_of_them if most_seem else _without_odd(trusted, all_of_them, FAULT_SIGMAS[1], solved)
    fewer = _without_odd(trusted, others, tuning.faulty_sigmas, solved) if others[1].edges else others
    return others if fewer[1].edges else fewer


def _with_rolling(pb: FleetProblem, result: Estimate) -> tuple[FleetProblem, Estimate, Mapping[int, Rolling]]:
    """Solve again with machines that roll differently modelled, so they do not pull other scales.

    If they cannot be named, all are modelled; then only slopes show scales.
    """
    unlike, on_slopes = rolling(pb, result)
    while new := unlike.keys() & set(on_slopes) - set(pb.unlike):
        named = all(one.is_named for one in unlike.values())
        pb = replace(pb, unlike=tuple(sorted({*pb.unlike, *(new if named else on_slopes)})))
        result = estimate(pb)
        unlike, on_slopes = rolling(pb, result)
    return pb, result, unlike


def _without_odd(
    trusted: Mapping[str, Table],
    first: tuple[FleetProblem, Estimate],
    in_doubt: float,
    solved: Callable[[Mapping[str, Table]], tuple[FleetProblem, Estimate]],
) -> tuple[FleetProblem, Estimate]:
    """Remove the oddest machines step by step; `first` if no majority would remain.

    trusted: all machines. first: solved so far. in_doubt: limit of a scale [data-sheet sigmas] while slopes are in
    doubt.
    """
    now = first
    while odd := _odd(*now, (FAULT_SIGMAS[0], in_doubt if now[1].edges else FAULT_SIGMAS[1]))[
        : math.ceil(AT_ONCE * len(trusted))
    ]:
        left = [name for name in now[0].names if name not in odd]
        if 2 * len(left) <= len(trusted):
            return first
        now = solved({name: trusted[name] for name in left})
    return now


def _odd(pb: FleetProblem, result: Estimate, sigmas: tuple[float, float]) -> list[str]:
    """Machines whose bias or scale exceeds data-sheet sigmas, worst first."""
    far = (beyond_data_sheet(pb, result) / sigmas).max(axis=1)
    return [pb.names[index] for index in np.argsort(-far, kind="stable").tolist() if far[index] > 1]


def _said(
    pb: FleetProblem,
    result: Estimate,
    observed: ObservedPart,
    unlike: Mapping[int, Rolling],
    others: CommonScale = KNOWN,
) -> tuple[list[Correction], dict[str, MachineErrors]]:
    """others: common scale of the ground it was solved against."""
    applied = applied_part(pb, result, observed, others)
    return _corrections(pb, applied, unlike), _states(pb, applied, observed.by)


def _corrections(pb: FleetProblem, applied: AppliedPart, unlike: Mapping[int, Rolling]) -> list[Correction]:
    """One per epoch, the newest open-ended. A sensor that measures no force has no scale."""
    layout, epochs = pb.layout, pb.epochs
    both = zip(applied.x[layout.rolls], applied.x[layout.drags], strict=True)
    rolls = {i: each for i, each in zip(pb.unlike, both, strict=True) if i in unlike and unlike[i].is_named}
    out = []
    for epoch, (machine, number) in enumerate(zip(epochs.machine.tolist(), epochs.number.tolist(), strict=True)):
        at = np.array([epoch, layout.scales.start + machine, layout.lateral.start + machine])
        newest = epoch + 1 == len(epochs.number) or epochs.machine[epoch + 1] != machine
        zero, k, across = applied.x[at].tolist()
        m, b = rolls.get(machine, (0.0, 0.0))
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
                covariance=_covariance(applied.covariance[np.ix_(at, at)], pb.tuning),
                most_share=most_share,
                rolls=round(float(m), DIGITS),
                drags=round(float(b), DIGITS),
            )
        )
    return out


def _covariance(covariance: Floats, tuning: CalibrationTuning) -> tuple[tuple[float, ...], ...]:
    """Add floors; round as facts are."""
    floored = covariance + np.diag(np.square([tuning.zero_floor, tuning.scale_floor, tuning.zero_floor]))
    return tuple(tuple(float(f"{value:.4g}") for value in row) for row in floored.tolist())


def _states(
    pb: FleetProblem, applied: AppliedPart, shown: Mapping[str, Mapping[str, tuple[str, ...]]]
) -> dict[str, MachineErrors]:
    """shown: sources by machine and value."""
    layout, tuning = pb.layout, pb.tuning
    x, std = applied.x, np.sqrt(np.diag(applied.covariance))
    out = {}
    for index, name in enumerate(pb.names):
        epoch = int(np.flatnonzero(pb.epochs.machine == index)[-1])
        scale, across = layout.scales.start + index, layout.lateral.start + index
        out[name] = MachineErrors(
            zero=float(x[epoch]),
            zero_std=float(np.hypot(std[epoch], tuning.zero_floor)),
            scale=float(x[scale]),
            scale_std=float(np.hypot(std[scale], tuning.scale_floor)),
            across=float(x[across]),
            across_std=float(np.hypot(std[across], tuning.zero_floor)),
            zero_by=shown[name]["zero"],
            scale_by=shown[name]["scale"],
            beyond=(float(applied.beyond[index, 0]), float(applied.beyond[index, 1])),
        )
    return out
