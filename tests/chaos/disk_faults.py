"""Real spool and store on a disk that loses or tears unsynced data, or whose writes fail.

`python -m tests.chaos.disk_faults WHAT CONTROL FOLDER SEED STRIDE`: repeats the same work with another failing write,
sync or new file each time (sometimes one or two more after it): full disk and I/O error at every write. The last line
is the outcome as JSON.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from agents.delivery.spool import Spool, SpoolConfig
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.history import history_rows
from mapserver.journal.location import JournalLocation
from protocol.errors import StoreError
from protocol.machine.samples import content_hash, empty
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch
from tests.chaos import power_worker as work
from tests.chaos.disk_model import SECTOR, Disk, Kind, Operation, read_trace
from tests.chaos.disk_shim import DiskError, FailingDisk, build
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun
from tests.journals import history_beside

CUTS = 2000  # in the whole suite, half of the spool
STEPS = {"spool": 400, "store": 200}
SWEEP_STEPS = 12
MOST = 5000  # bound of a sweep, far beyond its work
IN_MEMORY = Path("/dev/shm")
SampleNumber = tuple[int, int]  # spool_id, seq


@dataclass(frozen=True)
class Remains:
    """Data after a cut. contents: per identity, with repetitions."""

    contents: dict[SampleNumber, list[str]]
    problem: str = ""


def power(scenario: FaultRun) -> FaultOutcome:
    """Cut the power of a working spool and store at random moments, and reopen them."""
    total = FaultOutcome(scenario.fault)
    scenario.folder.mkdir(parents=True)
    if not (library := build(scenario.folder)):
        return FaultOutcome(scenario.fault, skipped="no C compiler for the shim")
    for what in ("spool", "store"):
        operations = trace(library, scenario.folder / what, what, scenario.seed)
        cuts = (scenario.strikes or round(CUTS * scenario.scale)) // 2
        add(total, cut(operations, what, cuts, scenario.rng, scenario.console.wait))
    return total


def trace(library: Path, folder: Path, what: str, seed: int, *options: str) -> list[Operation]:
    folder.mkdir(parents=True)
    disk, log = folder / "disk", folder / "trace"
    disk.mkdir()
    env = {**os.environ, **FailingDisk(library, disk, folder / "fault").env, "CHAOS_TRACE": str(log)}
    words = [sys.executable, "-m", "tests.chaos.power_worker", what, str(disk), str(seed), str(STEPS[what])]
    subprocess.run([*words, *options], env=env, check=True, timeout=300)
    return [operation for operation in read_trace(log) if not operation.name.endswith("-shm")]


def cut(
    operations: list[Operation],
    what: str,
    cuts: int,
    rng: random.Random,
    wait: Callable[[float], None] = lambda _: None,
) -> FaultOutcome:
    """Cut at random points and compare with the promises made before."""
    points = sorted(rng.choices(range(1, len(operations)), k=cuts))
    outcome, disk, promises, done = FaultOutcome("power", count=cuts), Disk(), "", 0
    for point in points:
        for operation in operations[done:point]:
            if operation.name == work.PROMISES:
                promises += operation.data.decode() if operation.kind == Kind.WRITE else ""
            else:
                disk.do(operation)
        done = point
        wait(0)
        folder = Path(tempfile.mkdtemp(prefix="chaos-", dir=IN_MEMORY if IN_MEMORY.is_dir() else None))
        try:
            disk.cut(rng, folder)
            wear_marks(folder, rng)
            judge(outcome, promises, LOOK[what](folder))
        finally:
            shutil.rmtree(folder)
    return outcome


def wear_marks(folder: Path, rng: random.Random) -> None:
    """Leave marks intact, outdated, torn or missing: never synced, they must never raise an alarm."""
    for mark in folder.rglob("*-mark"):
        match rng.randrange(4):
            case 0:
                mark.unlink()
            case 1:
                os.truncate(mark, rng.randint(0, mark.stat().st_size))
            case 2:
                content = bytearray(mark.read_bytes())
                at = rng.randrange(len(content) + 1)
                mark.write_bytes(content[:at] + bytes(min(SECTOR, len(content) - at)) + content[at + SECTOR :])


def judge(outcome: FaultOutcome, promises: str, left: Remains) -> None:
    """Compare data with promises and add to the counts."""
    promised = _promised(promises)
    outcome.recorded += len(promised)
    kept = sum(not may_be.isdisjoint(left.contents.get(identity, ())) for identity, may_be in promised.items())
    outcome.merged += kept
    outcome.lost += len(promised) - kept
    outcome.silent += len(promised) - kept
    outcome.double += sum(len(contents) - 1 for contents in left.contents.values())
    if left.problem and len(outcome.problems) < 5:
        outcome.problems.append(left.problem)


def _promised(promises: str) -> dict[SampleNumber, set[str]]:
    """Permitted contents per sample."""
    promised: dict[SampleNumber, set[str]] = {}
    for sign, spool_id, seq, *content in (line.split() for line in promises.splitlines()):
        if sign == "+":
            promised[int(spool_id, 16), int(seq)] = {content[0]}
        elif sign == "?":
            promised[int(spool_id, 16), int(seq)].add(content[0])
        else:
            promised = {at: c for at, c in promised.items() if at[0] != int(spool_id, 16) or at[1] > int(seq)}
    return promised


def _look_at_spool(folder: Path) -> Remains:
    """Open and empty the remaining spool."""
    contents: dict[SampleNumber, list[str]] = {}
    try:
        spool = Spool(folder / work.SPOOL_FILE, SpoolConfig())
    except StoreError as error:
        return Remains({}, f"spool does not open: {error}")
    while head := spool.head(1000):
        for i, row in enumerate(head.rows):
            contents.setdefault((head.spool_id, head.first_seq + i), []).append(content_hash(row))
        spool.acknowledge(head.spool_id, head.first_seq + len(head.rows) - 1)
    problem = "" if spool.is_settled() else "spool does not settle"
    problem = f"false alarm: {spool.damage}" if spool.damage else problem
    spool.close()
    return Remains(contents, problem)


def _look_at_store(folder: Path) -> Remains:
    """Open, read and fold the remaining store, and send another batch."""
    contents: dict[SampleNumber, list[str]] = {}
    config = ServerConfig()
    try:
        store = Store(JournalLocation(folder / work.STORE_FOLDER), work.SITE, config, lambda: 10**18)
    except StoreError as error:
        return Remains({}, f"store does not open: {error}")
    refolded = Grid(work.SITE.cell_m, config.fold)
    for row in history_rows(history_beside(store.journal)):
        refolded.fold(row.rows, row.machine)
        for i, sample in enumerate(row.rows):
            contents.setdefault((row.spool_id, row.first_seq + i), []).append(content_hash(sample))
    problem = "" if refolded.folded == store.grid.folded else "grid and journal differ"
    watermark = store.journal.watermark(work.MACHINE, work.SPOOL_ID).seq
    rows = empty(1)
    rows["stamp_ns"] = 1
    payload = encode_batch(SampleBatch(work.MACHINE, work.SPOOL_ID, watermark + 1, rows, work.SITE.frame, 0))
    if not isinstance(store.commit([Incoming(work.MACHINE, payload)])[0], Ack):
        problem = "store takes nothing more"
    if store.shortfalls:
        problem = f"false alarm: {store.shortfalls[-1]}"
    store.close()
    return Remains(contents, problem)


LOOK = {"spool": _look_at_spool, "store": _look_at_store}


def add(total: FaultOutcome, part: FaultOutcome) -> None:
    for name in ("count", "recorded", "merged", "lost", "double", "silent"):
        setattr(total, name, getattr(total, name) + getattr(part, name))
    total.problems += part.problems


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
        words = ("-m", "tests.chaos.disk_faults", what, control, folder, scenario.seed, stride)
        child = subprocess.Popen([sys.executable, *map(str, words)], env=env, stdout=subprocess.PIPE, text=True)
        total.pids.append(child.pid)
        try:
            while child.poll() is None:
                scenario.console.wait(0.1)
            text = child.communicate()[0]
        finally:
            child.kill()
        add(total, FaultOutcome(**json.loads(text.splitlines()[-1])))
    return total


def sweep(what: str, disk: FailingDisk, folder: Path, seed: int, stride: int) -> FaultOutcome:
    """Fail the n-th write, for all n or each stride-th."""
    outcome = FaultOutcome(what)
    for n in range(0, MOST, stride):
        used, promised = folder / str(n), folder.with_name(f"{what}-{n}.promises")
        used.mkdir()
        promises = work.Promises(promised)
        times = 1 + n % 3
        disk.set(list(DiskError)[n // stride % 2], after=n, times=times)
        work.USE[what](used, promises, seed, SWEEP_STEPS)
        untouched = disk.left == times
        disk.set(0)
        promises.close()
        judge(outcome, promised.read_text(encoding="ascii"), LOOK[what](used))
        outcome.count += 1
        if untouched:
            return outcome
    return outcome


if __name__ == "__main__":
    WHAT, CONTROL, FOLDER, SEED, STRIDE = sys.argv[1:]
    DISK = FailingDisk(Path(), Path(FOLDER), Path(CONTROL))
    print(json.dumps(vars(sweep(WHAT, DISK, Path(FOLDER), int(SEED), int(STRIDE)))))
