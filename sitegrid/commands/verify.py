"""`sitegrid verify`: read and check a whole store or backup."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path

from sitegrid.process.lifetime import say, tell

HELP = "read all of a store or a backup, and check it"
EXTRA = "server"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("store", type=Path, metavar="STORE", help="folder of a store or a backup")


def run(arguments: Namespace) -> int:
    """Verify and print the contents."""
    from sitegrid.backup import lines, verify

    examined = verify(arguments.store)
    say(asdict(examined)) if arguments.json else tell(*lines(arguments.store, examined))
    return 0
