"""Options shared by commands."""

from __future__ import annotations

from argparse import SUPPRESS, ArgumentParser, _SubParsersAction
from pathlib import Path
from typing import TypeAlias

from protocol.wire.session import DEFAULT_ENDPOINT

Subparsers: TypeAlias = "_SubParsersAction[ArgumentParser]"  # argparse has no public name for it


def add_command(commands: Subparsers, name: str, summary: str) -> ArgumentParser:
    """Add `sitegrid NAME` with the common options."""
    parser: ArgumentParser = commands.add_parser(name, description=sentence(summary))
    parser.add_argument("--json", action="store_true", help="print JSON for machines")
    parser.add_argument("--verbose", action="store_true", help="log normal events too, not only warnings and errors")
    return parser


def add_action(actions: Subparsers, name: str, summary: str, description: str | None = None) -> ArgumentParser:
    """Add a command's second word, like `point` in `sitegrid query point`."""
    parser: ArgumentParser = actions.add_parser(name, help=summary, description=description)
    # a default would overwrite a --json before the second word
    parser.add_argument("--json", action="store_true", default=SUPPRESS, help="print JSON for machines")
    verbose = "log normal events too, not only warnings and errors"
    parser.add_argument("--verbose", action="store_true", default=SUPPRESS, help=verbose)
    return parser


def add_network(parser: ArgumentParser, *, again: bool = False) -> None:
    """Options to connect to the router. again: also after the second word, so without defaults."""
    router = f"router to connect to (default {DEFAULT_ENDPOINT})"
    parser.add_argument("--endpoint", default=SUPPRESS if again else DEFAULT_ENDPOINT, help=router)
    keys = "folder with the keys of this process (see `sitegrid keys`); the default endpoint is tls/... then"
    parser.add_argument("--keys", type=Path, default=SUPPRESS if again else None, metavar="FOLDER", help=keys)


def add_site(parser: ArgumentParser, *, again: bool = False) -> None:
    """The site's name; default: see `connect`. again: see `add_network`."""
    site = "name of the site (default: that of the keys, else paper)"
    parser.add_argument("--site", default=SUPPRESS if again else None, help=site)


def sentence(summary: str) -> str:
    """A summary as a description."""
    return summary[0].upper() + summary[1:] + "."
