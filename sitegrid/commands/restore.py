"""`sitegrid restore`: make a store from a backup."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path

from sitegrid.options.values import FOLDER
from sitegrid.process.lifetime import raise_interrupts, say, tell

HELP = "make a store of a backup"
EXTRA = "server"
ADVICE = (
    "machines send again what they still have of what came later, and declare the rest lost;",
    "with journal.db-mark of the old store beside the new journal, the server names at once what is missing",
)


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("backup", type=Path, metavar="BACKUP", help="folder of the backup")
    parser.add_argument("--out", type=FOLDER, required=True, metavar="STORE", help="folder of the store")


def run(arguments: Namespace) -> int:
    """Restore once and print the store's contents."""
    from sitegrid.backup import lines, restore

    raise_interrupts()  # incomplete output is removed
    examined = restore(arguments.backup, arguments.out)
    say(asdict(examined)) if arguments.json else tell(*lines(arguments.out, examined), *ADVICE)
    return 0
