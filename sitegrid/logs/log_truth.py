"""Reference of a recording: `evaluation.toml` beside the manifest, never read by agents.

[truth]                                # true track of `base_link` or an antenna
file = "truth.csv.gz"                  # in the data folder; keys and columns like a sensor's in the manifest
mount = { xyz_m = [0.4, 0.0, 1.9] }    # that antenna's mount; default `base_link`
stamp = "t"
x_m = "x"                              # metres in `map`; or lat_deg and lon_deg
y_m = "y"
[[ground]]                             # area of known resistance, gradient, or both
name = "ramp"
outline = [[0.0, 0.0], [20.0, 0.0], [20.0, 15.0]]    # corners in `map` [m]
c_rr = 0.012
grade_east = 0.05                      # rise over run
grade_north = 0.0
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from protocol.arrays import Floats, Ints
from protocol.config import from_table, section
from protocol.errors import ConfigError, LogFolderError, RowError
from protocol.files import load_toml
from protocol.machine.csv_file import (
    Column,
    CsvFile,
    no_value,
    number_reader,
    opened_rows,
    parse_column,
    require,
    stamp_reader,
    take_file,
)
from protocol.machine.log_columns import MAX_FAR_M
from protocol.machine.log_folder import LogFolder
from protocol.machine.machine_config import Mount
from protocol.site.site_config import KnownGround, Projection
from sitegrid.logs.clocks import ALL_DIGITS, stands
from sitegrid.proof.tracks import Truth

SIDE_FILE = "evaluation.toml"
PLANAR, GEODETIC = ("x_m", "y_m"), ("lat_deg", "lon_deg")
LIMITS = {"x_m": MAX_FAR_M, "y_m": MAX_FAR_M, "lat_deg": 90.0, "lon_deg": 180.0}
GAP_NS = 2_000_000_000  # between rows farther apart the position is unknown


@dataclass(frozen=True)
class LogTruth:
    """True track of a log; lever_m (3,): the tracked point in `base_link`."""

    track: Truth
    lever_m: Floats


@dataclass(frozen=True)
class KnownArea:
    """Area with known ground; None: unknown.

    outline: corners in `map` [m]. c_rr: rolling resistance [-]. grade_east, grade_north: rise over run.
    """

    name: str
    outline: tuple[tuple[float, float], ...]
    c_rr: float | None = None
    grade_east: float | None = None
    grade_north: float | None = None

    def __post_init__(self) -> None:
        self.inside_m(0.0, 0.0)  # refuses an invalid outline or resistance
        if self.c_rr is None and not self.has_gradient:
            raise ValueError(f"{self.name}: state c_rr, grade_east or grade_north, else nothing is known of it")

    @property
    def has_gradient(self) -> bool:
        """Whether its gradient is known, east or north."""
        return self.grade_east is not None or self.grade_north is not None

    def inside_m(self, x_m: float, y_m: float) -> float:
        """Distance inside the outline [m], negative outside."""
        return KnownGround(self.name, self.c_rr or 0.0, self.outline).inside_m(x_m, y_m)


def read_log_truth(log: LogFolder, folder: Path) -> LogTruth | None:
    """The true track from a folder's side file, or None."""
    described = section(_side_file(folder), "truth", str(folder / SIDE_FILE))
    return _read(log, described, f"{folder / SIDE_FILE} [truth]") if described else None


def require_overlap(truth: LogTruth, first_ns: int, last_ns: int) -> None:
    """ConfigError if the truth does not overlap readings from first_ns to last_ns."""
    begins_s, ends_s = (float(truth.track.stamp_ns[i] - first_ns) * 1e-9 for i in (0, -1))
    seconds = (last_ns - first_ns) * 1e-9
    if ends_s < 0 or begins_s > seconds:
        where = f"from {begins_s:.0f} to {ends_s:.0f} s of the log, which lasts from 0 to {seconds:.0f} s"
        raise ConfigError(SIDE_FILE, f"the truth is {where}: look at its stamps and their unit")


