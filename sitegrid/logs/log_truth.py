"""The truth of a real log. Agents never read the file beside its manifest that describes it, `evaluation.toml`.

[truth]                                # the true track of the log, of `base_link` or of an antenna
file = "truth.csv.gz"                  # in the data folder; keys and columns as those of a sensor in the manifest
mount = { xyz_m = [0.4, 0.0, 1.9] }    # where that antenna sits; default at `base_link`
stamp = "t"
x_m = "x"                              # metres in `map`; or lat_deg and lon_deg
y_m = "y"
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
from protocol.site.site_config import Projection
from sitegrid.proof.tracks import Truth

SIDE_FILE = "evaluation.toml"
PLANAR, GEODETIC = ("x_m", "y_m"), ("lat_deg", "lon_deg")
LIMITS = {"x_m": MAX_FAR_M, "y_m": MAX_FAR_M, "lat_deg": 90.0, "lon_deg": 180.0}
GAP_NS = 2_000_000_000  # between two rows that are further apart nobody knows where the machine was


@dataclass(frozen=True)
class LogTruth:
    """The true track of a log; lever_m (3,): where in `base_link` the point is whose track it is."""

    track: Truth
    lever_m: Floats


def read_log_truth(log: LogFolder, folder: Path) -> LogTruth | None:
    """The truth that the side file in a folder describes, None without such a file."""
    where = folder / SIDE_FILE
    if not where.is_file():
        return None
    table = load_toml(where)
    described = section(table, "truth", str(where))
    if table:
        raise ConfigError(where, f"unknown key `{next(iter(table))}`; known: truth")
    return _read(log, described, f"{where} [truth]")


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
    if pair == GEODETIC:
        places = np.stack(Projection(log.site).to_map_many(*places.T), axis=1)
    return LogTruth(_cut_at_gaps(stamps, places), np.array(mount.xyz_m))


def _rows(
    log: LogFolder, file: CsvFile, time: Column, pair: Mapping[str, Column]
) -> Iterator[tuple[int, float, float]]:
    """Stamp and place of each row that counts, NaN where a row says so; raises LogFolderError with the line."""
    path, newest = log.data / file.file, 0
    stamp, readers = stamp_reader(time), [number_reader(column, name) for name, column in pair.items()]
    with opened_rows(file, log.data) as rows:
        for column in (time, *pair.values()):
            require(column.weights, rows, path)
        for row in rows:
            try:
                file.check(row)
                stamp_ns, (a, b) = log.start_ns + stamp(row), (read(row) for read in readers)
            except RowError:
                continue
            except (ValueError, TypeError, OverflowError):
                raise LogFolderError(path, f"line {rows.line_num}: a value is missing, or is not a number") from None
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
    """The track, with nothing known between rows that are far apart: a receiver was lost there."""
    gaps = np.flatnonzero(np.diff(stamps) > GAP_NS)
    middles = stamps[gaps] + np.diff(stamps)[gaps] // 2
    return Truth(np.insert(stamps, gaps + 1, middles), np.insert(places, gaps + 1, math.nan, axis=0))
