"""What machines of the suite read: a recording of the simulator, replayed from another instant at every start.

One recording replayed twice from the same instant would give the same samples twice; the time columns count from the
manifest's `start_ns`, so a manifest of its own makes each start a drive of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from threading import Event

from protocol.machine.log_folder import open_log, write_log
from sim.config import SimConfig
from sim.recorder import record
from sim.simulator import START_NS

SECONDS = 160
SPEED = 4.0  # times real time: about 25 samples a second and machine
IDLE, PARKED = "idle", "parked"  # variants of a recording: without a reading; with nothing more for an hour at its end
HOUR_NS = 3600 * 10**9


@dataclass(frozen=True)
class Recordings:
    """Recordings of some machines in one folder. clock: of the site."""

    folder: Path
    machines: tuple[str, ...]

    def data(self, machine: str) -> Path:
        """Folder of a machine's CSV files."""
        return self.folder / machine

    def manifest(self, path: Path, machine: str, first_ns: int, variant: str = "") -> Path:
        """Write a manifest of a drive that begins at first_ns. variant: IDLE or PARKED."""
        text = (self.data(machine) / "log.toml").read_text(encoding="utf-8")
        head, rest = text.split("\n[site]", 1)
        text = f"{head}start_ns = {first_ns - START_NS}\n\n[site]{rest}"
        path.write_text(text.replace(".csv", f".csv.{variant}") if variant else text, encoding="utf-8")
        return path


def make(folder: Path, machines: int, seed: int, seconds: float = SECONDS, stop: Event | None = None) -> Recordings:
    """Record machines that drive; stop: once set, the recording ends with what it has."""
    folder.mkdir(parents=True, exist_ok=True)
    simulator = record(SimConfig(world="fast", machines=machines, seconds=seconds, seed=seed), folder, stop=stop)
    names = tuple(machine.name for machine in simulator.machines)
    for name in names:
        log = open_log(folder / name)
        write_log(folder / "nothing" / name, "nothing", log.site, log.machine, ())
        for path in (folder / "nothing" / name).glob("*.csv"):
            path.rename(folder / name / f"{path.name}.{IDLE}")
        for path in list((folder / name).glob("*.csv")):
            _park(path, path.with_name(f"{path.name}.{PARKED}"))
    return Recordings(folder, names)


def _park(source: Path, target: Path) -> None:
    """A copy whose last reading comes again an hour later: until then a replay waits, as for sensors that are off."""
    text = source.read_text(encoding="utf-8")
    stamp, values = text.splitlines()[-1].split(",", 1)
    target.write_text(f"{text}{int(stamp) + HOUR_NS},{values}\n", encoding="utf-8")
