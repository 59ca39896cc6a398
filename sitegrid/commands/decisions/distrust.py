"""`sitegrid distrust`: exclude a machine's samples from the map."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from sitegrid.commands.decisions.trust import add_decision, decide
from sitegrid.options.groups import add_network

HELP = "exclude all samples of a machine from the map"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_network(parser)
    parser.add_argument("--reason", required=True, help="reason in one line, kept with the decision")
    add_decision(parser)


def run(arguments: Namespace) -> int:
    """Distrust the machine."""
    machine, reason, wait_s = arguments.machine, arguments.reason, arguments.wait
    return decide(arguments, lambda client: client.distrust(machine, reason, wait_s=wait_s))
