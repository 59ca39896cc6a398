"""Read layers: from evidence to float32 values, NaN where unknown (docs/layers.md).

A new layer of a cell is a function and a line in LAYERS; one that looks at its neighbours, a function and a line in
`gap_filling.AREA_LAYERS`. What is debatable, such as the classes' boundaries, is applied here,
without folding again.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from mapserver import error_model
from mapserver.evidence import cells as ev
from mapserver.layers.gap_filling import AREA_LAYERS, Area
from mapserver.layers.statistics import linear_count, ratio, robust_centre, robust_spread
from protocol.arrays import AnyArray, Floats, Floats32, Ints
from protocol.config import require_positive
from protocol.errors import QueryError, Refusal
from protocol.site import ground_classes

LOG_STEP = math.log(ev.RESISTANCE_CENTRES[1] / ev.RESISTANCE_CENTRES[0])  # between resistance bins
GRADE_STEP = float(ev.GRADE_CENTRES[1] - ev.GRADE_CENTRES[0])
MAX_REACH_M = 50.0  # every window is widened by it, and its kernel has its square of cells
SURE_AXIS = 0.2  # least length of the mean axis, 0 to 1, that is a preferred one
# The centre of the votes for c_rr is off by so much of what they differ by, however many there are.
SPREAD_SHARE = 0.5
# Votes for the class that leads less are mostly errors of places: shares to this power are right as often as they say.
SHARPNESS = 1.5


@dataclass(frozen=True)
class ReadConfig:
    """How evidence is read.

    min_weight_m: cells with fewer metres of evidence than this are unknown; so are resistance and gradient where fewer
    metres than this have one. boundaries: of the classes of resistance, increasing; n of them make n + 1 classes.
    fill_reach_m: so far from the next known cell gaps are filled.
    """

    min_weight_m: float = 0.1
    boundaries: tuple[float, ...] = ground_classes.BOUNDARIES
    fill_reach_m: float = 5.0

    def __post_init__(self) -> None:
        if not self.min_weight_m >= 0:
            raise ValueError("min_weight_m: negative")
        if not self.boundaries or not all(low < high for low, high in pairwise((0.0, *self.boundaries))):
            raise ValueError(f"boundaries: {self.boundaries} are not positive and increasing")
        require_positive(self, ["fill_reach_m"])
        if self.fill_reach_m > MAX_REACH_M:
            raise ValueError(f"fill_reach_m: {self.fill_reach_m:g} is over {MAX_REACH_M:g}")


@dataclass(frozen=True)
class CellEvidence:
    """What the layers of cells are derived from.

    evidence: of cells, arrays (cells, ...) as in Evidence. now_ns (cells,): the site's now, 0 where it is not known.
    """

    evidence: ev.Evidence
    now_ns: Ints
    config: ReadConfig

    def votes(self, part: slice) -> Floats:
        """Votes (cells, bins) of one histogram; exact as floating point, and several times faster.

        None where they are too few: most samples of a cell may say only that the machine was there.
        """
        votes: Floats = self.evidence.counts[..., part].astype(np.float64)
        votes[votes.sum(axis=-1) < self.config.min_weight_m * ev.WEIGHT_UNITS_PER_M] = 0.0
        return votes

    # Centres on the bin axis; several layers ask for them.
    @cached_property
    def resistance_bin(self) -> Floats:
        """Robust centre of the c_rr votes, in bins."""
        return robust_centre(self.votes(ev.RESISTANCE), reach=2.5)

    @cached_property
    def gradient(self) -> tuple[Floats, Floats]:
        """Robust centre of the votes for the gradient, east and north [m/m]."""
        # nearer than for c_rr: gradients one and a half bins apart meet in a cell, and must not be averaged
        east, north = (robust_centre(self.votes(part), reach=1.5) for part in (ev.GRADE_EAST, ev.GRADE_NORTH))
        return ev.GRADE_CENTRES[0] + GRADE_STEP * east, ev.GRADE_CENTRES[0] + GRADE_STEP * north


# --- layers of a cell ------------------------------------------------------------------------------------------------

Layer = Callable[[CellEvidence], Floats]


def resistance(cells: CellEvidence) -> Floats:
    """Rolling resistance coefficient [-]: robust centre of the votes, in log(c_rr)."""
    centre: Floats = ev.RESISTANCE_CENTRES[0] * np.exp(LOG_STEP * cells.resistance_bin)
    return centre


def resistance_std(cells: CellEvidence) -> Floats:
    """Standard deviation of `resistance` [-]: half of what votes differ by, and what they err in alike."""
    c_rr = resistance(cells)
    spread = SPREAD_SHARE * c_rr * LOG_STEP * robust_spread(cells.votes(ev.RESISTANCE))
    deviation: Floats = np.sqrt(spread**2 + error_model.resistance_variance(c_rr))
    return deviation


def resistance_class(cells: CellEvidence) -> Floats:
    """Index of the ground class with most votes (by default 0 dry concrete ... 4 sand)."""
    votes = _class_votes(cells)
    return np.where(votes.sum(axis=-1) > 0, votes.argmax(axis=-1), np.nan)


def confidence(cells: CellEvidence) -> Floats:
    """How likely the leading ground class is right: its share of all classes' votes, each to the power SHARPNESS."""
    votes = _class_votes(cells)
    sharp = (votes / np.maximum(votes.sum(axis=-1, keepdims=True), 1.0)) ** SHARPNESS
    return ratio(sharp.max(axis=-1), sharp.sum(axis=-1))


