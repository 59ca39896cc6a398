"""Synthetic samples of an eastward drive, and tracks."""

import numpy as np

from protocol.arrays import Table
from protocol.machine.samples import SAMPLE_DTYPE
from sim.simulator import START_NS
from sitegrid.proof.tracks import LoadTrack

SECOND_NS = 10**9


def driving(begin_s: float, count: int, y_m: float = 20.5, c_rr: float = 0.02) -> Table:
    """Samples from (20.5, y_m) on, one per second and metre."""
    rows = np.zeros(count, SAMPLE_DTYPE)
    rows["stamp_ns"] = START_NS + np.round((begin_s + np.arange(count)) * 1e9).astype(np.int64)
    rows["x_m"], rows["y_m"] = 20.5 + np.arange(count), y_m
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.01
    rows["speed_mps"] = rows["distance_m"] = 1.0
    rows["c_rr"], rows["c_rr_var"], rows["grade_var"] = c_rr, 1e-6, 1e-6
    return rows


def track(place_m: np.ndarray, step_s: float = 0.5) -> LoadTrack:
    stamps = START_NS + np.round(np.arange(len(place_m)) * step_s * 1e9).astype(np.int64)
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(place_m, axis=0).T))])
    return LoadTrack(stamps, place_m, np.zeros(len(place_m)), np.zeros((len(place_m), 2)), driven)
