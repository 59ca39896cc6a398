"""Real logs: errors against fixes that were withheld, and against the truth where there is one.

What only an evaluation may know stands in `evaluation.toml` beside the manifest; agents never read that file:

    [truth]                    # the true track of base_link, metres in `map`
    file = "truth.csv.gz"      # in the data folder; stamp counts as in the manifest
    stamp = "t"
    x_m = "x"
    y_m = "y"

    [[planar]]                 # a GPS file in metres of `map`: gets the columns lat_deg and lon_deg
    file = "gps_sim1.csv.gz"
    x_m = "x"
    y_m = "y"
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from agents.holdout import Holdout, HoldoutConfig
from agents.pipeline import Pipeline
from evaluation.campaign.figures import Report, Row, root_mean_square, rounded
from evaluation.campaign.truth import Truth
from evaluation.positions.configurations import Configuration
from evaluation.positions.replay import Trace, errors, replay, score
from protocol.config import from_table
from protocol.errors import ConfigError, LogFolderError
from protocol.files import load_toml
from protocol.machine.log_folder import MANIFEST, LogFolder, open_log, open_text
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from protocol.site.site_config import Projection
from protocol.units import stamp_ns, stamp_scale

SIDE_FILE = "evaluation.toml"
NOTHING_WITHHELD = {"fixes": 0, "rms_m": None, "median_m": None, "max_m": None}
TRUTH_FIGURES = ("rmse_x_m", "rmse_y_m", "net_m", "max_m", "nees", "coverage95", "covered")
WITHHOLD = ((0.0, 1.0), (1.0, 10.0), (10.0, 30.0), (30.0, 60.0))  # seconds off, of every so many; the first is nothing


@dataclass(frozen=True)
class TruthFile:
    """A CSV file of the data folder with the true track of `base_link`, and its columns."""

    file: str
    stamp: str
    x_m: str
    y_m: str
    stamp_unit: str = "s"


@dataclass(frozen=True)
class PlanarFile:
    """A GPS file whose fixes are metres in `map`, and its columns."""

    file: str
    x_m: str
    y_m: str


@dataclass(frozen=True)
class Side:
    """`evaluation.toml`: what only an evaluation may know of a log."""

    truth: TruthFile | None = None
    planar: tuple[PlanarFile, ...] = ()


@contextmanager
def opened(manifest: Path, data: Path | None = None) -> Iterator[tuple[LogFolder, Truth | None]]:
    """Open a log, and the truth that its side file names; None without.

    Planar fixes are converted into a folder that lasts as long as the context.
    """
    log = open_log(manifest, data)
    side_file = (manifest if manifest.is_dir() else manifest.parent) / SIDE_FILE
    side = from_table(Side, load_toml(side_file), str(side_file)) if side_file.is_file() else Side()
    if unknown := {p.file for p in side.planar} - {s.file for s in log.sources}:
        raise ConfigError(side_file, f"planar: {MANIFEST} has no sensor with the file {min(unknown)!r}")
    truth = read_truth(log, side.truth) if side.truth else None
    with TemporaryDirectory(prefix="sitegrid-") as folder:
        made = {planar.file: str(convert(log, planar, Path(folder))) for planar in side.planar}
        log.sources = tuple(replace(source, file=made.get(source.file, source.file)) for source in log.sources)
        yield log, truth


def run(
    log: LogFolder,
    truth: Truth | None,
    row: Configuration,
    patterns: Sequence[tuple[float, float]] = WITHHOLD,
    on_progress: Callable[[str], None] = lambda _: None,
) -> Report:
    """Replay a log once per pattern of withheld GPS: (seconds off, period). refused: readings by reason."""
    readings = list(log.readings())
    rows = []
    for off_s, period_s in patterns:
        on_progress(f"{log.name}: {withheld_name(off_s, period_s)}")
        rows.append(_row(log, truth, row, readings, (off_s, period_s)))
    described = {"log": log.name, "filter": row.filter, "profile": row.profile, "gps": row.gps}
    return {**described, "readings": len(readings), "refused": dict(log.refused), "rows": rows}


def refitted(log: LogFolder, machine: MachineConfig) -> LogFolder:
    """The log with the sensors of this machine, of which others may be in use."""
    sensors = {sensor.name: sensor for sensor in machine.sensors}
    sources = tuple(replace(source, sensor=sensors[source.sensor.name]) for source in log.sources)
    return replace(log, machine=machine, sources=sources)


def receivers(machine: MachineConfig) -> int:
    """How many GPS receivers are in use."""
    return sum(sensor.use and sensor.kind == "gps" for sensor in machine.sensors)


def withheld_name(off_s: float, period_s: float) -> str:
    """As the command line has it."""
    return f"{off_s:g}/{period_s:g}" if off_s else "none"


def read_truth(log: LogFolder, described: TruthFile) -> Truth:
    """The true track that a log's side file names."""
    rows, scale = _read(log.data / described.file), stamp_scale(described.stamp_unit)
    try:
        stamps = [log.start_ns + stamp_ns(row[described.stamp], scale) for row in rows]
        places = [(float(row[described.x_m]), float(row[described.y_m])) for row in rows]
    except (KeyError, ValueError, TypeError) as error:
        raise LogFolderError(log.data / described.file, f"is no truth as described: {error}") from None
    return Truth(np.array(stamps, np.int64), np.array(places))


