"""True ground and tracks, kept apart from sensors; for comparisons only."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from protocol.arrays import Floats32, Table
from protocol.errors import StoreError
from sim.terrain.terrain import C_RR, Terrain

TRACK_EVERY = 10  # steps per row: 10 Hz
# Track column -> field of the state [m, rad, m/s, kg, -, m/m].
TRACK_VALUES = {"x": "x_m", "y": "y_m", "z": "z_m", "yaw": "yaw_rad", "pitch": "pitch_rad", "roll": "roll_rad"}
TRACK_VALUES |= {"speed": "speed_mps", "mass": "mass_kg", "c_rr": "c_rr", "grade_e": "grade_e", "grade_n": "grade_n"}
WORK = "work"  # column: engine work at the wheels so far [J]
TRACK_DTYPE = np.dtype([("stamp_ns", "<i8"), *((name, "<f8") for name in (*TRACK_VALUES, WORK))])
MAP_FILE = "truth_map.npz"


@dataclass(frozen=True)
class TruthMap:
    """True layers of a site: (rows, columns) float32, rows northwards, values at cell centres.

    west_m, south_m: corner of cell (0, 0). grade_*: over the cell [m/m].
    """

    west_m: float
    south_m: float
    c_rr: Floats32
    grade_east: Floats32
    grade_north: Floats32
    cell_m: float = 1.0

    def save(self, path: Path) -> None:
        """Write as .npz, the required suffix."""
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, **vars(self))

    @classmethod
    def load(cls, path: Path) -> TruthMap:
        """Read what `save` wrote; else StoreError."""
        try:
            with path.open("rb") as file, np.load(file) as data:
                west_m, south_m, cell_m = (float(data[name]) for name in ("west_m", "south_m", "cell_m"))
                return cls(west_m, south_m, data["c_rr"], data["grade_east"], data["grade_north"], cell_m)
        except (OSError, EOFError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise StoreError(path, f"is no truth map: {error}") from None


def truth_map(terrain: Terrain, width_m: float, depth_m: float, cell_m: float = 1.0) -> TruthMap:
    """Survey a terrain from the origin of `map`."""
    east = (np.arange(round(width_m / cell_m)) + 0.5) * cell_m
    north = (np.arange(round(depth_m / cell_m)) + 0.5) * cell_m
    x, y = np.meshgrid(east, north)
    half = cell_m / 2  # over the whole cell, not the terrain patch at its centre
    rise_e = (terrain.height(x + half, y) - terrain.height(x - half, y)) / cell_m
    rise_n = (terrain.height(x, y + half) - terrain.height(x, y - half)) / cell_m
    c_rr, east, north = (layer.astype(np.float32) for layer in (C_RR[terrain.zone(x, y)], rise_e, rise_n))
    return TruthMap(0.0, 0.0, c_rr, east, north, cell_m)


def save_tracks(folder: Path, tracks: Mapping[str, Table]) -> None:
    """Write <machine>.csv with the columns of TRACK_DTYPE."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, track in tracks.items():
        with (folder / f"{name}.csv").open("w", encoding="utf-8", newline="") as text:
            writer = csv.writer(text)
            writer.writerow(TRACK_DTYPE.names or ())
            writer.writerows([row[0], *map(repr, row[1:])] for row in track.tolist())
