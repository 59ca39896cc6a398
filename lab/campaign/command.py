"""Shared by experiment commands: options, running, printing."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

from lab.campaign.experiment import Runner
from lab.campaign.provenance import made_by
from lab.campaign.summary import chosen
from lab.campaign.workers import cores
from protocol.errors import ConfigError
from sitegrid.options.values import FOLDER, count, positive, seed
from sitegrid.process.lifetime import note, plain, raise_interrupts, say, tell
from sitegrid.process.progress import Display
from sitegrid.process.streams import lines
from sitegrid.proof.figures import Report

DEFAULT_SEEDS, DEFAULT_S = 12, 1200.0
QUICK = "a small version of its own, in about a minute: to see that all works"
Work = Callable[[Runner], tuple[Report, Any]]  # a report, and its raw results


def add_runs(parser: ArgumentParser, seconds: float | None = None, *, cases: bool = False) -> None:
    """Options of a seeded experiment. seconds: of a recording, if any. cases: whether it has cases."""
    parser.add_argument("--seeds", type=count, default=DEFAULT_SEEDS, help="number of seeds (default %(default)s)")
    parser.add_argument("--first-seed", type=seed, default=0, help="first seed (default %(default)s)")
    out = "folder for recordings and results (default %(default)s)"
    parser.add_argument("--out", type=FOLDER, default="lab-output", help=out)
    add_processes(parser)
    if seconds is not None:
        length = "length of each recording in seconds (default %(default)g)"
        parser.add_argument("--seconds", type=positive, default=seconds, help=length)
    if cases:
        parser.add_argument("--cases", type=_names, default=(), help="names, comma-separated; default all")


def add_processes(parser: ArgumentParser) -> None:
    """Number of processes."""
    parser.add_argument("--processes", type=count, help="number of parallel processes (default: one per core)")


def add_quick(parser: ArgumentParser) -> None:
    """Option for the quick version."""
    parser.add_argument("--quick", action="store_true", help=QUICK)


def seeds_of(arguments: Namespace) -> range:
    """Seeds from the options."""
    return range(arguments.first_seed, arguments.first_seed + arguments.seeds)


def is_quick(arguments: Namespace) -> bool:
    """Whether the quick version is requested; ConfigError beside other drive options."""
    if arguments.quick and (seeds_of(arguments), arguments.seconds) != (range(DEFAULT_SEEDS), DEFAULT_S):
        raise ConfigError("--quick", "has a drive of its own: leave out --seeds, --first-seed and --seconds")
    return bool(arguments.quick)


def perform(
    arguments: Namespace,
    title: str,
    work: Work,
    readable: Callable[[Report], Report] = lambda report: report,
) -> int:
    """Run an experiment with progress and print its report; returns the exit code.

    readable: shortens the report for people.
    """
    raise_interrupts()  # the progress bar hides the cursor
    with Display(title, headless=arguments.json, kept=arguments.out) as display:
        runner = Runner(arguments.out, arguments.processes or cores(), display.show)
        report, _ = work(runner)
    if not arguments.json:
        note(f"recordings and results are in {arguments.out}")
    show(arguments, report, readable)
    return 0


def seeded(module: str, title: str) -> Callable[[Namespace], int]:
    """The `run` of a command whose experiment in `module` takes seeds, seconds and perhaps cases."""

    def run(arguments: Namespace) -> int:
        experiment = import_module(module)  # keeps `--help` quick
        options: dict[str, Any] = {"seeds": seeds_of(arguments), "seconds": arguments.seconds}
        if hasattr(arguments, "cases"):
            options["cases"] = chosen(experiment.CASES, arguments.cases)
        return perform(arguments, title, partial(experiment.run, **options))

    return run


def show(arguments: Namespace, report: Report, readable: Callable[[Report], Report] = lambda report: report) -> None:
    """Print a report; with `--json` as one object with its provenance in `made`."""
    if arguments.json:
        say(plain({"made": made_by(arguments.words), **report}))
    else:
        tell("\n\n".join(lines(plain(readable(report)))))


def _names(text: str) -> Sequence[str]:
    return tuple(name for name in text.split(",") if name)
