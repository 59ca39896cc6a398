"""Errors of machines without GPS in the full filter, with another day's lanes and without."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agents.localisation.lanes.lane_map import LaneMap
from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig, Positioning
from lab.campaign.experiment import Experiment, Runner, Task, read_result, replay_task
from lab.fedback.days import day
from lab.fedback.maps import days_ago, lane_map
from lab.fedback.nodes import EXPERIMENT as NODES
from lab.fedback.nodes import TAKEN, Machine, Nodes, with_receivers
from protocol.arrays import Floats, Ints
from protocol.machine.log_folder import open_log
from protocol.machine.readings import Gps, GpsVelocity
from sim.recorder import TRACKS_FOLDER
from sitegrid.proof.figures import Row, rounded
from sitegrid.proof.tracks import read_track

LOST_S, LASTS_S = 110.0, 300.0  # start after the first reading; duration
AT_S = (60.0, 300.0)  # after the loss, when errors are judged
INSIDE = 5.991  # normalised squared error at the 95 % ellipse


@dataclass(frozen=True)
class Lost:
    """A machine without GPS for a while. other: seed of its lanes' day, -1: none."""

    machine: str
    other: int = -1

    @property
    def name(self) -> str:
        """Name for files."""
        return f"{self.machine}-lost-{self.other}"


@dataclass(frozen=True)
class Errors:
    """Live pose, each second: errors (n, 2), covariances (n, 2, 2).

    after_s (n,): since loss of GPS. true_m (n, 2): position.
    """

    after_s: Floats
    off_m: Floats
    covariance_m2: Floats
    true_m: Floats


def solve(task: Task[Lost], cache: Path) -> Errors:
    """Localise a machine that loses GPS."""
    assert task.drive
    other = task.variant.other
    lanes = lanes_of(other, task.seconds, cache) if other >= 0 else None
    return localise(task.drive.folder(cache), task.variant.machine, lanes)


EXPERIMENT = Experiment("blackout", Errors, solve)


def lanes_of(seed: int, seconds: float, cache: Path) -> LaneMap:
    """Lanes of an earlier day with existing nodes."""
    drive = day("driven", seed, seconds)
    files = {name: NODES.file(replay_task(Machine(name), drive), cache) for name in drive.names}
    return lane_map(days_ago([(name, read_result(Nodes, file).rows) for name, file in files.items()], 1))


def localise(folder: Path, name: str, lanes: LaneMap | None) -> Errors:
    """Errors with lanes from the start and GPS lost later."""
    log = open_log(folder / "logs" / name)
    config = LocalisationConfig(map_aid="auto" if lanes else "off")
    core = Positioning(log.site, with_receivers(log.machine, 2), PipelineConfig(localisation=config))
    if core.lanes:
        core.lanes.lanes = lanes
    readings = list(log.readings())
    lost_ns = readings[0].stamp_ns + round(LOST_S * 1e9)
    lost = range(lost_ns, lost_ns + round(LASTS_S * 1e9))
    heard = [r for r in readings if not (isinstance(r, Gps | GpsVelocity) and r.stamp_ns in lost)]
    poses = {}
    for first in range(0, len(heard), TAKEN):
        core.step(heard[first : first + TAKEN])
        if pose := core.pose:
            poses[pose.stamp_ns // 10**9] = pose
    stamp_ns: Ints = np.array([pose.stamp_ns for pose in poses.values()])
    true_m = read_track(folder / "truth" / TRACKS_FOLDER / f"{name}.csv").at(stamp_ns)
    off_m: Floats = np.array([(pose.x_m, pose.y_m) for pose in poses.values()]) - true_m
    covariance_m2 = np.array([pose.covariance_m2 for pose in poses.values()])
    after_s = (stamp_ns - lost_ns).astype(float) * 1e-9
    return Errors(after_s, off_m, covariance_m2, true_m)


Courses = Mapping[bool, Sequence[Errors]]  # with lanes, without


def courses_of(runner: Runner, turns: Sequence[tuple[int, int]], seconds: float) -> Courses:
    """All machines on each turn's second day, with and without the first day's lanes."""
    courses: dict[bool, list[Errors]] = {}
    for aided in (True, False):
        drives = [(first, day("driven", second, seconds)) for first, second in turns]
        who = [(Lost(name, first if aided else -1), drive) for first, drive in drives for name in drive.names]
        courses[aided] = runner.run(EXPERIMENT, [replay_task(lost, drive) for lost, drive in who])
    return courses


def row_of(after_s: float, courses: Courses) -> Row:
    """Errors at a time after the loss of GPS."""
    row: Row = {"case": f"driven-lost-{after_s:g}s", "courses": len(courses[True])}
    for aided, ending in ((True, ""), (False, "_without")):
        at = [int(np.argmin(np.abs(course.after_s - after_s))) for course in courses[aided]]
        pairs = [(course.off_m[i], course.covariance_m2[i]) for course, i in zip(courses[aided], at, strict=True)]
        errors_m = np.array([np.hypot(*off_m) for off_m, _ in pairs])
        inside = [off_m @ np.linalg.solve(P, off_m) < INSIDE for off_m, P in pairs]
        row |= {
            f"mean{ending}_m": float(errors_m.mean()),
            f"median{ending}_m": float(np.median(errors_m)),
            f"largest{ending}_m": float(errors_m.max()),
            f"ellipse{ending}_pct": 100 * float(np.mean(inside)),
        }
    return rounded({**row, "mean_ratio": row["mean_m"] / row["mean_without_m"]}, 2)
