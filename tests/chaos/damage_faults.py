"""Damaged files of a site: write-ahead logs, a store from a backup, calibrations.

If acknowledged samples are destroyed, all must be named in the server's or agent's log and counted by machine; all
others must exist once.
"""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections import Counter
from contextlib import closing
from pathlib import Path

from agents.delivery.spool import Spool, SpoolConfig
from agents.estimation.calibration import Calibration
from agents.estimation.calibration_file import load, save
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.shortfall import KIND, Shortfall, missing
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from protocol.disk.write_ahead_log import HEADER, scan
from protocol.errors import StoreError
from protocol.site.site_file import load_site
from tests.chaos.chaos_site import SERVER, ChaosSite
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun

FLIPS = 150  # copies of each log, in the whole suite
PAUSE_S = 1.5  # samples accumulate
BEFORE = Calibration(0.0031, -0.02, ((1e-6, -2e-7), (-2e-7, 1e-4)), 1, 41)  # older than any drive's


def wal_flip(scenario: FaultRun) -> FaultOutcome:
    """Kill the server or an agent, flip a bit of its write-ahead log, restart it."""
    with scenario.site() as site:
        site.start_all()
        rng, left_s, strikes, verdicts = scenario.rng, max(2 * PAUSE_S, scenario.seconds), 0, Counter[str]()
        while left_s > 0:
            site.linger(PAUSE_S)
            victim = (SERVER, *site.machines)[strikes % 2 * rng.randint(1, len(site.machines))]
            with site.fault():
                site.put_down(victim)
                database = _database(site, victim)
                if strikes < 2:  # many flips of copies first
                    verdicts += _flip_copies(site, victim, rng, max(20, round(FLIPS * scenario.scale)))
                verdicts[_flip_and_start(site, victim, database, rng)] += 1
            left_s, strikes = left_s - PAUSE_S, strikes + 1
        for verdict in ("silent", "unnamed"):
            if verdicts[verdict]:
                site.problem(f"{verdicts[verdict]} flips of a write-ahead log were {verdict}")
        outcome = site.finish(scenario.fault, verdicts.total())
        outcome.notes |= verdicts
        outcome.silent += verdicts["silent"]
        _require_named(site)
        return outcome


def _database(site: ChaosSite, victim: str) -> Path:
    return site.folder / "store" / JOURNAL_FILE if victim == SERVER else site.folder / "spool" / f"{victim}.db"


def flip(database: Path, rng: random.Random) -> None:
    """Flip a bit in the valid part of a log; none without such a part."""
    log = database.with_name(f"{database.name}-wal")
    content = bytearray(log.read_bytes()) if log.exists() else bytearray()
    if frames := scan(bytes(content)).recovered:
        page = int.from_bytes(content[8:12], "big")
        content[rng.randrange(HEADER + frames * (24 + page))] ^= 1 << rng.randrange(8)
        log.write_bytes(content)


def _flip_copies(site: ChaosSite, victim: str, rng: random.Random, n: int) -> Counter[str]:
    """Open copies with one flipped bit each: missing samples must be counted."""
    database, verdicts, folder = _database(site, victim), Counter[str](), site.folder / "flipped"
    look = _look_at_journal if victim == SERVER else _look_at_spool
    truth = None
    for i in range(n + 1):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for path in database.parent.glob(f"{database.name}*"):
            shutil.copy(path, folder / path.name)
        if i:
            flip(folder / database.name, rng)
        try:
            samples, counted = look(folder / database.name, site)
        except StoreError as error:
            verdicts["named" if database.name in str(error) else "unnamed"] += 1
            continue
        truth = samples if truth is None else truth
        if i:
            verdicts["harmless" if samples == truth else "named" if samples + counted >= truth else "silent"] += 1
        elif counted:
            verdicts["unnamed"] += 1  # a false alarm
    shutil.rmtree(folder)
    site.console.wait(0)
    return verdicts


def _look_at_journal(path: Path, site: ChaosSite) -> tuple[int, int]:
    """Samples of a journal, and those it reports missing."""
    definition = load_site(site.folder / "site.toml")
    with closing(SqliteJournal(path, definition.name, definition.frame)) as journal:
        shortfalls = [Shortfall.from_event(event) for event in journal.events(KIND)]
        watermarks = journal.watermarks()
    return sum(mark.seq for mark in watermarks.values()), missing(shortfalls, watermarks).total()


def _look_at_spool(path: Path, _: ChaosSite) -> tuple[int, int]:
    """Samples in a spool, and those it reports gone."""
    with closing(Spool(path, SpoolConfig())) as spool:
        counters = spool.counters()
    return counters["depth"], counters["gone"]


