"""The `sitegrid` command: noun first, quiet by default, `--json` for machines.

Exit codes: 0 ok, 1 failed, 2 usage. The commands are the modules of `sitegrid.commands`.
"""

from __future__ import annotations

import json
import pkgutil
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from importlib import import_module

from protocol.errors import SitegridError
from sitegrid import commands
from sitegrid.options.groups import add_command
from sitegrid.process.logs import start_logging

EXTRAS = {"numba": "server", "cv2": "server", "filterpy": "agent", "pyproj": "agent", "rich": "sim", "pybullet": "sim"}
EXTRAS |= {"scipy": "eval", "matplotlib": "eval", "cryptography": "security"}


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; errors in one line."""
    arguments = build_parser().parse_args(words)
    start_logging(verbose=arguments.verbose)
    try:
        return int(arguments.run(arguments))
    except SitegridError as error:
        return _fail(str(error), as_json=arguments.json)
    except ModuleNotFoundError as error:
        extra = EXTRAS.get(str(error.name))
        if not extra:
            raise
        return _fail(f"{error.name} is not installed: pip install 'sitegrid[{extra}]'", as_json=arguments.json)
    except KeyboardInterrupt:
        return 130


def build_parser() -> ArgumentParser:
    """The parser of all commands."""
    parser = ArgumentParser(prog="sitegrid", description="Many machines draw one map of the ground together.")
    nouns = parser.add_subparsers(metavar="COMMAND", required=True)
    for info in pkgutil.iter_modules(commands.__path__, f"{commands.__name__}."):
        module = import_module(info.name)
        noun = add_command(nouns, info.name.rpartition(".")[2], module.HELP)
        noun.set_defaults(run=module.run)
        module.add_options(noun)
    return parser


def _fail(problem: str, *, as_json: bool) -> int:
    print(json.dumps({"error": problem}) if as_json else f"sitegrid: {problem}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
