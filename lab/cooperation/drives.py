"""Drives and arms of the comparison: machines, links, and one deviating machine.

Four tours of the paper's site, driven in turn by one machine or by up to eight at once. All share one stretch in one
direction, so a lone machine drives them as one closed loop without detour; its extra time is what the others would
drive.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lab.calibration.drives import spoiled
from lab.campaign.recordings import PlannedDrive, RecordedDrive, Setup, toml_of
from lab.positions.substitution import TrueMotion, gps_errors, with_gps_errors
from protocol.arrays import Floats
from protocol.machine.log_folder import open_log, write_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, Reading
from sim.operators.routes import Corners, Leg, Route, tour
from sim.recorder import TRACKS_FOLDER
from sim.scenario.file import load_scenario
from sim.scenario.ground import GroundConfig, Point
from sim.scenario.tables import ScheduledChange
from sim.sensors.presets import load_preset
from sitegrid.proof.tracks import read_track
from tests.tcp_proxy import FAIR, Weather

SITE = "paper_site"
SHARED: Corners = ((96, 50), (96, 82))  # the shared stretch
# Corners beyond the stretch: concrete and gravel, sand, the slope in dry dirt, the slope in wet dirt.
TOURS: dict[str, Corners] = {
    "west": ((82, 88), (44, 84), (26, 66), (24, 30), (38, 15), (80, 16), (90, 28)),
    "north": ((98, 112), (84, 130), (40, 134), (18, 118), (20, 98), (34, 72), (56, 52), (82, 38)),
    "south": ((112, 88), (164, 82), (184, 66), (182, 38), (164, 20), (112, 16), (101, 28)),
    "east": ((102, 110), (118, 132), (166, 132), (186, 116), (182, 96), (168, 72), (138, 54), (110, 38)),
}
ROUNDING_M = 7.0
DRIVE_MPS = 4.0
# Repaved ground: around the shared stretch, and on one tour alone.
REPAVED: dict[str, tuple[Point, ...]] = {
    "shared": ((82, 46), (112, 46), (112, 84), (82, 84)),
    "west": ((14, 28), (36, 28), (36, 62), (14, 62)),
}
PAVED_WITH = {"shared": "dry concrete", "west": "gravel"}


@dataclass(frozen=True)
class Crew:
    """Machines of one model. tours: assigned in turn, each a sequence of tours."""

    name: str
    count: int
    tours: tuple[tuple[str, ...], ...]
    model: str = "wheel_loader"


EACH = tuple((name,) for name in TOURS)
EIGHT = (Crew("loader", 8, EACH),)
TWO = (Crew("loader", 2, (("west", "north"), ("south", "east"))),)
ONE = (Crew("loader", 1, (tuple(TOURS),)),)
FOUR = (Crew("loader", 4, EACH),)
MIXED = (Crew("loader", 2, EACH[::2]), Crew("truck", 2, EACH[1::2], "dump_truck"))


@dataclass(frozen=True)
class SharedDrive(PlannedDrive):
    """Machines that start together. repaves: ground is repaved at half time."""

    crews: tuple[Crew, ...] = FOUR
    repaves: bool = False

    @property
    def scenario_toml(self) -> str:
        """Scenario file."""
        tours = dict.fromkeys(names for crew in self.crews for names in crew.tours)
        tables = [toml_of({"base": self.setup.scenario, "world": self.setup.world})]
        for names in tours:
            route = {"name": "-".join(names), "corners": corners(names), "rounding_m": ROUNDING_M}
            tables.append(f"[[route]]\n{toml_of(route)}")
        for crew in self.crews:
            routes = ["-".join(names) for names in crew.tours]
            fleet = {"name": crew.name, "count": crew.count, "model": crew.model, "routes": routes, "payload": False}
            tables.append(f"[[fleet]]\n{toml_of({**fleet, 'preset': self.preset, 'drive_mps': DRIVE_MPS})}")
        tables += [f"[[change]]\n{toml_of(vars(change))}" for change in self.changes.values()]
        return "\n\n".join(tables) + "\n"

    @property
    def changes(self) -> dict[str, ScheduledChange]:
        """Repaved ground by name."""
        if not self.repaves:
            return {}
        return {name: ScheduledChange(self.seconds / 2, PAVED_WITH[name], outline) for name, outline in REPAVED.items()}

    @property
    def machines(self) -> tuple[str, ...]:
        """Names in the simulator's order."""
        return tuple(f"{crew.name}-{i + 1}" for crew in self.crews for i in range(crew.count))

    @property
    def tours(self) -> dict[str, tuple[str, ...]]:
        """Tours by machine."""
        turns = [crew.tours[i % len(crew.tours)] for crew in self.crews for i in range(crew.count)]
        return dict(zip(self.machines, turns, strict=True))

    @property
    def ground(self) -> GroundConfig:
        """Ground before repaving."""
        return load_scenario(self.setup.scenario).ground


def planned(
    seed: int, seconds: float, crews: tuple[Crew, ...], world: str | None, *, repaves: bool = False
) -> SharedDrive:
    """A drive with the scenario's sensors."""
    return SharedDrive(seed, seconds, "dgps", Setup(SITE, (), (), (), world=world), crews, repaves)


def corners(names: Sequence[str]) -> Corners:
    """Corners of consecutive tours, starting far from the shared stretch, where starts would collide."""
    whole = [point for name in names for point in (*SHARED, *TOURS[name])]
    begin = 2 + len(TOURS[names[0]]) // 2
    return (*whole[begin:], *whole[:begin])


def lines() -> dict[str, Leg]:
    """Line of each tour."""
    return {name: _leg(tour(corners((name,)), ROUNDING_M)) for name in TOURS}


