"""Log folders: CSV files and a manifest `log.toml`, which may lie apart (docs/log-folders.md)."""

import csv
import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

from protocol.config import from_table, section, toml_lines
from protocol.errors import ConfigError, LogFolderError, MessageError, Refusal, RowError, one_line
from protocol.files import load_toml
from protocol.machine.clock_watch import LATE_LIMIT, LONG_NS, ClockWatch
from protocol.machine.csv_file import (
    Column,
    CsvFile,
    Row,
    check_place,
    no_value,
    opened_rows,
    parse_column,
    require,
    stamp_reader,
    take_file,
)
from protocol.machine.log_columns import ReadingColumns, reading_columns
from protocol.machine.machine_config import (
    MAX_DELAY_S,
    MAX_EARLY_S,
    MachineConfig,
    SensorConfig,
    parse_machine,
    plain_lines,
    powertrain_lines,
    sensor_lines,
)
from protocol.machine.readings import MAX_STAMP_NS, Reading, columns, parse_reading
from protocol.site.site_config import SiteConfig, site_toml

MANIFEST = "log.toml"
_Numbered = tuple[int, Reading]  # line and reading of a row


@dataclass(frozen=True)
class SensorFile:
    """A sensor's CSV file, its time column and reading columns.

    ahead_s: lead of its clock, subtracted from stamps: a `delay_s` too large for live readings.
    """

    sensor: SensorConfig
    file: CsvFile
    stamp: Column
    columns: ReadingColumns
    ahead_s: float = 0.0


