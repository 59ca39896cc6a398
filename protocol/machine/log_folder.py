"""Log folders: CSV files and a manifest `log.toml` that describes them (docs/log-folders.md).

The manifest may lie apart from the data, so that logs of others are described without touching them.
"""

import csv
import gzip
import heapq
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import IO, Any

from protocol.config import from_table, section, toml_lines
from protocol.errors import ConfigError, LogFolderError, MessageError, Refusal
from protocol.files import load_toml
from protocol.machine.machine_config import MachineConfig, SensorConfig, parse_machine, plain_lines, sensor_lines
from protocol.machine.readings import Reading, columns, parse_reading
from protocol.site.site_config import SiteConfig, site_toml
from protocol.units import factor, stamp_ns, stamp_scale

MANIFEST = "log.toml"
MAX_LINE = 2**20  # characters of a CSV file


@dataclass(frozen=True)
class Column:
    """Where one field of a reading comes from: a CSV column in a unit, or a constant."""

    column: str = ""
    unit: str = ""
    value: float = 0.0


@dataclass(frozen=True)
class SensorFile:
    """The CSV file of one sensor. fields: reading field -> Column; `stamp` is the time column."""

    sensor: SensorConfig
    file: str
    stamp: Column
    fields: dict[str, Column]


@dataclass
class LogFolder:
    """A described recording. `refused` counts the rows that were skipped while it is read, by reason."""

    name: str
    data: Path
    start_ns: int
    site: SiteConfig
    machine: MachineConfig
    sources: tuple[SensorFile, ...]
    refused: Counter[str] = field(default_factory=Counter)

    def readings(self) -> Iterator[Reading]:
        """All readings of the sensors in use, in the order of `known_ns`; counts `refused` anew."""
        self.refused.clear()
        streams = [self._read(source) for source in self.sources if source.sensor.use]
        return heapq.merge(*streams, key=self.known_ns)

    def known_ns(self, reading: Reading) -> int:
        """When a machine had a reading: at its stamp, but never before it was true (a negative delay)."""
        return reading.stamp_ns + self._early_ns.get(reading.sensor, 0)

    @cached_property
    def _early_ns(self) -> dict[str, int]:
        """How much too early the stamps of some sensors are."""
        return {s.name: s.true_ns(0) for s in (source.sensor for source in self.sources) if s.delay_s < 0}

    def _read(self, source: SensorFile) -> Iterator[Reading]:
        path = self.data / source.file
        try:
            with open_text(path) as text:
                yield from self._parse(text, source, path)
        except (OSError, EOFError, zlib.error, ValueError, csv.Error) as error:  # ValueError: no UTF-8, or no path
            raise LogFolderError(path, f"cannot be read: {error}") from None

    def _parse(self, text: IO[str], source: SensorFile, path: Path) -> Iterator[Reading]:
        rows = csv.DictReader(_lines(text, path))
        header = rows.fieldnames or ()
        picks = [_pick(name, source.fields[name], header, path) for name in columns(source.sensor.kind)]
        stamp_column, scale = _require(source.stamp.column, header, path), stamp_scale(source.stamp.unit or "s")
        newest = 0
        for row in rows:
            try:
                stamp = self.start_ns + stamp_ns(row[stamp_column], scale)
                values = tuple(float(row[c]) * k if c else k for c, k in picks)
                reading = parse_reading(source.sensor.kind, source.sensor.name, stamp, values)
            except (ValueError, TypeError, OverflowError):
                self.refused[Refusal.WRONG_TYPE] += 1
            except MessageError as error:
                self.refused[error.reason] += 1
            else:
                if stamp < newest:  # the merge of the files needs each of them in order
                    self.refused["stamp_goes_back"] += 1
                    continue
                newest = stamp
                yield reading


def open_log(manifest: Path, data: Path | None = None) -> LogFolder:
    """Read a manifest. manifest: the file, or the folder that holds it as `log.toml`; data: where the CSV files are."""
    if manifest.is_dir():
        manifest = manifest / MANIFEST
    where = str(manifest)
    table = load_toml(manifest)
    log = section(table, "log", where)
    machine = section(table, "machine", where)
    site = section(table, "site", where)
    tables = table.pop("sensor", [])
    if table:
        raise ConfigError(where, f"unknown key `{next(iter(table))}`; known: log, site, machine, sensor")
    if not isinstance(tables, list) or not tables:
        raise ConfigError(where, "no [[sensor]] is described")
    sources = tuple(_parse_source(t, f"{where} [[sensor]] {i + 1}") for i, t in enumerate(tables))
    header = from_table(_Header, log, f"{where} [log]")
    return LogFolder(
        name=header.name,
        data=data or manifest.parent,
        start_ns=header.start_ns,
        site=from_table(SiteConfig, site, f"{where} [site]"),
        machine=parse_machine(machine, tuple(s.sensor for s in sources), where),
        sources=sources,
    )


