"""Files that others enter: a map or samples for each recording, checked line by line before anything is scored."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from evaluation.benchmark.recordings import MACHINE
from evaluation.maps.methods import Layers
from protocol.arrays import Table
from protocol.errors import ConfigError, MessageError
from protocol.machine.samples import COLUMNS, SAMPLE_DTYPE, check_samples
from sim.truth import TruthMap

PLACE = ("x_m", "y_m")
VALUES = ("resistance", "grade_east", "grade_north")
CONFIDENCE = "confidence"  # a column that a map may have
EXTENT_M = 10_000.0  # from the origin; no site is larger


def is_samples(path: Path) -> bool:
    """Whether a file has samples, not a map, by its header."""
    return MACHINE in _header(path)


def read_map(path: Path, truth: TruthMap) -> Layers:
    """Layers (rows, columns) of a map file over the cells of a site; cells that it does not name are unknown.

    A ConfigError names the line of a value that is none, of a place outside of the site, of a cell that comes twice.
    """
    rows, columns = truth.c_rr.shape
    names = [*VALUES, *([CONFIDENCE] if CONFIDENCE in _header(path) else [])]
    layers = {name: np.full((rows, columns), np.nan) for name in names}
    seen = np.zeros((rows, columns), np.bool_)
    for where, line in _lines(path, (*PLACE, *names)):
        x_m, y_m = (_number(where, line, axis) for axis in PLACE)
        if not (0 <= x_m - truth.west_m < columns * truth.cell_m and 0 <= y_m - truth.south_m < rows * truth.cell_m):
            raise ConfigError(where, f"({x_m:g}, {y_m:g}) is outside of the site")
        row, column = int((y_m - truth.south_m) / truth.cell_m), int((x_m - truth.west_m) / truth.cell_m)
        if seen[row, column]:
            raise ConfigError(where, f"the cell of ({x_m:g}, {y_m:g}) was named before")
        seen[row, column] = True
        for name in names:
            layers[name][row, column] = _number(where, line, name)
        if not 0 <= (said := layers.get(CONFIDENCE, seen)[row, column]) <= 1 and not math.isnan(said):
            raise ConfigError(where, f"{CONFIDENCE} {said:g} is not between 0 and 1")
    return layers


def read_samples(path: Path) -> dict[str, Table]:
    """Samples by machine; a ConfigError names the line or the field that is wrong."""
    rows: dict[str, list[tuple[float, ...]]] = {}
    for where, line in _lines(path, (MACHINE, *COLUMNS)):
        values = [_number(where, line, name) for name in COLUMNS[1:]]
        rows.setdefault(line[MACHINE], []).append((_whole(where, line, COLUMNS[0]), *values))
    tables = {name: np.array(own, SAMPLE_DTYPE) for name, own in sorted(rows.items())}
    for name, table in tables.items():
        try:
            check_samples(table, EXTENT_M)
        except MessageError as error:
            raise ConfigError(path, f"machine {name[:40]}: {error}") from None
    return tables


def _lines(path: Path, names: Sequence[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """The lines of a file after its header, each with where it is; a ConfigError where a column is missing."""
    if missing := [name for name in names if name not in _header(path)]:
        raise ConfigError(path, f"has no column {', '.join(missing)}")
    with path.open(encoding="utf-8", newline="") as text:
        for number, line in enumerate(csv.DictReader(text), 2):
            if any(line[name] is None for name in names):
                raise ConfigError(f"{path}, line {number}", "is shorter than the header")
            yield f"{path}, line {number}", line


def _number(where: str, line: Mapping[str, str], name: str) -> float:
    """A number; NaN where there is nothing. Infinite ones are refused."""
    text = line[name].strip()
    try:
        value = float(text or "nan")
    except ValueError:
        raise ConfigError(where, f"{name} is {text[:40]!r}, which is no number") from None
    if math.isinf(value):
        raise ConfigError(where, f"{name} is infinite; leave it empty where it is not known")
    return value


def _whole(where: str, line: Mapping[str, str], name: str) -> int:
    try:
        return int(line[name])
    except ValueError:
        raise ConfigError(where, f"{name} is {line[name][:40]!r}, which is no whole number") from None


def _header(path: Path) -> list[str]:
    try:
        with path.open(encoding="utf-8", newline="") as text:
            return next(csv.reader(text), [])
    except FileNotFoundError:
        raise ConfigError(path, "there is no such file; an entry has one for each recording") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(path, f"cannot be read: {error}") from None
