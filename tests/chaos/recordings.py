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
IDLE = "idle"
# The cheaper filter, and a short lag: the suite needs many samples that are true to their form and come soon, not good
# ones. `window` alone has the usual lag.
AGENT = """
linger_s = 20.0
[pipeline.localisation]
filter = "ekf"
lag_s = 8.0
"""


@dataclass(frozen=True)
class Recordings:
    """Recordings of some machines in one folder. clock: of the site."""

    folder: Path
    machines: tuple[str, ...]

    def data(self, machine: str) -> Path:
        """Folder of a machine's CSV files."""
        return self.folder / machine

    def manifest(self, path: Path, machine: str, first_ns: int, *, idle: bool = False) -> Path:
        """Write a manifest of a drive that begins at first_ns; idle: of a machine that reads nothing."""
        text = (self.data(machine) / "log.toml").read_text(encoding="utf-8")
        head, rest = text.split("\n[site]", 1)
        text = f"{head}start_ns = {first_ns - START_NS}\n\n[site]{rest}"
        path.write_text(text.replace(".csv", f".csv.{IDLE}") if idle else text, encoding="utf-8")
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
    (folder / "agent.toml").write_text(AGENT, encoding="utf-8")
    return Recordings(folder, names)
