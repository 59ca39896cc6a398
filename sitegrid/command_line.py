"""Entry point of the command: the parser of all commands; failures become one line and an exit code.

Our errors carry their own advice. Errors of the system, of Zenoh and missing libraries are put in words here. Anything
else is a bug and shows its traceback.
"""

from __future__ import annotations

import errno
import json
import logging
import pkgutil
import re
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from importlib import import_module
from platform import machine
from types import ModuleType
from typing import NoReturn

import zenoh

from protocol.errors import SitegridError, one_line
from protocol.version import package_version
from protocol.wire.session import reason_of
from sitegrid import commands
from sitegrid.options.groups import add_command
from sitegrid.process import streams
from sitegrid.process.logs import start_logging

INTERRUPTED = 130  # shell convention: 128 + SIGINT
# Extras that any command may need beside its own (`EXTRA` of its module, `BESIDE` for some options).
BESIDE = {"cryptography": "security", "filterpy": "paper", "mcap": "record"}
OURS = ("protocol", "agents", "mapserver", "sim", "sitegrid", "lab")
ADVICE = {
    errno.EACCES: "run this as a user who may, or choose another place",
    errno.EPERM: "run this as a user who may, or choose another place",
    errno.EROFS: "choose another place",
    errno.ENOSPC: "make room, or choose another place",
    errno.EDQUOT: "make room, or choose another place",
    errno.EMFILE: "raise the limit of open files (`ulimit -n`)",
    errno.EADDRINUSE: "end the process that listens there, or choose another port",
}
log = logging.getLogger("sitegrid.command_line")


class CommandParser(ArgumentParser):
    """A parser that names the words that a mistyped one may have meant, before the usage and all the choices."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        if mistyped := re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message):
            word, choices = mistyped.groups()
            if meant := get_close_matches(word, re.findall(r"[\w-]+", choices), n=2):
                self.exit(2, f"{self.prog}: '{word}' is not known; did you mean {' or '.join(meant)}?\n")
        super().error(message)


def run(words: Sequence[str], commands: ModuleType = commands, program: str = "sitegrid") -> int:
    """Run a command; returns its exit code. SystemExit from argparse: wrong usage, help."""
    streams.complete()
    try:
        code = _run(words, commands, program)
    finally:
        streams.flush()
    if not code and streams.problem():
        return _fail(f"standard output: {streams.problem()}; not all of the answer was written", words)
    return code


def _run(words: Sequence[str], commands: ModuleType, program: str) -> int:
    extra, beside = "", BESIDE
    try:
        arguments = build_parser(commands, program).parse_args(words, Namespace(words=words))
        extra, beside = arguments.extra, BESIDE | arguments.beside
        start_logging(verbose=arguments.verbose)
        return int(arguments.run(arguments))
    except SitegridError as error:
        return _fail(str(error), words)
    except zenoh.ZError as error:
        return _fail(f"network: {reason_of(error)}", words)
    except ModuleNotFoundError as error:
        if not (advice := _extra_for(error, extra, beside)):
            raise
        return _fail(advice, words)
    except OSError as error:
        log.info("failed", exc_info=True)  # --verbose shows the traceback
        return _fail(_system_problem(error), words)
    except KeyboardInterrupt:
        return INTERRUPTED


def build_parser(commands: ModuleType = commands, program: str = "sitegrid") -> ArgumentParser:
    """Parser of all commands, the modules of a package, described by the first line of its docstring.

    `--help` lists them by the package's `GROUPS`: heading to names.
    """
    about = (commands.__doc__ or "").partition("\n")[0]
    parser: ArgumentParser = CommandParser(prog=program, description=about, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--version", action="version", version=f"sitegrid {package_version()}")
    nouns = parser.add_subparsers(metavar="COMMAND", required=True, help="one of those below; COMMAND --help says more")
    those = pkgutil.walk_packages(commands.__path__, f"{commands.__name__}.")
    modules = {info.name.rpartition(".")[2]: import_module(info.name) for info in those if not info.ispkg}
    parser.epilog = _listed(getattr(commands, "GROUPS", {"commands": sorted(modules)}), modules)
    for word, module in modules.items():
        noun = add_command(nouns, word, module.HELP)
        noun.set_defaults(run=module.run, extra=getattr(module, "EXTRA", ""), beside=getattr(module, "BESIDE", {}))
        module.add_options(noun)
    return parser


def _listed(groups: Mapping[str, Sequence[str]], modules: Mapping[str, ModuleType]) -> str:
    width = max(map(len, modules))
    lines = {title: [f"  {word:<{width}}  {modules[word].HELP}" for word in words] for title, words in groups.items()}
    return "\n\n".join("\n".join([f"{title}:", *listed]) for title, listed in lines.items())


def _extra_for(error: ModuleNotFoundError, extra: str, beside: Mapping[str, str] = BESIDE) -> str:
    """Advice to install an extra; empty if the module is ours, or in no extra."""
    module = str(error.name).partition(".")[0]
    if module == "pybullet" and (sys.version_info >= (3, 12) or machine() != "x86_64"):
        return "PyBullet has wheels for Python 3.11 on x86-64 alone: run this there, or with --world fast"
    extras = ",".join(dict.fromkeys(filter(None, (extra, beside.get(module)))))
    if not extras or module in OURS or module in sys.stdlib_module_names:
        return ""
    return f"{module} is not installed: pip install '.[{extras}]' in the folder of this project"


def _system_problem(error: OSError) -> str:
    """A system error: file, problem, advice if there is any."""
    where = f"{error.filename}: " if error.filename is not None else ""
    what = error.strerror or str(error) or type(error).__name__
    advice = f"; {ADVICE[error.errno]}" if error.errno in ADVICE else ""
    return one_line(f"{where}{what}{advice}")


def _fail(problem: str, words: Sequence[str]) -> int:
    streams.write_error(json.dumps({"error": problem}) if "--json" in words else f"sitegrid: {problem}")
    return 1
