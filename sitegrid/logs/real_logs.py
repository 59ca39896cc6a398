"""Real logs: errors against fixes that were withheld, and against the truth where there is one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agents.config import require_place
from agents.holdout import NOTHING, Holdout, HoldoutConfig
from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig, Positioning
from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from sitegrid.logs.log_truth import LogTruth, read_log_truth
from sitegrid.logs.replay import Trace, covered, errors, replay, score
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


@dataclass(frozen=True)
class Outage:
    """GPS is withheld once, for length_s from start_s on, counted from the first reading."""

    start_s: float
    length_s: float

    def withholds(self, seconds: float) -> bool:
        """Whether GPS is withheld so long after the first reading."""
        return 0 <= seconds - self.start_s < self.length_s

    def __str__(self) -> str:
        return f"{self.start_s:g},{self.length_s:g}"


@dataclass(frozen=True)
class Periodic(HoldoutConfig):
    """GPS is withheld for off_s of every period_s."""

    def __str__(self) -> str:
        return f"{self.off_s:g}/{self.period_s:g}"


Pattern = Outage | Periodic | None  # of None, nothing is withheld
WITHHOLD: tuple[Pattern, ...] = (None, Periodic(10.0, 1.0), Periodic(30.0, 10.0), Periodic(60.0, 30.0))


def parse_pattern(kind: str, first_s: float, second_s: float) -> Pattern:
    """What `--withhold` means: `/` off and period, `,` start and length."""
    if kind == "/":
        return Periodic(period_s=second_s, off_s=first_s)
    return Outage(first_s, second_s) if kind == "," else None


def run(
    manifest: Path,
    data: Path | None,
    options: LocalisationConfig,
    patterns: Sequence[Pattern] = WITHHOLD,
    choose: Callable[[MachineConfig], MachineConfig] = lambda machine: machine,
    on_progress: Callable[[str], None] = lambda _: None,
) -> Report:
    """Replay a log once per pattern of withheld GPS. refused: readings by reason, and where the first of each stands.

    choose: which sensors of the machine are in use.
    """
    log = open_log(manifest, data)
    log = refitted(log, choose(log.machine))
    require_place(log.machine, options)
    truth = read_log_truth(log, manifest if manifest.is_dir() else manifest.parent)
    readings = list(log.readings())
    _require_time(log, truth, readings, patterns)
    rows = []
    for pattern in patterns:
        on_progress(f"{log.name}: {pattern or 'none'}")
        rows.append(_row(log, truth, options, readings, pattern))
        if not rows[-1]["covered"]:
            on_progress(
                f"{log.name}: no pose, as the heading never showed: that takes wheels, fixes and 12 m of driving"
            )
    described = {"log": log.name, "filter": options.filter, "profile": options.profile}
    used = [sensor.name for sensor in log.machine.sensors if sensor.use]
    counted = {"readings": len(readings), "refused": dict(log.refused), "first_refused": dict(log.first_refused)}
    return {**described, "gps": receivers(log.machine), "sensors": used, **counted, "rows": rows}


def measurements(rows: Sequence[Row]) -> list[Row]:
    """Of each row and sensor: measurements that the filter used and refused, and how consistent it is with fixes."""
    listed = []
    for row in rows:
        counters = row["counters"]
        for name in (counter.removesuffix("_used") for counter in counters if counter.endswith("_used")):
            consistency = row["consistency"].get(name, {})
            figures = {key: consistency.get(key) for key in ("nis", "correlation", "verdict")}
            counted = {key: counters.get(f"{name}_{key}", 0) for key in ("used", "gated", "relocked")}
            listed.append(rounded({"withhold": row["withhold"], "measurement": name, **counted, **figures}, 2))
    return listed


def refitted(log: LogFolder, machine: MachineConfig) -> LogFolder:
    """The log with the sensors of this machine, of which others may be in use."""
    sensors = {sensor.name: sensor for sensor in machine.sensors}
    sources = tuple(replace(source, sensor=sensors[source.sensor.name]) for source in log.sources)
    return replace(log, machine=machine, sources=sources)


def receivers(machine: MachineConfig) -> int:
    """How many GPS receivers are in use."""
    return sum(sensor.use and sensor.kind == "gps" for sensor in machine.sensors)


def _require_time(
    log: LogFolder, truth: LogTruth | None, readings: Sequence[Reading], patterns: Sequence[Pattern]
) -> None:
    """Refuse what lies outside of the log's time."""
    if not readings:
        raise LogFolderError(log.data, "no sensor in use has a reading")
    first_ns, seconds = readings[0].stamp_ns, (readings[-1].stamp_ns - readings[0].stamp_ns) * 1e-9
    for pattern in patterns:
        if isinstance(pattern, Outage) and pattern.start_s >= seconds:
            raise ConfigError(f"--withhold {pattern}", f"the log ends after {seconds:.0f} s")
    if truth:
        begins_s, ends_s = (float(truth.track.stamp_ns[i] - first_ns) * 1e-9 for i in (0, -1))
        if ends_s < 0 or begins_s > seconds:
            where = f"from {begins_s:.0f} to {ends_s:.0f} s of the log, which lasts from 0 to {seconds:.0f} s"
            raise LogFolderError(log.data, f"the truth is {where}: look at its stamps and their unit")


def _row(
    log: LogFolder,
    truth: LogTruth | None,
    options: LocalisationConfig,
    readings: Sequence[Reading],
    pattern: Pattern,
) -> Row:
    """Errors [m] against the withheld fixes, and against the truth if known.

    Of periodic outages those count from `agents.holdout.SETTLE_S` on, of a placed one all.
    """
    settle = {"settle_s": 0.0} if isinstance(pattern, Outage) else {}
    holdout = Holdout(log.site, log.machine, pattern, **settle) if pattern else None
    core = Positioning(log.site, log.machine, PipelineConfig(localisation=options))
    trace = replay(core, readings, holdout)
    consistency = core.localiser.consistency.items()
    return {
        "withhold": str(pattern or "none"),
        **(holdout.report() if holdout else NOTHING),
        "covered": round(covered(trace), 4),
        "wheel_scale": rounded(core.localiser.wheel_scale, 4),
        "us_per_second": round(trace.cpu_s * 1e6 / trace.seconds) if trace.seconds else None,
        "counters": dict(core.counters),
        "consistency": {name: value.report for name, value in consistency},
        **(_against_truth(trace.moved(truth.lever_m), truth.track, pattern) if truth else {}),
    }


def _against_truth(trace: Trace, truth: Truth, pattern: Pattern) -> Row:
    """Errors from the first pose on; truth_withheld_m: of the times without GPS; truth_end_m: of the last of each."""
    scored = score(trace, truth)
    off = np.hypot(*errors(trace, truth).T)
    dark = np.array([pattern is not None and pattern.withholds(s) for s in trace.since_start_s], bool)
    ends = dark & ~np.append(dark[1:], False)
    values = {name: getattr(scored, name) for name in TRUTH_FIGURES}
    known = np.isfinite(off)
    values |= {"known": float(known.mean()) if len(off) else 0.0, "nees_95": [scored.nees_low, scored.nees_high]}
    values |= {"withheld_m": root_mean_square(off[dark & known]), "end_m": root_mean_square(off[ends & known])}
    return rounded({f"truth_{name}": value for name, value in values.items()}, 4)
