"""`python -m lab cooperation`: benefit of a shared map."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial

from lab.campaign.command import DEFAULT_S, add_quick, add_runs, is_quick, perform, seeds_of

HELP = "measure what machines gain that draw one map, over real links"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command; seconds: a lone machine's drive of all tours."""
    add_runs(parser, DEFAULT_S)
    add_quick(parser)


def run(arguments: Namespace) -> int:
    """One to eight machines draw one map."""
    from lab.cooperation import experiment
    from lab.cooperation.experiment import QUICK, Plan

    plan = QUICK if is_quick(arguments) else Plan.full(seeds_of(arguments), arguments.seconds)
    work = partial(experiment.run, plan=plan)
    return perform(arguments, "machines drive, and draw one map", work)
