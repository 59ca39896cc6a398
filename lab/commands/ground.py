"""`python -m lab ground`: how right the estimate of the ground is."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from lab.campaign.command import add_runs, perform, seeds_of

HELP = "measure the accuracy of rolling resistance and gradient of loaders at work"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, 600.0)


def run(arguments: Namespace) -> int:
    """Let estimators follow loaders at work."""
    from lab.ground import experiment

    work = partial(experiment.run, seeds=seeds_of(arguments), seconds=arguments.seconds)
    return perform(arguments, "loaders work, estimators follow", work)
