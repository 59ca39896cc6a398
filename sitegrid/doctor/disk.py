"""Files and disks: spool, store, free space."""

from __future__ import annotations

import math
import shutil
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from agents.delivery.spool_file import require_schema, run_ends_in, runs_cut_short
from protocol.disk.high_water_mark import Traces, look_beside
from protocol.errors import StoreError
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.site.site_config import SiteConfig
from sitegrid.doctor import Finding, Level
from sitegrid.health import problems_of, status_of, table_of

FREE_FAIL, FREE_WARN = 64 * 2**20, 2**30
WAITING_S = 3600.0  # age of samples that nobody has taken for long
TAIL_ROWS = 20_000  # journal rows that a restart folds in seconds


def free_bytes(path: Path) -> int:
    """Free space for a file or folder, existing or not."""
    place = path.absolute()
    while not place.is_dir():
        place = place.parent
    return shutil.disk_usage(place).free


def check_disk(what: str, free: int) -> Finding:
    """Free space [bytes] where a file grows."""
    message = f"{free / 2**30:.1f} GiB are free"
    if free < FREE_FAIL:
        return Finding(Level.FAIL, f"{what} disk", message, "make room now: soon nothing more can be written")
    if free < FREE_WARN:
        return Finding(Level.WARN, f"{what} disk", message, "make room")
    return Finding(Level.PASS, f"{what} disk", message)


class InUseError(StoreError):
    """The spool is open in an agent."""


@dataclass(frozen=True)
class SpoolState:
    """A spool at rest. gone: samples lost by its disk. oldest_ns: stamp, 0: none.

    damage: of its write-ahead log, empty: none.
    """

    depth: int
    dropped: int
    quarantined: int
    oldest_ns: int
    gone: int = 0
    damage: str = ""


def read_spool(path: Path) -> SpoolState:
    """State of a spool at rest; StoreError if unusable, InUseError while an agent runs on it."""
    if not path.is_file():
        raise StoreError(path, "no such file; an agent makes it when it starts")
    traces = look_beside(path)
    try:
        with closing(sqlite3.connect(_read_only(path), uri=True, timeout=0.2)) as db:
            return _spool_state(db, traces)
    except (sqlite3.Error, ValueError) as error:
        if "locked" in str(error):
            raise InUseError(path, "an agent has it open") from None
        raise StoreError(path, f"is no usable spool: {error}") from None


def _read_only(path: Path) -> str:
    """URI that creates no file beside a spool: immutable without a write-ahead log."""
    log = path.with_name(f"{path.name}-wal")
    at_rest = not log.exists() or log.stat().st_size == 0
    return f"{path.absolute().as_uri()}?mode=ro" + ("&immutable=1" if at_rest else "")


def _spool_state(db: sqlite3.Connection, traces: Traces) -> SpoolState:
    require_schema(db)
    (depth,), (quarantined,) = (db.execute(f"SELECT COUNT(*) FROM {t}").fetchone() for t in ("sample", "quarantine"))  # noqa: S608
    meta = {key: int(value) for key, value in db.execute("SELECT key, value FROM meta")}
    oldest = db.execute("SELECT row FROM sample ORDER BY number LIMIT 1").fetchone()
    oldest_ns = int(np.frombuffer(oldest[0], SAMPLE_DTYPE)["stamp_ns"][0]) if oldest else 0
    short = runs_cut_short(run_ends_in(db), traces.mark)
    gone = meta.get("gone", 0) + sum(n for _, n in short)
    return SpoolState(depth, meta.get("dropped", 0), quarantined, oldest_ns, gone, traces.damage)


def check_spool(state: SpoolState, now_ns: int) -> Finding:
    """Depth, age, permanent losses."""
    age_s = (now_ns - state.oldest_ns) * 1e-9 if state.oldest_ns else 0.0
    message = f"{state.depth} samples wait" + (f", the oldest is of {_ago(age_s)}" if state.oldest_ns else "")
    message += f"; {state.dropped} were dropped, {state.quarantined} quarantined"
    message += f", {state.gone} are gone" if state.gone else ""
    advice = [state.damage] if state.damage else []
    if state.gone:
        advice.append("its disk has lost recorded samples: look at the disk")
    if state.depth and age_s > WAITING_S:
        advice.append("start its agent, and see what it says of its uplink")
    if state.dropped:
        advice.append("it was full: mend the link, or raise max_samples")
    if state.quarantined:
        advice.append("the map server refused samples: table `quarantine` has them and the reasons")
    return Finding(Level.WARN if advice else Level.PASS, "spool", message, "; ".join(advice))


