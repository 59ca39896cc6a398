"""Bits that flip in database files at rest: found and named, or without effect, never served as data."""

from __future__ import annotations

import random
import shutil
import signal
import sqlite3
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agents.spool import Spool, SpoolConfig
from mapserver.config import ServerConfig
from mapserver.past import History, history_rows
from mapserver.store import JOURNAL_FILE, Store
from protocol.errors import StoreError
from protocol.samples import content_hash
from protocol.site import load_site
from tests.chaos.chaos_site import ROUTER, SERVER, Site
from tests.chaos.outcome import Outcome
from tests.chaos.scenario import Scenario

FLIPS = 400  # of each file, in the whole suite
Content = dict[Any, Any]


def flips(scenario: Scenario) -> Outcome:
    """Stop a site, flip bits in copies of its files; then damage the files themselves, and restore them."""
    with scenario.site() as site:
        site.start_all()
        site.linger(scenario.seconds)
        for role in (SERVER, *site.machines, ROUTER):  # the server first: spools are to have samples
            site.stop(role)
            site.told.wait(1.0)
        n, verdicts = max(20, round(FLIPS * scenario.scale)), Counter[str]()
        for path, look in _files(site):
            found = _flip_all(path, look, scenario.rng, n, site.folder / "flipped")
            scenario.say(f"{path.name} " + ", ".join(f"{what} {k}" for what, k in sorted(found.items())))
            if served := found["served"]:
                site.problem(f"{served} of {n} flips in {path.name} are served as data")
            if unnamed := found["unnamed"]:
                site.problem(f"{unnamed} of {n} flips in {path.name} end in an error that does not name the file")
            for verdict in Verdict:
                verdicts[verdict] += found[verdict]
        _damage_and_restore(site)
        site.start_all()
        outcome = site.finish(scenario.fault, verdicts.total())
        outcome.notes |= verdicts
        outcome.longest_pause_s = None  # it was switched off meanwhile
        return outcome


def _files(site: Site) -> list[tuple[Path, Callable[[Path], Content]]]:
    """Files, and how to read what they say."""
    store = site.folder / "store"
    definition = load_site(site.folder / "site.toml")
    snapshot = max(store.glob("snapshot-*.npz"), key=lambda path: path.stat().st_mtime)

    def look_at_store(path: Path) -> Content:
        return read_store(path.parent, definition)

    spool = site.folder / "spool" / f"{site.machines[0]}.db"
    return [(store / JOURNAL_FILE, look_at_store), (snapshot, look_at_store), (spool, read_spool)]


def read_store(folder: Path, definition: Any) -> Content:
    """All that a server would take from its folder: rows, watermarks, grid."""
    store = Store(folder, definition, ServerConfig(), lambda: 10**18)
    try:
        rows = {
            row.row: (row.machine, row.spool_id, row.first_seq, row.received_ns, row.rows.tobytes())
            for row in history_rows(History.of(store._journal))
        }
        grid = store.grid.state()
        votes = [(at.x, at.y, at.rung, at.index, at.page.votes.tobytes()) for at in grid.pages]
        marks = {key: (mark.seq, mark.lost) for key, mark in store._journal.marks().items()}
        return {"rows": rows, "marks": marks, "grid": (grid.folded, sorted(votes)), "last": store.journalled}
    finally:
        store._opened.close()


def read_spool(path: Path) -> Content:
    """All that an agent would send: contents by identity, and what it says is lost."""
    spool, found, named = Spool(path, SpoolConfig()), {}, 0
    try:
        while head := spool.head(1000):
            for i, row in enumerate(head.rows):
                found[head.spool_id, head.first_seq + i] = content_hash(row)
            spool.acknowledge(head.spool_id, head.first_seq + len(head.rows) - 1)
        counters = spool.counters()
        named = sum(counters.get(name, 0) for name in ("put_aside", "damaged"))
        return {"contents": found, "named": named}
    finally:
        spool._db.close()


def _flip_all(path: Path, look: Callable[[Path], Content], rng: random.Random, n: int, folder: Path) -> Counter[str]:
    """Flip one bit in each of n copies of a file's folder, and compare what is read with what was there."""
    truth, verdicts = look(_copy(path, folder)), Counter[str]()
    for _ in range(n):
        copy = _copy(path, folder)
        flip(copy, rng)
        try:
            found = look(copy)
        except (StoreError, sqlite3.Error) as error:
            verdicts["detected" if isinstance(error, StoreError) and str(copy) in str(error) else "unnamed"] += 1
            continue
        except Exception as error:
            verdicts[f"unnamed"] += 1
            verdicts[f"as {type(error).__name__}"] += 1
            continue
        verdicts[_verdict(truth, found)] += 1
    shutil.rmtree(folder)
    return verdicts


def _verdict(truth: Content, found: Content) -> str:
    if found == truth:
        return "harmless"
    if found.get("named") and found["contents"].items() <= truth["contents"].items():
        return "detected"  # the damaged samples are named, the others sent
    return "served"


def flip(path: Path, rng: random.Random) -> None:
    """Flip one bit."""
    content = bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def _copy(path: Path, folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(path.parent, folder)
    return folder / path.name


def _damage_and_restore(site: Site) -> None:
    """With files that are damaged for sure, server and agent must not start, and say which file it is."""
    machine = site.machines[0]
    site.start(ROUTER)
    for role, path in ((SERVER, site.folder / "store" / JOURNAL_FILE), (machine, site.folder / "spool" / f"{machine}.db")):
        backup = path.read_bytes()
        path.write_bytes(bytes([backup[0] ^ 1]) + backup[1:])
        code, words = site.expect_end(role)
        if code in (None, 0, -signal.SIGKILL) or path.name not in words:
            site.problem(f"{role} with a damaged {path.name}: ended with {code}, saying {words!r}")
        path.write_bytes(backup)
    site.stop(ROUTER)
