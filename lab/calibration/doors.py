"""The same drive by two inputs: readings in bundles, and receiver bytes with the rest in bundles.

The host clock and link delays are simulated, without wall clock. Bytes pass an agent's framer, decoders and time base;
maps come from the server's calibration, fold and read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from agents.drivers import Observed
from agents.drivers.line import Line
from agents.drivers.sources import Sources
from agents.drivers.time_base import TimeBase
from agents.estimation.ground import EstimationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from lab.calibration.cases import Rows, Tampered
from lab.calibration.drives import Scene, all_samples
from lab.calibration.solving import judged, served
from lab.campaign.experiment import Experiment, Runner, Task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.campaign.summary import column, mean, summary
from protocol.machine.readings import Reading, columns
from sim.config import SimConfig
from sim.receivers.receiver import SimulatedReceiver, carried, wire
from sim.sensors.rigs import Rig
from sim.simulator import Simulator
from sim.truth import save_tracks
from sitegrid.proof.figures import Report, Row, root_mean_square, rounded
from sitegrid.proof.tracks import read_load_track

MACHINES = 3
BOOT_NS = 5_000 * 10**9  # host's monotonic clock at the start
LATE_S = 0.004  # mean link delay of 50 ms of bytes
DIGITS = 4


@dataclass(frozen=True)
class Door:
    """A receiver format."""

    name: str


DOORS = Door("ubx"), Door("nmea")


@dataclass(frozen=True)
class Compared:
    """One seed, by (bundles, bytes). rmse_m: smoothed positions. wrong_pct: driven cells."""

    rmse_m: tuple[float, float]
    wrong_pct: tuple[float, float]
    readings: tuple[int, int]


def run(runner: Runner, seeds: Sequence[int], seconds: float) -> tuple[Report, list[Compared]]:
    """A row per format: means over seeds, and their ratios."""
    tasks = [Task(door, seed, seconds) for seed in seeds for door in DOORS]
    results = runner.run(EXPERIMENT, tasks)
    rows = [_row(door, results[i :: len(DOORS)]) for i, door in enumerate(DOORS)]
    report = {"seeds": list(seeds), "seconds": seconds, "rows": rows, "goals": judge(goals("doors"), rows)}
    return report, results


def _row(door: Door, results: Sequence[Compared]) -> Row:
    names = "rmse_m", "wrong_pct", "readings"
    by_seed = [
        {f"{name}{end}": getattr(result, name)[i] for name in names for i, end in enumerate(("", "_through"))}
        for result in results
    ]
    ratios = {f"{n}_ratio": mean(column(by_seed, f"{n}_through")) / mean(column(by_seed, n)) for n in names[:2]}
    return rounded({**summary({"format": door.name}, by_seed), **ratios}, DIGITS)


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[Door], _: Path) -> Compared:
    """Drive, and make both maps."""
    format_ = task.variant.name
    config = SimConfig(
        "paper_site", world="fast", machines=MACHINES, seed=task.seed, seconds=task.seconds, receivers=format_
    )
    with closing(Simulator(config)) as simulator:
        rigs = simulator.scenario.rigs()
        spans = [simulator.advance() for _ in range(simulator.bundles or 0)]
        true = _scene(simulator, rigs)
    read: tuple[dict[str, Sequence[Reading]], ...] = ({}, {})
    for rig in rigs:
        own = [span[rig.machine.name] for span in spans]
        read[0][rig.machine.name] = [reading for span in own for reading in span]
        read[1][rig.machine.name] = through(rig, format_, own, task.seed)
    rows = [{rig.machine.name: _samples(simulator, rig, by[rig.machine.name]) for rig in rigs} for by in read]
    rmse_m, wrong_pct = zip(*(_judged(each, true) for each in rows), strict=True)
    counts = tuple(sum(map(len, by.values())) for by in read)
    return Compared(rmse_m, wrong_pct, (counts[0], counts[1]))


def through(rig: Rig, format_: str, spans: Sequence[Sequence[Reading]], seed: int) -> list[Reading]:
    """An agent's readings from a machine's receivers, span by span with link delay."""
    wirings, draw = wire(rig, format_), np.random.default_rng(seed)
    lines = [(SimulatedReceiver(wiring), Line(format_, wiring.feeds)) for wiring in wirings]
    pieces, first_ns = [], spans[0][0].stamp_ns
    for span in filter(None, spans):
        host_ns = BOOT_NS + span[-1].stamp_ns - first_ns + round(draw.exponential(LATE_S) * 1e9)
        pieces.append([value for receiver, line in lines for value in line.feed(receiver.speak(span), host_ns)])
        pieces[-1] += [_bundled(reading, host_ns) for reading in span if reading.sensor not in carried(wirings)]
    driver, readings = Sources({"drive": _Played(pieces)}, TimeBase()), list[Reading]()
    with closing(driver):
        while (piece := driver.read(1.0)) is not None:
            readings += piece
    return readings


def _bundled(reading: Reading, host_ns: int) -> Observed:
    values = tuple(getattr(reading, name) for name in columns(reading.kind))
    return Observed(reading.sensor, reading.kind, values, host_ns, reading.stamp_ns)


class _Played:
    """A source of these pieces."""

    def __init__(self, pieces: Sequence[Sequence[Observed]]) -> None:
        self._pieces = iter(pieces)

    def read(self, timeout_s: float) -> Sequence[Observed] | None:  # noqa: ARG002 - nothing is waited for
        return next(self._pieces, None)

    def counters(self) -> Mapping[str, int]:
        return {}

    def problems(self) -> Sequence[str]:
        return ()

    def close(self) -> None:
        pass


def _scene(simulator: Simulator, rigs: Sequence[Rig]) -> Scene:
    with TemporaryDirectory() as folder:
        save_tracks(Path(folder), simulator.tracks())
        machines = [rig.machine for rig in rigs]
        tracks = {m.name: read_load_track(Path(folder) / f"{m.name}.csv", m.load_centre_m) for m in machines}
    return Scene(simulator.truth_map, tracks)


def _samples(simulator: Simulator, rig: Rig, readings: Sequence[Reading]) -> np.ndarray:
    options = PipelineConfig(estimation=EstimationConfig(closed_tours=True))
    return np.asarray(all_samples(Pipeline(simulator.site, rig.machine, options), readings).final)


def _judged(rows: Rows, true: Scene) -> tuple[float, float]:
    off_m = [
        np.stack([table["x_m"], table["y_m"]], axis=1) - true.tracks[name].at(table["stamp_ns"]).place_m
        for name, table in rows.items()
    ]
    off = np.hypot(*np.concatenate(off_m).T)
    wrong = judged(served(rows), Tampered(rows, true.truth.c_rr), true).figures["wrong_pct"]
    return root_mean_square(off[np.isfinite(off)]), wrong if math.isfinite(wrong) else math.nan


EXPERIMENT = Experiment("doors", Compared, _solve)
