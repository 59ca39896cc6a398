"""The error budget: what each kind of error costs, shown by drives without it.

Each row replays the same drives with the truth in place of what one kind of sensor read, or of several, and compares
its position error with that of the drives as they are. The filter must expect what it gets, or its caution hides the
gain: what a sensor is worth is said in its configuration; how far machines slip and headings drift are constants of the
filter, no options of an agent, and are set for the time of a replay, in the process of a worker.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from agents.localisation import alignment, measurements
from agents.localisation.filters import motion as motion_model
from agents.positioning import PipelineConfig, Positioning
from lab.campaign.experiment import Experiment, Runner, Task, replay_task
from lab.campaign.recordings import MACHINES_PROTOCOL, PAPER, PlannedDrive, RecordedDrive, Setup
from lab.positions.configurations import Configuration
from lab.positions.substitution import (
    TrueMotion,
    gps_errors,
    true_motion,
    with_gps_errors,
    with_true_turn,
    with_true_wheels,
    without_side_slip,
    without_slow_errors,
)
from lab.positions.table import paired_ratio, values
from protocol.machine.machine_config import MachineConfig
from sitegrid.logs.replay import Score, replay, score
from sitegrid.logs.sensors import select
from sitegrid.proof.figures import Report, Row, half_width, rounded

RECEIVERS = (1, 2)
SOURCES = (
    "agents",
    *MACHINES_PROTOCOL,
    *(f"lab/positions/{part}.py" for part in ("budget", "configurations", "replay", "consistency")),
    "lab/positions/substitution.py",
)
Constants = tuple[tuple[ModuleType, str, float], ...]
Substitution = Callable[[RecordedDrive, TrueMotion, PlannedDrive], RecordedDrive]


def _without_slow_gps(recording: RecordedDrive, motion: TrueMotion, drive: PlannedDrive) -> RecordedDrive:
    """The recording with the white noise of its own fixes alone."""
    noise = drive.scenario.preset(drive.preset).gps
    errors = gps_errors(recording.machine, noise, drive.seed, int(motion.stamp_ns[-1]))
    return with_gps_errors(recording, motion, without_slow_errors(errors))


@dataclass(frozen=True)
class Truth:
    """The truth in place of one kind of error.

    substitute: puts it into a recording. sensors: options of the sensors of a kind then. constants: what the filter
    expects then.
    """

    substitute: Substitution
    sensors: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    constants: Constants = ()


TRUTHS = {
    # Wheels that never slip need no torque: without it the filter neither corrects the speed nor expects slip.
    "wheels": Truth(
        lambda recording, motion, _: with_true_wheels(recording, motion),
        sensors={"encoder": {"std": {"speed": 0.01}}, "torque": {"use": False}},
        constants=(
            (motion_model, "SLIP_ALONG", 0.003),
            (motion_model, "WHEEL_SCALE_WALK", 1e-6),
            (alignment, "WHEEL_SCALE", 0.002),
        ),
    ),
    "turn rate": Truth(
        lambda recording, motion, _: with_true_turn(recording, motion),
        sensors={"imu": {"std": {"rate": 0.001}}},
        constants=(
            (motion_model, "HEADING_WALK", 1e-5),
            (motion_model, "GYRO_BIAS_WALK", 1e-8),
            (alignment, "GYRO_BIAS_RADPS", 1e-5),
        ),
    ),
    "side slip": Truth(
        lambda recording, motion, _: without_side_slip(recording, motion),
        constants=((motion_model, "SLIP_ACROSS", 0.003), (measurements, "SIDE_MPS", 0.01)),
    ),
    "slow GPS error": Truth(_without_slow_gps, sensors={"gps": {"drift_share": 0.0}}),
}
ROWS = (
    (),
    *((name,) for name in TRUTHS),
    ("wheels", "turn rate"),
    ("wheels", "turn rate", "side slip"),
)


@dataclass(frozen=True)
class BudgetRow:
    """One row: receivers in use, and what the truth stands in for."""

    gps: int
    truth: tuple[str, ...]

    @property
    def name(self) -> str:
        """Short and unique, for files."""
        return f"{self.gps}gps-{'-'.join(self.truth).replace(' ', '_') or 'as_it_is'}"


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, setup: Setup = PAPER
) -> tuple[Report, dict[BudgetRow, list[Score]]]:
    """Record, replay and score all rows with all seeds; ratios are to the same drives as they are."""
    drives = [PlannedDrive(seed, seconds, setup.preset, setup) for seed in seeds]
    rows = [BudgetRow(gps, truth) for gps in RECEIVERS for truth in ROWS]
    pairs = [(drive, row) for drive in drives for row in rows]
    done = runner.run(EXPERIMENT, [replay_task(row, drive) for drive, row in pairs])
    scores = {row: [one for (_, own), one in zip(pairs, done, strict=True) if own == row] for row in rows}
    table = [_summary(row, scores[row], scores[BudgetRow(row.gps, ())]) for row in rows]
    return {"scenario": setup.scenario, "seeds": list(seeds), "seconds": seconds, "rows": table}, scores


def _summary(row: BudgetRow, scores: Sequence[Score], as_it_is: Sequence[Score]) -> Row:
    """Means over the seeds, and ratios to the drives as they are, of live and of smoothed poses."""
    net, smoothed = values(scores, "net_m"), values(scores, "smoothed_net_m")
    ratio, ratio_ci95 = paired_ratio(net, values(as_it_is, "net_m"))
    smoothed_ratio, smoothed_ci95 = paired_ratio(smoothed, values(as_it_is, "smoothed_net_m"))
    summary = {
        "gps": row.gps,
        "truth": ", ".join(row.truth) or "none",
        "net_m": float(net.mean()),
        "ci95_m": half_width(net),
        "ratio": ratio,
        "ratio_ci95": ratio_ci95,
        "coverage95": float(values(scores, "coverage95").mean()),
        "nees": float(values(scores, "nees").mean()),
        "smoothed_net_m": float(smoothed.mean()),
        "smoothed_ratio": smoothed_ratio,
        "smoothed_ratio_ci95": smoothed_ci95,
        "net_by_seed_m": net.tolist(),
    }
    return rounded(summary, 3)


# --- in the worker processes -----------------------------------------------------------------------------------------


def configured(machine: MachineConfig, truth: Sequence[str]) -> MachineConfig:
    """The machine as its agent is to know it with the truth in place of these errors."""
    sensors = machine.sensors
    for name in truth:
        sensors = tuple(replace(sensor, **TRUTHS[name].sensors.get(sensor.kind, {})) for sensor in sensors)
    return replace(machine, sensors=sensors)


@contextmanager
def constants(values: Constants) -> Iterator[None]:
    """Set constants of modules, and put them back; what modules have cached of them is forgotten both times."""
    before = [(module, name, getattr(module, name)) for module, name, _ in values]
    try:
        _set(values)
        yield
    finally:
        _set(before)


def _set(values: Sequence[tuple[ModuleType, str, float]]) -> None:
    for module, name, value in values:
        setattr(module, name, value)
        for function in vars(module).values():
            if hasattr(function, "cache_clear"):
                function.cache_clear()


def substituted(
    recording: RecordedDrive, motion: TrueMotion, drive: PlannedDrive, truth: Sequence[str]
) -> RecordedDrive:
    """The recording with the truth in place of these errors, one after the other."""
    for name in truth:
        recording = TRUTHS[name].substitute(recording, motion, drive)
    return recording


def _replay(task: Task[BudgetRow], cache: Path) -> Score:
    """Run one row on one recording."""
    drive, truth = task.drive, task.variant.truth
    assert drive
    recording = substituted(task.recording(cache), true_motion(drive.folder(cache)), drive, truth)
    machine = configured(select(recording.machine, task.variant.gps, 1), truth)
    options: PipelineConfig = Configuration("ukf", task.variant.gps, 1, "default").options
    in_use = {sensor.name for sensor in machine.sensors if sensor.use}
    readings = [reading for reading in recording.readings if reading.sensor in in_use]
    with constants(tuple(constant for name in truth for constant in TRUTHS[name].constants)):
        return score(replay(Positioning(recording.site, machine, options), readings), recording.truth)


EXPERIMENT = Experiment("budget", Score, SOURCES, _replay)
