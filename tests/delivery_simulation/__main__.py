"""`python -m tests.delivery_simulation`: many worlds, or one that is traced.

--seeds N [--first F] [--real] [--json]: run N worlds, print failures with the command that replays them, and sums.
--seed N --trace: run one and print its events. Exit code 1 if anything is lost, double or stuck.
"""

from __future__ import annotations

import argparse
import json
import logging
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.delivery_simulation.world import Outcome, World

IN_MEMORY = Path("/dev/shm")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.delivery_simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first one")
    parser.add_argument("--seed", type=int, help="only this one")
    parser.add_argument("--trace", action="store_true", help="with --seed: print what happens")
    parser.add_argument("--real", action="store_true", help="with the map server's own store, on files")
    parser.add_argument("--json", action="store_true", help="the last line is one JSON object")
    arguments = parser.parse_args()
    logging.disable()  # agents and server log their faults
    if arguments.seed is not None:
        outcome = run_one(arguments.seed, real=arguments.real, say=print if arguments.trace else None)
        print(outcome)
        return 0 if outcome.is_good else 1
    start_s = time.monotonic()
    sums = run_seeds(
        arguments.first, arguments.seeds, real=arguments.real, say=lambda line: print(line, file=sys.stderr)
    )
    table = {**sums, "seconds": round(time.monotonic() - start_s, 1)}
    print(json.dumps(table) if arguments.json else "  ".join(f"{name} {value}" for name, value in table.items()))
    return 1 if sums["failed"] else 0


def run_one(seed: int, *, real: bool = False, say: Callable[[str], None] | None = None) -> Outcome:
    """Run one world; errors are failures of the seed."""
    folder = Path(tempfile.mkdtemp(prefix="sitegrid-", dir=IN_MEMORY if IN_MEMORY.is_dir() else None))
    try:
        world = World(seed, folder, real=real, say=say)
        try:
            return world.run()
        finally:
            world.close()
    except Exception as error:
        if say:
            raise
        return Outcome(seed, problems=[f"{type(error).__name__}: {error}"])
    finally:
        shutil.rmtree(folder)


def run_seeds(
    first: int, n: int, *, real: bool = False, say: Callable[[str], None], stop_at_failure: bool = False
) -> dict[str, Any]:
    """Run `n` worlds; returns sums and events.

    Failures are reported with the command that replays them.
    """
    sums: Counter[str] = Counter()
    events: Counter[str] = Counter()
    failed: list[int] = []
    for seed in range(first, first + n):
        outcome = run_one(seed, real=real)
        for name in ("recorded", "journalled", "explained", "lost", "double"):
            sums[name] += getattr(outcome, name)
        events.update(outcome.events)
        if not outcome.is_good:
            failed.append(seed)
            problem = "; ".join(outcome.problems)
            replay = f"python -m tests.delivery_simulation --seed {seed} --trace{' --real' if real else ''}"
            say(f"seed {seed}: lost {outcome.lost}, double {outcome.double} {problem}  replay: {replay}")
            if stop_at_failure:
                break
    return {"seeds": n, "failed": len(failed), "failed_seeds": failed[:20], **sums, "events": dict(events)}


if __name__ == "__main__":
    sys.exit(main())
