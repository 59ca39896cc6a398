"""What a machine's samples are off by, fitted against the truth: calibration is judged by it, the oracle made of it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lab.fleet.cases import Tampered, cells, truth_places
from lab.fleet.drives import Scene
from mapserver.fleet.correction import LAST_NS, measured
from protocol.arrays import AnyArray, Floats, Floats32, Table
from protocol.site.ground_classes import resistance_class
from sitegrid.proof.map_score import border_distance

INTERIOR_M = 2.0  # from a border of soils
OUTLIER = 3.0  # typical errors beyond which a sample does not count


@dataclass(frozen=True)
class TrueError:
    """What a machine's samples are off by from a stamp to another, fitted against the truth."""

    from_ns: int
    to_ns: int
    zero: float
    scale: float
    across: float


def true_errors(data: Tampered, name: str, true: Scene, spans: int) -> list[TrueError]:
    """Zero and scale of what a machine measured, in equal spans of its samples, by least squares to the true ground.

    Samples near borders of soils do not count, nor those further off than OUTLIER typical errors.
    """
    rows = measured(data.rows[name])
    oldest, newest = int(rows["stamp_ns"].min()), int(rows["stamp_ns"].max())
    ends = [0, *((oldest * (spans - i) + newest * i) // spans for i in range(1, spans)), LAST_NS]
    out = []
    for from_ns, to_ns in pairwise(ends):
        part = rows[(rows["stamp_ns"] >= from_ns) & (rows["stamp_ns"] < to_ns)]
        out.append(TrueError(from_ns, to_ns, *_fit(part, data.earlier.get(name, data.c_rr), name, true)))
    return out


def _fit(rows: Table, c_rr: Floats32, name: str, true: Scene) -> tuple[float, float, float]:
    """Zero, scale error k and lateral zero of these samples."""
    track = true.tracks[name].at(rows["stamp_ns"])
    at = cells(truth_places(rows, true, name), true)
    ground, border_m = c_rr[at].astype(np.float64), border_distance(resistance_class(c_rr), true.truth.cell_m)[at]
    ahead = np.stack([np.cos(track.yaw_rad), np.sin(track.yaw_rad)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    d, slope = np.sign(rows["speed_mps"].astype(np.float64)), (track.gradient * ahead).sum(axis=1)
    gradient = np.stack([rows["grade_e"], rows["grade_n"]], axis=1)
    across = np.nanmedian(((gradient - track.gradient) * left).sum(axis=1))
    usable = np.isfinite(rows["c_rr"]) & np.isfinite(slope) & (border_m > INTERIOR_M)
    columns, off = np.stack([d, d * (d * ground + slope)], axis=1)[usable], (rows["c_rr"] - ground)[usable]
    first = _least_squares(columns, off)
    residual = np.abs(off - columns @ first)
    near = residual < OUTLIER * 1.4826 * np.median(residual)
    zero, scale = _least_squares(columns[near], off[near]).tolist()
    return zero, scale, float(across)


def _least_squares(A: AnyArray, b: AnyArray) -> Floats:
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0], np.float64)