@dataclass(frozen=True)
class _Header:
    """The manifest's [log]. start_ns: the UTC instant that the time columns count from."""

    name: str
    start_ns: int = 0


def _parse_source(table: Any, where: str) -> SensorFile:
    if not isinstance(table, dict):
        raise ConfigError(where, "a table is expected")
    table = dict(table)
    file, mapping = table.pop("file", None), section(table, "columns", where)
    sensor = from_table(SensorConfig, table, where)
    if not isinstance(file, str):
        raise ConfigError(where, "key `file` is missing")
    parsed = {name: _parse_column(value, f"{where} columns.{name}") for name, value in mapping.items()}
    known = ("stamp", *columns(sensor.kind))
    if unknown := sorted(set(parsed) - set(known)):
        raise ConfigError(where, f"unknown column `{unknown[0]}`; a {sensor.kind} has {', '.join(known)}")
    if missing := [name for name in known if name not in parsed]:
        raise ConfigError(where, f"column `{missing[0]}` is not described")
    if not parsed["stamp"].column:
        raise ConfigError(f"{where} columns.stamp", "a column is expected, not a constant")
    for name, column in parsed.items():
        _check_unit(name, column, f"{where} columns.{name}")
    return SensorFile(sensor, file, parsed.pop("stamp"), parsed)


def _parse_column(value: Any, where: str) -> Column:
    table = {"column": value} if isinstance(value, str) else value
    if isinstance(table, dict) and ("column" in table) != ("value" in table) and table.get("column") != "":
        return from_table(Column, table, where)
    raise ConfigError(where, 'write "name", { column = "name", unit = "deg" } or { value = 0.01 }')


def _check_unit(name: str, column: Column, where: str) -> None:
    try:
        if name == "stamp":
            stamp_scale(column.unit or "s")
        elif column.unit:
            factor(column.unit, name)
    except ValueError as error:
        raise ConfigError(where, str(error)) from None


def _pick(name: str, column: Column, header: Sequence[str], path: Path) -> tuple[str, float]:
    """Return a CSV column and the factor to the field's unit; or no column and a constant."""
    scale = factor(column.unit, name) if column.unit else 1.0
    if not column.column:
        return "", column.value * scale
    return _require(column.column, header, path), scale


def _require(column: str, header: Sequence[str], path: Path) -> str:
    if column not in header:
        raise LogFolderError(path, f"has no column `{column}`; it has {', '.join(header)}")
    return column


def open_text(path: Path) -> IO[str]:
    """Open a text file for reading, compressed if its name ends in .gz; raises OSError."""
    if path.suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8-sig", newline="")
    return path.open(encoding="utf-8-sig", newline="")  # with or without the mark that spreadsheets write


def _lines(text: IO[str], path: Path) -> Iterator[str]:
    """Lines, refused where one is too long: a small compressed file can hold a line of many gigabytes."""
    while line := text.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise LogFolderError(path, f"cannot be read: a line is longer than {MAX_LINE} characters")
        yield line


def write_log(folder: Path, name: str, site: SiteConfig, machine: MachineConfig, readings: Iterable[Reading]) -> None:
    """Write readings as a log folder that `open_log` reads back exactly."""
    folder.mkdir(parents=True, exist_ok=True)
    files: dict[str, list[Reading]] = {s.name: [] for s in machine.sensors}
    for reading in readings:
        if reading.sensor not in files:
            raise LogFolderError(folder, f"machine {machine.name} has no sensor `{reading.sensor}`")
        files[reading.sensor].append(reading)
    for sensor in machine.sensors:
        with (folder / f"{sensor.name}.csv").open("w", encoding="utf-8", newline="") as text:
            writer = csv.writer(text)
            names = columns(sensor.kind)
            writer.writerow(["stamp_ns", *names])
            writer.writerows([r.stamp_ns, *(repr(float(getattr(r, n))) for n in names)] for r in files[sensor.name])
    (folder / MANIFEST).write_text(_manifest(name, site, machine), encoding="utf-8")


def _manifest(name: str, site: SiteConfig, machine: MachineConfig) -> str:
    head = "\n".join(["[log]", *toml_lines({"name": name}), "", "[site]"])
    lines = [head, site_toml(site), "[machine]", *plain_lines(machine)]
    for sensor in machine.sensors:
        lines += ["", "[[sensor]]", *sensor_lines(sensor), f'file = "{sensor.name}.csv"', "[sensor.columns]"]
        lines += ['stamp = { column = "stamp_ns", unit = "ns" }', *(f'{c} = "{c}"' for c in columns(sensor.kind))]
    return "\n".join(lines) + "\n"
