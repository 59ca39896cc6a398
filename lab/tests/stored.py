"""Figures of small runs without PyBullet; `python -m lab.tests.stored` renews stored.json."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from lab.campaign.experiment import Runner
from lab.campaign.recordings import PAPER, Setup
from lab.ground import experiment as ground
from lab.ground.experiment import GroundConfiguration
from lab.maps import experiment as maps
from lab.maps.cases import CASES
from lab.positions import experiment
from lab.positions.configurations import Configuration
from sitegrid.process.lifetime import plain
from sitegrid.proof.figures import Report, Row

FILE = Path(__file__).parent / "stored.json"
COST = ("us_per_second", "seconds")  # CPU time depends on the host

FAST = replace(PAPER, world="fast")
POSITIONS = tuple(
    Configuration("ukf", gps, 1, "default", share)
    for gps, share in ((1, None), (2, 0.0), (0, 0.0), (2, 0.95), (9, None))
)
LOADERS = Setup("paper_site", ("west", "east"), gps=(1, 2), imu=(3,), world="fast")
GROUND = (GroundConfiguration("kalman", "calibrated"), GroundConfiguration("rls", "harsh"))
SMALL = tuple(replace(case, columns=45, rows=30) for case in CASES)
RUNS: dict[str, Callable[[Runner], Report]] = {
    "positions": lambda runner: experiment.run(runner, (3,), 14.0, POSITIONS, FAST)[0],
    "ground": lambda runner: ground.run(runner, (4,), 40.0, GROUND, LOADERS)[0],
    "maps": lambda runner: maps.run(runner, (3,), SMALL)[0],
}


def figures(name: str, cache: Path) -> list[Row]:
    """Rows of a run, without CPU time."""
    return [{**row, **dict.fromkeys(COST)} for row in plain(RUNS[name](Runner(cache))["rows"])]


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        rows = {name: figures(name, Path(folder)) for name in RUNS}
    FILE.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
