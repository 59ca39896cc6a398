"""The command line of the benchmarks."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from benchmarks import ingest, merge
from benchmarks.measure import Result

SAMPLES = {"merge": 20_000, "ingest": 20_000}


def main(words: Sequence[str] | None = None) -> int:
    """Run one benchmark and print what it found."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure the speed of the map server.")
    parser.add_argument("name", choices=sorted(SAMPLES), help="what to measure")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--samples", type=int, default=0, help="samples in a run")
    parser.add_argument("--runs", type=int, default=5, help="runs of each variant; the median counts")
    arguments = parser.parse_args(words)
    if arguments.samples < 0 or arguments.runs < 1:
        parser.error("--samples and --runs must be positive")
    run = {"merge": merge.run, "ingest": ingest.run}[arguments.name]
    result = run(arguments.samples or SAMPLES[arguments.name], arguments.runs)
    print(json.dumps(result) if arguments.json else _table(result))
    return 0


def _table(result: Result) -> str:
    """Rows under their names, numbers to the right."""
    names = list(result["rows"][0])
    lines = [names, *([str(row[name]) for name in names] for row in result["rows"])]
    widths = [max(len(line[i]) for line in lines) for i in range(len(names))]
    return "\n".join("  ".join(word.rjust(width) for word, width in zip(line, widths, strict=True)) for line in lines)


if __name__ == "__main__":
    sys.exit(main())
