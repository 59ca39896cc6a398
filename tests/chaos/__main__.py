"""`python -m tests.chaos`: real processes under faults, and a table of lost and double samples.

Exit code 0: none; 1: some, or any other failure; 2: wrong option; 130: interrupted. Order and times of faults follow
from --seed, which is printed.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.chaos import (
    bit_flips,
    damage_faults,
    disk_faults,
    pending_faults,
    reader_faults,
    site_faults,
    store_faults,
    visitor_faults,
)
from tests.chaos.outcome import Console, FaultOutcome, InterruptError, table
from tests.chaos.recordings import make
from tests.chaos.scenario import FaultRun

MACHINES = 3
WHOLE_S = 480.0  # of the whole suite; scales untimed counts
LANES = 3  # concurrent scenarios, which mostly wait


@dataclass(frozen=True)
class ChaosFault:
    """A scenario. share: of the suite's time."""

    name: str
    run: Callable[[FaultRun], FaultOutcome]
    share: float = 0.0


# Longest first, so that lanes end together.
FAULTS = (
    ChaosFault("kills", site_faults.kills, 0.45),
    ChaosFault("power", disk_faults.power),
    ChaosFault("writes", disk_faults.writes),
    ChaosFault("proxy", site_faults.proxy, 0.08),
    ChaosFault("cable", site_faults.cable, 0.08),
    ChaosFault("freezes", site_faults.freezes, 0.08),
    ChaosFault("disks", site_faults.disks, 0.08),
    ChaosFault("clocks", site_faults.clocks, 0.08),
    ChaosFault("window", pending_faults.window),
    ChaosFault("parked", pending_faults.parked),
    ChaosFault("second_server", store_faults.second_server),
    ChaosFault("far_future", store_faults.far_future),
    ChaosFault("archive_clock", store_faults.archive_clock),
    ChaosFault("wal_flip", damage_faults.wal_flip, 0.03),
    ChaosFault("visitors", visitor_faults.visitors, 0.05),
    ChaosFault("scatter", visitor_faults.scatter),
    ChaosFault("questions", reader_faults.questions, 0.02),
    ChaosFault("sleeping_reader", reader_faults.sleeping_reader, 0.06),
    ChaosFault("waiting_reader", reader_faults.waiting_reader, 0.02),
    ChaosFault("flips", bit_flips.flips, 0.02),
    ChaosFault("restored_store", damage_faults.restored_store, 0.01),
    ChaosFault("calibration_flip", damage_faults.calibration_flip, 0.01),
)


def main(words: list[str] | None = None) -> int:
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


def run_suite(
    faults: Iterable[ChaosFault], folder: Path, console: Console, seed: int, seconds: float
) -> list[FaultOutcome]:
    """Run faults, a few at a time; InterruptError if stopped."""
    logging.disable()  # the tested parts log their misfortunes
    recordings = make(folder / "recordings", MACHINES, seed, stop=console.stop)
    scale = seconds / WHOLE_S
    scenarios = [
        (fault, FaultRun(fault.name, folder / fault.name, recordings, console, seed, seconds * fault.share, scale))
        for fault in faults
    ]
    with ThreadPoolExecutor(LANES) as lanes:
        runs = [lanes.submit(_run, fault, scenario) for fault, scenario in scenarios]
        while wait(runs, timeout=0.5).not_done:  # without a timeout, signals caught by other threads are not noticed
            pass
        outcomes = [run.result() for run in runs]
    if console.stop.is_set():
        raise InterruptError
    return outcomes


def _run(fault: ChaosFault, scenario: FaultRun) -> FaultOutcome:
    """Run one; its errors are results, and the others continue."""
    if scenario.console.stop.is_set():
        return FaultOutcome(fault.name)
    try:
        outcome = fault.run(scenario)
    except InterruptError:
        return FaultOutcome(fault.name, problems=["interrupted"])
    except Exception as error:
        return FaultOutcome(fault.name, problems=[f"{type(error).__name__}: {error}"])
    scenario.say(f"done, {'ok' if outcome.is_good else 'FAILED'}")
    return outcome


def totals(outcomes: Sequence[FaultOutcome], seed: int) -> dict[str, Any]:
    """Sums over all faults. kills: of the fault `kills`."""
    table: dict[str, Any] = {"kills": sum(outcome.count for outcome in outcomes if outcome.fault == "kills")}
    for name in ("recorded", "merged", "declared", "lost", "named", "double", "silent"):
        table[name] = sum(getattr(outcome, name) for outcome in outcomes)
    table["ack_ms_max"] = max((outcome.ack_ms_max or 0 for outcome in outcomes), default=0)
    table["ok"] = all(outcome.is_good for outcome in outcomes)
    return {**table, "seed": seed, "faults": [asdict(outcome) for outcome in outcomes]}


if __name__ == "__main__":
    sys.exit(main())
