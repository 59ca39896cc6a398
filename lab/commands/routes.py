"""`python -m lab routes`: routes and ways."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from lab.campaign.command import add_runs, perform, seeds_of

HELP = "compare routes with what machines spent, and ways with a finer search"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, 900.0, cases=True)


def run(arguments: Namespace) -> int:
    """Judge the routes of all cases."""
    from lab.campaign.summary import chosen
    from lab.routes import experiment

    cases = chosen(experiment.CASES, arguments.cases)
    work = partial(experiment.run, seeds=seeds_of(arguments), seconds=arguments.seconds, cases=cases)
    return perform(arguments, "machines drive on patches of soil, their samples price routes", work)