def convert(log: LogFolder, planar: PlanarFile, folder: Path) -> Path:
    """Write a copy of a GPS file with latitude and longitude, by the projection of the log's site; returns its path."""
    source = log.data / planar.file
    rows = _read(source)
    try:
        x, y = (np.array([float(row[name]) for row in rows]) for name in (planar.x_m, planar.y_m))
    except (KeyError, ValueError, TypeError) as error:
        raise LogFolderError(source, f"has no planar fixes as described: {error}") from None
    places = Projection(log.site).to_geodetic_many(x, y, np.zeros(len(x)))
    path = folder / f"{source.name.split('.')[0]}.csv"
    with path.open("w", encoding="utf-8", newline="") as text:
        writer = csv.DictWriter(text, [*(rows[0] if rows else ()), "lat_deg", "lon_deg"])
        writer.writeheader()
        for row, lat, lon in zip(rows, places[0], places[1], strict=True):
            writer.writerow({**row, "lat_deg": repr(float(lat)), "lon_deg": repr(float(lon))})
    return path


def _row(
    log: LogFolder, truth: Truth | None, row: Configuration, readings: Sequence[Reading], pattern: tuple[float, float]
) -> Row:
    """Errors [m] against the withheld fixes, from `HoldoutConfig.settle_s` on, and against the truth if known."""
    off_s, period_s = pattern
    config = HoldoutConfig(period_s=period_s, off_s=off_s) if off_s else None
    holdout = Holdout(log.site, log.machine, config) if config else None
    pipeline = Pipeline(log.site, log.machine, row.options)
    trace = replay(pipeline, readings, holdout)
    health = pipeline.health()
    return {
        "withhold": withheld_name(*pattern),
        **(holdout.report() if holdout else NOTHING_WITHHELD),
        "us_per_second": round(trace.cpu_s * 1e6 / trace.seconds) if trace.seconds else None,
        "counters": health["counters"],
        "consistency": health["consistency"],
        **(_against_truth(trace, truth, pattern) if truth else {}),
    }


def _against_truth(trace: Trace, truth: Truth, pattern: tuple[float, float]) -> Row:
    """Errors from the first pose on; truth_withheld_m: of the times without GPS."""
    overall = vars(score(trace, truth))
    off = np.hypot(*errors(trace, truth).T)
    dark = np.isfinite(off) & (trace.since_start_s % pattern[1] < pattern[0])
    values = {name: overall[name] for name in TRUTH_FIGURES} | {"withheld_m": root_mean_square(off[dark])}
    return rounded({f"truth_{name}": value for name, value in values.items()}, 4)


def _read(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file, by column."""
    try:
        with open_text(path) as text:
            return list(csv.DictReader(text))
    except (OSError, EOFError, UnicodeDecodeError, csv.Error) as error:
        raise LogFolderError(path, f"cannot be read: {error}") from None
