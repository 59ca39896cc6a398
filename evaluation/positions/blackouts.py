"""Positions without GPS: blackouts in the middle of a drive, receivers that come back wrong, drives from a start alone.

A drive is replayed once with GPS. At each placement all that is believed is copied, and the copy goes on without GPS:
one blackout shows the error after each length. In the cases `jump` GPS comes back after a minute, but wrong, and
recovers slowly. In the case `start` there is none at all, and the start is known.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agents.pipeline import Positioning
from evaluation.campaign.experiment import Experiment, Runner, Task, replay_task
from evaluation.campaign.figures import Goal, Report, Row, half_width, judge, rounded
from evaluation.campaign.recordings import PAPER, PlannedDrive, RecordedDrive, Setup
from evaluation.positions.configurations import PROFILES, Configuration, select
from evaluation.positions.consistency import ellipse_limit, normalised_square
from evaluation.positions.replay import Trace, errors, replay
from protocol.arrays import Floats, Ints
from protocol.errors import SitegridError
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, Reading
from protocol.site.site_config import Projection, SiteConfig

LENGTHS_S = (10, 30, 60, 120, 300)  # of blackouts
PLACEMENTS = 4  # per drive, at even distances
SETTLED_S = 120.0  # of GPS before the first: the heading is known, gyro and wheels have shown their errors
GAP_S = 60  # how long a receiver is away before it jumps
BACK_S = (0, 5, 15, 45, 90)  # when its errors are looked at after that
JUMPS = {"jump-6m": 6.0, "jump-15m": 15.0}  # near to what a receiver states, and far beyond it [m]
RECOVERY_S = 30.0  # time in which a jump fades by a factor of e
MAX_RATIO = 1.5  # of the error on one drive to that of the profile `paper`
BLACKOUT, START = "blackout", "start"
SENSORS = ("reference", "gyro")  # with the attitude reference, and with one gyro and wheels alone
SOURCES = (
    "agents",
    "protocol",
    *(f"evaluation/positions/{part}.py" for part in ("blackouts", "configurations", "replay")),
)


@dataclass(frozen=True)
class Variant:
    """What happens to GPS, with which sensors, and the profile of the filter."""

    case: str
    sensors: str
    profile: str

    @property
    def name(self) -> str:
        """A name for files."""
        return f"{self.case}-{self.sensors}-{self.profile}"


@dataclass(frozen=True)
class Courses:
    """Errors of n courses at whole seconds since GPS was lost, NaN without a pose.

    error_m: (n, t, 2); covariance_m2: (n, t, 2, 2), as stated.
    """

    error_m: Floats
    covariance_m2: Floats

    @property
    def distance_m(self) -> Floats:
        """How far off (n, t)."""
        return np.asarray(np.hypot(self.error_m[..., 0], self.error_m[..., 1]))

    @property
    def inside(self) -> Floats:
        """Where the 95 % ellipse holds the truth (n, t): 1, else 0."""
        nees = normalised_square(self.error_m.reshape(-1, 2), self.covariance_m2.reshape(-1, 2, 2))
        return np.asarray(nees <= ellipse_limit(2), float).reshape(self.error_m.shape[:2])


@dataclass(frozen=True)
class Outcome:
    """One variant on one drive."""

    drive: PlannedDrive
    variant: Variant
    courses: Courses


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, setup: Setup = PAPER, preset: str = "paper"
) -> tuple[Report, list[Outcome]]:
    """Record, replay and compare all cases with all seeds; SitegridError where drives have no room for blackouts."""
    least_s = SETTLED_S + LENGTHS_S[-1] + 1
    if seconds < least_s:
        raise SitegridError(f"seconds: {seconds:g} is too short; blackouts need drives of {least_s:g} s or more")
    drives = [PlannedDrive(seed, seconds, preset, setup) for seed in seeds]
    cases = (BLACKOUT, *JUMPS, START)
    variants = [Variant(case, sensors, profile) for case in cases for sensors in SENSORS for profile in PROFILES]
    pairs = [(drive, variant) for drive in drives for variant in variants]
    results = runner.run(EXPERIMENT, [replay_task(variant, drive) for drive, variant in pairs])
    outcomes = [Outcome(*pair, courses) for pair, courses in zip(pairs, results, strict=True)]
    by_variant = {v: [o.courses for o in outcomes if o.variant == v] for v in variants}
    rows = [row for v, several in by_variant.items() for row in summarise(v, several)]
    ratios = [row for case in cases for sensors in SENSORS for row in compare(case, sensors, by_variant)]
    report: Report = {
        "scenario": setup.scenario,
        "preset": preset,
        "seeds": list(seeds),
        "seconds": seconds,
        "placements_s": placements_s(seconds),
        "rows": rows,
        "ratios": ratios,
        "goals": judge(NEVER_WORSE, ratios) + judge(HONEST, rows),
    }
    return report, outcomes


def placements_s(seconds: float) -> list[float]:
    """When GPS is lost in a drive of so many seconds."""
    places: list[float] = np.linspace(SETTLED_S, seconds - LENGTHS_S[-1] - 1, PLACEMENTS).round(1).tolist()
    return places


# --- rows ------------------------------------------------------------------------------------------------------------


def lengths_s(case: str, courses: Courses) -> list[int]:
    """At which seconds without GPS, or after its loss, a case is looked at."""
    whole = courses.error_m.shape[1] - 1
    if case == START:
        return [length for length in (60, 300) if length < whole] + [whole]
    return list(LENGTHS_S) if case == BLACKOUT else [GAP_S + back for back in BACK_S]


def summarise(variant: Variant, several: Sequence[Courses]) -> list[Row]:
    """One row per length: errors at its end over all seeds (n) and courses, and whether their ellipses hold them."""
    rows = []
    for length in lengths_s(variant.case, several[0]):
        off = np.array([courses.distance_m[:, length] for courses in several])
        by_seed = off.mean(axis=1)
        row = {
            **vars(variant),
            "seconds": length,
            "error_m": float(off.mean()),
            "ci95_m": half_width(by_seed),
            "median_m": float(np.median(off)),
            "largest_m": float(off.max()),
            "coverage95": float(np.mean([courses.inside[:, length] for courses in several])),
            "error_by_seed_m": by_seed.tolist(),
        }
        rows.append(rounded(row, 3))
    return rows


def compare(case: str, sensors: str, by_variant: Mapping[Variant, Sequence[Courses]]) -> list[Row]:
    """`default` over `paper` per length: of the means of all seeds, of the worst seed, and how often a course is worse.

    over: courses whose error is more than MAX_RATIO times that of the same course with `paper`.
    """
    ours, theirs = (by_variant[Variant(case, sensors, profile)] for profile in ("default", "paper"))
    rows = []
    for length in lengths_s(case, ours[0]):
        a, b = (np.array([courses.distance_m[:, length] for courses in several]) for several in (ours, theirs))
        by_seed = a.mean(axis=1) / b.mean(axis=1)
        row = {
            "case": case,
            "sensors": sensors,
            "seconds": length,
            "ratio": float(a.mean() / b.mean()),
            "worst_seed": float(by_seed.max()),
            "largest": float(a.max() / b.mean()),
            "over": int((a > MAX_RATIO * b).sum()),
            "courses": a.size,
        }
        rows.append(rounded(row, 3))
    return rows


NEVER_WORSE = [
    Goal({"case": BLACKOUT, "sensors": "reference", "seconds": length}, figure, "<=", limit)
    for length in LENGTHS_S
    for figure, limit in (("ratio", 1.0), ("worst_seed", MAX_RATIO))
]
HONEST = [
    Goal({"case": BLACKOUT, "sensors": "gyro", "profile": "default", "seconds": LENGTHS_S[-1]}, "median_m", "<=", 12.0),
    *(
        Goal(
            {"case": BLACKOUT, "sensors": sensors, "profile": "default", "seconds": LENGTHS_S[-1]},
            "coverage95",
            ">=",
            0.9,
        )
        for sensors in SENSORS
    ),
]


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[Variant], cache: Path) -> Courses:
    """The courses of one variant on one recording."""
    recording, variant = task.recording(cache), task.variant
    machine = sensors_of(recording.machine, variant.sensors)
    options = Configuration("ukf", 1, 1, variant.profile).options
    in_use = {sensor.name for sensor in machine.sensors if sensor.use}
    readings = [reading for reading in recording.readings if reading.sensor in in_use]
    if variant.case == START:
        options = replace(options, localisation=replace(options.localisation, start=recording.start))
        core = Positioning(recording.site, machine, options)
        return _course([(core, without_gps(readings))], recording, math.floor(task.seconds) - 1)
    forks = _forks(Positioning(recording.site, machine, options), readings, placements_s(task.seconds))
    if variant.case == BLACKOUT:
        return _course([(core, without_gps(rest)) for core, rest in forks], recording, LENGTHS_S[-1])
    jump_m = JUMPS[variant.case]
    directions = np.random.default_rng(task.seed).uniform(-math.pi, math.pi, len(forks))
    returning = [
        (core, after_gap(rest, recording.site, jump_m * math.cos(angle), jump_m * math.sin(angle)))
        for (core, rest), angle in zip(forks, directions.tolist(), strict=True)
    ]
    return _course(returning, recording, GAP_S + BACK_S[-1])


EXPERIMENT = Experiment("blackout", Courses, SOURCES, _solve)
Fork = tuple[Positioning, Sequence[Reading]]  # what is believed, and the readings from then on


def sensors_of(machine: MachineConfig, sensors: str) -> MachineConfig:
    """The machine with one receiver and one IMU, with its attitude reference or without; sensors: one of SENSORS."""
    one = select(machine, 1, 1)
    keeps = sensors == "reference"
    return replace(one, sensors=tuple(replace(s, use=s.use and (keeps or s.kind != "attitude")) for s in one.sensors))


def without_gps(readings: Sequence[Reading]) -> list[Reading]:
    """All but the fixes."""
    return [reading for reading in readings if not isinstance(reading, Gps)]


def after_gap(readings: Sequence[Reading], site: SiteConfig, east_m: float, north_m: float) -> list[Reading]:
    """Readings of which the fixes of the first GAP_S are lost, and the later ones are off by a jump that fades."""
    projection, back_ns = Projection(site), readings[0].stamp_ns + round(GAP_S * 1e9)

    def jumped(gps: Gps) -> Gps:
        left = math.exp(-(gps.stamp_ns - back_ns) * 1e-9 / RECOVERY_S)
        x, y, _ = projection.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        lat_deg, lon_deg, _ = projection.to_geodetic(x + left * east_m, y + left * north_m)
        return replace(gps, lat_deg=lat_deg, lon_deg=lon_deg)

    seen = [r for r in readings if not (isinstance(r, Gps) and r.stamp_ns < back_ns)]
    return [jumped(r) if isinstance(r, Gps) else r for r in seen]


def _forks(core: Positioning, readings: Sequence[Reading], places_s: Sequence[float]) -> list[Fork]:
    """Copies of what is believed at each place, after a replay with GPS up to there."""
    stamps = np.array([reading.stamp_ns for reading in readings])
    forks: list[Fork] = []
    begin = 0
    for place_s in places_s:
        end = int(np.searchsorted(stamps, stamps[0] + round(place_s * 1e9)))
        replay(core, readings[begin:end])
        forks.append((copy.deepcopy(core), readings[end:]))
        begin = end
    return forks


def _course(forks: Sequence[Fork], recording: RecordedDrive, seconds: int) -> Courses:
    """Replay each to so many seconds after its first reading."""
    error_m, covariance_m2 = (
        np.full((len(forks), seconds + 1, 2), np.nan),
        np.full((len(forks), seconds + 1, 2, 2), np.nan),
    )
    for i, (core, readings) in enumerate(forks):
        until_ns = readings[0].stamp_ns + round((seconds + 0.2) * 1e9)
        trace = replay(core, [reading for reading in readings if reading.stamp_ns < until_ns])
        at, picked = _whole_seconds(trace, seconds)
        error_m[i, at] = errors(trace, recording.truth)[picked]
        covariance_m2[i, at] = trace.covariance_m2[picked]
    return Courses(error_m, covariance_m2)


def _whole_seconds(trace: Trace, seconds: int) -> tuple[Ints, Ints]:
    """Whole seconds up to a last one, and the first pose of a trace in each of them."""
    at, picked = np.unique(trace.since_start_s.astype(int), return_index=True)
    return at[at <= seconds], picked[at <= seconds]
