"""All commands of the parser, a command line for each, and their output, in this process."""

from __future__ import annotations

import io
import json
from argparse import Action, ArgumentParser, _SubParsersAction
from contextlib import redirect_stderr, redirect_stdout
from typing import Any, NamedTuple

from sitegrid.cli import main
from sitegrid.command_line import build_parser
from sitegrid.options.values import OutputFile

Given = dict[str, str]  # option values by destination


class Command(NamedTuple):
    """A command with its actions: words, and the parser behind each."""

    words: tuple[str, ...]
    parsers: tuple[ArgumentParser, ...]

    @property
    def name(self) -> str:
        return "-".join(self.words)

    def options(self) -> list[Action]:
        """All options; of duplicates on two levels, the last."""
        return [a for parser in self.parsers for a in parser._actions if not isinstance(a, _SubParsersAction)]

    def line(self, given: Given) -> list[str]:
        """A command line with these values, and something for all required options."""
        line: list[str] = []
        for word, parser in zip(self.words, self.parsers, strict=True):
            line.append(word)
            groups = [group._group_actions for group in parser._mutually_exclusive_groups if group.required]
            chosen = [group[0] for group in groups if not any(option.dest in given for option in group)]
            for option in parser._actions:
                if isinstance(option, _SubParsersAction):
                    continue
                value = given.get(option.dest)
                is_needed = option.required or option in chosen or not option.option_strings
                values = [] if value is None else [value]
                if value is None and is_needed and (option.nargs != "?" or option.type is float):
                    values = _anything(option)
                if values:
                    line += [*option.option_strings[-1:], *values]
        return line


class Said(NamedTuple):
    """A command's exit code and output."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Parsed last line."""
        assert self.code == 0, self.err
        return json.loads(self.out.splitlines()[-1])


def said(*words: object) -> Said:
    """Run a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:  # wrong usage
            code = int(end.code or 0)
    return Said(code, out.getvalue(), err.getvalue())


Parsers = tuple[ArgumentParser, ...]


def _commands(parser: ArgumentParser, words: tuple[str, ...] = (), above: Parsers = ()) -> list[Command]:
    """All commands below a parser; their parsers without the topmost."""
    branches = [a for a in parser._actions if isinstance(a, _SubParsersAction)]
    if not branches:
        return [Command(words, (*above, parser))]
    above = (*above, parser) if words else ()
    return [
        command
        for branch in branches
        for word, below in branch.choices.items()
        for command in _commands(below, (*words, word), above)
    ]


def _anything(option: Action) -> list[str]:
    if option.type is float and option.nargs == "+":
        return ["1", "2", "3", "4"]  # two places
    if option.type is float:
        return ["2" if option.dest in ("east_m", "north_m", "to_x_m") else "1"]
    suffix = option.type.suffixes[0] if isinstance(option.type, OutputFile) and option.type.suffixes else ""
    return [str(next(iter(option.choices))) if option.choices else f"nothing-of-the-sort{suffix}"]


COMMANDS = _commands(build_parser())
