"""The road network that judges all arms: cells of the tours, their truth, figures of a map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from lab.cooperation.drives import lines, points
from lab.ground.truth import TrueGround
from protocol.arrays import Bools, Floats, Floats32, Ints
from protocol.site.ground_classes import UNKNOWN, resistance_class
from sitegrid.proof.figures import root_mean_square
from sitegrid.proof.map_score import border_distance
from sitegrid.proof.tracks import LoadTrack

SURE = 0.6  # confidence from which a cell counts as certain
SHARE_PCT = 90.0  # of the network, or of repaved cells
BORDER_M, BREAK_M = 2.0, 5.0  # from soil borders and slope breaks; nearer cells are judged separately
STEP_M = 0.1  # point spacing of lines
SLOPE_STEP = 0.01  # gradients closer than this count as one slope
LAYERS = ("resistance", "grade_east", "grade_north", "confidence", "resistance_class")
FIGURES = (
    "covered_pct", "known_pct", "wrong_pct", "c_rr_pct", "c_rr_all_pct", "grade_pct", "grade_all_pct",
    "grade_across_pct", "grade_profile_pct",
)  # fmt: skip


@dataclass(frozen=True)
class Network:
    """Unique cells of the tours (k,). row, column: in the true map. direction (k, 2): of travel, unit.

    c_rr: true. border_m, break_m: distance from the nearest soil border and slope break. profile (k, 2): gradient
    without roughness. plane (k, 2): gradient of the plane through passing machines' wheels, NaN without one. tour:
    index of the (first) tour.
    """

    row: Ints
    column: Ints
    direction: Floats
    c_rr: Floats
    border_m: Floats
    break_m: Floats
    profile: Floats
    plane: Floats
    tour: Ints

    @property
    def place_m(self) -> Floats:
        """Centres (k, 2)."""
        return np.stack([self.column, self.row], axis=1).astype(np.float64) + 0.5

    def part(self, where: Bools) -> Network:
        """A subset of the cells."""
        return replace(self, **{field.name: getattr(self, field.name)[where] for field in fields(self)})


def network(ground: TrueGround, tracks: Iterable[LoadTrack]) -> Network:
    """Cells on the lines of all tours. tracks: of machines, for mean wheel planes."""
    cells: dict[tuple[int, int], tuple[Floats, int]] = {}
    for number, leg in enumerate(lines().values()):
        line = _dense(points(leg))
        ahead = np.gradient(line, axis=0)
        for (column, row), direction in zip(np.floor(line).astype(int).tolist(), ahead, strict=True):
            cells.setdefault((row, column), (direction / np.hypot(*direction), number))
    row, column = np.array(list(cells), np.int64).T
    direction = np.array([ahead for ahead, _ in cells.values()])
    truth = ground.truth
    classes = resistance_class(truth.c_rr)
    shape = truth.c_rr.shape
    x_m, y_m = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    slope = np.stack(ground.profile.gradient(x_m, y_m), axis=-1)
    return Network(
        row,
        column,
        direction,
        truth.c_rr[row, column].astype(np.float64),
        border_distance(classes, truth.cell_m)[row, column],
        break_distance(slope, truth.cell_m)[row, column],
        slope[row, column],
        _planes(tracks, shape)[row, column],
        np.array([number for _, number in cells.values()], np.int64),
    )


def break_distance(slope: Floats, cell_m: float) -> Floats:
    """Distance [m] of cells from the nearest other slope; slope: gradients (rows, columns, 2)."""
    steps = np.round(slope / SLOPE_STEP).astype(np.int64)
    _, kinds = np.unique(steps.reshape(-1, 2), axis=0, return_inverse=True)
    return border_distance(kinds.reshape(steps.shape[:2]), cell_m)


def figures(layers: Mapping[str, Floats32 | Floats], cells: Network) -> dict[str, float]:
    """FIGURES of a map (rows, columns) over cells; NaN if unknown everywhere; percent.

    covered_pct: right class with confidence SURE. wrong_pct: of known cells. c_rr_pct: RMS relative error beyond
    BORDER_M from a border; c_rr_all_pct: everywhere. grade_pct: along travel, against the wheel plane, beyond BREAK_M
    from a slope break; grade_all_pct: everywhere; grade_across_pct: across travel; grade_profile_pct: along travel,
    against the ground without roughness.
    """
    at = {name: np.asarray(layers[name], np.float64)[cells.row, cells.column] for name in LAYERS}
    kind, true = resistance_class(at["resistance"]), resistance_class(cells.c_rr)
    known, right = kind != UNKNOWN, kind == true
    off = at["resistance"] / cells.c_rr - 1
    inner, even = cells.border_m > BORDER_M, cells.break_m > BREAK_M
    gradient = np.stack([at["grade_east"], at["grade_north"]], axis=1)
    left = np.stack([-cells.direction[:, 1], cells.direction[:, 0]], axis=1)
    along, across = (((gradient - cells.plane) * axis).sum(axis=1) for axis in (cells.direction, left))
    profile = ((gradient - cells.profile) * cells.direction).sum(axis=1)
    values = (
        float((right & known & (at["confidence"] >= SURE)).mean()),
        float(known.mean()),
        float((~right[known]).mean()) if known.any() else np.nan,
        _rms(off[inner]),
        _rms(off),
        _rms(along[even]),
        _rms(along),
        _rms(across[even]),
        _rms(profile[even]),
    )
    return {name: 100.0 * value for name, value in zip(FIGURES, values, strict=True)}


def _rms(values: Floats) -> float:
    return root_mean_square(values[np.isfinite(values)])


def _dense(line: Floats) -> Floats:
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.arange(0.0, along[-1], STEP_M)
    return np.stack([np.interp(at, along, column) for column in line.T], axis=1)


def _planes(tracks: Iterable[LoadTrack], shape: tuple[int, ...]) -> Floats:
    """Mean gradient of wheel planes by cell (rows, columns, 2)."""
    total, count = np.zeros((*shape, 2)), np.zeros(shape)
    for track in tracks:
        moved = np.diff(track.driven_m, prepend=0.0) > 0.01
        column, row = np.floor(track.place_m[moved]).astype(np.int64).T
        np.add.at(total, (row, column), track.gradient[moved])
        np.add.at(count, (row, column), 1)
    mean: Floats = np.full((*shape, 2), np.nan)
    np.divide(total, count[..., None], out=mean, where=count[..., None] > 0)
    return mean