def length_m(names: Sequence[str]) -> float:
    """Length of one round."""
    return tour(corners(names), ROUNDING_M).length_m


def _leg(route: Route) -> Leg:
    (leg,) = route.legs
    return leg


def points(leg: Leg) -> Floats:
    """A closed line (k, 2), last point equal to the first."""
    return np.vstack([leg.points, leg.points[:1]])


# --- arms -------------------------------------------------------------------------------------------------------------


OUTAGE_S, PERIOD_S = 60.0, 300.0  # one minute in five
KBIT_PER_S = 300.0
BAD, STANDALONE = "bad", "standalone"
SPEED = 8.0  # of replays: two cores run four agents at 15 times real time


@dataclass(frozen=True)
class Link:
    """Link of each machine, in the log's time. outage_s: per period_s, machines in turn.

    kbit_per_s: in each direction, 0: unlimited.
    """

    name: str
    outage_s: float = 0.0
    kbit_per_s: float = 0.0

    def weather(self, turn: int, time_s: float, speed: float) -> Weather:
        """Link quality for the machine of this turn at a log time, replayed at `speed`."""
        if self.outage_s and (time_s - turn * OUTAGE_S) % PERIOD_S >= PERIOD_S - self.outage_s:
            return Weather(cut=True)
        return Weather(bytes_per_s=speed * self.kbit_per_s * 1000 / 8) if self.kbit_per_s else FAIR


ALWAYS, LOST, SLOW = Link("always"), Link("lost", outage_s=OUTAGE_S), Link("slow", kbit_per_s=KBIT_PER_S)


@dataclass(frozen=True)
class Arm:
    """An arm. crews: of the recording; its first `machines` take part.

    seconds: of the recording. spoiled: the last machine's defect, BAD or STANDALONE. speed: of the replay.
    """

    name: str
    crews: tuple[Crew, ...]
    machines: int
    seconds: float
    speed: float
    link: Link = ALWAYS
    spoiled: str = ""
    repaves: bool = False
    world: str | None = None

    def drive(self, seed: int) -> SharedDrive:
        """Its recording."""
        return planned(seed, self.seconds, self.crews, self.world, repaves=self.repaves)

    def names(self, drive: SharedDrive) -> tuple[str, ...]:
        """Participants."""
        return drive.machines[: self.machines]


def arms(whole_s: float, world: str | None = None) -> tuple[Arm, ...]:
    """All arms. whole_s: a lone machine's recording, at least three rounds of all tours.

    Two machines drive 3/5 of it, more machines 9/20: at least six rounds of one tour each.
    """
    four = Arm("four", EIGHT, 4, 0.45 * whole_s, SPEED, world=world)
    return (
        Arm("one", ONE, 1, whole_s, SPEED, world=world),
        Arm("two", TWO, 2, 0.6 * whole_s, SPEED, world=world),
        four,
        replace(four, name="eight", machines=8, speed=SPEED / 2),
        replace(four, name="lost", link=LOST),
        replace(four, name="slow", link=SLOW),
        replace(four, name="bad_machine", spoiled=BAD),
        replace(four, name=STANDALONE, spoiled=STANDALONE),
        replace(four, name="repaved", crews=FOUR, repaves=True),
        replace(four, name="mixed", crews=MIXED),
    )


# --- what agents read -------------------------------------------------------------------------------------------------


def logs_of(arm: Arm, drive: SharedDrive, cache: Path, scratch: Path) -> Iterator[tuple[str, Path]]:
    """Machines of an arm with their log folders; a spoiled log is written to `scratch`."""
    folder = drive.folder(cache)
    names = arm.names(drive)
    for name in names:
        logs = folder / "logs" / name
        if arm.spoiled and name == names[-1]:
            logs = scratch / name
            _write_spoiled(arm, drive, folder, name, logs)
        yield name, logs


def _write_spoiled(arm: Arm, drive: SharedDrive, folder: Path, name: str, to: Path) -> None:
    log = open_log(folder / "logs" / name)
    machine, readings = log.machine, tuple(log.readings())
    if arm.spoiled == BAD:
        machine, readings = spoiled(machine, readings)
    else:
        track = folder / "truth" / TRACKS_FOLDER / f"{name}.csv"
        recorded = RecordedDrive(log.site, machine, readings, read_track(track), (0.0, 0.0, 0.0))
        machine, readings = uncorrected(recorded, _motion(track), drive.seed, drive.machines.index(name))
    write_log(to, log.name, log.site, machine, readings)


def uncorrected(
    recorded: RecordedDrive, motion: TrueMotion, seed: int, number: int
) -> tuple[MachineConfig, tuple[Reading, ...]]:
    """The drive with uncorrected receivers, and the machine configured for them.

    number: index in the fleet, which selects the errors.
    """
    noise = load_preset(STANDALONE).gps
    share = noise.drift_std_m**2 / (noise.drift_std_m**2 + noise.white_std_m**2)
    sensors = tuple(
        replace(each, drift_share=round(share, 2), drift_time_s=noise.drift_time_s) if each.kind == Gps.kind else each
        for each in recorded.machine.sensors
    )
    last_ns = max(reading.stamp_ns for reading in recorded.readings)
    errors = gps_errors(recorded.machine, noise, seed, last_ns, number)
    changed = with_gps_errors(recorded, motion, errors)
    return replace(recorded.machine, sensors=sensors), changed.readings


def _motion(track: Path) -> TrueMotion:
    """True motion of one machine."""
    table = np.genfromtxt(track, delimiter=",", names=True, dtype=None)
    angles = [np.unwrap(table[name]) for name in ("roll", "pitch", "yaw")]
    position_m = np.stack([table[name] for name in "xyz"], axis=1)
    return TrueMotion(table["stamp_ns"].astype(np.int64), position_m, np.stack(angles, axis=1))
