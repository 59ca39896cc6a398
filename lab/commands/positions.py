"""`python -m lab positions`: the paper's table of positions on simulated recordings."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from lab.campaign.command import DEFAULT_S, add_runs, perform, seeds_of
from lab.campaign.recordings import SETUPS
from sitegrid.options.values import shares

HELP = "repeat the paper's table of positions on simulated recordings"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, DEFAULT_S)
    scenario = "what is driven; in the last two the driver wanders and stops (default %(default)s)"
    parser.add_argument("--scenario", choices=tuple(SETUPS), default=next(iter(SETUPS)), help=scenario)
    parser.add_argument("--rows", choices=("all", "headline"), default="all", help="headline: 1 IMU with 1, 2, 3 GPS")
    shared = "shares of slow GPS errors that the receivers have in common, comma-separated (default: as recorded)"
    parser.add_argument("--shares", type=shares, default=(None,), help=shared)


def run(arguments: Namespace) -> int:
    """Record, replay and score all rows."""
    from lab.positions import experiment
    from lab.positions.configurations import HEADLINE, SENSORS, configurations

    rows = configurations(HEADLINE if arguments.rows == "headline" else SENSORS, arguments.shares)
    setup = SETUPS[arguments.scenario]
    work = partial(experiment.run, seeds=seeds_of(arguments), seconds=arguments.seconds, rows=rows, setup=setup)
    return perform(arguments, "machines drive, filters follow", work)
