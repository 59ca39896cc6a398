"""`python -m tests.planted`: plant faults in the product one by one; shows which ones the tests catch.

    python -m tests.planted run [FOLDER] --out OUT [--common FOLDER]    plant them in a checkout; resumes
    python -m tests.planted run [FOLDER] --out OUT --survivors OTHER    only those that survived another run
    python -m tests.planted compare BEFORE AFTER                        two runs side by side

60 faults are written by hand (`faults.toml`), 200 drawn by --seed over functions common to FOLDER and --common. A run
of the suite with coverage by test selects each fault's tests; they stop at the first failure. Survivors get the tests
of `make nightly` that run their lines. --quick omits that run: a fault gets the unit tests of its module, then of its
folder, then of its package.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue

from tests.paths import ROOT
from tests.planted.faults import Fault, drawn, written
from tests.planted.suite import Suite, trial

UNMARKED = ("-m", "not nightly")  # tests of --quick
RESULTS = "results.jsonl"
NO_PLACE, SURVIVED = "no place", "survived"
MOST_S = 300.0  # of tests per fault, by their duration in the coverage run


def run(suite: Suite, faults: Sequence[Fault], processes: int, most_s: float) -> dict[str, dict[str, str]]:
    """Fate of each fault; kept line by line in RESULTS."""
    suite.folder.mkdir(parents=True, exist_ok=True)
    if not suite.quick:
        suite.measure(processes)
    kept, results = suite.folder / RESULTS, results_of(suite.folder)
    waiting = [fault for fault in faults if fault.name not in results]
    trees = SimpleQueue[Path]()
    for number in range(processes):
        trees.put(suite.copy(number))

    def work(fault: Fault) -> dict[str, str]:
        tree = trees.get()
        try:
            return judged(suite, fault, tree, most_s)
        finally:
            trees.put(tree)

    with ThreadPoolExecutor(processes) as pool, kept.open("a") as file:
        for number, row in enumerate(pool.map(work, waiting), len(results) + 1):
            results[row["name"]] = row
            print(json.dumps(row), file=file, flush=True)
            print(f"{number} of {len(faults)}  {row['tier']:8}  {row['name']}: {row['what']}  {row['by']}", flush=True)
    return results


def judged(suite: Suite, fault: Fault, tree: Path, most_s: float) -> dict[str, str]:
    """Tier and test that catch a fault."""
    row = {"name": fault.name, "what": fault.what, "by": ""}
    try:
        tests = suite.tests_of(fault)
    except KeyError:
        return {**row, "tier": NO_PLACE}
    if suite.quick:
        by = next(filter(None, (trial(tree, fault, [*UNMARKED, test]) for test in tests)), "")
        return {**row, "tier": "test" if by else SURVIVED, "by": by}
    for tier, own in (
        ("test", [test for test in tests if test not in suite.nightly]),
        ("nightly", [test for test in tests if test in suite.nightly]),
    ):
        ends = accumulate(suite.seconds[test] for test in own)
        given = [test for test, end in zip(own, ends, strict=True) if end <= most_s or test == own[0]]
        if given and (by := trial(tree, fault, given)):
            return {**row, "tier": tier, "by": by}
    return {**row, "tier": SURVIVED}


def results_of(folder: Path) -> dict[str, dict[str, str]]:
    """Results of a run so far, by fault."""
    kept = folder / RESULTS
    return {row["name"]: row for row in map(json.loads, kept.read_text().splitlines())} if kept.exists() else {}


def compare(before: Path, after: Path) -> tuple[str, int]:
    """Both runs as a table, and the number of faults only the first catches."""
    columns = [results_of(folder) for folder in (before, after)]
    both = [
        name
        for name, row in columns[0].items()
        if name in columns[1] and NO_PLACE not in (row["tier"], columns[1][name]["tier"])
    ]
    pairs = Counter((columns[0][name]["tier"], columns[1][name]["tier"]) for name in both)
    lines = ["before    after     faults"]
    lines += [f"{first:8}  {second:8}  {n:6}" for (first, second), n in sorted(pairs.items())]
    lost = [name for name in both if columns[0][name]["tier"] != SURVIVED and columns[1][name]["tier"] == SURVIVED]
    lines += [f"lost: {name}: {columns[0][name]['what']}, caught before by {columns[0][name]['by']}" for name in lost]
    lines += [
        f"survives: {name}: {columns[1][name]['what']}"
        for name in both
        if columns[1][name]["tier"] == SURVIVED and name not in lost
    ]
    return "\n".join(lines), len(lost)


def main(words: Sequence[str] | None = None) -> int:
    """Plant or compare. Exit code 1: a fault survives, or is no longer caught."""
    parser = argparse.ArgumentParser(prog="python -m tests.planted", description="Plant faults, see which tests catch.")
    what = parser.add_subparsers(required=True, dest="what")
    planting = what.add_parser("run", help="plant faults in a checkout")
    planting.add_argument("folder", type=Path, nargs="?", default=ROOT)
    planting.add_argument("--common", type=Path, help="a checkout that must have the functions, too")
    planting.add_argument("--survivors", type=Path, help="only faults that survive in this run of another checkout")
    planting.add_argument("--tests", nargs="+", default=["tests"], help="files and folders of the suite (%(default)s)")
    planting.add_argument("--quick", action="store_true", help="by the folders that mirror a module, without coverage")
    planting.add_argument("--out", type=Path, default=Path("planted-output"))
    planting.add_argument("--seed", type=int, default=1000)
    planting.add_argument("--drawn", type=int, default=200, help="how many are drawn (%(default)s)")
    planting.add_argument("--processes", type=int, default=2)
    planting.add_argument("--seconds", type=float, default=MOST_S, help="of tests that one fault is given to")
    comparing = what.add_parser("compare", help="two runs side by side")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    options = parser.parse_args(words)
    if options.what == "compare":
        table, lost = compare(options.before, options.after)
        print(table)
        return int(lost > 0)
    root, common = options.folder.resolve(), (options.common or options.folder).resolve()
    faults = [*written(), *drawn(root, common, options.drawn, options.seed)]
    if options.survivors:
        left = {name for name, row in results_of(options.survivors).items() if row["tier"] == SURVIVED}
        faults = [fault for fault in faults if fault.name in left]
    suite = Suite(root, options.out.resolve(), tuple(options.tests), quick=options.quick)
    results = run(suite, faults, options.processes, options.seconds)
    tiers = Counter(results[fault.name]["tier"] for fault in faults)
    print(", ".join(f"{tier} {n}" for tier, n in tiers.most_common()))
    return int(tiers[SURVIVED] > 0)


if __name__ == "__main__":
    sys.exit(main())
