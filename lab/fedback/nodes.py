"""A drive reduced by our filter, for filtering again with more measurements.

Between nodes, a second apart, the smoother sums readings (`agents/localisation/filters/smoother.py`): Phi, the adjoint
a, the information I; P is the covariance at the first node. The error xi of node k is

    seen by the readings up to node k + 1 with information J = I (1 - P I)^-1 and vector j = (1 - I P)^-1 a
    xi_{k+1} = A (xi_k - P a) + w,  w ~ N(0, W)     A = Phi (1 - P I)^-1,  W = P_{k+1} - A (P - P I P) A^T

A rerun with measurements added at nodes is 30 times as fast and exact to first order, but invalid without GPS, where
the gains are deliberately suboptimal (`considers`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agents.localisation.filters.belief import Belief, Conditioned, Filter, Measurement, Motion, PoseBelief
from agents.localisation.filters.smoother import NODE_NS, SmoothedPose
from agents.pipeline import corrected
from agents.positioning import PipelineConfig, Positioning
from lab.campaign.experiment import Experiment, Task
from protocol.arrays import Floats, Ints, Table
from protocol.machine.log_folder import open_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.samples import empty
from sim.recorder import TRACKS_FOLDER
from sitegrid.proof.tracks import read_track

EVERY_M = 0.5  # sample spacing
TAKEN = 10  # readings per step: some hundredths of a second


Segments = tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats]  # x, P, A, W, J, j, shift


@dataclass(frozen=True)
class Nodes:
    """Beliefs at n nodes, and the readings' information between them.

    stamp_ns: (n,). x: (n, s), P: (n, s, s). A, W, J: (n - 1, s, s), j, shift: (n - 1, s), shift = P a. true_m: (n, 2)
    position. way_ns: (k,), way: (k, 4) by dead reckoning: x, y [m], angle [rad], distance [m]. rows: final samples,
    positions only. ahead_m: of the load centre.
    """

    stamp_ns: Ints
    x: Floats
    P: Floats
    A: Floats
    W: Floats
    J: Floats
    j: Floats
    shift: Floats
    true_m: Floats
    way_ns: Ints
    way: Floats
    rows: Table
    ahead_m: float


@dataclass(frozen=True)
class Machine:
    """One machine of a day, with this number of receivers."""

    machine: str
    receivers: int = 2

    @property
    def name(self) -> str:
        """Name for people and files."""
        return f"{self.machine}-{self.receivers}gps"


def solve(task: Task[Machine], cache: Path) -> Nodes:
    """Nodes of one machine's drive."""
    assert task.drive
    return watch(task.drive.folder(cache), task.variant)


EXPERIMENT = Experiment("fedback", Nodes, solve)


class _Watched:
    """A filter recording its belief each second."""

    def __init__(self, engine: Filter) -> None:
        self.engine = engine
        self.noted: dict[int, Belief] = {}

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        if stamp_ns // NODE_NS != belief.stamp_ns // NODE_NS and belief.past:
            self.noted[belief.stamp_ns // NODE_NS] = belief
        return self.engine.predict(belief, motion, stamp_ns)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        return self.engine.condition(belief, measurement)


def with_receivers(machine: MachineConfig, count: int) -> MachineConfig:
    """The machine with its first `count` GPS receivers."""
    gps = [sensor.name for sensor in machine.sensors if sensor.kind == "gps"]
    sensors = (replace(s, use=s.use and s.name not in gps[count:]) for s in machine.sensors)
    return replace(machine, sensors=tuple(sensors))


def watch(folder: Path, who: Machine) -> Nodes:
    """The filter's nodes of one recorded machine."""
    name = who.machine
    log = open_log(folder / "logs" / name)
    core = Positioning(log.site, with_receivers(log.machine, who.receivers), PipelineConfig())
    watched = core.localiser.engine = _Watched(core.localiser.engine)
    readings = list(log.readings())
    way: list[tuple[int, float, float, float, float]] = []
    smoothed: list[SmoothedPose] = []
    poses: dict[int, PoseBelief] = {}
    for first in range(0, len(readings), TAKEN):
        smoothed += core.step(readings[first : first + TAKEN])
        at, pose = core.dead_reckoning.pose, core.pose
        if pose and (not way or at.stamp_ns > way[-1][0]):
            way.append((at.stamp_ns, at.x_m, at.y_m, at.angle_rad, core.dead_reckoning.distance_m))
            poses[pose.stamp_ns] = pose
    smoothed += core.remaining()
    track = np.array(way)
    way_ns = np.array([stamp for stamp, *_ in way], np.int64)
    rows = _samples(track, poses, smoothed, log.machine.load_centre_m)
    truth = read_track(folder / "truth" / TRACKS_FOLDER / f"{name}.csv")
    stamps, segments = _segments([watched.noted[key] for key in sorted(watched.noted)])
    ahead_m, true_m = log.machine.load_centre_m, truth.at(stamps)
    return Nodes(stamps, *segments, true_m=true_m, way_ns=way_ns, way=track[:, 1:], rows=rows, ahead_m=ahead_m)


def _samples(way: Floats, poses: dict[int, PoseBelief], smoothed: list[SmoothedPose], ahead_m: float) -> Table:
    """Smoothed position samples, one per EVERY_M driven."""
    step = np.floor(way[:, 4] / EVERY_M)
    at = np.flatnonzero(np.diff(step, prepend=step[:1]) > 0)
    stamps = np.array(sorted(poses))
    near = stamps[np.clip(np.searchsorted(stamps, way[at, 0].astype(np.int64)), 0, len(stamps) - 1)]
    placed = [corrected(poses[stamp], smoothed) for stamp in near.tolist()]
    rows = empty(len(placed))
    heading = np.array([pose.heading_rad for pose in placed])
    rows["stamp_ns"], rows["heading_rad"], rows["distance_m"] = near, heading, EVERY_M
    rows["x_m"] = [pose.x_m for pose in placed] + ahead_m * np.cos(heading)
    rows["y_m"] = [pose.y_m for pose in placed] + ahead_m * np.sin(heading)
    covariance = np.array([pose.covariance_m2 for pose in placed])
    for name, (i, j) in {"cov_xx_m2": (0, 0), "cov_xy_m2": (0, 1), "cov_yy_m2": (1, 1)}.items():
        rows[name] = covariance[:, i, j]
    for name in ("c_rr", "c_rr_var", "grade_e", "grade_n", "grade_var"):
        rows[name] = np.nan
    return rows


def _segments(beliefs: list[Belief]) -> tuple[Ints, Segments]:
    """Stamps, and the filter's columns of `Nodes`."""
    stamps = np.array([belief.stamp_ns for belief in beliefs], np.int64)
    x, P = np.array([belief.x for belief in beliefs]), np.array([belief.P for belief in beliefs])
    pasts = [belief.past for belief in beliefs[1:]]
    Phi, a, info = (
        np.array([getattr(past, name) for past in pasts]) for name in ("transition", "adjoint", "information")
    )
    before, one = P[:-1], np.eye(P.shape[1])
    inverse = np.linalg.inv(one - before @ info)
    A, J = Phi @ inverse, info @ inverse
    W = P[1:] - A @ (before - before @ info @ before) @ A.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh((W + W.transpose(0, 2, 1)) / 2)
    W = (vectors * np.maximum(values, 0)[:, None]) @ vectors.transpose(0, 2, 1)
    j, shift = np.einsum("kji,kj->ki", inverse, a), np.einsum("kij,kj->ki", before, a)
    symmetric = (J + J.transpose(0, 2, 1)) / 2
    return stamps, (x, P, A, W, symmetric, j, shift)
