"""`python -m tests.chaos`: real processes under faults, and a table of what was lost or came twice.

Exit code 0 if nothing was, 1 if something was or anything else went wrong, 2 for a wrong option, 130 if interrupted.
The order and the times of faults come from --seed, which is printed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from tests.chaos.outcome import Console, InterruptError, table
from tests.chaos.suite import FAULTS, WHOLE_S, run_suite, totals


def main(words: list[str] | None = None) -> int:
    """Run the suite."""
    arguments = _parse(words)
    console, began_s = Console(), time.monotonic()
    console.stop_on_signals()
    faults = [fault for fault in FAULTS if fault.name in arguments.faults]
    with tempfile.TemporaryDirectory(prefix="sitegrid-chaos-") as folder:
        console.say(f"seed {arguments.seed}")
        try:
            outcomes = run_suite(faults, arguments.keep or Path(folder), console, arguments.seed, arguments.seconds)
        except InterruptError:
            console.say("interrupted; everything is ended")
            return 130
    console.say(f"\n{table(outcomes)}\n")
    result = totals(outcomes, arguments.seed) | {"seconds": round(time.monotonic() - began_s, 1)}
    verdict = "nothing lost, nothing double" if result["ok"] else "FAILED"
    console.say(json.dumps(result) if arguments.json else f"{verdict}, in {result['seconds']} s")
    return 0 if result["ok"] else 1


def _parse(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__)
    names = ",".join(fault.name for fault in FAULTS)
    parser.add_argument("--seconds", type=float, default=WHOLE_S, help="about how long to run (default %(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="what is drawn comes from here (default %(default)s)")
    parser.add_argument("--faults", type=_names, default=names, help="only these (default %(default)s)")
    parser.add_argument("--json", action="store_true", help="the last line is one JSON object")
    parser.add_argument("--keep", type=Path, help="work in this new folder, and leave it")
    arguments = parser.parse_args(words)
    if not 0 < arguments.seconds <= 3600:
        parser.error("--seconds: between 0 and 3600")
    if arguments.keep and arguments.keep.exists():
        parser.error(f"--keep {arguments.keep}: exists already")
    return arguments


def _names(text: str) -> list[str]:
    known, asked = [fault.name for fault in FAULTS], text.split(",")
    if unknown := sorted(set(asked) - set(known)):
        raise argparse.ArgumentTypeError(f"no fault `{unknown[0]}`; there are {', '.join(known)}")
    return asked


if __name__ == "__main__":
    sys.exit(main())
