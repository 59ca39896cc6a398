"""`python -m lab calibration`: machines that calibrate each other."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from lab.campaign.command import add_runs, perform, seeds_of

HELP = "measure what calibration of machines by each other and by the ground gives the map"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, 900.0)


def run(arguments: Namespace) -> int:
    """Calibrate the machines of all cases."""
    from lab.calibration import experiment

    work = partial(experiment.run, seeds=seeds_of(arguments), seconds=arguments.seconds)
    return perform(arguments, "machines drive, and are calibrated by the ground", work)
