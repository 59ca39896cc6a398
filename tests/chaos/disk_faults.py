"""Disks of the server and of the machines that are full, or answer with errors, for a while."""

from __future__ import annotations

import signal
from contextlib import ExitStack

from tests.chaos.chaos_site import SERVER
from tests.chaos.disk_shim import DiskError, FailingDisk, build
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun

# What SQLite and the system say; a process that starts on such a disk has to end, and is started again.
EXCUSES = (
    "disk I/O error",
    "database or disk is full",
    "unable to open database file",
    "No space left",
    "Input/output",
)


def disks(scenario: FaultRun) -> FaultOutcome:
    """Every write of the store, or of all spools, fails for some seconds; sometimes the process is killed in it."""
    rng, left_s, count = scenario.rng, scenario.seconds, 0
    with scenario.site() as site:
        if not (library := build(site.folder)):
            return FaultOutcome(scenario.fault, skipped="no C compiler for the shim")
        top = site.folder
        disks_by_name = {name: FailingDisk(library, top / name, top / f"{name}.bin") for name in ("store", "spool")}
        site.env = {SERVER: disks_by_name["store"].env, **dict.fromkeys(site.machines, disks_by_name["spool"].env)}
        site.start_all()
        site.excuses = EXCUSES
        while left_s > 0:
            name, error, is_killed = rng.choice(tuple(disks_by_name)), rng.choice(tuple(DiskError)), rng.random() < 0.3
            pause_s, lasts_s = rng.uniform(0.5, 1.5), rng.uniform(0.5, 4.0)
            victim = SERVER if name == "store" else rng.choice(site.machines)
            scenario.say(f"{name} {error.name.lower()} for {lasts_s:.1f} s{f', {victim} killed' if is_killed else ''}")
            site.linger(pause_s)
            with site.fault(), ExitStack() as broken:
                broken.enter_context(disks_by_name[name].failing(error))
                site.linger(lasts_s)
                count += disks_by_name[name].failed
                if is_killed:
                    site.send(victim, signal.SIGKILL)
            if is_killed:
                site.kill(victim)
            left_s -= pause_s + lasts_s
            site.outcome.notes["spells"] = site.outcome.notes.get("spells", 0) + 1
        return site.finish(scenario.fault, count)
