"""`python -m lab speed`: speed of the parts."""

from __future__ import annotations

from argparse import REMAINDER, ArgumentParser, Namespace

from lab.speed.__main__ import LOADS, main

HELP = "measure speed and memory"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command, declared by each load."""
    loads = f"what to measure, and its options: {', '.join(LOADS)}; `NAME --help` says more"
    parser.add_argument("load", nargs=REMAINDER, metavar="NAME ...", help=loads)


def run(arguments: Namespace) -> int:
    """Run one load."""
    return main([*arguments.load, *["--json"] * arguments.json])
