"""`python -m lab sensitivity`: which constants matter."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from lab.campaign.command import add_runs, perform, seeds_of

HELP = "vary each constant of a stage by 30 %, and see which figures move"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, 600.0)
    stages = ("estimation", "localisation", "calibration", "trust")
    parser.add_argument("--stage", choices=stages, default=stages[0], help="whose constants (default %(default)s)")


def run(arguments: Namespace) -> int:
    """Vary, replay and judge."""
    from lab import sensitivity

    options = {"seeds": seeds_of(arguments), "seconds": arguments.seconds, "stage": arguments.stage}
    return perform(arguments, "machines work, stages with other constants follow", partial(sensitivity.run, **options))
