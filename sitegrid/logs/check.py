"""Usability of a recording, and reasons: manifest, files, clocks, rates, gaps.

`examine` reads every file of the sensors in use. Judging functions are pure; each finding says what to do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np

from agents.status import UNIT, WHEELS
from protocol.arrays import Floats, Ints
from protocol.errors import ConfigError, LogFolderError
from protocol.machine.clock_watch import GAP_NS
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.machine_config import ABSOLUTE, DRIVES, QUANTITIES, MachineConfig, SensorConfig
from protocol.machine.readings import Gps, Imu, Reading
from sitegrid.doctor import Finding, Level
from sitegrid.logs.clocks import ALL_DIGITS, check_clocks, stands, time_of
from sitegrid.logs.log_truth import SIDE_FILE, KnownArea, LogTruth, read_known_ground, read_log_truth, require_overlap
from sitegrid.logs.speeds import places, wheel_distance, wheel_share
from sitegrid.logs.wheels import check_wheels
from sitegrid.proof.figures import Row, rounded

PAGE = "docs/log-folders.md"
PAUSE = 5.0  # intervals: longer is a gap, from LEAST_GAP_S
LEAST_GAP_S = 1.0
REPEATS, HELD_S = 0.2, 10.0  # limits of a sound receiver: share of repeated fixes, time at one place
ADVICE = {
    "below_least": "rows that the receiver itself calls bad; no harm if they are few",
    "not_finite": "rows without a fix; no harm if they are few",
    "out_of_range": "look at the unit of that column; variances of 0 mean unknown: give `std`, and no such columns",
    "stamp_ahead": "no harm if they are few: the clock was not set yet, or a message was damaged",
    "stamp_goes_back": "no harm if they are few; else sort the file by time",
    "wrong_type": 'numbers are expected; of times as 2025-06-15T15:06:40Z say unit = "iso", of 4901.2345 N "ddmm"',
}


@dataclass(frozen=True)
class SensorData:
    """Contents of a sensor's file. refused: rows by reason; first: place of the first of each.

    problem: why nothing is usable, else empty.
    """

    sensor: SensorConfig
    readings: Sequence[Reading]
    refused: dict[str, int]
    first: dict[str, str]
    problem: str = ""

    @property
    def stamps_ns(self) -> Ints:
        """Stamps (n,) of usable rows."""
        return np.array([reading.stamp_ns for reading in self.readings], np.int64)


@dataclass(frozen=True)
class LogCheck:
    """begins: first reading's time, empty without one. rows: table of sensors. findings: notes."""

    begins: str
    rows: list[Row]
    findings: list[Finding]

    @property
    def ok(self) -> bool:
        """Whether `sitegrid log run` can run it."""
        return not any(one.level == Level.FAIL and one.check == "positions" for one in self.findings)


def examine(manifest: Path, data: Path | None = None) -> LogCheck:
    """Examine a log and the files beside its manifest; ConfigError on the manifest."""
    log, folder = open_log(manifest, data), manifest if manifest.is_dir() else manifest.parent
    read = [_read(log, source.sensor) for source in log.sources if source.sensor.use]
    unused = [SensorData(source.sensor, (), {}, {}) for source in log.sources if not source.sensor.use]
    start_ns = min((int(one.stamps_ns[0]) for one in read if one.readings), default=0)
    last_ns = max((int(one.stamps_ns[-1]) for one in read if one.readings), default=0)
    rows = [_row(one, start_ns) for one in read] + [{**_row(one, 0), "usable": "use = false"} for one in unused]
    barring = [*check_clocks(log, {one.sensor.name: one.readings for one in read}), *check_places(log, read)]
    is_barred = any(finding.level == Level.FAIL for finding in barring)
    findings = [
        *(finding for one in read for finding in check_sensor(one)),
        *barring,
        *(check_speeds(log, read) if not is_barred else ()),
        *(check_wheels(log, [one.readings for one in read]) if not is_barred else ()),
        check_positions(read, is_barred=is_barred),
        *_compared(log, folder, start_ns, last_ns),
    ]
    return LogCheck(time_of(start_ns) if start_ns else "", rows, findings)


