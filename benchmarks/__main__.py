"""The command line of the benchmarks."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence

from benchmarks import filter as filters
from benchmarks import ingest, merge, merge_memory, merge_restart, sim
from benchmarks.measure import Report, table
from benchmarks.merge_work import HOURS

SAMPLES, SECONDS, STEPS, RUNS = 20_000, 20.0, 1000, 5
MERGED, JOURNALLED = 200_000, 20_000_000


def main(words: Sequence[str] | None = None) -> int:
    """Run one benchmark and print what it found."""
    arguments = vars(_parser().parse_args(words))
    run, as_json = arguments.pop("run"), arguments.pop("json")
    result: Report = run(**arguments)
    tables = [result[name] for name in ("rows", "agent") if name in result]
    print(json.dumps(result) if as_json else "\n\n".join(map(table, tables)))
    for variant, remedy in result.get("missing", {}).items():
        print(f"not measured: {variant}; {remedy}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    """A sub-command for each benchmark, so that an option that does nothing for it is refused.

    Options are named as the parameters of the benchmark's `run`.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure how fast the parts are.")
    names = parser.add_subparsers(required=True, metavar="NAME", help="what to measure:")
    merges = names.add_parser("merge", help="samples that the map server folds into its grid, and plain sums")
    memories = names.add_parser("memory", help="memory that a day of work on 1 km2 takes of the map server")
    restarts = names.add_parser("restart", help="time in which the map server opens a store with a long journal")
    ingests = names.add_parser("ingest", help="samples that the map server takes, from their bytes to the grid")
    sims = names.add_parser("sim", help="simulated time of small and large fleets, sensors on")
    steps = names.add_parser("filter", help="steps of the localisation filters, and a whole agent's CPU and memory")
    runs = {
        merges: merge.run,
        memories: merge_memory.run,
        restarts: merge_restart.run,
        ingests: ingest.run,
        sims: sim.run,
        steps: filters.run,
    }
    for benchmark, run in runs.items():
        benchmark.set_defaults(run=run)
        benchmark.add_argument("--json", action="store_true", help="print one JSON object")
    for benchmark in (merges, ingests, sims, steps):
        benchmark.add_argument(
            "--runs", metavar="N", type=_count, default=RUNS, help="of each variant; the median counts (%(default)s)"
        )
    for benchmark, default in ((merges, MERGED), (ingests, SAMPLES), (restarts, JOURNALLED)):
        benchmark.add_argument(
            "--samples", metavar="N", type=_count, default=default, help="in a run, or a journal (%(default)s)"
        )
    memories.add_argument("--hours", metavar="H", type=_positive, default=HOURS, help="of work (%(default)s)")
    sims.add_argument(
        "--seconds", metavar="S", type=_positive, default=SECONDS, help="simulated, in a run (%(default)s)"
    )
    steps.add_argument("--steps", metavar="N", type=_count, default=STEPS, help="in a run (%(default)s)")
    return parser


def _count(word: str) -> int:
    if (count := int(word)) < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return count


def _positive(word: str) -> float:
    if not 0 < (number := float(word)) < math.inf:
        raise argparse.ArgumentTypeError("must be positive")
    return number


if __name__ == "__main__":
    sys.exit(main())
