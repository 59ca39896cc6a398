"""Parity with robot_localization: the final poses that its own tests assert, on its own recorded data.

Its tests fuse wheel velocity, orientation, angular rate and acceleration; no GPS. Here the profile `paper` does the
same from a given start at the origin, with a filter step for every reading (step_s 0.02 s).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from agents.dead_reckoning import DeadReckoning
from agents.localisation.localiser import LocalisationConfig, Localiser
from agents.stream_order import by_stamp
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.readings import Reading
from protocol.site.site_config import Projection
from sitegrid.logs.sensors import refitted
from sitegrid.proof.figures import Row, rounded

LOGS = Path(__file__).parents[1] / "logs"
STEP_S = 0.02
# What its tests assert, by log and filter: the final position [m], and how far off it may be [m].
ASSERTED = {
    "rl_test1_husky": {
        "ekf": ((-40.0454, -76.9988, -2.6974), 1.0452),
        "ukf": ((-39.7333, -76.9820, -2.4427), 1.2910),
    },
    "rl_test2_jackal": {"ekf": ((1.0206, 3.4292, 0.7419), 0.1383), "ukf": ((1.0438, 3.4940, 0.7260), 0.2351)},
}


def run(data: Path, on_progress: Callable[[str], None] = lambda _: None) -> list[Row]:
    """Run both filters on both logs: the final position of each [m], and how far it is from the asserted one.

    data: the folder that holds a folder of each log's name.
    """
    rows = []
    for folder, asserted in ASSERTED.items():
        log = _without_gps(open_log(LOGS / folder, data / folder))
        readings = list(log.readings())
        for name, (expected, tolerance_m) in asserted.items():
            on_progress(f"{folder}: {name}")
            position = _final_position(log, readings, name)
            place = dict(zip(("x_m", "y_m", "z_m"), position, strict=True))
            off_m = math.dist(position, expected)
            judged = {"off_m": off_m, "tolerance_m": tolerance_m, "within": off_m <= tolerance_m}
            rows.append(rounded({"log": folder, "filter": name, **place, **judged}, 4))
    return rows


def _final_position(log: LogFolder, readings: list[Reading], name: str) -> tuple[float, float, float]:
    config = LocalisationConfig(filter=name, profile="paper", start=(0.0, 0.0, 0.0))
    dead_reckoning = DeadReckoning(log.machine, config.slip)
    localiser = Localiser(log.machine, Projection(log.site), config, STEP_S)
    sensors = {sensor.name: sensor for sensor in log.machine.sensors}
    for group in by_stamp(readings):
        sensed = [(reading, sensors[reading.sensor]) for reading in group]
        for reading, sensor in sensed:
            dead_reckoning.update(reading, sensor)
        localiser.update(sensed, dead_reckoning)
    assert localiser.belief is not None
    x, y, z = localiser.belief.x[:3].tolist()
    return x, y, z


def _without_gps(log: LogFolder) -> LogFolder:
    """Every sensor of the log in use but GPS, also those that the manifest does not use."""
    sensors = tuple(replace(sensor, use=sensor.kind != "gps") for sensor in log.machine.sensors)
    return refitted(log, replace(log.machine, sensors=sensors))
