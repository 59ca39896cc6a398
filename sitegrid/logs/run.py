"""Replay a recording: positions against withheld fixes and truth, ground against known ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agents.config import require_place
from agents.holdout import NOTHING, Holdout
from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig, Positioning
from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from sitegrid.logs.check import missing_for_ground, missing_for_truth
from sitegrid.logs.clocks import check_clocks
from sitegrid.logs.ground import compare, samples_of
from sitegrid.logs.log_truth import KnownArea, LogTruth, read_known_ground, read_log_truth, require_overlap
from sitegrid.logs.outages import WITHHOLD, Outage, Pattern
from sitegrid.logs.replay import Trace, covered, errors, replay, score
from sitegrid.logs.sensors import refitted
from sitegrid.proof.figures import Report, Row, root_mean_square, rounded
from sitegrid.proof.tracks import Truth

TRUTH_FIGURES = (
    "rmse_x_m",
    "rmse_y_m",
    "net_m",
    "max_m",
    "nees",
    "coverage95",
    "smoothed_net_m",
    "smoothed_coverage95",
)
NO_POSE = "no pose, as the heading never showed: that takes wheels, fixes and 12 m of driving"


@dataclass(frozen=True)
class Recording:
    """A log, its readings, and known references."""

    log: LogFolder
    readings: Sequence[Reading]
    truth: LogTruth | None = None
    areas: Sequence[KnownArea] = ()


Draw = Callable[[Recording, Pattern, Trace], None]


def read_recording(
    manifest: Path, data: Path | None, choose: Callable[[MachineConfig], MachineConfig] = lambda machine: machine
) -> Recording:
    """Read a log with the sensors that `choose` leaves in use. Errors name the file."""
    log = open_log(manifest, data)
    log = refitted(log, choose(log.machine))
    folder = manifest if manifest.is_dir() else manifest.parent
    truth, areas = read_log_truth(log, folder), read_known_ground(log, folder)
    readings = list(log.readings())
    if not readings:
        raise LogFolderError(log.data, "no sensor in use has a reading")
    if truth:
        require_overlap(truth, readings[0].stamp_ns, readings[-1].stamp_ns)
    return Recording(log, readings, truth, areas)


def run(
    recording: Recording,
    options: LocalisationConfig,
    patterns: Sequence[Pattern] = WITHHOLD,
    on_progress: Callable[[str], None] = lambda _: None,
    draw: Draw | None = None,
) -> Report:
    """Replay a log per withholding pattern, and once more if ground is known.

    draw: gets the first pattern's trace. In the report: refused: readings by reason, and the first place of each;
    missing: impossible comparisons and why; clocks: deviating clocks, a sentence each.
    """
    log = recording.log
    require_place(log.machine, options)
    _require_time(recording, patterns)
    rows: list[Row] = []
    clocks = _clocks(recording)
    report = {**_described(recording, options), "clocks": clocks, "rows": rows}
    for problem in clocks:
        on_progress(f"{log.name}: {problem}")
    for pattern in patterns:
        on_progress(f"{log.name}: {pattern or 'none'}")
        row, trace = _row(recording, options, pattern)
        if draw and not rows:
            draw(recording, pattern, trace)
        rows.append(row)
        if not row["covered"]:
            on_progress(f"{log.name}: {'no pose, as clocks are apart' if clocks else NO_POSE}")
    missing = {
        "truth": missing_for_truth(recording.truth),
        "ground": missing_for_ground(log.machine, recording.areas),
    }
    if not missing["ground"]:
        on_progress(f"{log.name}: ground")
        report["ground"] = compare(samples_of(log, options, recording.readings), recording.areas)
    return {**report, "missing": {name: why for name, why in missing.items() if why}}


def _clocks(recording: Recording) -> list[str]:
    """Deviating clocks, a sentence each."""
    readings: dict[str, list[Reading]] = {}
    for reading in recording.readings:
        readings.setdefault(reading.sensor, []).append(reading)
    findings = check_clocks(recording.log, readings)
    return [f"{finding.check}: {finding.message}; {finding.advice}" for finding in findings]


def _described(recording: Recording, options: LocalisationConfig) -> Report:
    """Facts of the replay: log, sensors, readings."""
    log = recording.log
    return {
        "log": log.name,
        "filter": options.filter,
        "profile": options.profile,
        "gps": receivers(log.machine),
        "sensors": [sensor.name for sensor in log.machine.sensors if sensor.use],
        "readings": len(recording.readings),
        "refused": dict(log.refused),
        "first_refused": dict(log.first_refused),
    }


def measurements(rows: Sequence[Row]) -> list[Row]:
    """Per row and sensor: measurements used and refused, and consistency with fixes."""
    listed = []
    for row in rows:
        counters = row["counters"]
        for name in (counter.removesuffix("_used") for counter in counters if counter.endswith("_used")):
            consistency = row["consistency"].get(name, {})
            figures = {key: consistency.get(key) for key in ("nis", "correlation", "variance_factor", "verdict")}
            counted = {key: counters.get(f"{name}_{key}", 0) for key in ("used", "gated", "relocked")}
            listed.append(rounded({"withhold": row["withhold"], "measurement": name, **counted, **figures}, 2))
    return listed


def receivers(machine: MachineConfig) -> int:
    """Number of GPS receivers in use."""
    return sum(sensor.use and sensor.kind == "gps" for sensor in machine.sensors)


def _require_time(recording: Recording, patterns: Sequence[Pattern]) -> None:
    """Refuse outages after the log's end."""
    seconds = (recording.readings[-1].stamp_ns - recording.readings[0].stamp_ns) * 1e-9
    for pattern in patterns:
        if isinstance(pattern, Outage) and pattern.start_s >= seconds:
            raise ConfigError(f"--withhold {pattern}", f"the log ends after {seconds:.0f} s")


