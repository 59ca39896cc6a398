"""The command line of the benchmarks."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence

from lab.speed import fold, ingest, live, merge, merge_memory, merge_restart, past, roads, sim
from lab.speed.agents import filter as filters
from lab.speed.asking import query
from lab.speed.fleets import fleet, follow
from lab.speed.folds import archive
from lab.speed.measure import Report
from lab.speed.merge_work import HOURS
from lab.speed.scaling import sizes
from lab.speed.web import pages as web
from lab.speed.web import panels
from sitegrid.process.tables import table


def _count(word: str) -> int:
    if (count := int(word)) < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return count


def _positive(word: str) -> float:
    if not 0 < (number := float(word)) < math.inf:
        raise argparse.ArgumentTypeError("must be positive")
    return number


OPTIONS = {
    "runs": ("N", _count, "of each variant; the median counts"),
    "samples": ("N", _count, "in a run, or a journal"),
    "steps": ("N", _count, "in a run"),
    "queries": ("N", _count, "of each kind"),
    "machines": ("N", _count, "that send at the same time"),
    "hours": ("H", _positive, "of work"),
    "seconds": ("S", _positive, "simulated, or of the site's time, in a run"),
}
# Of each: what runs it, what it measures, and its options, named as the parameters of `run`, with their defaults.
BENCHMARKS: dict[str, tuple[Callable[..., Report], str, dict[str, float]]] = {
    "merge": (
        merge.run,
        "samples that the server folds into its grid, and plain sums",
        {"runs": 5, "samples": 200_000},
    ),
    "memory": (merge_memory.run, "memory that a day of work on 1 km2 takes of the map server", {"hours": HOURS}),
    "restart": (merge_restart.run, "time to open a store with a long journal", {"samples": 20_000_000}),
    "fold": (
        fold.run,
        "journals that are folded again, and a decision about a machine",
        {"hours": HOURS, "samples": 20_000_000, "runs": 1},
    ),
    "archive": (
        archive.run,
        "an archive that is folded by threads, processes and a cluster",
        {"samples": 50_000_000, "runs": 1},
    ),
    "live": (
        live.run,
        "processor time of a server at work, by thread",
        {"hours": 2.0, "seconds": 120.0},
    ),
    "past": (past.run, "checkpoints, maps of the past, the history of a point", {"hours": HOURS, "runs": 3}),
    "query": (
        query.run,
        "queries of a real server, while samples come in, and what 20 clients cost the machines",
        {"hours": HOURS, "queries": 200, "seconds": 20.0, "runs": 3},
    ),
    "roads": (
        roads.run,
        "roads of 40 km, the worklist of a day, and what asking for it costs a server that takes samples",
        {"hours": 24.0, "runs": 5, "seconds": 120.0},
    ),
    "ingest": (ingest.run, "samples that the server takes, from bytes to the grid", {"runs": 5, "samples": 20_000}),
    "fleet": (
        fleet.run,
        "a fleet at a real server: acknowledgements, and what they cost",
        {"machines": 500, "seconds": 70.0, "hours": HOURS},
    ),
    "follow": (
        follow.run,
        "followers: how soon they show a sample, what readers cost the machines with them and without",
        {"machines": 100, "seconds": 15.0, "hours": 1.0, "runs": 3},
    ),
    "web": (
        web.run,
        "the web server: what open pages cost, how soon they show what came in, tiles for other tools",
        {"hours": HOURS, "seconds": 20.0},
    ),
    "panels": (
        panels.run,
        "how soon the page shows worklist and routes, on the demo's site",
        {"seconds": 240.0, "runs": 15},
    ),
    "sizes": (
        sizes.run,
        "bytes per sample on a link, in journal and archive, and what an agent's link carries",
        {"samples": 60_000, "seconds": 60.0},
    ),
    "sim": (sim.run, "simulated time of small and large fleets, sensors on", {"runs": 5, "seconds": 20.0}),
    "filter": (
        filters.run,
        "steps of the filters, what the smoother adds, and a whole agent's CPU and memory",
        {"runs": 5, "steps": 1000},
    ),
}


def main(words: Sequence[str] | None = None) -> int:
    """Run one benchmark and print what it found."""
    arguments = vars(_parser().parse_args(words))
    run, as_json = arguments.pop("run"), arguments.pop("json")
    result: Report = run(**arguments)
    tables = [result[name] for name in ("rows", "ingest", "decisions", "past", "smoother", "agent") if name in result]
    print(json.dumps(result) if as_json else "\n\n".join(map(table, tables)))
    for variant, remedy in result.get("missing", {}).items():
        print(f"not measured: {variant}; {remedy}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    """A sub-command for each benchmark, so that an option that does nothing for it is refused."""
    parser = argparse.ArgumentParser(prog="python -m lab.speed", description="Measure how fast the parts are.")
    names = parser.add_subparsers(required=True, metavar="NAME", help="what to measure:")
    for name, (run, what, options) in BENCHMARKS.items():
        benchmark = names.add_parser(name, help=what)
        benchmark.set_defaults(run=run)
        benchmark.add_argument("--json", action="store_true", help="print one JSON object")
        for option, default in options.items():
            metavar, kind, meaning = OPTIONS[option]
            text = f"{meaning} (%(default)s)"
            benchmark.add_argument(f"--{option}", metavar=metavar, type=kind, default=default, help=text)
    return parser


if __name__ == "__main__":
    sys.exit(main())
