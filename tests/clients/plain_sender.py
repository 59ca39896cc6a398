"""An independent sender of samples, written from docs/protocol.md alone, without this project's code.

    python plain_sender.py ENDPOINT FRAME SITE MACHINE SPOOL --samples N --seed S

It makes N samples, records each in its spool (SQLite, synced), and sends until all are acknowledged: batches cut anew
at every attempt, timeouts often too short, and occasional repetitions despite an acknowledgement. One of 50 samples is
bad. It may be killed at any moment; a new process on the same spool continues. At the end it prints `done`.
"""

from __future__ import annotations

import argparse
import hashlib
import random
import secrets
import sqlite3
import struct
import time
from dataclasses import dataclass
from typing import Any

import msgpack
import zenoh

# Without calibration, mass, lanes and fuel it omits these columns.
COLUMNS = (  # name, format in the struct module
    *(("stamp_ns", "q"), ("x_m", "d"), ("y_m", "d")),
    *((name, "f") for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "heading_rad", "speed_mps", "distance_m")),
    *((name, "f") for name in ("c_rr", "c_rr_var", "grade_e", "grade_n", "grade_var")),
)
ROW = "<" + "".join(kind for _, kind in COLUMNS)
START_NS = 1_767_225_600_000_000_000
BAD_EVERY = 50
TOO_MANY = ("too_large",)
BAD_SAMPLE = ("not_finite", "out_of_range", "covariance", "outside_site", "far_future")
CLOSED_RUNS = 16

Row = tuple[Any, ...]


