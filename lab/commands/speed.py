"""`python -m lab speed`: how fast the parts are."""

from __future__ import annotations

from argparse import REMAINDER, ArgumentParser, Namespace

HELP = "measure speed and memory; `speed --help` lists what"
EXTRA = "lab"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command: those of each benchmark, which it declares itself."""
    parser.add_argument("benchmark", nargs=REMAINDER, metavar="NAME ...", help="a benchmark and its options")


def run(arguments: Namespace) -> int:
    """Run one benchmark."""
    from lab.speed.__main__ import main

    return main([*arguments.benchmark, *["--json"] * arguments.json])