def _row(recording: Recording, options: LocalisationConfig, pattern: Pattern) -> tuple[Row, Trace]:
    """Errors [m] against withheld fixes, and a known truth; and their trace.

    Periodic outages count from `agents.holdout.SETTLE_S` on, placed ones entirely.
    """
    log, truth = recording.log, recording.truth
    settle = {"settle_s": 0.0} if isinstance(pattern, Outage) else {}
    holdout = Holdout(log.site, log.machine, pattern, **settle) if pattern else None
    core = Positioning(log.site, log.machine, PipelineConfig(localisation=options))
    trace = replay(core, recording.readings, holdout)
    consistency = core.localiser.consistency.items()
    row = {
        "withhold": str(pattern or "none"),
        **(holdout.report() if holdout else NOTHING),
        "covered": round(covered(trace), 4),
        "wheel_scale": rounded(core.localiser.wheel_scale, 4),
        "us_per_second": round(trace.cpu_s * 1e6 / trace.seconds) if trace.seconds else None,
        "counters": dict(core.counters),
        "consistency": {name: value.report for name, value in consistency},
        **(_against_truth(trace.moved(truth.lever_m), truth.track, pattern) if truth else {}),
    }
    return row, trace


def _against_truth(trace: Trace, truth: Truth, pattern: Pattern) -> Row:
    """Errors from the first pose; truth_withheld_m: during outages; truth_end_m: at their ends."""
    scored = score(trace, truth)
    off = np.hypot(*errors(trace, truth).T)
    dark = np.array([pattern is not None and pattern.withholds(s) for s in trace.since_start_s], bool)
    ends = dark & ~np.append(dark[1:], False)
    values = {name: getattr(scored, name) for name in TRUTH_FIGURES}
    known = np.isfinite(off)
    values |= {"known": float(known.mean()) if len(off) else 0.0, "nees_95": [scored.nees_low, scored.nees_high]}
    values |= {"withheld_m": root_mean_square(off[dark & known]), "end_m": root_mean_square(off[ends & known])}
    return rounded({f"truth_{name}": value for name, value in values.items()}, 4)
