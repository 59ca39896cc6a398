"""Flipped bits in database files at rest: detected and named, or harmless, never served as data."""

from __future__ import annotations

import random
import re
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Any

from agents.delivery.spool import Spool, SpoolConfig
from mapserver.config import ServerConfig
from mapserver.ingest.store import Store
from mapserver.journal.history import history_rows
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.rows import Selection
from protocol.errors import StoreError
from protocol.machine.samples import content_hash
from protocol.site.site_file import load_site
from tests.chaos.chaos_site import ROUTER, SERVER, ChaosSite
from tests.chaos.outcome import FaultOutcome
from tests.chaos.scenario import FaultRun
from tests.journals import history_beside

STUCK_S = 2.0  # reading the suite's spools takes milliseconds


class FlipVerdict(StrEnum):
    DETECTED = "detected"
    HARMLESS = "harmless"  # or repaired, like a skipped snapshot
    SERVED = "served"
    UNNAMED = "unnamed"  # an error that does not name the file


FLIPS = 400  # per file, in the whole suite
Content = dict[Any, Any]


def flips(scenario: FaultRun) -> FaultOutcome:
    """Stop a site, flip bits in copies of its files; then damage and restore the files themselves."""
    with scenario.site() as site:
        site.start_all()
        site.linger(scenario.seconds)
        for role in (SERVER, *site.machines, ROUTER):  # the server first, so that spools fill
            site.stop(role)
            site.console.wait(1.0)
        n, verdicts = max(20, round(FLIPS * scenario.scale)), Counter[str]()
        for path, look in _files(site):
            counts = _flip_all(path, look, scenario.rng, n, site.folder / "flipped")
            scenario.say(f"{path.name} " + ", ".join(f"{what} {k}" for what, k in sorted(counts.items())))
            if served := counts[FlipVerdict.SERVED]:
                site.problem(f"{served} of {n} flips in {path.name} are served as data")
            if unnamed := counts[FlipVerdict.UNNAMED]:
                kinds = ", ".join(sorted(set(counts) - set(FlipVerdict)))
                site.problem(f"{unnamed} of {n} flips in {path.name} end in {kinds}, which does not name the file")
            for verdict in FlipVerdict:
                verdicts[verdict] += counts[verdict]
        _damage_and_restore(site)
        site.start_all()
        outcome = site.finish(scenario.fault, verdicts.total())
        outcome.notes |= verdicts
        outcome.longest_pause_s = None  # it was off meanwhile
        return outcome


def _files(site: ChaosSite) -> list[tuple[Path, Callable[[Path], Content]]]:
    """Files, and their readers."""
    store = site.folder / "store"
    definition = load_site(site.folder / "site.toml")
    snapshot = max(store.glob("snapshot-*"), key=lambda path: path.stat().st_mtime)

    def look_at_store(path: Path) -> Content:
        return read_store(path.parent, definition)

    spool = site.folder / "spool" / f"{site.machines[0]}.db"
    return [(store / JOURNAL_FILE, look_at_store), (snapshot, look_at_store), (spool, read_spool)]


def read_store(folder: Path, definition: Any) -> Content:
    """What a server would load: rows, watermarks, grid."""
    store = Store(JournalLocation(folder), definition, ServerConfig(), lambda: 10**18)
    try:
        rows = {
            row.row: (row.machine, row.spool_id, row.first_seq, row.received_ns, row.rows.tobytes())
            for row in history_rows(history_beside(store.journal))
        }
        grid = store.grid.state()
        votes = [(at.x, at.y, at.tier, at.index, at.page.votes.tobytes()) for at in grid.pages]
        marks = {key: (mark.seq, mark.lost) for key, mark in store.journal.watermarks().items()}
        placed = [
            (row.row, int(row.rows["stamp_ns"].min())) for row in store.journal.read(selection=Selection(from_ns=1))
        ]
        return {
            "rows": rows,
            "placed": placed,  # found by time and place
            "events": store.journal.events(),
            "marks": marks,
            "grid": (grid.folded, sorted(votes)),
            "last": store.journalled,
        }
    finally:
        store._opened.close()


