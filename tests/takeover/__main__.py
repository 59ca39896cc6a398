"""`python -m tests.takeover --count N`: N take-overs; prints lost and double samples, and durations."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections import Counter
from pathlib import Path

from sitegrid.process.children import Children
from tests.postgres_server import cluster
from tests.takeover.site import FAULTS, TakeOverSite, round_of


def main() -> int:
    """Run; 1 if anything is wrong."""
    parser = argparse.ArgumentParser(prog="tests.takeover", description=__doc__)
    parser.add_argument("--count", type=int, default=len(FAULTS), help="how many take-overs")
    parser.add_argument("--samples", type=int, default=0, help="so many are in the journal before")
    arguments = parser.parse_args()
    count = arguments.count
    with cluster() as server, tempfile.TemporaryDirectory() as name, Children(Path(name)) as children:
        site = TakeOverSite(Path(name), children, server.new_database())
        site.fill(arguments.samples)
        site.start()
        rounds = []
        for number in range(count):
            rounds.append(round_of(site, FAULTS[number % len(FAULTS)]))
            print(json.dumps({"round": number + 1, **rounds[-1]}), flush=True)
        for sender in site.senders:
            sender.end()
        verdict = site.verdict()
    verdict.faults = dict(Counter(one["fault"] for one in rounds))
    times: dict[str, list[float]] = {}
    for one in rounds:
        times.setdefault(one["fault"], []).append(one["seconds"])
    seconds = {fault: {"median": round(statistics.median(s), 2), "max": max(s)} for fault, s in times.items()}
    print(json.dumps({**vars(verdict), "exit_codes": dict(site.exit_codes), "first_ack_s": seconds}))
    return 0 if verdict.is_clean else 1


if __name__ == "__main__":
    sys.exit(main())
