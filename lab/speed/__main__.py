"""Command line of the loads."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any, Protocol, cast

from lab.speed.measure import Goals, judged, machine
from sitegrid.process.streams import table
from sitegrid.proof.figures import Row


class Load(Protocol):
    """A module of this folder. OPTIONS: of `run`, with defaults. GOALS: by case and figure."""

    OPTIONS: Mapping[str, float]
    GOALS: Goals
    run: Callable[..., Iterator[Row]]


def _count(word: str) -> int:
    if (count := int(word)) < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return count


def _positive(word: str) -> float:
    if not 0 < (number := float(word)) < math.inf:
        raise argparse.ArgumentTypeError("must be positive")
    return number


OPTIONS: Mapping[str, tuple[str, Callable[[str], float], str]] = {
    "runs": ("N", _count, "of each variant; the median counts"),
    "samples": ("N", _count, "in a run, or a journal"),
    "steps": ("N", _count, "in a run"),
    "queries": ("N", _count, "of each kind"),
    "machines": ("N", _count, "that send at the same time"),
    "hours": ("H", _positive, "of work"),
    "seconds": ("S", _positive, "simulated, or of the site's time, in a run"),
}
LOADS = {
    "merge": "samples folded into the grid, against plain sums",
    "ingest": "samples that the server takes, from bytes to the grid, by journal",
    "fleet": "a fleet at a real server: acknowledgements, and what they cost; the link of an agent",
    "live": "processor time of a server at work, by thread",
    "query": "queries of a real server while samples come in",
    "visitors": "memory that a visitor's worst questions cost the map server and the web server (minutes)",
    "restart": "a store opened, a journal folded again, and memory",
    "filter": "steps of the filters, the smoother, a whole agent",
    "sim": "simulated time of small and large fleets, sensors on",
    "archive": "an archive folded by threads, processes and a cluster (minutes)",
    "walks": "modules that a fix and an answer pass through",
    "export": "the map of 1 km2 as a GeoTIFF, and what memory that takes",
    "followers": "how soon followers show a sample, and what readers cost with them and without",
}


def load_of(name: str) -> Load:
    """Import this load only: a measured process inherits its parent's imports."""
    return cast("Load", import_module(f"lab.speed.{name}"))


def main(words: Sequence[str] | None = None) -> int:
    """Run one load and print its table."""
    arguments = vars(_parser(words).parse_args(words))
    name, as_json = arguments.pop("load"), arguments.pop("json")
    load = load_of(name)
    report: dict[str, Any] = {"load": name, **arguments, **machine()}
    report["rows"] = judged(load.run(**arguments), load.GOALS)
    print(json.dumps(report) if as_json else table(report["rows"]))
    return 0


def _parser(words: Sequence[str] | None) -> argparse.ArgumentParser:
    """A sub-command per load, so that inapplicable options are refused."""
    parser = argparse.ArgumentParser(prog="python -m lab speed", description="Measure how fast the parts are.")
    loads = parser.add_subparsers(required=True, metavar="LOAD", dest="load", help="what to measure:")
    for name, what in LOADS.items():
        load = loads.add_parser(name, help=what, description=f"Measure {what}.")
        load.add_argument("--json", action="store_true", help="print one JSON object")
        chosen = name in (sys.argv[1:] if words is None else words)
        for option, default in load_of(name).OPTIONS.items() if chosen else ():
            metavar, kind, meaning = OPTIONS[option]
            text = f"{meaning} (%(default)s)"
            load.add_argument(f"--{option}", metavar=metavar, type=kind, default=default, help=text)
    return parser


if __name__ == "__main__":
    sys.exit(main())
