"""Bias, scale and lateral bias of all machines, by robust least squares on common ground.

Each round eliminates the ground, solves for the machines, updates the ground and reweights. Shares of drive force,
products of unknowns, follow the ground. No source is a vote: a closed loop shows the bias and the foot of a ramp the
scale of one machine alone, so common errors are corrected too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from mapserver.calibration import sources as src
from mapserver.calibration import stays
from mapserver.calibration.equations import NO_GROUND, Equations, Information, eliminate, equations
from mapserver.calibration.ledger import CELL_M, EPOCH_NS
from mapserver.calibration.passages import Epochs, Passages, passages
from mapserver.calibration.sources import GroundState, Parameters
from mapserver.calibration.tuning import TUNING, CalibrationTuning
from protocol.arrays import Floats, Ints, Table
from protocol.machine.samples import SCALE_STD, ZERO_STD, ZERO_WALK
from protocol.site.site_config import KnownGround

ZERO_S = 2 * ZERO_STD**2 / ZERO_WALK**2  # seconds; with this walk a Gauss-Markov process stays within the data sheet
MOST_ROUNDS = 20
SETTLED = 2e-6  # largest change of a parameter, below the rounding of corrections


@dataclass(frozen=True)
class Prior:
    """Prior of a machine: bias and scale error k with covariance (2, 2)."""

    zero: float = 0.0
    scale: float = 0.0
    covariance: tuple[tuple[float, float], tuple[float, float]] = ((ZERO_STD**2, 0.0), (0.0, SCALE_STD**2))


DATA_SHEET = Prior()


@dataclass(frozen=True)
class FleetProblem:
    """What is solved. names: sorted. cells: numbers. known (cells,): stated c_rr or NaN. unlike: see `Parameters`."""

    names: tuple[str, ...]
    passages: Passages
    epochs: Epochs
    cells: Ints
    known: Floats
    priors: tuple[Prior, ...]
    unlike: tuple[int, ...] = ()
    tuning: CalibrationTuning = TUNING

    @property
    def layout(self) -> Parameters:
        """Positions of the parameters."""
        return Parameters(len(self.epochs.number), len(self.names), self.unlike)


@dataclass(frozen=True)
class Estimate:
    """Parameters x (p,), information by source, and the ground.

    steps: of places where the slope changes [c_rr]. edges: why unused, or "".
    """

    x: Floats
    information: Mapping[str, Information]
    prior: Information
    ground: GroundState
    steps: Floats
    edges: str = ""
    rounds: int = 0

    def covariance(self, *names: str) -> Floats:
        """Covariance (p, p) by the prior and these sources, or all."""
        chosen = names or tuple(self.information)
        return inverse(self.prior.matrix + sum(self.information[name].matrix for name in chosen))


def problem(
    ledgers: Mapping[str, Table],
    areas: Sequence[KnownGround],
    priors: Mapping[str, Prior],
    tuning: CalibrationTuning = TUNING,
) -> FleetProblem:
    """Build a problem. ledgers: stays by machine; areas: of stated c_rr; priors: where not the data sheet."""
    names = tuple(sorted(name for name, table in ledgers.items() if len(table)))
    p, epochs, cells = passages({name: ledgers[name] for name in names})
    known = known_cells(cells, areas, tuning.inside_m)
    return FleetProblem(
        names, p, epochs, cells, known, tuple(priors.get(name, DATA_SHEET) for name in names), tuning=tuning
    )


def known_cells(cells: Ints, areas: Sequence[KnownGround], inside_m: float = TUNING.inside_m) -> Floats:
    """Stated c_rr (n,) of cells (n,) well inside areas, else NaN."""
    out = np.full(len(cells), np.nan)
    centres = (np.stack(stays.column_row(cells), axis=1) + 0.5) * CELL_M
    for area in areas:
        low, high = np.min(area.outline, axis=0), np.max(area.outline, axis=0)
        for i in np.flatnonzero(((centres > low) & (centres < high)).all(axis=1)).tolist():
            if area.inside_m(*centres[i].tolist()) > inside_m:
                out[i] = area.c_rr
    return out


def estimate(pb: FleetProblem) -> Estimate:
    """Solve; without edges if they contradict each other or c_rr depends on slope."""
    result = _rounds(pb, with_edges=True)
    reason = _doubt(result, pb)
    return _rounds(pb, with_edges=False, reason=reason) if reason else result


def against(pb: FleetProblem, others: FleetProblem, result: Estimate) -> Estimate:
    """Solve an excluded machine against the others' fixed ground.

    Edges are used if theirs are; it may share little ground.
    """
    cells = len(pb.cells)
    c_rr, gradient = np.full(cells, np.nan), np.full((cells, 2), np.nan)
    _, own, theirs = np.intersect1d(pb.cells, others.cells, return_indices=True)
    c_rr[own], gradient[own] = result.ground.c_rr[theirs], result.ground.gradient[theirs]
    return _rounds(pb, with_edges=not result.edges, frozen=GroundState(c_rr, gradient))


def inverse(information: Floats) -> Floats:
    """Covariance of an information matrix."""
    out = np.linalg.inv(information)
    return np.asarray((out + out.T) / 2, np.float64)


def _rounds(pb: FleetProblem, *, with_edges: bool, reason: str = "", frozen: GroundState | None = None) -> Estimate:
    """frozen: ground known from elsewhere."""
    layout, cells, tuning = pb.layout, len(pb.cells), pb.tuning
    means, ground = src.means(pb.passages, tuning), src.first_ground(pb.passages, cells)
    prior = prior_equations(pb)
    fixed = {
        src.CROSSINGS: src.crossings(means, layout, cells),
        src.HEIGHTS: src.heights(pb.passages, layout, cells, tuning),
    }
    if with_edges:
        fixed[src.EDGES] = src.edges(pb.passages, layout, ground, tuning)
    if frozen:
        fixed[src.CROSSINGS] = fixed[src.CROSSINGS].on(frozen.gradient.T.ravel())
        ground = _filled(frozen, ground)
    x, unknowns = np.zeros(layout.size), dict[str, Floats]()
    for rounds in range(1, MOST_ROUNDS + 1):
        same = src.same_ground(means, layout, ground, pb.known)
        system = fixed | {
            src.SAME_GROUND: same.on(frozen.c_rr) if frozen else same,
            src.KNOWN_GROUND: src.known_ground(means, layout, ground, pb.known, tuning),
        }
        information = {name: eliminate(eq, eq.weights(x, unknowns.get(name))) for name, eq in system.items()}
        own = eliminate(prior, prior.weights(x, NO_GROUND if rounds > 1 else None))
        matrix = own.matrix + sum(each.matrix for each in information.values())
        new = np.linalg.solve(matrix, own.vector + sum(each.vector for each in information.values()))
        moved, x = float(np.abs(new - x).max()), np.asarray(new, np.float64)
        unknowns = {name: each.ground(x) for name, each in information.items()}
        if not frozen:
            ground = _ground(pb, unknowns, ground)
        if moved < SETTLED:
            break
    data_sheet = eliminate(prior, prior.weights(x, None))
    return Estimate(x, information, data_sheet, ground, unknowns.get(src.EDGES, NO_GROUND), reason, rounds)


def _ground(pb: FleetProblem, unknowns: Mapping[str, Floats], before: GroundState) -> GroundState:
    """Best-fitting ground; c_rr as stated where known."""
    c_rr = np.where(np.isfinite(pb.known), pb.known, unknowns[src.SAME_GROUND])
    gradient = unknowns[src.CROSSINGS].reshape(2, -1).T
    return GroundState(np.where(np.isfinite(before.c_rr), c_rr, np.nan), gradient)


def _filled(first: GroundState, second: GroundState) -> GroundState:
    pairs = ((first.c_rr, second.c_rr), (first.gradient, second.gradient))
    c_rr, gradient = (np.where(np.isfinite(one), one, other) for one, other in pairs)
    return GroundState(c_rr, gradient)


def prior_equations(pb: FleetProblem) -> Equations:
    """Data sheets, with biases that wander between epochs."""
    layout, tuning, n = pb.layout, pb.tuning, len(pb.epochs.number)
    machine, number = pb.epochs.machine, pb.epochs.number
    follows = np.r_[False, machine[1:] == machine[:-1]]
    apart_s = np.diff(number, prepend=number[:1]) * (EPOCH_NS * 1e-9)
    kept = np.where(follows, np.exp(-apart_s / ZERO_S), 0.0)
    zero, scale = (np.array([getattr(prior, part) for prior in pb.priors]) for part in ("zero", "scale"))
    covariance = np.array([prior.covariance for prior in pb.priors])
    zero_std, scale_std = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1])
    A = sp.identity(layout.size, format="csr") - sp.csr_matrix(
        (kept, (np.arange(n), np.maximum(np.arange(n) - 1, 0))), shape=(layout.size, layout.size)
    )
    b = np.concatenate([(1 - kept) * zero[machine], scale, np.zeros(layout.size - layout.lateral.start)])
    of_rolling = np.repeat([tuning.rolls_std, tuning.drags_std], len(layout.unlike))
    beside = np.concatenate([np.full(layout.machines, ZERO_STD), [tuning.ramps_std], of_rolling])
    std = np.concatenate([zero_std[machine] * np.sqrt(1 - kept**2), scale_std, beside])
    return equations(A.tocsr(), None, b, std)


def _doubt(result: Estimate, pb: FleetProblem) -> str:
    """Why edges must not count, or ""."""
    layout, tuning = pb.layout, pb.tuning
    ramps, std = result.x[layout.ramps], np.sqrt(result.covariance()[layout.ramps, layout.ramps])
    if abs(ramps) > max(tuning.ramps_limit, tuning.ramps_sigmas * std):
        return "ground_changes_with_slope"
    if len(result.steps) and np.mean(np.abs(result.steps) > tuning.step_limit) > tuning.stepped_share:
        return "places_disagree"
    return ""