def check_sensor(data: SensorData) -> Iterator[Finding]:
    """Refused rows, frozen stamps, gaps, repeated fixes."""
    name, stamps = data.sensor.name, data.stamps_ns
    if data.problem:
        worst = max(data.refused, key=lambda reason: data.refused[reason], default="")
        yield Finding(Level.FAIL, name, data.problem, ADVICE.get(worst, ""))
        return
    for reason, count in data.refused.items():
        what = f"{count} of {count + len(stamps)} rows refused ({reason}), first {data.first[reason]}"
        yield Finding(Level.FAIL if count > len(stamps) else Level.WARN, name, what, ADVICE.get(reason, ""))
    if stands(stamps):
        what = f"its stamps do not advance: {len(np.unique(stamps))} different in {len(stamps)} rows"
        yield Finding(Level.FAIL, name, what, ALL_DIGITS)
        return
    steps_s = np.diff(stamps) * 1e-9
    if (longest := float(steps_s.max(initial=0.0))) * 1e9 > GAP_NS:
        at_s = (stamps[steps_s.argmax()] - stamps[0]) * 1e-9
        what = f"gaps: {len(_gaps(steps_s))}, the longest of {longest:.1f} s, {at_s:.0f} s after its first row"
        yield Finding(Level.WARN, name, what, "positions rest on the other sensors until it is back")
    share, held_s = _repeated(data.readings)
    if share > REPEATS or held_s > HELD_S:
        what = f"{share:.0%} of its fixes repeat the one before, one of them for {held_s:.0f} s"
        yield Finding(Level.WARN, name, what, "keep one row per fix; a receiver that freezes is of no use meanwhile")


def check_places(log: LogFolder, data: Sequence[SensorData]) -> Iterator[Finding]:
    """Fixes off the site."""
    for one in data:
        if one.readings and _is_receiver(one.sensor):
            far_m = np.abs(places(one.readings, log.site)[1]).max(axis=1)
            if (share := float((far_m > log.site.extent_m).mean())) > 0:
                what = f"{share:.0%} of its fixes are more than {log.site.extent_m / 1000:g} km from the site's origin"
                advice = "look at the origin in [site], and whether latitude and longitude are exchanged"
                yield Finding(Level.FAIL if share > 1 / 2 else Level.WARN, one.sensor.name, what, advice)


def check_speeds(log: LogFolder, data: Sequence[SensorData]) -> Iterator[Finding]:
    """Wheels against fixes, to find wrong units."""
    fixes = next((one for one in data if len(one.readings) > 1 and _is_receiver(one.sensor)), None)
    for one in data:
        if fixes and len(one.readings) > 1 and one.sensor.kind in WHEELS:
            share = wheel_share(places(fixes.readings, log.site), wheel_distance(one.readings, log.machine))
            if not 1 / UNIT < share < UNIT and share >= 0:  # NaN: the machine stands
                what = f"the wheels turn {share:.2g} times as far as {fixes.sensor.name} goes"
                advice = "look at the unit of the speed, `wheel_radius_m`, `ticks_per_rev`"
                yield Finding(Level.WARN, one.sensor.name, what, advice)


def check_positions(data: Sequence[SensorData], *, is_barred: bool) -> Finding:
    """Whether the sensors in use can locate the machine. is_barred: clocks or places are inconsistent."""
    there = [one.sensor for one in data if one.readings and one.sensor.kind in QUANTITIES]
    kinds, problem, advice = {sensor.kind for sensor in there}, "", ""
    if not any(_is_receiver(sensor) for sensor in there):
        problem, advice = "no usable GPS fixes", "add a receiver, or `sitegrid log run --set start=[x,y,heading]`"
    elif unread := [one.sensor.name for one in data if one.problem]:
        problem, advice = f"{unread[0]} cannot be read", "mend its file, or leave it out by `use = false`"
    elif is_barred or any(stands(one.stamps_ns) for one in data):
        problem, advice = "readings do not fit together", "mend the stamps and places that are named above"
    if problem:
        return Finding(Level.FAIL, "positions", problem, advice)
    named = ", ".join(sensor.name for sensor in there)
    if not ("steering" in kinds or any(s.provides("rate") for s in there if s.kind in ("imu", "odometry"))):
        return Finding(Level.WARN, "positions", f"{named}: none shows the turn", "add a gyro or a steering angle")
    if not kinds & WHEELS:
        what, advice = f"{named}: no wheels, speed is by GPS", "an encoder or odometry would show rolling resistance"
        return Finding(Level.WARN, "positions", what, advice)
    return Finding(Level.PASS, "positions", f"by {named}")


