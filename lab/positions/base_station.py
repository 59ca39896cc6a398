"""What a base station brings: the same drives with its corrections and without, also those of a base that fails.

The fixes of recordings are made anew, so that machine and base share a part of their slow errors. The base runs as an
agent would run it, on fixes of its own; a link holds up its corrections. It has stood there for an hour when the
machine starts, unless it is new.

Poses as they are known at once are judged, so nothing is smoothed. One task is all the cases of a drive with one share:
they are one recording, and up to where a base fails one run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import cache as cache_calls
from pathlib import Path

import numpy as np

from agents.base_station import BaseStation
from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig, Positioning
from lab.campaign.experiment import Experiment, Runner, Task, replay_task
from lab.campaign.recordings import MACHINES_PROTOCOL, PlannedDrive
from lab.positions.substitution import GpsErrors, gps_errors, true_motion, with_gps_errors
from lab.positions.table import paired_ratio, values
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Correction, Gps, Reading
from protocol.site.site_config import Projection, SiteConfig
from sim.sensors.presets import GpsNoise, load_preset
from sim.sensors.rigs import base_config
from sim.simulator import START_NS
from sitegrid.logs.replay import STEP_NS, Score, Trace, continued, replay, score
from sitegrid.logs.sensors import select
from sitegrid.proof.figures import Goal, Report, Row, judge, rounded
from sitegrid.proof.tracks import Truth

SHARES = (0.0, 0.8, 0.95)
STOOD_S = 3600  # how long a base that is not new has stood there
LINK_S = 0.3  # from the base to the machine
PLACE_M = (60.0, 60.0)
NUMBER = 1000  # of the base among the machines of its site: another one's errors
JUMP_M = 5.0
SOURCES = (
    "agents",
    *MACHINES_PROTOCOL,
    "sim/sensors",
    *(f"lab/positions/{part}.py" for part in ("base_station", "configurations", "replay", "substitution")),
)
# What happens to the base: there is none, all is well, it has just begun, it is surveyed so many metres wrong; and from
# the middle of the drive on: silence, corrections of the first half again, one of them over and over, a jump.
LINK_FAULTS = ("dies", "repeats", "sticks")
FAULTS = (*LINK_FAULTS, "jumps")
CASES = ("none", "good", "new", "off_1m", "off_2m", "off_5m", "new_off_5m", *FAULTS)


@dataclass(frozen=True)
class BaseCase:
    """One row: how much of the slow variance the site has in common, and what happens to the base."""

    site_share: float
    case: str

    @property
    def at_base(self) -> BaseCase:
        """The case as the base itself has it: its link alone may fail."""
        return replace(self, case="good") if self.case in LINK_FAULTS else self

    @property
    def survey_off_m(self) -> float:
        """How far east of the true place the base is surveyed."""
        return float(self.case.rpartition("_")[2].removesuffix("m")) if "off_" in self.case else 0.0

    @property
    def stood_s(self) -> int:
        """How long the base has stood there when the machine starts."""
        return 0 if self.case.startswith("new") else STOOD_S


@dataclass(frozen=True)
class BaseRun(Score):
    """A score; used, gated: corrections that the filter took and refused. share: what the machine made of the base."""

    used: int
    gated: int
    share: float


@dataclass(frozen=True)
class SharedSite:
    """All rows of one share."""

    site_share: float

    @property
    def name(self) -> str:
        """A name for files."""
        return f"share{self.site_share:g}"

    @property
    def rows(self) -> list[BaseCase]:
        """The row without a base is the first."""
        return [row for row in ROWS if row.site_share == self.site_share]


@dataclass(frozen=True)
class BaseRuns:
    """The fields of a `BaseRun` of every case, by its name."""

    cases: dict[str, dict[str, float]]


ROWS = [BaseCase(0.0, "none"), BaseCase(0.0, "good")]
ROWS += [BaseCase(share, case) for share in SHARES[1:] for case in CASES]
GOALS = [
    Goal({"site_share": 0.0, "case": "good"}, "ratio", "<=", 1.03),
    Goal({"site_share": 0.8, "case": "good"}, "ratio", "<=", 0.75),
    Goal({"site_share": 0.95, "case": "good"}, "ratio", "<=", 0.55),
    *(Goal({"case": case}, "ratio", "<=", 1.03) for case in ("off_5m", "new_off_5m", *FAULTS)),
    *(Goal({"case": case}, "ratio", "<=", 1.1) for case in ("off_1m", "off_2m")),
    *(Goal({"case": case}, "coverage95", ">=", 0.9) for case in ("good", "off_1m", "off_2m")),
]


def run(runner: Runner, seeds: Sequence[int], seconds: float) -> tuple[Report, list[BaseRuns]]:
    """Record, replay and score every row with all seeds."""
    sites = [SharedSite(share) for share in SHARES]
    tasks = [replay_task(site, PlannedDrive(seed, seconds)) for seed in seeds for site in sites]
    runs = runner.run(EXPERIMENT, tasks)
    of_row: dict[BaseCase, list[BaseRun]] = {row: [] for row in ROWS}
    for task, several in zip(tasks, runs, strict=True):
        for row in task.variant.rows:
            of_row[row].append(BaseRun(**several.cases[row.case]))  # type: ignore[arg-type]  # counts are whole
    rows = [_summarise(row, several, of_row[BaseCase(row.site_share, "none")]) for row, several in of_row.items()]
    report: Report = {"seeds": list(seeds), "seconds": seconds, "gps": 1, "link_s": LINK_S, "stood_s": STOOD_S}
    return {**report, "rows": rows, "goals": judge(GOALS, rows)}, runs


def _summarise(row: BaseCase, runs: Sequence[BaseRun], without: Sequence[BaseRun]) -> Row:
    net, alone = values(runs, "net_m"), values(without, "net_m")
    ratio, half = paired_ratio(net, alone)
    return rounded(
        {
            "site_share": row.site_share,
            "case": row.case,
            "net_m": float(net.mean()),
            "ratio": ratio,
            "ci95": half,
            "worst_ratio": float((net / alone).max()),
            "coverage95": float(values(runs, "coverage95").mean()),
            "nees": float(values(runs, "nees").mean()),
            "share_found": float(values(runs, "share").mean()),
            "used": int(values(runs, "used").sum()),
            "gated": int(values(runs, "gated").sum()),
            "us_per_second": round(float(values(runs, "us_per_second").mean())),
            "net_by_seed_m": net.tolist(),
        },
        4,
        nees=3,
    )


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[SharedSite], cache: Path) -> BaseRuns:
    """Replay one drive without a base and with all that one may be."""
    share, recording = task.variant.site_share, task.recording(cache)
    assert task.drive
    preset = load_preset(task.drive.preset)
    noise = replace(preset.gps, site_share=share, machine_share=share)
    until_ns = recording.readings[-1].stamp_ns
    # Of all rows the errors are those from STOOD_S on, so that they are paired.
    errors = _later(gps_errors(recording.machine, noise, task.seed, until_ns + STOOD_S * 10**9))
    recording = with_gps_errors(recording, true_motion(task.drive.folder(cache)), errors)
    machine = select(recording.machine, gps=1, imu=1)
    readings = [r for r in recording.readings if (sensor := machine.sensor(r.sensor)) and sensor.use]
    config = PipelineConfig(localisation=LocalisationConfig(lag_s=0.0))
    trace = replay(alone := Positioning(recording.site, machine, config), readings)
    cases = {"none": _run(trace, alone, recording.truth)}

    base = base_config("base", replace(preset, gps=noise))
    machine = replace(machine, sensors=(*machine.sensors, SensorConfig(base.name, Correction.kind)))
    off = _later(gps_errors(base, noise, task.seed, until_ns + STOOD_S * 10**9, NUMBER))[base.sensors[0].name]
    middle_ns = START_NS + round(task.seconds * 5e8) // STEP_NS * STEP_NS
    published = cache_calls(lambda row: corrections(recording.site, base, noise, off, row, middle_ns))
    heard = {
        row: arrivals(readings, list(failing(published(row.at_base), row.case, middle_ns)), LINK_S)
        for row in task.variant.rows[1:]
    }
    core = Positioning(recording.site, machine, config)
    for row, trace, positioning in _traces(core, heard, middle_ns):
        cases[row.case] = _run(trace, positioning, recording.truth)
    return BaseRuns({case: asdict(run) for case, run in cases.items()})


def _traces(
    core: Positioning, heard: Mapping[BaseCase, Sequence[Reading]], middle_ns: int
) -> Iterator[tuple[BaseCase, Trace, Positioning]]:
    """Replay what is heard in each case; up to the middle once, where the base is good until then."""
    good = next(mixed for row, mixed in heard.items() if row.case == "good")
    first = good[: _until(good, middle_ns)]
    halfway = deepcopy(core)
    before = replay(halfway, first)
    for row, mixed in heard.items():
        if row.case in ("good", *FAULTS):
            positioning = deepcopy(halfway)
            yield row, continued(before, replay(positioning, mixed[len(first) :])), positioning
        else:
            positioning = deepcopy(core)
            yield row, replay(positioning, mixed), positioning


def _run(trace: Trace, positioning: Positioning, truth: Truth) -> BaseRun:
    counters, state = positioning.counters, positioning.localiser.base_report()
    used, gated, share = counters["base_used"], counters["base_gated"], state["share"] if state else 0.0
    return BaseRun(**vars(score(trace, truth)), used=used, gated=gated, share=share)


def _until(arriving: Sequence[Reading], stamp_ns: int) -> int:
    """How many come before the machine's own first reading at a stamp or after it."""
    own = (i for i, r in enumerate(arriving) if not isinstance(r, Correction) and r.stamp_ns >= stamp_ns)
    return next(own, len(arriving))


