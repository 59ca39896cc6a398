"""Simulate into log folders, without a network."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path

from protocol.errors import ConfigError
from protocol.machine.log_folder import MANIFEST, write_log
from protocol.machine.readings import Reading
from sim.config import SimConfig
from sim.simulator import Simulator
from sim.truth import MAP_FILE, save_tracks

TRACKS_FOLDER = "tracks"


def write_truth(folder: Path, simulator: Simulator) -> None:
    """Write the truth map and tracks so far: `truth_map.npz`, `tracks/<machine>.csv`.

    Before each change of the ground: `truth_map_until_<second>s.npz`.
    """
    simulator.truth_map.save(folder / MAP_FILE)
    for until_s, former in simulator.former_truth_maps:
        former.save(folder / f"{Path(MAP_FILE).stem}_until_{until_s:g}s.npz")
    save_tracks(folder / TRACKS_FOLDER, simulator.tracks())


def record(
    config: SimConfig,
    record_dir: Path,
    truth_dir: Path | None = None,
    *,
    on_progress: Callable[[float], None] = lambda _: None,
    stop: threading.Event | None = None,
) -> Simulator:
    """Simulate into `<record_dir>/<machine>/log.toml` and CSV files; the truth goes to truth_dir.

    on_progress gets the simulated time per bundle; stop ends the recording early. Returns the closed simulator.
    ConfigError if the folder holds a recording.
    """
    if used := sorted(record_dir.glob(f"*/{MANIFEST}")):
        problem = f"has a recording of {used[0].parent.name} already; choose another folder, or remove that"
        raise ConfigError(record_dir, problem)
    with contextlib.closing(Simulator(config)) as simulator:
        if simulator.bundles is None:
            raise ConfigError("seconds", "a recording needs an end: set seconds above 0")
        readings: dict[str, list[Reading]] = {machine.name: [] for machine in simulator.machines}
        for _ in range(simulator.bundles):
            if stop and stop.is_set():
                break
            for name, new in simulator.advance().items():
                readings[name] += new
            on_progress(simulator.simulated_s)
        for machine in simulator.machines:
            name = f"{simulator.site.name}-{machine.name}"
            write_log(record_dir / machine.name, name, simulator.site, machine, readings[machine.name])
        if truth_dir:
            write_truth(truth_dir, simulator)
    return simulator
