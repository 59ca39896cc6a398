"""`sitegrid trust`: use a machine's samples despite contradictions."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable

from protocol.queries.answers import TrustAnswer
from sitegrid.client import Client, connect
from sitegrid.options.groups import add_network, add_site
from sitegrid.options.values import not_negative
from sitegrid.process.lifetime import plain, say, tell

HELP = "use a machine's samples, even if they contradict other machines"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_network(parser)
    parser.add_argument("--auto", action="store_true", help="let the map server decide again")
    add_decision(parser)


def add_decision(parser: ArgumentParser) -> None:
    """Options of decisions about a machine."""
    parser.add_argument("machine", metavar="MACHINE")
    add_site(parser)
    add_wait(parser)


def add_wait(parser: ArgumentParser) -> None:
    """Timeout for a decision's effects."""
    waits = "seconds to wait until the map is folded again (default %(default)g)"
    parser.add_argument("--wait", type=not_negative, default=30.0, help=waits)


def run(arguments: Namespace) -> int:
    """Trust the machine, or let the map server decide."""
    machine, wait_s = arguments.machine, arguments.wait
    if arguments.auto:
        return decide(arguments, lambda client: client.judge_automatically(machine, wait_s=wait_s))
    return decide(arguments, lambda client: client.trust(machine, wait_s=wait_s))


def decide(arguments: Namespace, command: Callable[[Client], TrustAnswer]) -> int:
    """Execute the decision, wait for the map, print the machine's state."""
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        machine = command(client)
    state = "is trusted" if machine.trusted else "is left out of the map"
    line = f"{machine.name} {state}, as of journal row {machine.merged}"
    say(plain(machine)) if arguments.json else tell(line)
    return 0
