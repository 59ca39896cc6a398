"""Machines that roll differently on the same ground, given correct slopes.

Soft tyres and dragging brakes take force that is neither ground nor sensor error:

    c_i = (1 + m) c + b + d z + d k (d c + s)

A scale k also multiplies the force on slopes, which separates the two; on level ground it explains all. Cells are
compared within an epoch: rain is nobody's fault. What all share is the ground; of two groups nobody knows which is
right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapserver.calibration import sources as src
from mapserver.calibration.equations import eliminate
from mapserver.calibration.select import SURE, Rolling, without_data_sheet
from mapserver.calibration.solver import Estimate, FleetProblem, inverse, prior_equations
from protocol.arrays import Floats, Ints
from protocol.machine.samples import SCALE_STD
from protocol.units import GRAVITY_MPS2

MET_EPOCHS = 2  # epochs in which a machine must meet others; one may be rain
ROUNDS = 5  # reweighting rounds


def rolling(pb: FleetProblem, result: Estimate) -> tuple[dict[int, Rolling], tuple[int, ...]]:
    """Machines (indices) that clearly roll differently, and all with scales known from slopes.

    Other scales are assumed within data sheets.
    """
    tuning, machines = pb.tuning, len(pb.names)
    m = src.means(pb.passages, tuning)
    number, known = pb.epochs.number[m.epoch], np.isfinite(m.c_rr)
    _, place = np.unique(np.stack([m.cell, number]), axis=1, return_inverse=True)
    epochs = _met_epochs(m.machine[known], place.ravel()[known], number[known], machines)
    if not (candidates := np.flatnonzero(epochs >= MET_EPOCHS)).size:
        return {}, ()
    _, covariance = _solved(replace(pb, unlike=tuple(range(machines))), range(machines), m, place.ravel(), result)
    on_slopes = np.sqrt(np.diag(covariance)[pb.layout.scales]) < SCALE_STD / 2
    free = replace(pb, unlike=tuple(np.flatnonzero(on_slopes).tolist()))
    x, covariance = _solved(free, free.unlike, m, place.ravel(), result)
    doubt, layout = np.where(on_slopes, 0.0, SCALE_STD), free.layout
    out, against = dict[int, Rolling](), dict[int, set[int]]()
    for i in candidates.tolist():
        own = np.flatnonzero(known & (m.machine == i))
        c_rr = float(np.average(m.c_rr[own], weights=m.c_std[own] ** -2.0))
        harder = np.zeros((machines, layout.size))
        harder[~on_slopes, layout.scales] = np.eye(machines)[~on_slopes]
        harder[on_slopes, layout.rolls] = np.eye(len(free.unlike))
        harder[on_slopes, layout.drags] = np.eye(len(free.unlike)) / c_rr
        g = harder[i] - harder  # this machine minus each
        variance = tuning.rolls_floor**2 + doubt[i] ** 2 + doubt**2
        std = np.sqrt(((g @ covariance) * g).sum(axis=1) + variance)
        unlike = np.abs(g @ x) - SURE * std > tuning.unlike
        alike = (np.abs(g @ x) < tuning.alike) & (std < tuning.alike)  # includes itself
        if unlike.sum() >= alike.sum() and unlike.any():
            mean, against[i] = g[unlike].mean(axis=0), set(np.flatnonzero(unlike).tolist())
            share, off = float(mean @ x), float(np.sqrt(mean @ covariance @ mean + variance[unlike].mean()))
            work_jpkgs = share * c_rr * GRAVITY_MPS2 * float(pb.passages.speed_mps[pb.passages.machine == i].mean())
            out[i] = Rolling(share, off, bool(unlike.sum() > alike.sum()), work_jpkgs)
    named = {i: one for i, one in out.items() if one.is_named}
    groups = {i: one for i, one in out.items() if against[i] - named.keys()}  # also against machines not yet named
    return named | groups if len(groups) > 1 else named, free.unlike


def _solved(
    free: FleetProblem, on_slopes: Sequence[int], m: src.Means, place: Ints, result: Estimate
) -> tuple[Floats, Floats]:
    """Parameters and covariance with free rolling, by cell within epochs; other sources as in the result.

    on_slopes: machines whose scales ignore data sheets.
    """
    layout, prior = free.layout, prior_equations(free)
    own, others = eliminate(prior, prior.weights(np.zeros(layout.size), None)), slice(0, layout.rolls.start)
    matrix, vector = without_data_sheet(free, own.matrix, on_slopes), own.vector
    for name in {src.CROSSINGS, src.HEIGHTS, src.EDGES} & result.information.keys():
        matrix[others, others] += result.information[name].matrix[others, others]
        vector[others] += result.information[name].vector[others]
    same = src.same_ground(m, layout, result.ground, free.known, place)
    sources = same, src.known_ground(m, layout, result.ground, free.known, free.tuning)
    shown = [eliminate(each, each.weights(vector, None)) for each in sources]
    for _ in range(ROUNDS):
        whole = matrix + shown[0].matrix + shown[1].matrix
        x = np.asarray(np.linalg.solve(whole, vector + shown[0].vector + shown[1].vector), np.float64)
        pairs = zip(sources, shown, strict=True)
        shown = [eliminate(each, each.weights(x, before.ground(x))) for each, before in pairs]
    return x, inverse(matrix + shown[0].matrix + shown[1].matrix)


def _met_epochs(machine: Ints, place: Ints, number: Ints, machines: int) -> Ints:
    """Number of epochs in which each machine met any other."""
    pairs = np.unique(np.stack([machine, place]), axis=1)
    shared = np.bincount(pairs[1], minlength=place.max(initial=0) + 1)[place] > 1
    each = np.unique(np.stack([machine[shared], number[shared]]), axis=1)
    return np.bincount(each[0], minlength=machines)
