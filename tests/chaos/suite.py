"""All faults, how much time each gets, and running them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.chaos import bit_flips, clock_faults, disk_faults, link_faults, power_cuts, process_faults, write_faults
from tests.chaos.outcome import Console, InterruptError, Outcome
from tests.chaos.recordings import make
from tests.chaos.scenario import Scenario

MACHINES = 3
WHOLE_S = 480.0  # of the whole suite; scales what is counted and not timed
LANES = 3  # scenarios that run at the same time: most of them mostly wait


@dataclass(frozen=True)
class Fault:
    """A scenario. share: of the suite's time that its faults strike."""

    name: str
    run: Callable[[Scenario], Outcome]
    share: float = 0.0


# The longest first, so that lanes end together.
FAULTS = (
    Fault("kills", process_faults.kills, 0.45),
    Fault("power", power_cuts.power),
    Fault("writes", write_faults.writes),
    Fault("proxy", link_faults.proxy, 0.08),
    Fault("cable", link_faults.cable, 0.08),
    Fault("freezes", process_faults.freezes, 0.08),
    Fault("disks", disk_faults.disks, 0.08),
    Fault("clocks", clock_faults.clocks, 0.08),
    Fault("flips", bit_flips.flips, 0.02),
)


def run_suite(faults: Iterable[Fault], folder: Path, console: Console, seed: int, seconds: float) -> list[Outcome]:
    """Run faults, a few at a time; InterruptError if the suite was stopped."""
    logging.disable()  # what the parts under test log of their misfortunes
    recordings = make(folder / "recordings", MACHINES, seed, stop=console.stop)
    scale = seconds / WHOLE_S
    scenarios = [
        (fault, Scenario(fault.name, folder / fault.name, recordings, console, seed, seconds * fault.share, scale))
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


def _run(fault: Fault, scenario: Scenario) -> Outcome:
    """Run one; what goes wrong in it is a result, and the others go on."""
    if scenario.console.stop.is_set():
        return Outcome(fault.name)
    try:
        outcome = fault.run(scenario)
    except InterruptError:
        return Outcome(fault.name, problems=["interrupted"])
    except Exception as error:
        return Outcome(fault.name, problems=[f"{type(error).__name__}: {error}"])
    scenario.say(f"done, {'ok' if outcome.is_good else 'FAILED'}")
    return outcome


def totals(outcomes: Sequence[Outcome], seed: int) -> dict[str, Any]:
    """Sums for machines. kills: of the fault of that name."""
    table: dict[str, Any] = {"kills": sum(outcome.count for outcome in outcomes if outcome.fault == "kills")}
    for name in ("recorded", "merged", "lost", "double"):
        table[name] = sum(getattr(outcome, name) for outcome in outcomes)
    table["ok"] = all(outcome.is_good for outcome in outcomes)
    return {**table, "seed": seed, "faults": [outcome.plain() for outcome in outcomes]}