def grade_east(cells: CellEvidence) -> Floats:
    """Eastern component of the gradient [m/m], positive where the ground rises to the east."""
    return cells.gradient[0]


def grade_north(cells: CellEvidence) -> Floats:
    """Northern component of the gradient [m/m], positive where the ground rises to the north."""
    return cells.gradient[1]


def grade(cells: CellEvidence) -> Floats:
    """Steepness: length of the gradient [m/m]."""
    return np.hypot(*cells.gradient)


def grade_std(cells: CellEvidence) -> Floats:
    """Standard deviation of one component of the gradient [m/m], root mean square of the two, as `resistance_std`."""
    east, north = (robust_spread(cells.votes(part)) for part in (ev.GRADE_EAST, ev.GRADE_NORTH))
    spread = GRADE_STEP * np.hypot(east, north) / math.sqrt(2)
    deviation: Floats = np.sqrt(spread**2 + error_model.gradient_variance(grade(cells)))
    return deviation


def slope_class(cells: CellEvidence) -> Floats:
    """0 flat, 1 slope (the paper's: steeper than 7.5 degrees)."""
    classes = ground_classes.slope_class(*cells.gradient)
    return np.where(classes == ground_classes.UNKNOWN, np.nan, classes.astype(np.float64))


def heading(cells: CellEvidence) -> Floats:
    """Axis along which machines drive [rad], -pi/2 to pi/2 from east, both ways alike; NaN where none is preferred."""
    # the axis, not the direction: a haul road is driven both ways, and doubled angles do not cancel then
    votes = cells.votes(ev.HEADING)
    doubled = np.exp(4j * np.pi / ev.SECTORS * np.arange(ev.SECTORS))
    east, north = votes @ doubled.real, votes @ doubled.imag
    sure = np.hypot(east, north) >= SURE_AXIS * np.maximum(votes.sum(axis=-1), 1)
    return np.where(sure, np.arctan2(north, east) / 2, np.nan)


def visits(cells: CellEvidence) -> Floats:
    """How many visits a cell had; at most 266."""
    return linear_count(cells.evidence.bitmaps[..., ev.VISITS])


def machines(cells: CellEvidence) -> Floats:
    """How many machines drove here; at most 266."""
    return linear_count(cells.evidence.bitmaps[..., ev.MACHINES])


def weight(cells: CellEvidence) -> Floats:
    """Metres of evidence."""
    metres: Floats = cells.evidence.weight / float(ev.WEIGHT_UNITS_PER_M)
    return metres


def age_s(cells: CellEvidence) -> Floats:
    """Time from the newest sample to the site's now [s]; NaN where now is not known."""
    return seconds_ago(cells.evidence.newest_ns, cells.now_ns)


def changed_s(cells: CellEvidence) -> Floats:
    """Time from the ground's last change to the site's now [s]; NaN where there was none or now is not known."""
    return seconds_ago(cells.evidence.changed_ns, cells.now_ns)