def check_health(machine: str, values: Mapping[str, Any]) -> Finding:
    """A running agent's health report, which other versions may fill with any values."""
    spool, status = table_of(values, "spool"), status_of(values)
    counts = [f"{spool.get(key, '?')} {word}" for key, word in (("depth", "samples wait"), ("dropped", "were dropped"))]
    waits = f"{counts[0]}, {spool.get('pending', '?')} of them for the smoother"
    message = f"{machine} runs: {waits}; {counts[1]}, {spool.get('put_aside', '?')} quarantined"
    message += f", {spool['gone']} are gone" if spool.get("gone") else ""
    problems = problems_of(values)
    message += f"; {status}" if status and status not in problems else ""
    lost = any(spool.get(key) for key in ("dropped", "put_aside", "gone"))
    return Finding(Level.WARN if problems or lost else Level.PASS, "spool", message, "; ".join(problems))


@dataclass(frozen=True)
class StoreState:
    """A store. snapshot_row, snapshot_age_s: of the newest snapshot; 0 and infinity without.

    shortfall: acknowledged samples now missing in its files, a line or empty. missing: those found by earlier starts,
    by machine. checkpoint_bytes: of all checkpoints.
    """

    site: str
    frame: str
    schema: int
    last_row: int
    archived_row: int
    machines: int
    snapshot_row: int
    snapshot_age_s: float
    shortfall: str = ""
    missing: Mapping[str, int] = field(default_factory=dict)
    checkpoints: int = 0
    checkpoint_bytes: int = 0
    damaged_checkpoints: int = 0
    replica: str = ""  # of a PostgreSQL journal


def read_store(folder: Path, now_s: float, url: str = "") -> StoreState:
    """State of a store, even in use; StoreError if unusable.

    url: of its journal in PostgreSQL.
    """
    # needs the `server` extra, missing on a machine's host
    from mapserver.ingest.map_info import lacking
    from mapserver.journal import shortfall as short
    from mapserver.journal.location import JOURNAL_FILE, JournalLocation
    from mapserver.past.checkpoints import Checkpoints, snapshot_path, snapshot_rows

    location = JournalLocation(folder, url)
    if not location.exists():
        what = "tables of a journal" if url else JOURNAL_FILE
        raise StoreError(location if url else folder, f"holds no {what}; a server makes it when it starts")
    lacks = lacking(location)
    with location.reader() as journal:
        journal.check()
        last_row, archived = journal.last_row, journal.archived_row
        watermarks, events = journal.watermarks(), journal.events()
        machines = {machine for machine, _ in watermarks}
        site, frame, schema, replica = journal.site, journal.frame, journal.schema, journal.replica
    known = [short.Shortfall.from_event(event) for event in events if event.kind == short.KIND]
    missing = short.missing(known, watermarks)
    newest = next(iter(snapshot_rows(folder)), 0)
    age_s = now_s - snapshot_path(folder, newest).stat().st_mtime if newest else math.inf
    text = str(lacks) if lacks else ""
    past = Checkpoints(folder).entries(lambda _: {}, last_row)
    sizes, damaged = sum(entry.bytes for entry in past), sum(entry.header is None for entry in past)
    rows = (schema, last_row, archived, len(machines), newest, age_s)
    behind = replica if url else ""
    return StoreState(site, frame, *rows, text, missing, len(past) - damaged, sizes, damaged, behind)


def check_store(state: StoreState, site: SiteConfig | None) -> Finding:
    """Its owner and its restart time."""
    rows = f"{state.last_row} rows of {state.machines} machines, {state.archived_row} archived"
    tail = state.last_row - state.snapshot_row
    snapshot = f"snapshot of row {state.snapshot_row}, {_ago(state.snapshot_age_s)}" if state.snapshot_row else ""
    checkpoints = f"{state.checkpoints} checkpoints of the past, {state.checkpoint_bytes / 1e9:.1f} GB"
    if state.damaged_checkpoints:
        checkpoints += f"; {state.damaged_checkpoints} damaged, the server makes them again"
    message = f"site {state.site}, schema {state.schema}: {rows}; {snapshot or 'no snapshot'}; {checkpoints}"
    message += f"; in PostgreSQL, replica: {state.replica}" if state.replica else ""
    if site and (site.name, site.frame) != (state.site, state.frame):
        problem = f"it is of site {state.site} with frame {state.frame}, the site file {site.name} with {site.frame}"
        return Finding(Level.FAIL, "store", problem, "choose another --store, or the site file that belongs to it")
    if state.shortfall:
        advice = (
            "restore a backup, or start the server: it goes on without them, and machines send what they still have"
        )
        return Finding(Level.FAIL, "store", state.shortfall, advice)
    if state.missing:
        counts = ", ".join(f"{n} of {machine}" for machine, n in sorted(state.missing.items()))
        return Finding(Level.WARN, "store", message, f"acknowledged samples are missing: {counts}; look at the disk")
    if tail > TAIL_ROWS:
        return Finding(Level.WARN, "store", message, f"a restart folds {tail} rows: see the log for failed snapshots")
    return Finding(Level.PASS, "store", message)


def _ago(age_s: float) -> str:
    if age_s < 0:
        return f"{-age_s:.0f} s from now"
    for unit, s in (("d", 86_400), ("h", 3600), ("min", 60)):
        if age_s >= 2 * s:
            return f"{age_s / s:.0f} {unit} ago"
    return f"{age_s:.0f} s ago"