def frame_of(lat_deg: float, lon_deg: float, height_m: float) -> str:
    """A site frame's eight digits."""
    origin = f"+lat_0={lat_deg!r} +lon_0={lon_deg!r}"
    text = f"+proj=tmerc {origin} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs {height_m!r}"
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def sample(seed: int, number: int) -> Row:
    """The n-th sample of a machine, unique by its stamp."""
    bad = number % BAD_EVERY == BAD_EVERY - 1
    x_m = float("nan") if bad else 40.0 + number % 60
    place = (START_NS + number * 10**8 + seed, x_m, 20.0 + number // 60 % 40)
    return (*place, 0.5, 0.1, 0.5, 0.0, 5.0, 1.0, 0.04, 1e-5, float("nan"), float("nan"), float("nan"))


def open_session(endpoint: str) -> Any:
    """A client of the site's router, once it is there."""
    config = zenoh.Config()
    for key, value in (
        ("mode", '"client"'),
        ("connect/endpoints", f'["{endpoint}"]'),
        ("scouting/multicast/enabled", "false"),
        ("transport/shared_memory/enabled", "false"),
    ):
        config.insert_json5(key, value)
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            time.sleep(0.2)


@dataclass
class Run:
    """One opening of the spool. newest: last number recorded; acknowledged: last number at the server."""

    id: int
    newest: int
    acknowledged: int
    store: str


class Spool:
    def __init__(self, path: str) -> None:
        self._db = sqlite3.connect(path, isolation_level=None)
        self._db.executescript(
            "PRAGMA journal_mode=WAL; PRAGMA synchronous=FULL;"
            "CREATE TABLE IF NOT EXISTS run (place INTEGER PRIMARY KEY, id TEXT, newest INTEGER, acknowledged INTEGER,"
            " store TEXT);"
            "CREATE TABLE IF NOT EXISTS sample (place INTEGER, seq INTEGER, row BLOB, PRIMARY KEY (place, seq));"
            "CREATE TABLE IF NOT EXISTS quarantine (place INTEGER, seq INTEGER, row BLOB);"
        )
        self.start_run()

    def recorded(self) -> int:
        """Samples of all runs so far."""
        return int(self._db.execute("SELECT sum(newest) FROM run").fetchone()[0])

    def record(self, rows: list[Row]) -> None:
        first = self.run(self.place).newest + 1
        with self._transaction():
            self._db.execute("UPDATE run SET newest = ? WHERE place = ?", (first - 1 + len(rows), self.place))
            packed = [(self.place, first + i, struct.pack(ROW, *row)) for i, row in enumerate(rows)]
            self._db.executemany("INSERT INTO sample VALUES (?, ?, ?)", packed)

    def runs(self) -> list[tuple[int, Run]]:
        """All runs, oldest first."""
        rows = self._db.execute("SELECT place, id, newest, acknowledged, store FROM run ORDER BY place").fetchall()
        return [(place, Run(int(number), *rest)) for place, number, *rest in rows]

    def run(self, place: int) -> Run:
        return next(run for at, run in self.runs() if at == place)

    def head(self, place: int, most: int) -> tuple[int, list[bytes]]:
        """A run's oldest consecutive samples: first number, and all."""
        rows = self._db.execute(
            "SELECT seq, row FROM sample WHERE place = ? ORDER BY seq LIMIT ?", (place, most)
        ).fetchall()
        first = rows[0][0] if rows else 0
        return first, [row for i, (seq, row) in enumerate(rows) if seq == first + i]

    def acknowledge(self, place: int, watermark: int, store: str) -> None:
        with self._transaction():
            self._db.execute("UPDATE run SET acknowledged = ?, store = ? WHERE place = ?", (watermark, store, place))
            self._db.execute("DELETE FROM sample WHERE place = ? AND seq <= ?", (place, watermark))

    def quarantine(self, place: int, seq: int) -> None:
        with self._transaction():
            self._db.execute("INSERT INTO quarantine SELECT * FROM sample WHERE place = ? AND seq = ?", (place, seq))
            self._db.execute("DELETE FROM sample WHERE place = ? AND seq = ?", (place, seq))

    def start_run(self) -> None:
        """Start a new run."""
        words = "INSERT INTO run (id, newest, acknowledged, store) VALUES (?, 0, 0, '')"
        self.place = int(self._db.execute(words, (str(secrets.randbits(64) or 1),)).lastrowid or 0)

    def _transaction(self) -> _Transaction:
        return _Transaction(self._db)


class _Transaction:
    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def __enter__(self) -> None:
        self._db.execute("BEGIN IMMEDIATE")

    def __exit__(self, kind: object, *_: object) -> None:
        self._db.execute("ROLLBACK" if kind else "COMMIT")


class Sender:
    def __init__(self, session: Any, key: str, machine: str, frame: str, spool: Spool, draw: random.Random) -> None:
        self._session, self._key, self._machine, self._frame = session, key, machine, frame
        self.spool, self._draw = spool, draw
        self._most = 64
        self._failures = 0
        self._sent: list[bytes] = []

    def ask(self, payload: bytes, timeout_s: float) -> dict[str, Any] | None:
        """The acknowledgement, or None, which proves nothing."""
        replies = list(self._session.get(self._key, payload=payload, timeout=timeout_s))
        for reply in replies:
            if reply.ok is not None:
                answer: dict[str, Any] = msgpack.unpackb(reply.ok.payload.to_bytes())
                return answer if answer.get("v") == 1 else None
        return None

    def batch(self, run: Run, first: int, rows: list[bytes], lost_before: int) -> bytes:
        columns = list(zip(*(struct.unpack(ROW, row) for row in rows), strict=True)) or [()] * len(COLUMNS)
        packed = {
            name: struct.pack(f"<{len(rows)}{kind}", *values)
            for (name, kind), values in zip(COLUMNS, columns, strict=True)
        }
        fields = {"v": 1, "machine": self._machine, "spool_id": run.id, "first_seq": first, "n": len(rows)}
        fields |= {"frame": self._frame, "lost_before": lost_before, "store": run.store, "cols": packed}
        return bytes(msgpack.packb(fields))

    def deliver(self, place: int) -> bool:
        """Send a run's oldest samples once; False if it has none."""
        run = self.spool.run(place)
        first, rows = self.spool.head(place, self._draw.randint(1, self._most))
        if not rows:
            return False
        payload = self.batch(run, first, rows, first - 1 - run.acknowledged)
        self._replay(payload)
        # Usually long enough; else the reply comes too late.
        answer = self.ask(payload, self._draw.choice((3.0, 3.0, 0.002)))
        self._take(place, run, first, len(rows), answer)
        return True

    def _take(self, place: int, run: Run, first: int, n: int, answer: dict[str, Any] | None) -> None:
        """Handle a batch's answer by the document."""
        if answer is None:
            self._pause()
            return
        self._failures = 0
        if answer["ack"]:
            self._acknowledged(place, run, answer)
            return
        reason = answer["reason"]
        if reason in BAD_SAMPLE and n == 1:
            self.spool.quarantine(place, first)
            self._most = 64
        elif reason in (*BAD_SAMPLE, *TOO_MANY):
            self._most = max(1, n // 2)
        elif reason == "gap" and answer["expected"] <= first:
            self.spool.acknowledge(place, answer["expected"] - 1, run.store)
            self.close_earlier()
        else:
            self._pause(answer.get("retry_after_s", 0.0))

    def _acknowledged(self, place: int, run: Run, answer: dict[str, Any]) -> None:
        store, watermark = answer["store"], answer["watermark"]
        if run.store not in ("", store) and answer.get("replaces", "") != run.store:
            self._pause()
            return
        if watermark > run.newest:
            self.spool.start_run()
            return
        # An empty run is unbound: its acknowledgement only says that no sample is known.
        self.spool.acknowledge(place, watermark, store if watermark else run.store)

    def close_earlier(self) -> None:
        """Declare the newest earlier runs closed."""
        for _, run in [each for each in self.spool.runs() if each[0] < self.spool.place][-CLOSED_RUNS:]:
            while not (answer := self.ask(self.batch(run, run.newest + 1, [], run.newest), 3.0)) or not answer["ack"]:
                self._pause()
            self._failures = 0

    def _pause(self, least_s: float = 0.0) -> None:
        """Exponential back-off with jitter."""
        pause_s = min(5.0, 0.2 * 2**self._failures) * self._draw.uniform(0.5, 1.0)
        self._failures += 1
        time.sleep(max(least_s, pause_s))

    def _replay(self, payload: bytes) -> None:
        """Occasionally repeat something sent before, ignoring the answer."""
        self._sent = [*self._sent[-20:], payload]
        if self._draw.random() < 0.3:
            self.ask(self._draw.choice(self._sent), 3.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("endpoint", "frame", "site", "machine", "spool"):
        parser.add_argument(name)
    parser.add_argument("--samples", type=int, required=True)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    spool = Spool(given.spool)
    key = f"sitegrid/{given.site}/ingest/{given.machine}"
    draw = random.Random(f"{given.seed} {spool.place}")
    sender = Sender(open_session(given.endpoint), key, given.machine, given.frame, spool, draw)
    for place, _ in spool.runs()[:-1]:
        while sender.deliver(place):
            pass
    sender.close_earlier()
    while (number := spool.recorded()) < given.samples:
        numbers = range(number, min(given.samples, number + draw.randint(1, 30)))
        spool.record([sample(given.seed, n) for n in numbers])
        sender.deliver(spool.place)
    while sender.deliver(spool.place):
        pass
    spool.start_run()  # closes the last one
    sender.close_earlier()
    print("done", flush=True)


if __name__ == "__main__":
    main()
