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

from agents.localisation.filters.belief import Belief, Conditioned, Filter, Measurement, Motion
from agents.localisation.filters.smoother import NODE_NS
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import Samples, joined
from lab.campaign.experiment import Experiment, Task
from protocol.arrays import Floats, Ints, Table
from protocol.machine.log_folder import open_log
from protocol.machine.machine_config import MachineConfig
from sim.recorder import TRACKS_FOLDER
from sitegrid.proof.tracks import read_track

TAKEN = 10  # readings per step: some hundredths of a second


Segments = tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats]  # x, P, A, W, J, j, shift


@dataclass(frozen=True)
class Nodes:
    """Beliefs at n nodes, and the readings' information between them.

    stamp_ns: (n,). x: (n, s), P: (n, s, s). A, W, J: (n - 1, s, s), j, shift: (n - 1, s), shift = P a. true_m: (n, 2)
    position. way_ns: (k,), way: (k, 3) by dead reckoning: x, y [m], angle [rad]. rows: final samples, felt: pending
    ones, whose slopes the agent uses. ahead_m: of the load centre.
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
    felt: Table
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
    """The filter's nodes and the samples of one recorded machine."""
    log = open_log(folder / "logs" / who.machine)
    machine = with_receivers(log.machine, who.receivers)
    pipeline = Pipeline(log.site, machine, PipelineConfig())
    core = pipeline.positioning
    watched = core.localiser.engine = _Watched(core.localiser.engine)
    readings = list(log.readings())
    way: list[tuple[int, float, float, float]] = []
    made: list[Samples] = []
    for first in range(0, len(readings), TAKEN):
        made.append(pipeline.step(readings[first : first + TAKEN]))
        at = core.dead_reckoning.pose
        if core.pose and (not way or at.stamp_ns > way[-1][0]):
            way.append((at.stamp_ns, at.x_m, at.y_m, at.angle_rad))
    made.append(pipeline.finish())
    pending, final = joined(made)
    stamps, segments = _segments([watched.noted[key] for key in sorted(watched.noted)])
    truth = read_track(folder / "truth" / TRACKS_FOLDER / f"{who.machine}.csv")
    way_ns, track = np.array([at[0] for at in way], np.int64), np.array(way)[:, 1:]
    return Nodes(stamps, *segments, truth.at(stamps), way_ns, track, final, pending, machine.load_centre_m)


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
