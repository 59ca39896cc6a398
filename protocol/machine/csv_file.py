"""CSV files of logs: description in the manifest, and rows (docs/log-folders.md)."""

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
from protocol.units import DDMM, ISO, ddmm_deg, factor, iso_ns, stamp_ns, stamp_scale

MAX_LINE = 2**20  # characters
MAX_COLUMNS = 1000
SIDES = {"lat_deg": "NS", "lon_deg": "EW"}  # hemisphere letters of positions in degrees and minutes
SPACES = " "  # delimiter: any spaces and tabs
DELIMITERS = (",", ";", "\t", SPACES)
Row = Mapping[str, str]  # text by column


@dataclass(frozen=True)
class CsvFile:
    """A CSV file of the data folder.

    names: columns of a file without header; lines with # are comments then. at_least: least values of columns for a row
    to count, such as a receiver's fix quality.
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
        """RowError for a row that does not count, ValueError if unknown."""
        for name, least in self.at_least.items():
            if not float(row[name]) >= least:  # also true for NaN
                raise RowError("below_least", f"{name}: {row[name]} is below {least:g}")


@dataclass(frozen=True)
class Column:
    """A row's value: weighted sum of CSV columns plus offset, in a unit; or a constant.

    over: column that divides the sum, as power by speed, 0 for 0; or "". side: column with N, S, E or W of a ddmm.mmmm
    position; "" if behind the number.
    """

    weights: Mapping[str, float] = field(default_factory=dict, hash=False)
    unit: str = ""
    offset: float = 0.0
    over: str = ""
    side: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """Required CSV columns."""
        return tuple(filter(None, (*self.weights, self.over, self.side)))

    def text(self, unit: str) -> str:
        """The CSV column of a text value; ValueError if more is described."""
        only, *_ = *self.weights, ""
        if not only or self != Column({only: 1.0}, unit, side=self.side if unit == DDMM else ""):
            raise ValueError(f"unit `{unit}` is of a column alone, without weight, offset or quotient")
        return only

    def problem(self, field_: str, row: Row) -> str:
        """Why a row lacks that field's value, with column and text, or ""."""
        for name in filter(lambda name: name != self.side, self.columns):
            if not (text := row[name]):
                return f"{name}: a value is missing"
            try:
                if self.unit == ISO:
                    iso_ns(text)
                elif self.unit == DDMM:
                    _ddmm_reader(self, field_)(row)
                else:
                    float(text)
            except ValueError as error:
                why = str(error) if self.unit in (ISO, DDMM) else "is not a number"
                return f"{name}: {text!r:.40} {why}"
        return ""


@dataclass(frozen=True)
class _Written:
    """A column in the manifest, if not a mere name."""

    column: str | None = None
    columns: Mapping[str, float] | None = None
    value: float | None = None
    unit: str = ""
    offset: float = 0.0
    over: str = ""
    side: str = ""


def take_file(table: dict[str, Any], where: str) -> CsvFile:
    """Take a CSV file's keys out of a table."""
    return from_table(CsvFile, {f.name: table.pop(f.name) for f in fields(CsvFile) if f.name in table}, where)


def parse_column(value: Any, name: str, where: str) -> Column:
    """Parse a field's column; ConfigError, also for an unfit unit."""
    column = Column({value: 1.0}) if isinstance(value, str) and value else _parse_table(value, where)
    try:
        stamp_reader(column) if name == "stamp" else number_reader(column, name)
    except (ValueError, OverflowError) as error:  # also of a weight too large for a number
        raise ConfigError(where, str(error)) from None
    return column


def _parse_table(value: Any, where: str) -> Column:
    written = from_table(_Written, value, where) if isinstance(value, dict) else _Written()
    given = (written.column, written.columns, written.value)
    if (
        sum(one is not None for one in given) != 1
        or written.column == ""
        or (written.value is not None and (written.offset or written.over or written.side))
    ):
        forms = '{ column = "name", unit = "deg", offset = 1.5 }, { columns = { left = 0.5, right = 0.5 } }'
        raise ConfigError(where, f'write "name", {forms} or {{ value = 0.01 }}')
    if written.value is not None:
        return Column({}, written.unit, written.value)
    weights = {written.column: 1.0} if written.column else dict(written.columns or {})
    if not weights or not all(weights.values()):
        raise ConfigError(where, "columns: names with weights other than 0 are expected")
    return Column(weights, written.unit, written.offset, written.over, written.side)


def number_reader(column: Column, name: str) -> Callable[[Row], float]:
    """Function from a row to a field's value, in its suffix's unit.

    ValueError for an unknown or unfit unit; its result raises ValueError for text that is no number.
    """
    if column.unit == DDMM or column.side:
        return _ddmm_reader(column, name)
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