def missing_for_ground(machine: MachineConfig, areas: Sequence[KnownArea]) -> str:
    """Why ground cannot be compared; empty if it can."""
    used = [sensor for sensor in machine.sensors if sensor.use]
    if not any(sensor.kind == Imu.kind and sensor.provides("force") for sensor in used):
        return "no IMU with forces, which gradient and rolling resistance need"
    if not areas:
        return f"no ground is known; describe areas as [[ground]] in {SIDE_FILE} beside the manifest ({PAGE})"
    if any(sensor.kind in DRIVES for sensor in used) or any(area.has_gradient for area in areas):
        return ""
    return "no torque sensor, which rolling resistance needs"


def missing_for_truth(truth: LogTruth | None) -> str:
    """Why positions cannot be compared with a truth; empty if they can."""
    if truth:
        return ""
    return f"no true track is known; describe one as [truth] in {SIDE_FILE} beside the manifest ({PAGE})"


def _compared(log: LogFolder, folder: Path, first_ns: int, last_ns: int) -> Iterator[Finding]:
    """Comparisons possible with truth and known ground."""
    try:
        truth, areas = read_log_truth(log, folder), read_known_ground(log, folder)
        if truth:
            require_overlap(truth, first_ns, last_ns)
    except (ConfigError, LogFolderError) as error:
        yield Finding(Level.FAIL, "truth", str(error))
        return
    for check, why, there in (
        ("truth", missing_for_truth(truth), "a true track is known"),
        ("ground", missing_for_ground(log.machine, areas), f"known of {', '.join(area.name for area in areas)}"),
    ):
        yield Finding(Level.SKIP, check, f"not compared: {why}") if why else Finding(Level.PASS, check, there)


def _read(log: LogFolder, sensor: SensorConfig) -> SensorData:
    sources = tuple(source for source in log.sources if source.sensor == sensor)
    alone = replace(log, sources=sources, refused=Counter(), first_refused={})
    try:
        readings, problem = list(alone.readings()), ""
    except LogFolderError as error:
        readings, problem = [], str(error)
    if not readings and not problem:
        problem = "its file has no rows; `use = false` leaves it out"
    return SensorData(sensor, readings, alone.refused, alone.first_refused, problem)


def _row(data: SensorData, start_ns: int) -> Row:
    """A table row; times from the log's first reading."""
    stamps, sensor = data.stamps_ns, data.sensor
    row = {"sensor": sensor.name, "kind": sensor.kind, "usable": len(stamps), "refused": sum(data.refused.values())}
    figures: dict[str, float | int | None] = dict.fromkeys(("begins_s", "ends_s", "rate_hz", "gaps", "longest_gap_s"))
    if len(stamps) > 1:
        steps_s = np.diff(stamps) * 1e-9
        usual_s = float(np.median(steps_s))
        begin, end = ((int(stamps[i]) - start_ns) * 1e-9 for i in (0, -1))
        rate = 1 / usual_s if usual_s else None
        values = begin, end, rate, len(_gaps(steps_s)), float(steps_s.max())
        figures = rounded(dict(zip(figures, values, strict=True)), 2)
    return {**row, **figures}


def _gaps(steps_s: Floats) -> Floats:
    return steps_s[steps_s > max(PAUSE * float(np.median(steps_s)), LEAST_GAP_S)]


def _repeated(readings: Sequence[Reading]) -> tuple[float, float]:
    """Share of fixes equal to the previous one, and the longest such time [s]."""
    fixes = [reading for reading in readings if isinstance(reading, Gps)]
    held = [list(group) for _, group in groupby(fixes, key=attrgetter("lat_deg", "lon_deg"))]
    longest_ns = max((group[-1].stamp_ns - group[0].stamp_ns for group in held), default=0)
    return 1 - len(held) / len(fixes) if fixes else 0.0, longest_ns * 1e-9


def _is_receiver(sensor: SensorConfig) -> bool:
    return sensor.kind == Gps.kind and sensor.mode == ABSOLUTE
