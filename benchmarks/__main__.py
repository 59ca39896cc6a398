"""The command line of the benchmarks."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence

from benchmarks import ingest, merge, sim
from benchmarks.measure import Result

SAMPLES, SECONDS, RUNS = 20_000, 20.0, 5


def main(words: Sequence[str] | None = None) -> int:
    """Run one benchmark and print what it found."""
    arguments = _parser().parse_args(words)
    result: Result = arguments.run(arguments.size, arguments.runs)
    print(json.dumps(result) if arguments.json else _table(result))
    return 0


def _parser() -> argparse.ArgumentParser:
    """A sub-command for each benchmark, so that an option that does nothing for it is refused."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure how fast the parts are.")
    names = parser.add_subparsers(required=True, metavar="NAME", help="what to measure:")
    merges = names.add_parser("merge", help="samples that the map server folds into its grid")
    ingests = names.add_parser("ingest", help="samples that the map server takes, from their bytes to the grid")
    sims = names.add_parser("sim", help="simulated time of small and large fleets, sensors on")
    for benchmark, run in ((merges, merge.run), (ingests, ingest.run), (sims, sim.run)):
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
    return parser


def _count(word: str) -> int:
    if (count := int(word)) < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return count


def _seconds(word: str) -> float:
    if not 0 < (seconds := float(word)) < math.inf:
        raise argparse.ArgumentTypeError("must be positive")
    return seconds


def _table(result: Result) -> str:
    """Rows under their names, numbers to the right."""
    names = list(result["rows"][0])
    lines = [names, *([str(row[name]) for name in names] for row in result["rows"])]
    widths = [max(len(line[i]) for line in lines) for i in range(len(names))]
    return "\n".join("  ".join(word.rjust(width) for word, width in zip(line, widths, strict=True)) for line in lines)


if __name__ == "__main__":
    sys.exit(main())
