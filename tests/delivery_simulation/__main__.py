"""`python -m tests.delivery_simulation`: many worlds, or one that is traced.

--seeds N [--first F] [--real] [--json]: run so many, print each that fails with the command that replays it, and the
sums. --seed N --trace: run one and tell what happens. Exit code 1 if anything is lost, double or stuck.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time

from tests.delivery_simulation.campaign import run_one, run_seeds


def main() -> int:
    """Run."""
    parser = argparse.ArgumentParser(prog="python -m tests.delivery_simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first one")
    parser.add_argument("--seed", type=int, help="only this one")
    parser.add_argument("--trace", action="store_true", help="with --seed: tell what happens")
    parser.add_argument("--real", action="store_true", help="with the map server's own store, on files")
    parser.add_argument("--json", action="store_true", help="the last line is one JSON object")
    arguments = parser.parse_args()
    logging.disable()  # what agents and server log of their misfortunes
    if arguments.seed is not None:
        verdict = run_one(arguments.seed, real=arguments.real, say=print if arguments.trace else None)
        print(verdict)
        return 0 if verdict.is_good else 1
    start_s = time.monotonic()
    sums = run_seeds(
        arguments.first, arguments.seeds, real=arguments.real, say=lambda line: print(line, file=sys.stderr)
    )
    table = {**sums, "seconds": round(time.monotonic() - start_s, 1)}
    print(json.dumps(table) if arguments.json else "  ".join(f"{name} {value}" for name, value in table.items()))
    return 1 if sums["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
