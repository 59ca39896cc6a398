"""All faults, how much time each gets, and running them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.chaos import bit_flips, clock_faults, disk_faults, link_faults, power_cuts, process_faults, write_faults
from tests.chaos.outcome import Console, FaultOutcome, InterruptError
from tests.chaos.recordings import make
from tests.chaos.scenario import FaultRun

MACHINES = 3
WHOLE_S = 480.0  # of the whole suite; scales what is counted and not timed
LANES = 3  # scenarios that run at the same time: most of them mostly wait


@dataclass(frozen=True)
class ChaosFault:
    """A scenario. share: of the suite's time that its faults strike."""

    name: str
    run: Callable[[FaultRun], FaultOutcome]
    share: float = 0.0


# The longest first, so that lanes end together.
FAULTS = (
    ChaosFault("kills", process_faults.kills, 0.45),
    ChaosFault("power", power_cuts.power),
    ChaosFault("writes", write_faults.writes),
    ChaosFault("proxy", link_faults.proxy, 0.08),
    ChaosFault("cable", link_faults.cable, 0.08),
    ChaosFault("freezes", process_faults.freezes, 0.08),
    ChaosFault("disks", disk_faults.disks, 0.08),
    ChaosFault("clocks", clock_faults.clocks, 0.08),
    ChaosFault("flips", bit_flips.flips, 0.02),
)


def run_suite(
    faults: Iterable[ChaosFault], folder: Path, console: Console, seed: int, seconds: float
) -> list[FaultOutcome]:
    """Run faults, a few at a time; InterruptError if the suite was stopped."""
    logging.disable()  # what the parts under test log of their misfortunes
    recordings = make(folder / "recordings", MACHINES, seed, stop=console.stop)
    scale = seconds / WHOLE_S
    scenarios = [
        (fault, FaultRun(fault.name, folder / fault.name, recordings, console, seed, seconds * fault.share, scale))
        for fault in faults
    ]
    with ThreadPoolExecutor(LANES) as lanes:
        runs = [lanes.submit(_run, fault, scenario) for fault, scenario in scenarios]
        while wait(runs, timeout=0.5).not_done:  # with a time-out, or a signal that another thread got is not heard
            pass
        outcomes = [run.result() for run in runs]
    if console.stop.is_set():
        raise InterruptError
    return outcomes


def _run(fault: ChaosFault, scenario: FaultRun) -> FaultOutcome:
    """Run one; what goes wrong in it is a result, and the others go on."""
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
    """Sums for machines. kills: of the fault of that name."""
    table: dict[str, Any] = {"kills": sum(outcome.count for outcome in outcomes if outcome.fault == "kills")}
    for name in ("recorded", "merged", "lost", "double"):
        table[name] = sum(getattr(outcome, name) for outcome in outcomes)
    table["ok"] = all(outcome.is_good for outcome in outcomes)
    return {**table, "seed": seed, "faults": [outcome.plain() for outcome in outcomes]}
