"""`sitegrid accept`: let the map server's store replace a lost one."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from sitegrid.client import connect
from sitegrid.options.groups import add_network, add_site
from sitegrid.process.lifetime import say

HELP = "let the map server's store take the place of one that is gone"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_network(parser)
    parser.add_argument(
        "store", metavar="STORE", help="id of the store that is gone, as an agent or the server names it"
    )
    parser.add_argument("--reason", required=True, help="reason in one line, kept with the decision")
    add_site(parser)


def run(arguments: Namespace) -> int:
    """Accept the store and state the consequence."""
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        info = client.accept(arguments.store, arguments.reason)
    line = f"store {info.store} takes the place of {arguments.store}: what it lacks of machines' samples counts as lost"
    say({"store": info.store, "accepted": list(info.accepted)}) if arguments.json else print(line)
    return 0
