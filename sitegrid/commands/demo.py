"""`sitegrid demo`: the whole path on one host, every part its own process; ends with pictures and a proof."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from sitegrid.options.values import positive

HELP = "router, map server, simulator and agents, each its own process; pictures"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--seconds", type=positive, default=240.0, help="simulated time (default %(default)s)")
    parser.add_argument("--speed", type=positive, default=4.0, help="times real time (default %(default)s)")
    parser.add_argument("--scenario", default="paper_site", help="what is simulated (default %(default)s)")
    parser.add_argument("--world", choices=("pybullet", "fast"), help="what moves the machines (over the scenario)")
    parser.add_argument("--machines", type=int, help="machines of the scenario's first fleet (over the scenario)")
    parser.add_argument("--seed", type=int, help="seed of the simulation (over the scenario)")
    parser.add_argument("--out", type=Path, default=Path("demo-output"), help="folder for pictures and stores")
    parser.add_argument("--headless", action="store_true", help="no live display, plain lines only")
    parser.add_argument("--log", type=Path, help="manifest of a real log that a further agent replays")
    parser.add_argument("--data", type=Path, help="folder with the CSV files of that log")
    parser.add_argument("--no-log", action="store_true", help="replay no log, also where the default one exists")


def run(arguments: Namespace) -> int:
    """Run the demo."""
    from sitegrid.demo.run import run as run_demo

    return run_demo(arguments)
