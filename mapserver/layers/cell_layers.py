"""Read layers: from evidence to float32 values, NaN where unknown (docs/layers.md).

A new layer is a function and a line in LAYERS, or in `gap_filling.AREA_LAYERS` if it reads neighbours. Debatable
choices, such as class boundaries, apply on reading, without refolding.
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

LOG_STEP = math.log(ev.RESISTANCE_CENTRES[1] / ev.RESISTANCE_CENTRES[0])  # width of a resistance bin in log(c_rr)
GRADE_STEP = float(ev.GRADE_CENTRES[1] - ev.GRADE_CENTRES[0])
MAX_REACH_M = 50.0  # limit of filling; windows are widened by it
SURE_AXIS = 0.2  # least mean axis, 0 to 1, that is a preference
# error of the votes' centre, relative to their spread, however many there are
SPREAD_SHARE = 0.5
# minority votes are mostly position errors: with this power, shares are probabilities
SHARPNESS = 1.5


@dataclass(frozen=True)
class ReadConfig:
    """How evidence is read.

    min_weight_m: least evidence of a cell, of resistance and of gradient. boundaries: of resistance classes,
    increasing; n make n + 1 classes. fill_reach_m: largest distance of filling.
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
    """Input of cell layers. evidence: arrays (cells, ...). now_ns (cells,): the site's now, 0 if unknown."""

    evidence: ev.Evidence
    now_ns: Ints
    config: ReadConfig

    def votes(self, part: slice) -> Floats:
        """Votes (cells, bins) of a histogram as floats, exact and faster; 0 if too few."""
        votes: Floats = self.evidence.counts[..., part].astype(np.float64)
        votes[votes.sum(axis=-1) < self.config.min_weight_m * ev.WEIGHT_UNITS_PER_M] = 0.0
        return votes

    # Centres in bins, used by several layers.
    @cached_property
    def resistance_bin(self) -> Floats:
        """Robust centre of c_rr votes, in bins."""
        return robust_centre(self.votes(ev.RESISTANCE), reach=2.5)

    @cached_property
    def gradient(self) -> tuple[Floats, Floats]:
        """Robust centre of gradient votes, east and north [m/m]."""
        # shorter reach than for c_rr, so that gradients 1.5 bins apart are not averaged
        east, north = (robust_centre(self.votes(part), reach=1.5) for part in (ev.GRADE_EAST, ev.GRADE_NORTH))
        return ev.GRADE_CENTRES[0] + GRADE_STEP * east, ev.GRADE_CENTRES[0] + GRADE_STEP * north


# --- layers of a cell ------------------------------------------------------------------------------------------------

Layer = Callable[[CellEvidence], Floats]


def resistance(cells: CellEvidence) -> Floats:
    """Rolling resistance coefficient [-]: robust centre of votes in log(c_rr)."""
    centre: Floats = ev.RESISTANCE_CENTRES[0] * np.exp(LOG_STEP * cells.resistance_bin)
    return centre


def resistance_std(cells: CellEvidence) -> Floats:
    """Standard deviation of `resistance` [-]: half the votes' spread, and the common error."""
    c_rr = resistance(cells)
    spread = SPREAD_SHARE * c_rr * LOG_STEP * robust_spread(cells.votes(ev.RESISTANCE))
    deviation: Floats = np.sqrt(spread**2 + error_model.resistance_variance(c_rr))
    return deviation


def resistance_class(cells: CellEvidence) -> Floats:
    """Index of the ground class with most votes (default 0 dry concrete ... 4 sand)."""
    votes = _class_votes(cells)
    return np.where(votes.sum(axis=-1) > 0, votes.argmax(axis=-1), np.nan)


def confidence(cells: CellEvidence) -> Floats:
    """Chance that the leading class is right: its share of votes to the power SHARPNESS."""
    votes = _class_votes(cells)
    sharp = (votes / np.maximum(votes.sum(axis=-1, keepdims=True), 1.0)) ** SHARPNESS
    return ratio(sharp.max(axis=-1), sharp.sum(axis=-1))


def grade_east(cells: CellEvidence) -> Floats:
    """Eastern gradient [m/m], positive if the ground rises to the east."""
    return cells.gradient[0]


def grade_north(cells: CellEvidence) -> Floats:
    """Northern gradient [m/m], positive if the ground rises to the north."""
    return cells.gradient[1]


def grade(cells: CellEvidence) -> Floats:
    """Steepness: length of the gradient [m/m]."""
    return np.hypot(*cells.gradient)


def grade_std(cells: CellEvidence) -> Floats:
    """Standard deviation of a gradient component [m/m], RMS of both."""
    east, north = (robust_spread(cells.votes(part)) for part in (ev.GRADE_EAST, ev.GRADE_NORTH))
    spread = GRADE_STEP * np.hypot(east, north) / math.sqrt(2)
    deviation: Floats = np.sqrt(spread**2 + error_model.gradient_variance(grade(cells)))
    return deviation


def slope_class(cells: CellEvidence) -> Floats:
    """0 flat, 1 slope (in the paper: over 7.5 degrees)."""
    classes = ground_classes.slope_class(*cells.gradient)
    return np.where(classes == ground_classes.UNKNOWN, np.nan, classes.astype(np.float64))


