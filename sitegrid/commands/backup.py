"""`sitegrid backup`: copy a store, even while its server writes."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path

from sitegrid.options.values import FOLDER
from sitegrid.process.lifetime import raise_interrupts, say, tell

HELP = "copy a store, also while its map server runs"
EXTRA = "server"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("store", type=Path, metavar="STORE", help="folder of the store")
    parser.add_argument("--out", type=FOLDER, required=True, metavar="BACKUP", help="folder of the copy")


def run(arguments: Namespace) -> int:
    """Copy once and print the copy's contents."""
    from sitegrid.backup import backup, lines

    raise_interrupts()  # incomplete output is removed
    examined = backup(arguments.store, arguments.out)
    say(asdict(examined)) if arguments.json else tell(*lines(arguments.out, examined))
    return 0
