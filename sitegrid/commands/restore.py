"""`sitegrid restore`: a store made of a backup."""

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
    """Restore once and print what the store holds."""
    from sitegrid.backup import lines, restore

    raise_interrupts()  # what is not complete is removed
    examined = restore(arguments.backup, arguments.out)
    say(asdict(examined)) if arguments.json else tell(*lines(arguments.out, examined), *ADVICE)
    return 0