def read_spool(path: Path) -> Content:
    """What an agent would send: contents by identity, declared losses."""
    spool, contents, end_s = Spool(path, SpoolConfig()), {}, time.monotonic() + STUCK_S
    declared = 0  # lost, to the server, which counts them
    spool._db.set_progress_handler(lambda: time.monotonic() > end_s, 20)
    try:
        while head := spool.head(1000):
            declared += head.lost_before
            for i, row in enumerate(head.rows):
                contents[head.spool_id, head.first_seq + i] = content_hash(row)
            spool.acknowledge(head.spool_id, head.first_seq + len(head.rows) - 1)
        counters = spool.counters()
        return {"contents": contents, "named": counters["put_aside"] + declared}
    except StoreError:  # the uplink reports it and sends nothing
        if time.monotonic() > end_s:
            raise TimeoutError from None
        raise
    finally:
        spool._db.close()
        spool._mark.close()


def _flip_all(path: Path, look: Callable[[Path], Content], rng: random.Random, n: int, folder: Path) -> Counter[str]:
    """Flip one bit in each of n copies of a file's folder; compare with the original."""
    truth, verdicts = look(_copy(path, folder)), Counter[str]()
    identities = _near_identities(path.read_bytes(), truth)
    for i in range(n):
        copy = _copy(path, folder)
        flip(copy, rng, identities if i % 4 == 0 else None)
        verdict, error = judge(copy, look, truth)
        verdicts[verdict] += 1
        if error:
            verdicts[error] += 1
    shutil.rmtree(folder)
    return verdicts


def judge(path: Path, look: Callable[[Path], Content], truth: Content) -> tuple[FlipVerdict, str]:
    """Verdict on a damaged file, and the kind of an error that people should not see."""
    try:
        content = look(path)
    except StoreError as error:
        return (FlipVerdict.DETECTED, "") if str(path) in str(error) else (FlipVerdict.UNNAMED, str(error))
    except Exception as error:  # whatever damage can raise
        return FlipVerdict.UNNAMED, type(error).__name__
    if content == truth:
        return FlipVerdict.HARMLESS, ""
    if content.get("named", 0) > truth.get("named", 0) and content["contents"].items() <= truth["contents"].items():
        return FlipVerdict.DETECTED, ""  # damaged samples are named or declared lost, the others sent
    return FlipVerdict.SERVED, ""


def _near_identities(content: bytes, truth: Content) -> list[int]:
    """Bytes of identities, watermarks, counts and times, which chance would rarely hit."""
    ids = {spool_id for _, spool_id in truth.get("marks", ())} | {spool_id for spool_id, _ in truth.get("contents", ())}
    texts = {spool_id.to_bytes(8, "big") for spool_id in ids} | {f"{spool_id:016x}".encode() for spool_id in ids}
    texts |= {stamp_ns.to_bytes(8, "big") for _, stamp_ns in truth.get("placed", ())}
    spans = [match.span() for text in texts for match in re.finditer(re.escape(text), content)]
    return [at for begin, end in spans for at in range(max(0, begin - 12), min(len(content), end + 8))]


def flip(path: Path, rng: random.Random, among: list[int] | None = None) -> None:
    """Flip one bit; among: within these bytes."""
    content = bytearray(path.read_bytes())
    content[rng.choice(among or range(len(content)))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def _copy(path: Path, folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(path.parent, folder)
    return folder / path.name


def _damage_and_restore(site: ChaosSite) -> None:
    """Server and agent must refuse surely damaged files by name."""
    machine = site.machines[0]
    site.start(ROUTER)
    for role, path in (
        (SERVER, site.folder / "store" / JOURNAL_FILE),
        (machine, site.folder / "spool" / f"{machine}.db"),
    ):
        backup = path.read_bytes()
        path.write_bytes(bytes([backup[0] ^ 1]) + backup[1:])
        code, words = site.expect_end(role)
        if code in (None, 0, -signal.SIGKILL) or path.name not in words:
            site.problem(f"{role} with a damaged {path.name}: ended with {code}, saying {words!r}")
        path.write_bytes(backup)
    site.stop(ROUTER)
