"""`python -m tests.chaos.write_faults WHAT CONTROL FOLDER SEED STRIDE`: one write after the other fails.

The same work is done again and again, and each time another write, sync or new file is the one that fails (and, by
turns, one or two after it): full disk and I/O error at every write of the spool and of the store. The last line is the
outcome as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.chaos import power_cuts, power_worker
from tests.chaos.disk_shim import DiskError, FailingDisk, build
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun

STEPS = 12
MOST = 5000  # writes; the work ends long before


def writes(scenario: FaultRun) -> FaultOutcome:
    """Run the sweeps, each in a process under the shim."""
    scenario.folder.mkdir(parents=True)
    if not (library := build(scenario.folder)):
        return FaultOutcome(scenario.fault, skipped="no C compiler for the shim")
    total, stride = FaultOutcome(scenario.fault), max(1, round(1 / max(scenario.scale, 0.05)))
    for what in ("spool", "store"):
        folder, control = scenario.folder / what, scenario.folder / f"{what}.bin"
        folder.mkdir()
        env = {**os.environ, **FailingDisk(library, folder, control).env}
        words = ("-m", "tests.chaos.write_faults", what, control, folder, scenario.seed, stride)
        child = subprocess.Popen([sys.executable, *map(str, words)], env=env, stdout=subprocess.PIPE, text=True)
        total.pids.append(child.pid)
        try:
            while child.poll() is None:
                scenario.console.wait(0.1)
            text = child.communicate()[0]
        finally:
            child.kill()
        power_cuts.add(total, FaultOutcome(**json.loads(text.splitlines()[-1])))
    return total


def sweep(what: str, disk: FailingDisk, folder: Path, seed: int, stride: int) -> FaultOutcome:
    """Have the n-th write fail, for every n or each stride-th."""
    outcome = FaultOutcome(what)
    for n in range(0, MOST, stride):
        work, promised = folder / str(n), folder.with_name(f"{what}-{n}.promises")
        work.mkdir()
        promises = power_worker.Promises(promised)
        times = 1 + n % 3
        disk.set(list(DiskError)[n // stride % 2], after=n, times=times)
        power_worker.USE[what](work, promises, seed, STEPS)
        untouched = disk.left == times
        disk.set(0)
        promises.close()
        power_cuts.judge(outcome, promised.read_text(encoding="ascii"), power_cuts.LOOK[what](work))
        outcome.count += 1
        if untouched:
            return outcome
    return outcome


if __name__ == "__main__":
    WHAT, CONTROL, FOLDER, SEED, STRIDE = sys.argv[1:]
    DISK = FailingDisk(Path(), Path(FOLDER), Path(CONTROL))
    print(json.dumps(sweep(WHAT, DISK, Path(FOLDER), int(SEED), int(STRIDE)).plain()))
