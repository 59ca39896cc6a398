"""Fleets with known samples, ground and errors, in place of slow recordings."""

import numpy as np

from lab.calibration.drives import Scene
from protocol.arrays import Table
from sim.truth import TruthMap
from sitegrid.proof.tracks import LoadTrack
from tests.unit.mapserver.calibration.drives import LOW, RAMP, RAMP_AGAIN, Errors, drive, height_slope, soils

ROUTES = {"a": (LOW, Errors(0.004, -0.05)), "b": (RAMP, Errors(-0.006, 0.04)), "c": (RAMP_AGAIN, Errors(0.008, 0.03))}


def truth() -> TruthMap:
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(60) + 0.5)
    layers = soils(x, y, x), height_slope(x), np.zeros_like(x)
    return TruthMap(0.0, 0.0, *(layer.astype(np.float32) for layer in layers))


def track(rows: Table) -> LoadTrack:
    """The samples' places as truth; headings of the drive, slopes of the ground."""
    place = np.stack([rows["x_m"], rows["y_m"]], axis=1)
    gradient = np.stack([height_slope(rows["x_m"]), np.zeros(len(rows))], axis=1)
    driven = np.cumsum(rows["distance_m"].astype(np.float64))
    return LoadTrack(rows["stamp_ns"], place, np.unwrap(rows["heading_rad"].astype(np.float64)), gradient, driven)


def made_scene() -> tuple[dict[str, Table], Scene]:
    """Samples of three machines at their true places, and the truth."""
    rows = {name: drive(route, errors, seed=i, late=False) for i, (name, (route, errors)) in enumerate(ROUTES.items())}
    return rows, Scene(truth(), {name: track(table) for name, table in rows.items()})