def _ddmm_reader(column: Column, name: str) -> Callable[[Row], float]:
    """As `number_reader`, of degrees and minutes."""
    only, sides, side = column.text(DDMM), SIDES.get(name, ""), column.side
    if not sides:
        raise ValueError(f"unit `{DDMM}` does not fit `{name}`, but {', '.join(SIDES)}")
    return lambda row: ddmm_deg(row[only], row[side] if side else "", sides)


def stamp_reader(column: Column, start_ns: int = 0) -> Callable[[Row], int]:
    """Function from a row to UTC nanoseconds, exact for integers; ValueError.

    start_ns: origin of numbers, not of ISO times. Seconds and nanoseconds may be two columns, of weights 1.0 and 1e-9.
    """
    if column.unit == ISO:
        only = column.text(ISO)
        return lambda row: iso_ns(row[only])
    unit_ns = stamp_scale(column.unit or "s")
    if not column.weights or column.offset or column.over or column.side:
        raise ValueError(
            "a column is expected, neither a constant, an offset nor a quotient: times count from `start_ns`"
        )
    scales = {name: round(weight * unit_ns) for name, weight in column.weights.items()}
    for name, weight in column.weights.items():
        if not scales[name] or not math.isclose(scales[name], weight * unit_ns, rel_tol=1e-9):
            raise ValueError(f"{weight:g} of `{name}` is no whole number of nanoseconds")
    return lambda row: sum((stamp_ns(row[name], scale) for name, scale in scales.items()), start_ns)


@contextmanager
def opened_rows(csv_file: CsvFile, folder: Path) -> Iterator["csv.DictReader[str]"]:
    """A file's rows; LogFolderError if unreadable or outside the folder."""
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
            rows.fieldnames = [name.strip() for name in rows.fieldnames or ()]
            require(csv_file.at_least, rows, path)
            yield rows
    except FileNotFoundError:
        raise LogFolderError(path, "is not there; `--data` names the folder of the files") from None
    except (OSError, EOFError, zlib.error, ValueError, csv.Error) as error:  # ValueError: no UTF-8, or no path
        raise LogFolderError(path, f"cannot be read: {error}") from None


def check_place(path: Path, folder: Path) -> None:
    """Refuse what a foreign manifest may name: files outside its folder, FIFOs, devices."""
    if "\0" in str(path):
        raise LogFolderError(path, "is no name of a file")
    place = Path(os.path.realpath(path))
    if not place.is_relative_to(os.path.realpath(folder)):
        raise LogFolderError(path, "lies outside of the data folder; copy it there, or name its folder by `--data`")
    if place.exists() and not place.is_file():
        raise LogFolderError(path, "is no regular file")


def require(names: Iterable[str], rows: "csv.DictReader[str]", path: Path) -> None:
    """Refuse a file with a missing or duplicate column."""
    header = list(rows.fieldnames or ())
    if len(header) > MAX_COLUMNS:
        raise LogFolderError(path, f"has {len(header)} columns, over {MAX_COLUMNS}; keep those that the manifest names")
    for name in names:
        if name not in header:
            raise LogFolderError(path, f"has no column `{name}`; it has {', '.join(header)}")
        if header.count(name) > 1:
            raise LogFolderError(path, f"has {header.count(name)} columns `{name}`; name its columns by `names`")


def no_value(row: Row, described: Mapping[str, Column], csv_file: CsvFile) -> str:
    """The column without value in a row, as a sentence. described: columns by field, with the stamp."""
    counted = ((name, Column({name: 1.0})) for name in csv_file.at_least)
    problems = (column.problem(name, row) for name, column in (*counted, *described.items()))
    stamps = described["stamp"].columns  # as NaN, a number elsewhere
    return next(filter(None, problems), f"{', '.join(stamps)}: {', '.join(row[name] for name in stamps)!r} is no time")


def open_text(path: Path) -> IO[str]:
    """Open a text file, compressed if .gz; OSError."""
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8-sig", newline="")
    return path.open(encoding="utf-8-sig", newline="")  # with or without a spreadsheet's byte order mark


def _lines(text: IO[str], path: Path, csv_file: CsvFile) -> Iterator[str]:
    """Lines of bounded length, as a small compressed file can hold gigabytes in one; comments become empty."""
    while line := text.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise LogFolderError(path, f"cannot be read: a line is longer than {MAX_LINE} characters")
        if csv_file.names and line.startswith("#"):
            yield "\n"
        else:
            yield ",".join(line.split()) + "\n" if csv_file.delimiter == SPACES else line