def corrections(
    site: SiteConfig, base: MachineConfig, noise: GpsNoise, errors: GpsErrors, row: BaseCase, middle_ns: int
) -> list[Correction]:
    """What a base publishes from the start of a drive on. errors: of its receiver. middle_ns: when it would jump."""
    projection, (receiver,) = Projection(site), base.sensors
    begun = errors.stamp_ns >= START_NS - row.stood_s * 10**9
    seconds = (errors.stamp_ns - START_NS) * 1e-9
    heard = begun & (seconds % noise.outage_period_s >= noise.outage_s)
    off_m = errors.total_m.copy()
    if row.case == "jumps":
        off_m[errors.stamp_ns >= middle_ns, 0] += JUMP_M
    places = projection.to_geodetic_many(*(np.array([*PLACE_M, 0.0]) + off_m).T)
    stated = errors.stated_m2.tolist()
    surveyed = PLACE_M[0] + row.survey_off_m, PLACE_M[1]
    station = BaseStation(base.name, base.sensors, surveyed, projection)
    fixes = zip(errors.stamp_ns[heard].tolist(), places.T[heard].tolist(), strict=True)
    made = station.step([Gps(receiver.name, stamp, *place, *stated) for stamp, place in fixes])
    return [correction for correction in made if correction.stamp_ns > START_NS]


