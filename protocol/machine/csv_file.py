"""CSV files of logs: how a manifest describes a file and its columns, and what its rows hold (docs/log-folders.md)."""

import csv
import gzip
import math
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import IO, Any

from protocol.config import from_table
from protocol.errors import ConfigError, LogFolderError, RowError
from protocol.units import factor, stamp_ns, stamp_scale

MAX_LINE = 2**20  # characters of a CSV file
MAX_COLUMNS = 1000  # of a CSV file
SPACES = " "  # as a delimiter: any number of spaces and tabs
DELIMITERS = (",", ";", "\t", SPACES)
Row = Mapping[str, str]  # texts by column


@dataclass(frozen=True)
class CsvFile:
    """A CSV file of the data folder.

    names: of its columns, where its first line does not name them; lines that begin with # are comments then. at_least:
    the least values of columns that say whether a row counts, as a receiver's kind of fix does.
    """

    file: str
    names: tuple[str, ...] = ()
    delimiter: str = ","
    at_least: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.delimiter not in DELIMITERS:
            raise ValueError(f"delimiter: {self.delimiter!r} is none of {', '.join(map(repr, DELIMITERS))}")
        if twice := [name for name in self.names if not name or self.names.count(name) > 1]:
            raise ValueError(f"names: {twice[0]!r} is empty, or stands there twice")

    def check(self, row: Row) -> None:
        """Raise RowError on a row that does not count, ValueError where that cannot be known."""
        for name, least in self.at_least.items():
            if not float(row[name]) >= least:  # also true for NaN
                raise RowError("below_least", f"{name}: {row[name]} is below {least:g}")


@dataclass(frozen=True)
class Column:
    """A value of a row: the sum of CSV columns times their weights, plus an offset, in a unit; it may be constant.

    over: a column that the sum is divided by, as power is by speed; "" for none. Where it is 0, so is the quotient.
    """

    weights: Mapping[str, float] = field(default_factory=dict, hash=False)
    unit: str = ""
    offset: float = 0.0
    over: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """The CSV columns that it needs."""
        return (*self.weights, self.over) if self.over else tuple(self.weights)


@dataclass(frozen=True)
class _Written:
    """A column as the manifest has it, if it is not a mere name."""

    column: str | None = None
    columns: Mapping[str, float] | None = None
    value: float | None = None
    unit: str = ""
    offset: float = 0.0
    over: str = ""


def take_file(table: dict[str, Any], where: str) -> CsvFile:
    """Take the keys of a CSV file out of a table."""
    return from_table(CsvFile, {f.name: table.pop(f.name) for f in fields(CsvFile) if f.name in table}, where)


def parse_column(value: Any, name: str, where: str) -> Column:
    """Parse what a manifest writes for a field of that name; raises ConfigError, also on a unit that does not fit."""
    column = Column({value: 1.0}) if isinstance(value, str) and value else _parse_table(value, where)
    try:
        stamp_reader(column) if name == "stamp" else number_reader(column, name)
    except (ValueError, OverflowError) as error:  # a weight that no number holds
        raise ConfigError(where, str(error)) from None
    return column


def _parse_table(value: Any, where: str) -> Column:
    written = from_table(_Written, value, where) if isinstance(value, dict) else _Written()
    given = (written.column, written.columns, written.value)
    if (
        sum(one is not None for one in given) != 1
        or written.column == ""
        or (written.value is not None and (written.offset or written.over))
    ):
        forms = '{ column = "name", unit = "deg", offset = 1.5 }, { columns = { left = 0.5, right = 0.5 } }'
        raise ConfigError(where, f'write "name", {forms} or {{ value = 0.01 }}')
    if written.value is not None:
        return Column({}, written.unit, written.value)
    weights = {written.column: 1.0} if written.column else dict(written.columns or {})
    if not weights or not all(weights.values()):
        raise ConfigError(where, "columns: names with weights other than 0 are expected")
    return Column(weights, written.unit, written.offset, written.over)


def number_reader(column: Column, name: str) -> Callable[[Row], float]:
    """What makes the value of a field of a row, in the unit of the field's suffix.

    Raises ValueError if the unit is not known or does not fit; so does what it returns on a text that is no number.
    """
    scale = factor(column.unit, name) if column.unit else 1.0
    offset, weights = column.offset * scale, [(c, w * scale) for c, w in column.weights.items()]
    if over := column.over:

        def quotient(row: Row) -> float:
            divisor = float(row[over])
            return (sum(float(row[c]) * w for c, w in weights) / divisor if divisor else 0.0) + offset

        return quotient
    if len(weights) == 1 and not offset:
        ((only, weight),) = weights
        return lambda row: float(row[only]) * weight
    return lambda row: sum((float(row[c]) * w for c, w in weights), offset)


