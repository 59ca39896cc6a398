"""`python -m lab roads`: roads and what is lost on them."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from lab.campaign.command import add_runs, perform, seeds_of

HELP = "measure roads, traffic, losses and repairs on random patches of soil"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, 900.0, cases=True)


def run(arguments: Namespace) -> int:
    """Judge the roads of all cases."""
    from lab.campaign.summary import chosen
    from lab.roads import experiment

    cases = chosen(experiment.CASES, arguments.cases)
    work = partial(experiment.run, seeds=seeds_of(arguments), seconds=arguments.seconds, cases=cases)
    return perform(arguments, "machines drive on patches of soil, their samples show roads", work)