LAYERS: dict[str, Layer] = {
    "resistance": resistance,
    "resistance_std": resistance_std,
    "resistance_class": resistance_class,
    "confidence": confidence,
    "grade_east": grade_east,
    "grade_north": grade_north,
    "grade": grade,
    "grade_std": grade_std,
    "slope_class": slope_class,
    "heading": heading,
    "visits": visits,
    "machines": machines,
    "weight": weight,
    "age_s": age_s,
    "changed_s": changed_s,
}


# --- values ----------------------------------------------------------------------------------------------------------


def select(names: Sequence[str]) -> tuple[str, ...]:
    """Check layer names; none means all layers of cells (filled ones are asked for by name)."""
    known = [*LAYERS, *AREA_LAYERS]
    if unknown := [name for name in names if name not in known]:
        problem = f"layer `{unknown[0][:40]}` is not known; known: {', '.join(known)}"
        raise QueryError(Refusal.UNKNOWN_LAYER, problem)
    return tuple(names) or tuple(LAYERS)


def read(
    evidence: ev.Evidence, names: Sequence[str], config: ReadConfig, now_ns: int | Ints = 0
) -> dict[str, Floats32]:
    """Derive layers of cells, each (blocks, 256), NaN where the evidence is too thin.

    now_ns: the site's now, one or (blocks, 1).
    """
    metres = evidence.weight
    known = (metres > 0) & (metres >= config.min_weight_m * ev.WEIGHT_UNITS_PER_M)
    known_cells = {field.name: getattr(evidence, field.name)[known] for field in dataclasses.fields(evidence)}
    cells = CellEvidence(ev.Evidence(**known_cells), np.broadcast_to(now_ns, known.shape)[known], config)
    out = {name: np.full(known.shape, np.nan, np.float32) for name in names}
    for name, values in out.items():
        values[known] = LAYERS[name](cells)
    return out


def required(names: Sequence[str]) -> tuple[str, ...]:
    """Layers of cells from which `derive_area` makes these layers, each once."""
    cells: dict[str, None] = {}
    for name in names:
        needs = required(AREA_LAYERS[name].needs) if name in AREA_LAYERS else (name,)
        cells |= dict.fromkeys(needs)
    return tuple(cells)


def margin_cells(names: Sequence[str], cell_m: float, config: ReadConfig) -> int:
    """By how many cells on each side a window must be widened before `derive_area`, and cropped after it."""
    return math.ceil(config.fill_reach_m / cell_m) if any(name in AREA_LAYERS for name in names) else 0


def derive_area(
    names: Sequence[str], cells: Mapping[str, Floats32], cell_m: float, config: ReadConfig
) -> dict[str, Floats32]:
    """Make these layers, of cells or areas, from the `required` layers of cells, all (rows, columns)."""
    done: dict[str, Floats] = {name: values.astype(np.float64) for name, values in cells.items()}
    return {name: _derived(name, done, cell_m, config).astype(np.float32) for name in names}


def _derived(name: str, done: dict[str, Floats], cell_m: float, config: ReadConfig) -> Floats:
    """One layer, with those that it needs added to `done`.

    No closure: one that calls itself is a cycle, and keeps the arrays of a query until the next collection.
    """
    if name not in done:
        for need in AREA_LAYERS[name].needs:
            _derived(need, done, cell_m, config)
        done[name] = AREA_LAYERS[name].derive(Area(done, cell_m, config.fill_reach_m, config.boundaries))
    return done[name]


# --- shared by layers -------------------------------------------------------------------------------------------------


def _class_votes(cells: CellEvidence) -> Floats:
    """Votes (cells, classes): each bin's, by the share of its width, in log(c_rr), that lies in each class."""
    position = np.log(np.array(cells.config.boundaries) / ev.RESISTANCE_CENTRES[0]) / LOG_STEP
    edges = np.concatenate([[-np.inf], position, [np.inf]])
    bins = np.arange(ev.RESISTANCE_BINS)[:, None]
    share = np.maximum(np.minimum(bins + 0.5, edges[1:]) - np.maximum(bins - 0.5, edges[:-1]), 0)
    votes: Floats = cells.votes(ev.RESISTANCE) @ share
    return votes


def seconds_ago(stamp_ns: AnyArray, now_ns: Ints) -> Floats:
    """Time since stamps [s], not below 0; NaN where either is 0, which means not known."""
    return np.where((stamp_ns > 0) & (now_ns > 0), np.maximum(now_ns - stamp_ns, 0) / 1e9, np.nan)