def failing(made: Sequence[Correction], case: str, middle_ns: int) -> Iterator[Correction]:
    """The corrections of a base that fails at a stamp, which is as long after the first one as before the last one."""
    first = [c for c in made if c.stamp_ns < middle_ns]
    yield from first
    for i, correction in enumerate(made[len(first) :]):
        if case == "repeats":
            yield replace(first[i % len(first)], stamp_ns=correction.stamp_ns)
        elif case == "sticks":
            yield replace(first[-1], stamp_ns=correction.stamp_ns)
        elif case != "dies":
            yield correction


def arrivals(readings: Sequence[Reading], made: Sequence[Correction], link_s: float) -> list[Reading]:
    """Readings and corrections in the order in which they come to a machine, from its first reading on."""
    link_ns = round(link_s * 1e9)

    def at_ns(reading: Reading) -> int:
        return reading.stamp_ns + (link_ns if isinstance(reading, Correction) else 0)

    return sorted([*readings, *(c for c in made if at_ns(c) > readings[0].stamp_ns)], key=at_ns)


def _later(errors: dict[str, GpsErrors]) -> dict[str, GpsErrors]:
    """Errors as if the simulation had begun STOOD_S earlier."""
    return {name: replace(e, stamp_ns=e.stamp_ns - STOOD_S * 10**9) for name, e in errors.items()}


EXPERIMENT = Experiment("base", BaseRuns, SOURCES, _solve)
