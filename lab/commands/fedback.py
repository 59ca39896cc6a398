"""`python -m lab fedback`: benefit and harm of lanes fed back."""

from argparse import ArgumentParser, Namespace
from typing import Any

from lab.campaign.command import add_runs, perform, seeds_of
from lab.campaign.experiment import Runner
from lab.campaign.summary import chosen
from protocol.errors import ConfigError
from sitegrid.options.values import OutputFile
from sitegrid.proof.figures import Report

HELP = "filter drives again with the lanes of another day, at a thirtieth of the cost"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, seconds=420.0, cases=True)
    picture = "file to draw a machine into that loses GPS, the first of the case driven-lost"
    parser.add_argument("--picture", type=OutputFile((".png",)), metavar="FILE", help=picture)


def run(arguments: Namespace) -> int:
    """Run and draw."""
    from lab.fedback import experiment
    from lab.fedback.blackout import lanes_of

    seeds, cases = seeds_of(arguments), chosen(experiment.CASES, arguments.cases)
    if arguments.picture and not any(case.map == "lost" for case in cases):
        raise ConfigError("--picture", "is of the case driven-lost: add it to --cases")

    def work(runner: Runner) -> tuple[Report, Any]:
        report, courses = experiment.run(runner, seeds=seeds, seconds=arguments.seconds, cases=cases)
        if arguments.picture:
            from lab.fedback.picture import draw  # only pictures need matplotlib

            lanes = lanes_of(seeds[0], arguments.seconds, runner.cache)
            draw(lanes, courses[True][0], courses[False][0], arguments.picture)
        return report, courses

    return perform(arguments, "machines drive two days, the second on the lanes of the first", work)