def heading(cells: CellEvidence) -> Floats:
    """Axis of driving [rad], -pi/2 to pi/2 from east, or NaN."""
    # doubled angles, as opposite directions of a haul road must not cancel
    votes = cells.votes(ev.HEADING)
    doubled = np.exp(4j * np.pi / ev.SECTORS * np.arange(ev.SECTORS))
    east, north = votes @ doubled.real, votes @ doubled.imag
    sure = np.hypot(east, north) >= SURE_AXIS * np.maximum(votes.sum(axis=-1), 1)
    return np.where(sure, np.arctan2(north, east) / 2, np.nan)


def visits(cells: CellEvidence) -> Floats:
    """Number of visits, at most 266."""
    return linear_count(cells.evidence.bitmaps[..., ev.VISITS])


def machines(cells: CellEvidence) -> Floats:
    """Number of machines, at most 266."""
    return linear_count(cells.evidence.bitmaps[..., ev.MACHINES])


def weight(cells: CellEvidence) -> Floats:
    """Metres of evidence."""
    metres: Floats = cells.evidence.weight / float(ev.WEIGHT_UNITS_PER_M)
    return metres


def age_s(cells: CellEvidence) -> Floats:
    """Age of the newest sample at the site's now [s], NaN if now is unknown."""
    return seconds_ago(cells.evidence.newest_ns, cells.now_ns)


def changed_s(cells: CellEvidence) -> Floats:
    """Age of the last change at the site's now [s], NaN for none or if now is unknown."""
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
    """Check layer names; none means all cell layers."""
    known = [*LAYERS, *AREA_LAYERS]
    if unknown := [name for name in names if name not in known]:
        problem = f"layer `{unknown[0][:40]}` is not known; known: {', '.join(known)}"
        raise QueryError(Refusal.UNKNOWN_LAYER, problem)
    return tuple(names) or tuple(LAYERS)


def read(
    evidence: ev.Evidence, names: Sequence[str], config: ReadConfig, now_ns: int | Ints = 0
) -> dict[str, Floats32]:
    """Cell layers (blocks, 256), NaN for thin evidence. now_ns: the site's now, one or (blocks, 1)."""
    metres = evidence.weight
    known = (metres > 0) & (metres >= config.min_weight_m * ev.WEIGHT_UNITS_PER_M)
    known_cells = {field.name: getattr(evidence, field.name)[known] for field in dataclasses.fields(evidence)}
    cells = CellEvidence(ev.Evidence(**known_cells), np.broadcast_to(now_ns, known.shape)[known], config)
    out = {name: np.full(known.shape, np.nan, np.float32) for name in names}
    for name, values in out.items():
        values[known] = LAYERS[name](cells)
    return out


def required(names: Sequence[str]) -> tuple[str, ...]:
    """Distinct cell layers that `derive_area` needs."""
    cells: dict[str, None] = {}
    for name in names:
        needs = required(AREA_LAYERS[name].needs) if name in AREA_LAYERS else (name,)
        cells |= dict.fromkeys(needs)
    return tuple(cells)


def margin_cells(names: Sequence[str], cell_m: float, config: ReadConfig) -> int:
    """Cells by which `derive_area` needs a wider window on each side."""
    return math.ceil(config.fill_reach_m / cell_m) if any(name in AREA_LAYERS for name in names) else 0


def derive_area(
    names: Sequence[str], cells: Mapping[str, Floats32], cell_m: float, config: ReadConfig
) -> dict[str, Floats32]:
    """Derive these layers from the `required` cell layers, all (rows, columns)."""
    done: dict[str, Floats] = {name: values.astype(np.float64) for name, values in cells.items()}
    return {name: _derived(name, done, cell_m, config).astype(np.float32) for name in names}


def _derived(name: str, done: dict[str, Floats], cell_m: float, config: ReadConfig) -> Floats:
    """One layer; adds its inputs to `done`. A recursive closure would be a cycle, and keep arrays until collected."""
    if name not in done:
        for need in AREA_LAYERS[name].needs:
            _derived(need, done, cell_m, config)
        done[name] = AREA_LAYERS[name].derive(Area(done, cell_m, config.fill_reach_m, config.boundaries))
    return done[name]


# --- shared by layers -------------------------------------------------------------------------------------------------


def _class_votes(cells: CellEvidence) -> Floats:
    """Votes (cells, classes): bins divided by width in log(c_rr)."""
    position = np.log(np.array(cells.config.boundaries) / ev.RESISTANCE_CENTRES[0]) / LOG_STEP
    edges = np.concatenate([[-np.inf], position, [np.inf]])
    bins = np.arange(ev.RESISTANCE_BINS)[:, None]
    share = np.maximum(np.minimum(bins + 0.5, edges[1:]) - np.maximum(bins - 0.5, edges[:-1]), 0)
    votes: Floats = cells.votes(ev.RESISTANCE) @ share
    return votes


def seconds_ago(stamp_ns: AnyArray, now_ns: Ints) -> Floats:
    """Time since stamps [s], at least 0; NaN if either is 0, unknown."""
    return np.where((stamp_ns > 0) & (now_ns > 0), np.maximum(now_ns - stamp_ns, 0) / 1e9, np.nan)
