"""`python -m lab maps`: the merged map against other methods."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from lab.campaign.command import add_runs, perform, seeds_of

HELP = "compare this map merge with other methods"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, cases=True)


def run(arguments: Namespace) -> int:
    """Merge all cases' samples."""
    from lab.maps import experiment
    from lab.maps.cases import select

    work = partial(experiment.run, seeds=seeds_of(arguments), cases=select(arguments.cases))
    return perform(arguments, "machines drive, their samples are merged", work)
