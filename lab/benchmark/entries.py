"""Files of entries: a map or samples per recording, validated line by line before scoring."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from lab.benchmark.recordings import MACHINE
from lab.maps.methods import Layers
from protocol.arrays import Table
from protocol.errors import ConfigError, MessageError
from protocol.machine.samples import COLUMNS, LIMITS, SAMPLE_DTYPE, check_samples
from protocol.site.site_config import SiteConfig
from sim.truth import TruthMap

PLACE = ("x_m", "y_m")
VALUES = ("resistance", "grade_east", "grade_north")
ENCODING = "utf-8-sig"  # spreadsheets write a byte-order mark
CONFIDENCE = "confidence"  # optional column of a map
BOUNDS = {**dict.fromkeys(VALUES, (-100.0, 100.0)), CONFIDENCE: (0.0, 1.0)}  # larger values would break sums of errors
EXTENT_M = SiteConfig.extent_m  # from the origin
# Metres of samples over the length of their track: agents' samples have 0.98 to 1.02.
MOST_METRES, SPARE_M = 1.1, 10.0


def is_samples(path: Path) -> bool:
    """Whether a file has samples rather than a map, by its header; ConfigError without all columns of either."""
    header = _header(path)
    if MACHINE in header:
        _require_columns(path, header, (MACHINE, *COLUMNS))
    else:
        _require_columns(path, header, (*PLACE, *VALUES))
    return MACHINE in header


def read_map(path: Path, truth: TruthMap) -> Layers:
    """Layers (rows, columns) of a map file on a site's cells; unnamed cells are unknown.

    Places off the site are ignored: its extent is not published. ConfigError names the line of an invalid value or
    repeated cell, or says that no place is on the site.
    """
    rows, columns = truth.c_rr.shape
    names = [*VALUES, *([CONFIDENCE] if CONFIDENCE in _header(path) else [])]
    layers = {name: np.full((rows, columns), np.nan) for name in names}
    seen = np.zeros((rows, columns), np.bool_)
    for where, line in _lines(path, (*PLACE, *names)):
        x_m, y_m = (_number(where, line, axis) for axis in PLACE)
        if math.isnan(x_m) or math.isnan(y_m):
            raise ConfigError(where, "has no place: x_m and y_m are metres in `map`")
        if not (0 <= x_m - truth.west_m < columns * truth.cell_m and 0 <= y_m - truth.south_m < rows * truth.cell_m):
            continue
        row, column = int((y_m - truth.south_m) / truth.cell_m), int((x_m - truth.west_m) / truth.cell_m)
        if seen[row, column]:
            raise ConfigError(where, f"the cell of ({x_m:g}, {y_m:g}) was named before")
        seen[row, column] = True
        for name in names:
            value, (low, high) = _number(where, line, name), BOUNDS[name]
            if value < low or value > high:
                raise ConfigError(where, f"{name} {value:g} is not between {low:g} and {high:g}")
            layers[name][row, column] = value
    if not seen.any():
        raise ConfigError(path, "none of its places is on the site; x_m and y_m are metres in `map`")
    return layers


def read_samples(path: Path, machines: Collection[str]) -> dict[str, Table]:
    """Samples by machine of a recording; ConfigError names the wrong line or field.

    Stamps of a machine are unique, and samples weigh no more metres than their track: weight must not buy influence.
    """
    rows: dict[str, list[tuple[float, ...]]] = {}
    for where, line in _lines(path, (MACHINE, *COLUMNS)):
        if (name := line[MACHINE]) not in machines:
            raise ConfigError(where, f"{MACHINE} {name[:40]!r} is none of the recording: {', '.join(sorted(machines))}")
        values = [_number(where, line, name) for name in COLUMNS[1:]]
        rows.setdefault(name, []).append((_stamp(where, line), *values))
    tables = {name: np.array(own, SAMPLE_DTYPE) for name, own in sorted(rows.items())}
    for name, table in tables.items():
        try:
            check_samples(table, EXTENT_M)
        except MessageError as error:
            raise ConfigError(path, f"machine {name}: {error}") from None
        _check_weights(path, name, np.sort(table, order=COLUMNS[0]))
    return tables


def _check_weights(path: Path, name: str, table: Table) -> None:
    """ConfigError if samples (n,), sorted by stamp, weigh more than the machine drove."""
    again = np.flatnonzero(np.diff(table[COLUMNS[0]]) == 0)
    if len(again):
        raise ConfigError(path, f"machine {name}: {COLUMNS[0]} {table[COLUMNS[0]][again[0]]} comes twice")
    line_m = float(np.hypot(np.diff(table["x_m"]), np.diff(table["y_m"])).sum())
    stated_m = float(table["distance_m"].sum())
    if stated_m > MOST_METRES * line_m + SPARE_M:
        problem = f"distance_m adds up to {stated_m:.0f} m, along a line of {line_m:.0f} m"
        raise ConfigError(path, f"machine {name}: {problem}; it is the metres that each sample stands for")


def _lines(path: Path, names: Sequence[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """Lines after the header, with their place; ConfigError if a column is missing."""
    header = _header(path)
    _require_columns(path, header, names)
    number = 1
    with path.open(encoding=ENCODING, newline="") as text:
        reader = csv.reader(text)
        try:
            next(reader)
            for number, values in enumerate(reader, 2):
                if values and len(values) != len(header):
                    shorter = "shorter" if len(values) < len(header) else "longer"
                    raise ConfigError(f"{path}, line {number}", f"is {shorter} than the header")
                if values:
                    yield f"{path}, line {number}", dict(zip(header, values, strict=True))
        except (csv.Error, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}, line {number + 1}", f"cannot be read: {error}") from None
    if number == 1:
        raise ConfigError(path, "has a header, but no lines")


def _require_columns(path: Path, header: Sequence[str], names: Sequence[str]) -> None:
    """ConfigError for missing or repeated columns."""
    if not header:
        raise ConfigError(path, "is empty; its first line names the columns")
    if missing := [name for name in names if name not in header]:
        hint = "; commas stand between columns" if len(header) == 1 else ""
        raise ConfigError(path, f"has no column {', '.join(missing)}{hint}")
    if twice := [name for name in names if header.count(name) > 1]:
        raise ConfigError(path, f"has the column {twice[0]} twice")


def _number(where: str, line: Mapping[str, str], name: str) -> float:
    """A finite number; NaN for an empty field."""
    text = line[name].strip()
    try:
        value = float(text or "nan")
    except ValueError:
        raise ConfigError(where, f"{name} is {text[:40]!r}, which is no number") from None
    if math.isinf(value):
        raise ConfigError(where, f"{name} is infinite")
    return value


def _stamp(where: str, line: Mapping[str, str]) -> int:
    name, (low, high) = COLUMNS[0], LIMITS[COLUMNS[0]]
    try:
        stamp_ns = int(line[name])
    except ValueError:
        raise ConfigError(where, f"{name} is {line[name][:40]!r}, which is no whole number") from None
    if not low <= stamp_ns <= high:
        raise ConfigError(where, f"{name} {line[name][:40]} is not between {low:g} and {high:g}")
    return stamp_ns


def _header(path: Path) -> list[str]:
    try:
        with path.open(encoding=ENCODING, newline="") as text:
            return next(csv.reader(text), [])
    except FileNotFoundError:
        raise ConfigError(path, "there is no such file; an entry has one for each recording") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(path, f"cannot be read: {error}") from None