def stamp_reader(column: Column) -> Callable[[Row], int]:
    """What makes nanoseconds of a row's time, exactly where all its numbers are whole; raises ValueError.

    Seconds and nanoseconds may stand in two columns, of weights 1.0 and 1e-9.
    """
    unit_ns = stamp_scale(column.unit or "s")
    if not column.weights or column.offset or column.over:
        raise ValueError(
            "a column is expected, neither a constant, an offset nor a quotient: times count from `start_ns`"
        )
    scales = {name: round(weight * unit_ns) for name, weight in column.weights.items()}
    for name, weight in column.weights.items():
        if not scales[name] or not math.isclose(scales[name], weight * unit_ns, rel_tol=1e-9):
            raise ValueError(f"{weight:g} of `{name}` is no whole number of nanoseconds")
    return lambda row: sum(stamp_ns(row[name], scale) for name, scale in scales.items())


@contextmanager
def opened_rows(csv_file: CsvFile, folder: Path) -> Iterator["csv.DictReader[str]"]:
    """The rows of a file in a folder; raises LogFolderError where it cannot be read, or lies elsewhere."""
    path = folder / csv_file.file
    try:
        check_place(path, folder)
        with open_text(path) as text:
            rows = csv.DictReader(
                _lines(text, path, csv_file),
                fieldnames=csv_file.names or None,
                delimiter="," if csv_file.delimiter == SPACES else csv_file.delimiter,
                skipinitialspace=True,
            )
            require(csv_file.at_least, rows, path)
            yield rows
    except FileNotFoundError:
        raise LogFolderError(path, "is not there; `--data` names the folder of the files") from None
    except (OSError, EOFError, zlib.error, ValueError, csv.Error) as error:  # ValueError: no UTF-8, or no path
        raise LogFolderError(path, f"cannot be read: {error}") from None


def check_place(path: Path, folder: Path) -> None:
    """Refuse what a stranger's manifest may name: files outside of its folder, FIFOs and devices."""
    if "\0" in str(path):
        raise LogFolderError(path, "is no name of a file")
    place = Path(os.path.realpath(path))
    if not place.is_relative_to(os.path.realpath(folder)):
        raise LogFolderError(path, "lies outside of the data folder; copy it there, or name its folder by `--data`")
    if place.exists() and not place.is_file():
        raise LogFolderError(path, "is no regular file")


def require(names: Iterable[str], rows: "csv.DictReader[str]", path: Path) -> None:
    """Refuse a file that lacks a column, or has two of its name."""
    header = list(rows.fieldnames or ())
    if len(header) > MAX_COLUMNS:
        raise LogFolderError(path, f"has {len(header)} columns, over {MAX_COLUMNS}; keep those that the manifest names")
    for name in names:
        if name not in header:
            raise LogFolderError(path, f"has no column `{name}`; it has {', '.join(header)}")
        if header.count(name) > 1:
            raise LogFolderError(path, f"has {header.count(name)} columns `{name}`; name its columns by `names`")


def no_number(row: Row, names: Iterable[str]) -> str:
    """Which of these columns of a row has no number, as a sentence."""
    for name in names:
        try:
            float(row[name])
        except (ValueError, TypeError):
            return f"{name}: {row[name]!r:.40} is not a number" if row[name] else f"{name}: a value is missing"
    return "its stamp is not a number"  # as NaN, which is a number elsewhere


def open_text(path: Path) -> IO[str]:
    """Open a text file for reading, compressed if its name ends in .gz; raises OSError."""
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8-sig", newline="")
    return path.open(encoding="utf-8-sig", newline="")  # with or without the mark that spreadsheets write


def _lines(text: IO[str], path: Path, csv_file: CsvFile) -> Iterator[str]:
    """Lines, refused where one is too long: a small compressed file can hold a line of many gigabytes.

    Comments become empty lines, so that the reader counts them and does not read them.
    """
    while line := text.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise LogFolderError(path, f"cannot be read: a line is longer than {MAX_LINE} characters")
        if csv_file.names and line.startswith("#"):
            yield "\n"
        else:
            yield ",".join(line.split()) + "\n" if csv_file.delimiter == SPACES else line
