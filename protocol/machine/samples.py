"""Samples: located resistance and gradient as structured rows, the same bytes on machine, wire and server."""

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from protocol.arrays import AnyArray, Bools, Table
from protocol.errors import MessageError, Refusal
from protocol.machine.readings import MAX_STAMP_NS

# Order, types, names: part of the wire (docs/protocol.md), little-endian.
SAMPLE_DTYPE = np.dtype(
    [
        ("stamp_ns", "<i8"),
        ("x_m", "<f8"),
        ("y_m", "<f8"),
        ("cov_xx_m2", "<f4"),
        ("cov_xy_m2", "<f4"),
        ("cov_yy_m2", "<f4"),
        ("heading_rad", "<f4"),
        ("speed_mps", "<f4"),
        ("distance_m", "<f4"),
        ("c_rr", "<f4"),
        ("c_rr_var", "<f4"),
        ("grade_e", "<f4"),
        ("grade_n", "<f4"),
        ("grade_var", "<f4"),
        ("applied_zero", "<f4"),
        ("applied_scale", "<f4"),
        ("mass_kg", "<f4"),
        ("aid_share", "<f4"),
        ("fuel_l", "<f4"),
    ]
)
COLUMNS: tuple[str, ...] = SAMPLE_DTYPE.names or ()
RAW_SAMPLE = np.dtype((np.void, SAMPLE_DTYPE.itemsize))  # copied at once, while numpy copies records by field

COVARIANCES = ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
RESISTANCE = ("c_rr", "c_rr_var")  # may both be NaN
GRADE = ("grade_e", "grade_n", "grade_var")  # may all be NaN
APPLIED = ("applied_zero", "applied_scale")  # taken off the balance by the machine's own calibration
MASS = "mass_kg"  # with load; may be NaN
AIDED = "aid_share"  # share of the place that came from lanes [-]
FUEL = "fuel_l"  # litres of diesel since the last sample, while moving; may be NaN
# Optional columns of a batch, and their defaults.
OPTIONAL = {**dict.fromkeys(APPLIED, 0.0), MASS: np.nan, AIDED: 0.0, FUEL: np.nan}
NAN_ALLOWED = (RESISTANCE, GRADE, (MASS,), (FUEL,))  # groups that are NaN together or not at all

# Plausible range of each column.
LIMITS: dict[str, tuple[float, float]] = {
    "stamp_ns": (1, MAX_STAMP_NS),
    "cov_xx_m2": (0.0, 1e6),
    "cov_yy_m2": (0.0, 1e6),
    "cov_xy_m2": (-1e6, 1e6),
    "heading_rad": (-7.0, 7.0),
    "speed_mps": (-100.0, 100.0),
    "distance_m": (0.0, 100.0),
    "c_rr": (-1.0, 5.0),
    "c_rr_var": (0.0, 100.0),
    "grade_e": (-5.0, 5.0),
    "grade_n": (-5.0, 5.0),
    "grade_var": (0.0, 100.0),
    # Beyond any usable accelerometer or drive train. An uncalibrated IMU under a frame has a bias of 0.03 and is tilted
    # 0.026 rad (1.5 degrees): five times both.
    "applied_zero": (-0.2, 0.2),
    "applied_scale": (-0.5, 0.5),
    "mass_kg": (1.0, 1e6),
    "aid_share": (0.0, 1.0),
    "fuel_l": (0.0, 100.0),
}
# Standard deviations before calibration, by data sheets: accelerometer bias over gravity (0.044 m/s2), scale of drive
# force over weight; and the bias's random walk [1/sqrt(s)], its initial deviation in an hour.
ZERO_STD, SCALE_STD, ZERO_WALK = 0.0045, 0.045, 8e-5


def empty(n: int = 0) -> Table:
    """`n` samples of zeros, with mass and fuel unknown."""
    rows = np.zeros(n, SAMPLE_DTYPE)
    rows[MASS] = rows[FUEL] = np.nan
    return rows


def joined(tables: Sequence[Table]) -> Table:
    """Several tables in one."""
    return np.concatenate([np.empty(0, RAW_SAMPLE), *(table.view(RAW_SAMPLE) for table in tables)]).view(SAMPLE_DTYPE)


def content_hash(row: Table) -> str:
    """Hash of a sample's bytes, for audits."""
    return hashlib.blake2b(row.tobytes(), digest_size=8).hexdigest()


Columns = Table | Mapping[str, AnyArray]


def check_samples(rows: Columns, extent_m: float) -> None:
    """MessageError with field and row for an implausible sample.

    rows: samples, or some columns, with COVARIANCES and groups of NAN_ALLOWED complete. extent_m: bound of positions.
    """
    names = rows.keys() if isinstance(rows, Mapping) else COLUMNS
    _check_finite(rows, [name for name in COLUMNS if name in names])
    for name in ("x_m", "y_m"):
        _refuse(np.abs(rows[name]) > extent_m, rows, name, Refusal.OUTSIDE_SITE, f"beyond {extent_m:g} m of the origin")
    for name, (low, high) in ((name, ends) for name, ends in LIMITS.items() if name in names):
        bad: Bools = (rows[name] < low) | (rows[name] > high)  # NaN passes: checked above
        reason = Refusal.COVARIANCE if name.startswith("cov_") else Refusal.OUT_OF_RANGE
        _refuse(bad, rows, name, reason, f"not between {low:g} and {high:g}")
    if COVARIANCES[0] in names:
        problem = "covariance is not positive semidefinite"
        _refuse(~_is_semidefinite(rows), rows, "cov_xy_m2", Refusal.COVARIANCE, problem)


def _check_finite(rows: Columns, names: Sequence[str]) -> None:
    for group in (group for group in NAN_ALLOWED if group[0] in names):
        missing = np.stack([np.isnan(rows[name]) for name in group]).sum(axis=0)
        partly = (missing > 0) & (missing < len(group))
        _refuse(partly, rows, group[0], Refusal.NOT_FINITE, f"{', '.join(group)} must be NaN together or not at all")
    for name in names[1:]:
        may_be_nan = any(name in group for group in NAN_ALLOWED)
        bad = np.isinf(rows[name]) if may_be_nan else ~np.isfinite(rows[name])
        _refuse(bad, rows, name, Refusal.NOT_FINITE, "not finite")


def _is_semidefinite(rows: Columns) -> Bools:
    xx, xy, yy = (rows[name].astype(np.float64) for name in COVARIANCES)
    semidefinite: Bools = xx * yy - xy * xy >= -1e-6 * np.maximum(xx * yy, 1e-12)  # single precision rounds the product
    return semidefinite


def _refuse(bad: Bools, rows: Columns, field: str, reason: Refusal, problem: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        raise MessageError(reason, f"{rows[field][row]!s}: {problem}", field=field, row=row)
