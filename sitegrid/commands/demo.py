"""`sitegrid demo`: the whole system on one host, a process per part; ends with pictures and an audit."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from sitegrid.options.values import FOLDER, positive
from sitegrid.process.lifetime import stop_flag
from sitegrid.process.progress import Display

HELP = "run the whole system in simulation and draw the maps"
EXTRA = "demo"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add("--seconds", type=positive, default=240.0, help="simulated time in seconds (default %(default)s)")
    add("--speed", type=positive, default=4.0, help="speed relative to real time (default %(default)s)")
    add("--scenario", default="paper_site", help="scenario to simulate (default %(default)s)")
    add("--world", choices=("pybullet", "fast"), help="physics of the machines (overrides the scenario)")
    add("--machines", type=int, help="number of machines in the scenario's first fleet (overrides the scenario)")
    add("--seed", type=int, help="random seed (overrides the scenario)")
    add("--out", type=FOLDER, default="demo-output", help="folder for pictures and stores (default %(default)s)")
    add("--web", action="store_true", help="show the map in browsers meanwhile; on a terminal until Ctrl-C")
    add("--stay", action="store_true", help="with the page, and until Ctrl-C wherever it runs")
    add("--headless", action="store_true", help="no live display; print plain lines")
    add("--log", type=Path, help="manifest of a log, which another agent replays")
    add("--data", type=Path, help="folder with the CSV files of that log")


def run(arguments: Namespace) -> int:
    """Run the demo."""
    stop = stop_flag(None)  # has children to stop
    with Display("Python starts", headless=arguments.headless or arguments.json) as display:
        from sitegrid.demo.run import run as run_demo  # takes some seconds

        return run_demo(arguments, stop, display)