@dataclass
class LogFolder:
    """A described recording.

    refused: skipped rows by reason; first_refused: file, line and problem of the first.
    """

    name: str
    data: Path
    start_ns: int
    site: SiteConfig
    machine: MachineConfig
    sources: tuple[SensorFile, ...]
    refused: Counter[str] = field(default_factory=Counter)
    first_refused: dict[str, str] = field(default_factory=dict)

    def readings(self) -> Iterator[Reading]:
        """All used readings, ordered as in `timed`."""
        return map(itemgetter(1), self.timed())

    def timed(self) -> Iterator[tuple[int, Reading]]:
        """All used readings with arrival time [ns], in that order; restarts `refused`.

        Arrival is the stamp, but never before it was true, and goes on when a clock is set back.
        """
        self.refused.clear()
        self.first_refused.clear()
        streams = [self._read(source) for source in self.sources if source.sensor.use]
        return heapq.merge(*streams, key=itemgetter(0))

    def _read(self, source: SensorFile) -> Iterator[tuple[int, Reading]]:
        """A file's readings, held until enough continue them: the first may be of another clock."""
        watch, held, newest_ns = ClockWatch[_Numbered](), list[_Numbered](), 0
        later_ns = max(0, source.sensor.true_ns(0))
        for row in self._rows(source):
            if watch.goes_on(row[1].stamp_ns):
                astray = watch.count(row[1].stamp_ns)
                held.append(row)
            else:
                rows, astray = watch.doubt(row[1].stamp_ns, row)
                first_ns = rows[0][1].stamp_ns if rows else watch.newest_ns
                astray = [*astray, *(one for one in held if one[1].stamp_ns > first_ns)]
                held = [*(one for one in held if one[1].stamp_ns <= first_ns), *rows]
                later_ns += max(0, newest_ns - first_ns)
            if astray:
                self._refuse_astray(source, astray, watch.newest_ns)
            if watch.counted > LATE_LIMIT:
                for _, reading in self._settled(source, held):
                    yield reading.stamp_ns + later_ns, reading
                newest_ns, held = watch.newest_ns, []
        rows, astray = watch.end()
        self._refuse_astray(source, astray, watch.newest_ns)
        yield from ((reading.stamp_ns + later_ns, reading) for _, reading in self._settled(source, [*held, *rows]))

    def _settled(self, source: SensorFile, rows: Sequence[_Numbered]) -> Sequence[_Numbered]:
        """Rows without a shorter part before a break of LONG_NS, when the clock was not set."""
        for i in range(len(rows) // 2, 0, -1):
            if rows[i][1].stamp_ns - rows[i - 1][1].stamp_ns > LONG_NS:
                self._refuse_astray(source, rows[:i], rows[i][1].stamp_ns)
                return rows[i:]
        return rows

    def _refuse_astray(self, source: SensorFile, rows: Sequence[_Numbered], newest_ns: int) -> None:
        for line, reading in rows:
            ahead_s = (reading.stamp_ns - newest_ns) * 1e-9
            reason, where = ("stamp_ahead", "ahead of") if ahead_s > 0 else ("stamp_goes_back", "behind")
            self.refused[reason] += 1
            problem = f"it is {abs(ahead_s):.1f} s {where} the rows around it"
            columns_ = ", ".join(source.stamp.columns)
            self.first_refused.setdefault(reason, f"{source.file.file} line {line}: {columns_}: {problem}")

    def _rows(self, source: SensorFile) -> Iterator[_Numbered]:
        path, parse = self.data / source.file.file, self._parser(source)
        with opened_rows(source.file, self.data) as rows:
            for column in (source.stamp, *source.columns.described.values()):
                require(column.columns, rows, path)
            is_usable, problem = False, ""
            for row in rows:
                try:
                    reading = parse(row)
                except RowError as error:
                    problem = problem or f"line {rows.line_num}: {error}"
                    self.refused[error.reason] += 1
                    self.first_refused.setdefault(error.reason, f"{path.name} line {rows.line_num}: {error}")
                else:
                    is_usable = True
                    yield rows.line_num, reading
        if problem and not is_usable:
            raise LogFolderError(path, f"none of its rows can be used; {problem}")

    def _parser(self, source: SensorFile) -> Callable[[Row], Reading]:
        sensor, values = source.sensor, source.columns.reader(self.site)
        stamp, ahead_ns = stamp_reader(source.stamp, self.start_ns), round(source.ahead_s * 1e9)
        described = {"stamp": source.stamp, **source.columns.described}

        def parse(row: Row) -> Reading:
            try:
                source.file.check(row)
                return parse_reading(sensor.kind, sensor.name, stamp(row) - ahead_ns, values(row))
            except MessageError as error:
                raise RowError(error.reason, f"{error}{_cells(row, described, error.field or '')}") from None
            except (ValueError, TypeError, OverflowError):
                raise RowError(Refusal.WRONG_TYPE, no_value(row, described, source.file)) from None

        return parse


def _cells(row: Row, described: Mapping[str, Column], field_: str) -> str:
    """Texts of a row behind a field, as an addition to a sentence."""
    name = field_.rpartition(".")[2]
    column = described.get("stamp" if name == "stamp_ns" else name, Column())
    cells = ", ".join(f"`{one}` has {row[one]!r:.40}" for one in column.columns)
    return f" ({cells})" if cells else ""


def open_log(manifest: Path, data: Path | None = None) -> LogFolder:
    """Read a manifest, a file or a folder with `log.toml`; data: folder of the CSV files.

    ConfigError; LogFolderError if a named file is not a regular file of that folder.
    """
    if manifest.is_dir():
        folder, manifest = manifest, manifest / MANIFEST
        if not manifest.exists():
            raise ConfigError(folder, f"has no {MANIFEST} that describes its files; docs/log-folders.md has examples")
    where = str(manifest)
    if manifest.exists() and not manifest.is_file():
        raise ConfigError(where, "is no regular file")
    table = load_toml(manifest)
    log = section(table, "log", where)
    machine = section(table, "machine", where)
    site_table = section(table, "site", where)
    tables = table.pop("sensor", [])
    if table:
        raise ConfigError(where, f"unknown key `{next(iter(table))}`; known: log, site, machine, sensor")
    if not isinstance(tables, list) or not tables:
        raise ConfigError(where, "no [[sensor]] is described")
    header, site = from_table(_Header, log, f"{where} [log]"), from_table(SiteConfig, site_table, f"{where} [site]")
    sources = tuple(_parse_source(t, site, f"{where} [[sensor]] {i + 1}") for i, t in enumerate(tables))
    folder = data or manifest.parent
    for source in sources:
        check_place(folder / source.file.file, folder)
    return LogFolder(
        name=header.name,
        data=folder,
        start_ns=header.start_ns,
        site=site,
        machine=parse_machine(machine, tuple(s.sensor for s in sources), where),
        sources=sources,
    )


@dataclass(frozen=True)
class _Header:
    """[log] of the manifest. start_ns: UTC origin of the time columns."""

    name: str
    start_ns: int = 0


def _parse_source(table: Any, site: SiteConfig, where: str) -> SensorFile:
    if not isinstance(table, dict):
        raise ConfigError(where, "a table is expected")
    table = dict(table)
    mapping, file, ahead_s = section(table, "columns", where), take_file(table, where), _take_ahead_s(table)
    sensor = from_table(SensorConfig, table, where)
    described = {name: parse_column(value, name, f"{where} columns.{name}") for name, value in mapping.items()}
    if "stamp" not in described:
        raise ConfigError(where, "column `stamp` is not described")
    stamp = described.pop("stamp")
    return SensorFile(sensor, file, stamp, reading_columns(sensor, described, site, where), ahead_s)


def _take_ahead_s(table: dict[str, Any]) -> float:
    """Take a `delay_s` that is a clock offset: in a recording nothing is late."""
    delay_s: Any = table.get("delay_s")
    is_time = type(delay_s) in (int, float) and abs(delay_s) < MAX_STAMP_NS  # not NaN or infinite
    if is_time and not -MAX_EARLY_S <= delay_s <= MAX_DELAY_S:
        return float(table.pop("delay_s"))
    return 0.0


def write_log(folder: Path, name: str, site: SiteConfig, machine: MachineConfig, readings: Iterable[Reading]) -> None:
    """Write readings as a log folder that `open_log` reads back exactly."""
    folder.mkdir(parents=True, exist_ok=True)
    names = {sensor.name: columns(sensor.kind) for sensor in machine.sensors}
    with log_files(folder, {sensor.name: sensor.kind for sensor in machine.sensors}) as write:
        for reading in readings:
            if reading.sensor not in names:
                raise LogFolderError(folder, f"machine {machine.name} has no sensor `{reading.sensor}`")
            write(reading.sensor, reading.stamp_ns, [getattr(reading, name) for name in names[reading.sensor]])
    (folder / MANIFEST).write_text(manifest_toml(name, site, machine), encoding="utf-8")


@contextmanager
def log_files(folder: Path, kinds: Mapping[str, str]) -> Iterator[Callable[[str, int, Sequence[float]], None]]:
    """Write a log folder's CSV files; yields a writer of sensor, stamp [ns], values. kinds: by sensor."""
    with ExitStack() as stack:
        writers = {}
        for sensor, kind in kinds.items():
            text = stack.enter_context((folder / f"{sensor}.csv").open("w", encoding="utf-8", newline=""))
            writers[sensor] = csv.writer(text)
            writers[sensor].writerow(["stamp_ns", *columns(kind)])
        yield lambda sensor, ns, values: writers[sensor].writerow([ns, *(repr(float(value)) for value in values)])


def manifest_toml(
    name: str, site: SiteConfig, machine: MachineConfig, notes: Mapping[str, Sequence[str]] | None = None
) -> str:
    """Manifest for `log_files`. notes: comments by sensor; those of "" come first."""
    comments = {sensor: [f"# {one_line(line)}" for line in some] for sensor, some in (notes or {}).items()}
    lines = [*comments.get("", ()), "[log]", *toml_lines({"name": name}), "", "[site]", site_toml(site)]
    lines += ["[machine]", *plain_lines(machine), *powertrain_lines(machine)]
    for sensor in machine.sensors:
        lines += ["", *comments.get(sensor.name, ()), "[[sensor]]", *sensor_lines(sensor)]
        lines += [f'file = "{sensor.name}.csv"', "[sensor.columns]"]
        lines += ['stamp = { column = "stamp_ns", unit = "ns" }', *(f'{c} = "{c}"' for c in columns(sensor.kind))]
    return "\n".join(lines) + "\n"