def _flip_and_start(site: ChaosSite, victim: str, database: Path, rng: random.Random) -> str:
    """Flip a bit and restart; if the process refuses, as it may, restore the files."""
    kept = site.folder / "kept"
    shutil.copytree(database.parent, kept)
    flip(database, rng)
    site.start(victim)
    verdict = "started"
    if (words := site.words_of_refusal(victim)) is not None:
        verdict = "refused" if database.name in words else "unnamed"
        shutil.rmtree(database.parent)
        shutil.copytree(kept, database.parent)
        site.start(victim)
        site.wait_ready(victim)
    shutil.rmtree(kept)
    return verdict


def restored_store(scenario: FaultRun) -> FaultOutcome:
    """Restore the store from an outdated backup.

    One machine still has the missing samples in an outdated spool; the others deleted them.
    """
    with scenario.site() as site:
        site.start_all()
        *others, holder = site.machines
        site.linger(PAUSE_S)
        backup = site.folder / "backup.db"
        with (
            closing(sqlite3.connect(site.folder / "store" / JOURNAL_FILE)) as journal,
            closing(sqlite3.connect(backup)) as copy,
        ):
            journal.backup(copy)
        site.linger(max(PAUSE_S, scenario.seconds / 2))
        with site.fault():
            site.stop(SERVER)
            site.console.wait(PAUSE_S)  # samples accumulate
            site.put_down(holder)
            spools = site.folder / "spool"
            held = {path: path.read_bytes() for path in spools.glob(f"{holder}.db*")}
            site.start(SERVER)
            site.wait_ready(SERVER)
            site.deliver_rest(holder)
            site.linger(PAUSE_S)
            site.stop(SERVER)
            before = site.progress()
            shutil.rmtree(site.folder / "store")
            (site.folder / "store").mkdir()
            shutil.copy(backup, site.folder / "store" / JOURNAL_FILE)
            for path in spools.glob(f"{holder}.db*"):
                path.unlink()
            for path, content in held.items():
                path.write_bytes(content)
            behind = {machine: n - site.progress().get(machine, 0) for machine, n in before.items()}
            site.start(SERVER)
            site.wait_ready(SERVER)
            site.start(holder)
        outcome = site.finish(scenario.fault, 1)
        lost = _lost_by_machine(site)
        outcome.notes |= {"behind": behind, "declared by machine": lost}
        if not all(0 < lost.get(machine, 0) <= behind[machine] for machine in others):
            site.problem(f"machines were behind by {behind} and declared {lost}")
        if lost.get(holder, 0) >= behind[holder]:
            site.problem(f"{holder} had samples that were missing, and declared them lost")
        _require_named(site)
        return outcome


def calibration_flip(scenario: FaultRun) -> FaultOutcome:
    """Flip each bit of a calibration in copies; agents must name a damaged one."""
    with scenario.site() as site:
        files = {machine: site.folder / "spool" / f"{machine}.calibration.json" for machine in site.machines}
        for machine, path in files.items():
            save(path, machine, BEFORE)
        flips, used = _flip_calibration(site.folder / "flipped.json", site.machines[0])
        if used:
            site.problem(f"{used} of {flips} flips of a calibration were used as if they were right")
        site.start_all()
        for machine, path in files.items():
            with site.fault():
                site.put_down(machine)
                save(path, machine, BEFORE)
                content = path.read_bytes()
                path.write_bytes(content.replace(b'"zero": 0.0031', b'"zero": 0.0030'))  # lowest bit
                site.start(machine)
                site.wait_ready(machine)
            if "calibration" not in site.log_of(machine):
                site.problem(f"{machine} says nothing of a damaged calibration")
        site.linger(scenario.seconds)
        outcome = site.finish(scenario.fault, flips + len(files))
        outcome.silent += used
        return outcome


def _flip_calibration(path: Path, machine: str) -> tuple[int, int]:
    """Flip each bit; returns flips, and wrong calibrations without an error."""
    save(path, machine, BEFORE)
    whole, used = path.read_bytes(), 0
    for at in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[at // 8] ^= 1 << at % 8
        path.write_bytes(damaged)
        try:
            used += load(path, machine) != BEFORE
        except StoreError as error:
            used += path.name not in str(error)
    return 8 * len(whole), used


def _lost_by_machine(site: ChaosSite) -> dict[str, int]:
    with SqliteReader(site.folder / "store" / JOURNAL_FILE) as reader:
        lost = Counter[str]()
        for (machine, _), mark in reader.watermarks().items():
            lost[machine] += mark.lost
    return dict(+lost)


def _require_named(site: ChaosSite) -> None:
    """Declared losses must be in the server's log, by machine."""
    log = site.log_of(SERVER)
    for machine, n in _lost_by_machine(site).items():
        if not any('"declared lost"' in line and f'"{machine}"' in line for line in log.splitlines()):
            site.outcome.silent += n
            site.problem(f"the server's log does not name {n} samples that {machine} lost")
