"""Drives replayed without GPS: blackouts, receivers that come back wrong, and a start without any.

A drive is replayed once with GPS. At each placement all that is believed is copied, and the copy goes on without GPS:
one blackout shows the error after each length. After a minute it is copied again for the cases `jump`, in which GPS
comes back then, but wrong, and recovers slowly. In the case `start` there is none at all, and the start is known.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agents.positioning import Positioning
from lab.campaign.experiment import Experiment, Task
from lab.campaign.recordings import MACHINES_PROTOCOL, RecordedDrive
from lab.positions.configurations import Configuration
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, Reading
from protocol.site.site_config import Projection, SiteConfig
from sitegrid.logs.consistency import ellipse_limit, normalised_square
from sitegrid.logs.replay import Trace, continued, errors, replay
from sitegrid.logs.sensors import select

LENGTHS_S = (10, 30, 60, 120, 300)  # of blackouts
PLACEMENTS = 4  # per drive, at even distances
SETTLED_S = 120.0  # of GPS before the first: the heading is known, gyro and wheels have shown their errors
GAP_S = 60  # how long a receiver is away before it jumps
BACK_S = (0, 5, 15, 45, 90)  # when its errors are looked at after that
JUMPS = {"jump-6m": 6.0, "jump-15m": 15.0}  # near to what a receiver states, and far beyond it [m]
RECOVERY_S = 30.0  # time in which a jump fades by a factor of e
BLACKOUT, START = "blackout", "start"
CASES = (BLACKOUT, *JUMPS, START)
SENSORS = ("reference", "gyro")  # with the attitude reference, and with one gyro and wheels alone
SOURCES = (
    "agents",
    *MACHINES_PROTOCOL,
    *(f"lab/{part}.py" for part in ("outages/replays", "positions/configurations", "positions/replay")),
)


@dataclass(frozen=True)
class Filtering:
    """What is replayed at once: sensors and the profile of the filter."""

    sensors: str
    profile: str

    @property
    def name(self) -> str:
        """A name for files."""
        return f"{self.sensors}-{self.profile}"


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

    def by_case(self, seconds: float) -> dict[str, Courses]:
        """The courses of each case, of those of a whole drive of so many seconds: its blackouts, its jumps, its start.

        Each case has as many seconds as it is looked at.
        """
        first = np.cumsum([0] + [n for n, _ in sizes(seconds).values()])
        return {
            case: Courses(self.error_m[i : i + n, : last + 1], self.covariance_m2[i : i + n, : last + 1])
            for i, (case, (n, last)) in zip(first.tolist(), sizes(seconds).items(), strict=False)
        }


def placements_s(seconds: float) -> list[float]:
    """When GPS is lost in a drive of so many seconds."""
    places: list[float] = np.linspace(SETTLED_S, seconds - LENGTHS_S[-1] - 1, PLACEMENTS).round(1).tolist()
    return places


def sizes(seconds: float) -> dict[str, tuple[int, int]]:
    """How many courses each case has in a drive of so many seconds, and their last second without GPS."""
    jump = (PLACEMENTS, GAP_S + BACK_S[-1])
    return {BLACKOUT: (PLACEMENTS, LENGTHS_S[-1]), **dict.fromkeys(JUMPS, jump), START: (1, math.floor(seconds) - 1)}


def _solve(task: Task[Filtering], cache: Path) -> Courses:
    """The courses of all cases on one recording, one below the other."""
    recording = task.recording(cache)
    machine = sensors_of(recording.machine, task.variant.sensors)
    options = Configuration("ukf", 1, 1, task.variant.profile).options
    in_use = {sensor.name for sensor in machine.sensors if sensor.use}
    readings = [reading for reading in recording.readings if reading.sensor in in_use]
    forks = _forks(Positioning(recording.site, machine, options), readings, placements_s(task.seconds))
    directions = np.random.default_rng(task.seed).uniform(-math.pi, math.pi, len(forks)).tolist()
    traces: dict[str, list[Trace]] = {case: [] for case in CASES}
    for (core, rest), angle in zip(forks, directions, strict=True):
        for case, trace in _lost(core, rest, recording.site, angle).items():
            traces[case].append(trace)
    at_start = replace(options, localisation=replace(options.localisation, start=recording.start))
    traces[START] = [replay(Positioning(recording.site, machine, at_start), without_gps(readings))]
    return _courses([trace for case in CASES for trace in traces[case]], recording)


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


def _lost(core: Positioning, readings: Sequence[Reading], site: SiteConfig, angle_rad: float) -> dict[str, Trace]:
    """The traces of a blackout and of the jumps to one direction, from the first reading without GPS on."""
    stamps_s = (np.array([reading.stamp_ns for reading in readings]) - readings[0].stamp_ns) * 1e-9
    gap, end = (int(np.searchsorted(stamps_s, second)) for second in (GAP_S, LENGTHS_S[-1] + 0.2))
    back = int(np.searchsorted(stamps_s, GAP_S + BACK_S[-1] + 0.2))
    first = replay(core, without_gps(readings[:gap]))
    rest = {BLACKOUT: without_gps(readings[gap:end])}
    for case, jump_m in JUMPS.items():
        jumped = after_gap(readings[:back], site, jump_m * math.cos(angle_rad), jump_m * math.sin(angle_rad))
        rest[case] = [reading for reading in jumped if reading.stamp_ns >= readings[gap].stamp_ns]
    return {case: continued(first, replay(copy.deepcopy(core), later)) for case, later in rest.items()}


def _courses(traces: Sequence[Trace], recording: RecordedDrive) -> Courses:
    """Errors and covariances at whole seconds of traces, as many as the longest of them has."""
    seconds = [trace.since_start_s.astype(int) for trace in traces]
    shape = len(traces), 1 + max(int(at[-1]) for at in seconds)
    courses = Courses(np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan))
    for i, (trace, since) in enumerate(zip(traces, seconds, strict=True)):
        at, first = np.unique(since, return_index=True)
        courses.error_m[i, at] = errors(trace, recording.truth)[first]
        courses.covariance_m2[i, at] = trace.covariance_m2[first]
    return courses
