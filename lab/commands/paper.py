"""`python -m lab paper`: the paper's tables and maps."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from lab.campaign.command import DEFAULT_S, add_quick, add_runs, is_quick, perform, seeds_of
from protocol.errors import ConfigError
from sitegrid.options.values import FOLDER, OutputFile
from sitegrid.proof.figures import Report

if TYPE_CHECKING:
    from lab.campaign.experiment import Runner
    from lab.paper.drives import Plan

HELP = "repeat the paper's tables and maps, and what this project makes of the same drives"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_runs(parser, DEFAULT_S)
    add_quick(parser)
    plots = "folder to draw the true maps, the plotted ones and their wrong cells into, of the first seed"
    parser.add_argument("--plots", type=FOLDER, help=plots)
    tensor = (
        "file to write the map to that the paper plots, with the first seed: 2 x m x n x 3, x, y and value of each cell"
    )
    parser.add_argument("--tensor", type=OutputFile((".npy",)), metavar="FILE", help=tensor)
    tables = "positions: Tables 1 and 2 alone; maps: Table 3, and all else that is of maps (default %(default)s)"
    parser.add_argument("--tables", choices=("all", "positions", "maps"), default="all", help=tables)


def run(arguments: Namespace) -> int:
    """Repeat the paper."""
    from lab.paper import experiment
    from lab.paper.report import readable

    plan = _plan(arguments)

    def work(runner: Runner) -> tuple[Report, Any]:
        report, outcomes = experiment.run(runner, plan)
        if arguments.tensor:
            experiment.write_map(outcomes, runner, arguments.tensor)
        if arguments.plots:
            from lab.paper.plots import draw  # only pictures need matplotlib

            report["plots"] = list(map(str, draw(outcomes, runner, arguments.plots)))
        return report, outcomes

    return perform(arguments, "machines drive, and plot what they drive on", work, readable)


def _plan(arguments: Namespace) -> Plan:
    """Scope from options; ConfigError if they conflict."""
    from lab.paper.drives import QUICK, Plan

    if arguments.tables == "positions" and (arguments.plots or arguments.tensor):
        raise ConfigError("--tables positions", "makes no maps to draw or to write: leave out --plots and --tensor")
    if arguments.tables != "all" and arguments.quick:
        raise ConfigError("--quick", "has tables of its own: leave out --tables")
    if is_quick(arguments):
        return QUICK
    plan = Plan(seeds_of(arguments), arguments.seconds)
    if arguments.tables == "positions":
        return replace(plan, sources=())
    return replace(plan, positions=()) if arguments.tables == "maps" else plan
