"""Samples in, maps out, for benchmark entries; imports nothing of this project."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float64]
Samples = Mapping[str, Column]  # columns of samples.csv (n,), oldest first
Cell = tuple[int, int]  # column, row: floor of east and north [m]
Map = Mapping[Cell, Mapping[str, float]]  # resistance, grade_east, grade_north, optionally confidence
COLUMNS = ("stamp_ns", "x_m", "y_m", "cov_xx_m2", "cov_yy_m2", "c_rr", "c_rr_var", "grade_e", "grade_n", "grade_var")
VALUES = ("resistance", "grade_east", "grade_north", "confidence")


def enter(method: Callable[[Samples], Map], data: Path, entry: Path) -> None:
    """Run a method on a folder of recordings; write its maps to another."""
    entry.mkdir(parents=True, exist_ok=True)
    for path in sorted(data.glob("*/samples.csv")):
        write_map(entry / f"{path.parent.name}.csv", method(read_samples(path)))


def read_samples(path: Path) -> Samples:
    """Columns used by methods, oldest sample first."""
    with path.open(encoding="utf-8", newline="") as text:
        lines = list(csv.DictReader(text))
    columns = {name: np.array([float(line[name]) for line in lines]) for name in COLUMNS}
    order = np.argsort(columns["stamp_ns"], kind="stable")
    return {name: values[order] for name, values in columns.items()}


def write_map(path: Path, cells: Map) -> None:
    """Write a map in the benchmark's format."""
    with path.open("w", encoding="utf-8", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(["x_m", "y_m", *VALUES])
        for (column, row), values in cells.items():
            shown = [values.get(name, math.nan) for name in VALUES]
            writer.writerow([column + 0.5, row + 0.5, *("" if math.isnan(value) else value for value in shown)])


def by_cell(samples: Samples, value: str) -> dict[Cell, list[int]]:
    """Indices of samples with a value, by stated cell."""
    cells: dict[Cell, list[int]] = {}
    places = zip(samples["x_m"].tolist(), samples["y_m"].tolist(), samples[value].tolist(), strict=True)
    for i, (x_m, y_m, known) in enumerate(places):
        if not math.isnan(known):
            cells.setdefault((math.floor(x_m), math.floor(y_m)), []).append(i)
    return cells
