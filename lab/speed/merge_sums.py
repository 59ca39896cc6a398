"""Count, sum and sum of squares per cell, the plain way of merging samples, by several libraries and in C.

Each takes structured rows, as the fold of the map server does, makes of them what its library wants, and adds to what
it has: no covariance, no histograms, no time. polars and duckdb group a batch's rows by their cells, and what they find
is added to a dense array; they use all cores, the others one. Libraries that nothing else in the project needs are
imported where they are used.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np

from protocol.arrays import Floats, Ints, Table
from protocol.machine.samples import SAMPLE_DTYPE

QUERY = "SELECT cell, count(*) AS n, sum(value) AS s, sum(value * value) AS q FROM samples GROUP BY cell"


class Sums(ABC):
    """Sums over the cells of a site of side * side cells of 1 m, its corner at 0, 0."""

    def __init__(self, side: int) -> None:
        self._side = side
        self._sums: Floats = np.zeros((side * side, 3))

    @abstractmethod
    def fold(self, rows: Table) -> None:
        """Add samples, all of them on the site."""

    def sums(self) -> Floats:
        """Count, sum and sum of squares of c_rr (side * side, 3), row by row from the south."""
        return self._sums

    def _columns(self, rows: Table) -> tuple[Ints, Floats]:
        """Number of the cell that each sample lies in, and its c_rr."""
        cell = rows["y_m"].astype(np.int64) * self._side + rows["x_m"].astype(np.int64)
        return cell, rows["c_rr"].astype(np.float64)


class HardVotes(Sums):
    """A loop in numba over interleaved cells."""

    def fold(self, rows: Table) -> None:
        """See Sums."""
        _add(rows, self._sums.reshape(-1), self._side)


@numba.njit(cache=True, nogil=True)
def _add(rows: Any, sums: Any, side: int) -> None:
    """Add count, value and its square of each row to its cell of sums (side * side * 3,).

    A cell's three sums lie side by side, so that a sample costs one cache miss, not three. Indices are unsigned: numba
    then need not look for negative ones, which count from the end.
    """
    one, two, three = np.uintp(1), np.uintp(2), np.uintp(3)
    for k in range(len(rows)):
        row = rows[k]
        at = three * (np.uintp(row.y_m) * np.uintp(side) + np.uintp(row.x_m))
        value = np.float64(row.c_rr)  # float() would leave it single
        sums[at] += 1.0
        sums[at + one] += value
        sums[at + two] += value * value


class PlainC(Sums):
    """The same loop in C, compiled here; FileNotFoundError without a compiler."""

    def __init__(self, side: int) -> None:
        super().__init__(side)
        self._add = _compiled(ADD_IN_C)

    def fold(self, rows: Table) -> None:
        """See Sums."""
        self._add(rows.ctypes.data, len(rows), self._sums.ctypes.data, self._side)


ADD_IN_C = """
#include <stddef.h>
#include <stdint.h>
struct __attribute__((packed)) row {{ {fields} }};

void add(const struct row *rows, ptrdiff_t n, double *sums, ptrdiff_t side) {{
    for (ptrdiff_t k = 0; k < n; k++) {{
        double *cell = sums + 3 * ((ptrdiff_t)rows[k].y_m * side + (ptrdiff_t)rows[k].x_m);
        double value = rows[k].c_rr;
        cell[0] += 1;
        cell[1] += value;
        cell[2] += value * value;
    }}
}}
"""
_C_TYPES = {"i8": "int64_t", "f8": "double", "f4": "float"}


def _compiled(source: str) -> Callable[[int, int, int, int], None]:
    """Function `add` of C source with the fields of a sample."""
    if (compiler := shutil.which("cc")) is None:
        raise FileNotFoundError("cc")
    kinds = {name: SAMPLE_DTYPE[name].str[1:] for name in SAMPLE_DTYPE.names or ()}
    fields = " ".join(f"{_C_TYPES[kind]} {name};" for name, kind in kinds.items())
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "add.so"
        command = [compiler, "-O3", "-march=native", "-shared", "-fPIC", "-x", "c", "-o", str(library), "-"]
        subprocess.run(command, input=source.format(fields=fields).encode(), check=True)  # noqa: S603
        add = ctypes.CDLL(str(library)).add  # stays mapped without its file
    add.argtypes = [ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_void_p, ctypes.c_ssize_t]
    add.restype = None
    call: Callable[[int, int, int, int], None] = add
    return call


class AddAt(Sums):
    """np.add.at, once per sum."""

    def __init__(self, side: int) -> None:
        super().__init__(side)
        self._sums = np.zeros((3, side * side)).T  # each sum in one piece

    def fold(self, rows: Table) -> None:
        """See Sums."""
        cell, value = self._columns(rows)
        counts, sums, squares = self._sums.T
        np.add.at(counts, cell, 1.0)
        np.add.at(sums, cell, value)
        np.add.at(squares, cell, value * value)


class BoostHistogram(Sums):
    """A histogram with a mean per bin: count, mean, and sum of squared deviations in one fill."""

    def __init__(self, side: int) -> None:
        import boost_histogram as bh

        axes = (bh.axis.Regular(side, 0, side), bh.axis.Regular(side, 0, side))
        self._histogram = bh.Histogram(*axes, storage=bh.storage.Mean())

    def fold(self, rows: Table) -> None:
        """See Sums."""
        y_m, x_m = (np.ascontiguousarray(rows[name]) for name in ("y_m", "x_m"))  # twice as fast as strided
        self._histogram.fill(y_m, x_m, sample=rows["c_rr"].astype(np.float64))

    def sums(self) -> Floats:
        """See Sums."""
        view = np.asarray(self._histogram.view()).ravel()
        n, mean, deviations = (view[name] for name in ("count", "value", "_sum_of_deltas_squared"))
        return np.stack([n, n * mean, deviations + n * mean * mean], axis=1)


class Polars(Sums):
    """A group-by of polars for each batch."""

    def __init__(self, side: int) -> None:
        import polars as pl

        super().__init__(side)
        self._pl = pl

    def fold(self, rows: Table) -> None:
        """See Sums."""
        cell, value = self._columns(rows)
        c = self._pl.col("value")
        frame = self._pl.DataFrame({"cell": cell, "value": value})
        groups = frame.group_by("cell").agg(self._pl.len(), c.sum().alias("s"), (c * c).sum().alias("q"))
        self._sums[groups["cell"].to_numpy()] += groups.select("len", "s", "q").to_numpy()


class DuckDb(Sums):
    """A group-by of DuckDB for each batch."""

    def __init__(self, side: int) -> None:
        import duckdb

        super().__init__(side)
        self._connection = duckdb.connect()

    def fold(self, rows: Table) -> None:
        """See Sums."""
        cell, value = self._columns(rows)
        self._connection.register("samples", {"cell": cell, "value": value})
        groups = self._connection.execute(QUERY).fetchnumpy()
        self._sums[groups["cell"]] += np.stack([groups["n"], groups["s"], groups["q"]], axis=1)