def read_known_ground(log: LogFolder, folder: Path) -> tuple[KnownArea, ...]:
    """Areas of known ground from side file and site."""
    of_site = [KnownArea(area.name, area.outline, area.c_rr) for area in log.site.known_ground]
    described = from_table(_Ground, {"ground": _side_file(folder).get("ground", [])}, str(folder / SIDE_FILE))
    return *described.ground, *of_site


@dataclass(frozen=True)
class _Ground:
    """[[ground]] tables."""

    ground: tuple[KnownArea, ...] = ()


def _side_file(folder: Path) -> dict[str, Any]:
    """Tables of the side file, empty without one."""
    where = folder / SIDE_FILE
    table = load_toml(where) if where.is_file() else {}
    if unknown := [name for name in table if name not in ("truth", "ground")]:
        raise ConfigError(where, f"unknown key `{unknown[0]}`; known: truth, ground")
    return table


def _read(log: LogFolder, described: dict[str, Any], where: str) -> LogTruth:
    mount = from_table(Mount, section(described, "mount", where), f"{where} mount")
    file = take_file(described, where)
    columns = {name: parse_column(value, name, f"{where} {name}") for name, value in described.items()}
    pair = GEODETIC if GEODETIC[0] in columns else PLANAR
    if set(columns) != {"stamp", *pair}:
        known = f"stamp, {', '.join(PLANAR)}, or stamp, {', '.join(GEODETIC)}"
        raise ConfigError(where, f"its columns are {known}; not {', '.join(columns) or 'none'}")
    rows = list(_rows(log, file, columns["stamp"], {name: columns[name] for name in pair}))
    stamps, places = np.array([row[0] for row in rows], np.int64), np.array([row[1:] for row in rows])
    if stands(stamps):
        raise LogFolderError(log.data / file.file, f"the stamps of its {len(stamps)} rows do not advance; {ALL_DIGITS}")
    if pair == GEODETIC:
        places = np.stack(Projection(log.site).to_map_many(*places.T), axis=1)
    return LogTruth(_cut_at_gaps(stamps, places), np.array(mount.xyz_m))


def _rows(
    log: LogFolder, file: CsvFile, time: Column, pair: Mapping[str, Column]
) -> Iterator[tuple[int, float, float]]:
    """Stamp and place per usable row, NaN where stated; LogFolderError names the line."""
    path, newest = log.data / file.file, 0
    stamp = stamp_reader(time, log.start_ns)
    readers = [number_reader(column, name) for name, column in pair.items()]
    with opened_rows(file, log.data) as rows:
        for column in (time, *pair.values()):
            require(column.columns, rows, path)
        for row in rows:
            try:
                file.check(row)
                stamp_ns, (a, b) = stamp(row), (read(row) for read in readers)
            except RowError:
                continue
            except (ValueError, TypeError, OverflowError):
                raise LogFolderError(
                    path, f"line {rows.line_num}: {no_value(row, {'stamp': time, **pair}, file)}"
                ) from None
            if stamp_ns < newest:
                raise LogFolderError(path, f"line {rows.line_num}: it is older than the row before it")
            for name, value in zip(pair, (a, b), strict=True):
                if abs(value) > LIMITS[name]:
                    raise LogFolderError(path, f"line {rows.line_num}: {name}: {value!r} is beyond {LIMITS[name]:g}")
            newest = stamp_ns
            yield stamp_ns, a, b
    if not newest:
        raise LogFolderError(path, "has no row that counts")


def _cut_at_gaps(stamps: Ints, places: Floats) -> Truth:
    """The track with NaN inside gaps, where the receiver was lost."""
    gaps = np.flatnonzero(np.diff(stamps) > GAP_NS)
    middles = stamps[gaps] + np.diff(stamps)[gaps] // 2
    return Truth(np.insert(stamps, gaps + 1, middles), np.insert(places, gaps + 1, math.nan, axis=0))
