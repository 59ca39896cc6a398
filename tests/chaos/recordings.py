"""Input of the suite's machines: one simulated recording, replayed at another time on every start.

A replay at the same time would repeat samples; time columns count from the manifest's `start_ns`, so each start gets
its own manifest.
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
SPEED = 4.0  # real time factor: about 25 samples/s per machine
IDLE, PARKED = "idle", "parked"  # variants of a recording: no reading; silence for an hour at the end
HOUR_NS = 3600 * 10**9


@dataclass(frozen=True)
class Recordings:
    """Recordings of machines in one folder. clock: the site's."""

    folder: Path
    machines: tuple[str, ...]

    def data(self, machine: str) -> Path:
        return self.folder / machine

    def manifest(self, path: Path, machine: str, first_ns: int, variant: str = "") -> Path:
        """Write a manifest for a drive starting at first_ns. variant: IDLE or PARKED."""
        text = (self.data(machine) / "log.toml").read_text(encoding="utf-8")
        head, rest = text.split("\n[site]", 1)
        text = f"{head}start_ns = {first_ns - START_NS}\n\n[site]{rest}"
        path.write_text(text.replace(".csv", f".csv.{variant}") if variant else text, encoding="utf-8")
        return path


def make(folder: Path, machines: int, seed: int, seconds: float = SECONDS, stop: Event | None = None) -> Recordings:
    """Record machines; stop ends the recording early."""
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
    """A copy with its last reading repeated an hour later: the replay waits, like for silent sensors."""
    text = source.read_text(encoding="utf-8")
    stamp, values = text.splitlines()[-1].split(",", 1)
    target.write_text(f"{text}{int(stamp) + HOUR_NS},{values}\n", encoding="utf-8")
