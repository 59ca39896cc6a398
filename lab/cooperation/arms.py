"""The arms that are compared: who drives, over which links, and who is not as the others are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lab.calibration.drives import spoiled
from lab.campaign.recordings import RecordedDrive
from lab.cooperation.drives import EIGHT, FOUR, MIXED, ONE, TWO, Crew, SharedDrive, planned
from lab.positions.substitution import TrueMotion, gps_errors, with_gps_errors
from protocol.machine.log_folder import open_log, write_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, Reading
from sim.recorder import TRACKS_FOLDER
from sim.sensors.presets import load_preset
from sitegrid.proof.tracks import read_track
from tests.tcp_proxy import FAIR, Weather

OUTAGE_S, PERIOD_S = 60.0, 300.0  # one minute in five
KBIT_PER_S = 300.0
BAD, STANDALONE = "bad", "standalone"
SPEED = 8.0  # of replays: two cores run four agents 15 times as fast as logs are


@dataclass(frozen=True)
class Link:
    """The link of each machine to the router, in the log's time. outage_s: of every period_s, by turns of the machines.

    kbit_per_s: so much in each direction, 0 for any.
    """

    name: str
    outage_s: float = 0.0
    kbit_per_s: float = 0.0

    def weather(self, turn: int, time_s: float, speed: float) -> Weather:
        """What it is like for the machine of this turn after so many seconds of its log, replayed so fast."""
        if self.outage_s and (time_s - turn * OUTAGE_S) % PERIOD_S >= PERIOD_S - self.outage_s:
            return Weather(cut=True)
        return Weather(bytes_per_s=speed * self.kbit_per_s * 1000 / 8) if self.kbit_per_s else FAIR


ALWAYS, LOST, SLOW = Link("always"), Link("lost", outage_s=OUTAGE_S), Link("slow", kbit_per_s=KBIT_PER_S)


@dataclass(frozen=True)
class Arm:
    """What is compared. crews: of the recording, of which so many machines take part, the first ones.

    seconds: of the recording. spoiled: what is wrong with the last machine, BAD or STANDALONE. speed: of the replay.
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
        """Those who take part."""
        return drive.machines[: self.machines]


def arms(whole_s: float, world: str | None = None) -> tuple[Arm, ...]:
    """All arms. whole_s: of a lone machine's recording, which has three rounds of all tours or more.

    Two machines drive for 3/5 of that time, more machines for 9/20: six rounds and more of one tour each.
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
    """The machines of an arm, and the log folder of each; that of a spoiled one is written to `scratch`."""
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
    """The same drive with receivers that no station corrects, and the machine as it is configured for these.

    number: the machine's place in its fleet, by which errors are drawn.
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
    """The true motion of one machine of several."""
    table = np.genfromtxt(track, delimiter=",", names=True, dtype=None)
    angles = [np.unwrap(table[name]) for name in ("roll", "pitch", "yaw")]
    position_m = np.stack([table[name] for name in "xyz"], axis=1)
    return TrueMotion(table["stamp_ns"].astype(np.int64), position_m, np.stack(angles, axis=1))
