"""The command line of the benchmarks."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence

from benchmarks import filter as filters
from benchmarks import ingest, merge, sim
from benchmarks.measure import Result, table

SAMPLES, SECONDS, STEPS, RUNS = 20_000, 20.0, 1000, 5


def main(words: Sequence[str] | None = None) -> int:
    """Run one benchmark and print what it found."""
    arguments = _parser().parse_args(words)
    result: Result = arguments.run(arguments.size, arguments.runs)
    tables = [result[name] for name in ("rows", "agent") if name in result]
    print(json.dumps(result) if arguments.json else "\n\n".join(map(table, tables)))
    return 0


def _parser() -> argparse.ArgumentParser:
    """A sub-command for each benchmark, so that an option that does nothing for it is refused."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure how fast the parts are.")
    names = parser.add_subparsers(required=True, metavar="NAME", help="what to measure:")
    merges = names.add_parser("merge", help="samples that the map server folds into its grid")
    ingests = names.add_parser("ingest", help="samples that the map server takes, from their bytes to the grid")
    sims = names.add_parser("sim", help="simulated time of small and large fleets, sensors on")
    steps = names.add_parser("filter", help="steps of the localisation filters, and a whole agent's CPU and memory")
    runs = ((merges, merge.run), (ingests, ingest.run), (sims, sim.run), (steps, filters.run))
    for benchmark, run in runs:
        benchmark.set_defaults(run=run)
        benchmark.add_argument("--json", action="store_true", help="print one JSON object")
        benchmark.add_argument(
            "--runs", metavar="N", type=_count, default=RUNS, help="of each variant; the median counts (%(default)s)"
        )
    for benchmark in (merges, ingests):
        benchmark.add_argument(
            "--samples", metavar="N", dest="size", type=_count, default=SAMPLES, help="in a run (%(default)s)"
        )
    sims.add_argument(
        "--seconds", metavar="S", dest="size", type=_seconds, default=SECONDS, help="simulated, in a run (%(default)s)"
    )
    steps.add_argument("--steps", metavar="N", dest="size", type=_count, default=STEPS, help="in a run (%(default)s)")
    return parser


def _count(word: str) -> int:
    if (count := int(word)) < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return count


def _seconds(word: str) -> float:
    if not 0 < (seconds := float(word)) < math.inf:
        raise argparse.ArgumentTypeError("must be positive")
    return seconds


if __name__ == "__main__":
    sys.exit(main())
