"""Soak: hours of a working site, compressed in time, on a real map server; its memory must stay flat.

python -m tests.soak: twelve hours in twelve minutes. --whole adds 50 machines with accelerometer biases for the server
to find, base station corrections, a follower, and an open page.

Machines drive laps and send 4 s batches stamped in site time; visitors query the map all along. The first third warms
everything up, and calibration fills its four hours of memory.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zenoh
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as open_socket

from protocol.arrays import Table
from protocol.errors import SitegridError
from protocol.machine.samples import empty
from protocol.queries.requests import HistoryQuery
from protocol.site.site_config import SiteConfig
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.client import Client, connect
from sitegrid.process.children import Child, Children
from tests.golden.make import FOLDER
from tests.patience import PATIENCE_S

START_NS = 1_767_225_600_000_000_000
SITE_TOML = 'name = "soak"\norigin_lat_deg = 49.01\norigin_lon_deg = 8.4\n'
BATCH_S, RATE_HZ = 4.0, 2.5  # per machine: batch interval, sample rate (5 m/s, every 2 m)
ASK_S, PAST_S, LOOK_S = 10.0, 100.0, 60.0  # site time between queries, queries of the past, looks
MOST_GROWTH_PCT = 5.0
WHOLE = 50  # machines
ZERO = 0.004  # accelerometer bias over g, found within hours


@dataclass(frozen=True)
class Look:
    """The site after some minutes, and resident memory of its processes [MiB]."""

    minute: float
    samples: int
    mib: Mapping[str, float]


@dataclass(frozen=True)
class Soak:
    """Result of a soak. late_s: largest lag behind the pace, site time."""

    looks: tuple[Look, ...]
    sent: int
    late_s: float

    def growth_pct(self, process: str = "server") -> float:
        """Memory growth from the run's middle third to its last, by medians: single looks vary by a tenth.

        The first third warms up; memory fluctuates with queries and folds.
        """
        memory = [look.mib[process] for look in self.looks]
        third = max(1, len(memory) // 3)
        return 100 * (float(np.median(memory[-third:]) / np.median(memory[-2 * third : -third])) - 1)


class SoakMachine:
    """One machine on its own laps, with slow GPS-like errors."""

    def __init__(self, name: str, seed: int, zero: float = 0.0) -> None:
        """zero: accelerometer bias, also in c_rr and forward slope."""
        self.name, self._zero = name, zero
        self._draw = np.random.default_rng(seed)
        self._centre_m, self._radius_m = self._draw.uniform(80, 220, 2), self._draw.uniform(20, 70)
        self._spool_id, self._seq = seed + 1, 0
        self._error_m = np.zeros(2)

    def drive(self, from_s: float, frame: str) -> bytes:
        """The batch of the next BATCH_S."""
        rows = self._samples(from_s + np.arange(round(BATCH_S * RATE_HZ)) / RATE_HZ)
        batch = SampleBatch(self.name, self._spool_id, self._seq + 1, rows, frame)
        self._seq += len(rows)
        return encode_batch(batch)

    def _samples(self, at_s: np.ndarray) -> Table:
        self._error_m = 0.9 * self._error_m + self._draw.normal(0, 0.4, 2)
        angle = at_s * 5.0 / self._radius_m
        rows = empty(len(at_s))
        rows["stamp_ns"] = START_NS + np.round(at_s * 1e9).astype(np.int64)
        rows["x_m"] = self._centre_m[0] + self._radius_m * np.cos(angle) + self._error_m[0]
        rows["y_m"] = self._centre_m[1] + self._radius_m * np.sin(angle) + self._error_m[1]
        rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1.0
        rows["heading_rad"] = np.mod(angle + math.pi / 2, 2 * math.pi)
        rows["speed_mps"], rows["distance_m"] = 5.0, 5.0 / RATE_HZ
        rows["c_rr"] = 0.03 + 0.02 * (rows["x_m"] > 150) + self._draw.normal(0, 0.002, len(at_s))
        rows["c_rr_var"] = rows["grade_var"] = 1e-4
        if self._zero:
            rows["c_rr"] -= self._zero
            rows["grade_e"] = self._zero * np.cos(rows["heading_rad"])
            rows["grade_n"] = self._zero * np.sin(rows["heading_rad"])
        return rows


def main(words: Sequence[str] | None = None) -> int:
    """Run a soak and print its table; 1 if memory grows."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=720.0, help="site time (default %(default)s)")
    parser.add_argument("--speed", type=float, default=60.0, help="times real time (default %(default)s)")
    parser.add_argument("--machines", type=int, default=10, help="default %(default)s")
    whole = f"{WHOLE} machines that are calibrated, a base station, a follower, an open page"
    parser.add_argument("--whole", action="store_true", help=whole)
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    arguments = parser.parse_args(words)
    machines = WHOLE if arguments.whole else arguments.machines
    with tempfile.TemporaryDirectory() as folder:
        result = soak(Path(folder), arguments.minutes, arguments.speed, machines, whole=arguments.whole)
    growth_pct = {process: round(result.growth_pct(process), 2) for process in result.looks[-1].mib}
    report(result, growth_pct)
    if arguments.json:
        last = result.looks[-1]
        print(json.dumps({"samples": last.samples, "mib": last.mib, "growth_pct": growth_pct}))
    return 0 if max(growth_pct.values()) < MOST_GROWTH_PCT else 1


def report(result: Soak, growth_pct: Mapping[str, float]) -> None:
    print(" minute   samples" + "".join(f"{process:>10} MiB" for process in growth_pct))
    step = max(1, len(result.looks) // 12)
    for look in result.looks[step - 1 :: step]:
        print(f"{look.minute:7.0f} {look.samples:9d}" + "".join(f"{mib:14.1f}" for mib in look.mib.values()))
    growth = ", ".join(f"{process} {pct:+.1f} %" for process, pct in growth_pct.items())
    print(f"last third, of resident memory: {growth}; sent {result.sent}, late {result.late_s:.0f} s")


def soak(folder: Path, minutes: float, speed: float, machines: int, *, whole: bool = False) -> Soak:
    """Run router, map server and optional parts with driving machines and visitors.

    Returns the looks by minute.
    """
    (folder / "site.toml").write_text(SITE_TOML)
    site, endpoint = load_site(folder / "site.toml"), free_endpoint()
    site_file, store = ("--site-file", folder / "site.toml"), ("--store", folder / "store")
    started = {"router": ("--listen", endpoint), "server": ("--endpoint", endpoint, *site_file, *store)}
    if whole:
        started["follow"] = ("--endpoint", endpoint, *site_file, *store, "--name", "second")
        started["web"] = ("--endpoint", endpoint, "--site", site.name, "--listen", "0")
    over = threading.Event()
    with Children(folder) as children, ExitStack() as asking:
        watched = {}
        for name, options in started.items():
            watched[name] = children.start(name, name, *options)
            ready = watched[name].expect("ready", PATIENCE_S)
        askers = [threading.Thread(target=_ask, args=(endpoint, speed, over))]
        if whole:
            page = f"ws{ready['url'].removeprefix('http')}api/v1/sites/{site.name}/live"
            askers.append(threading.Thread(target=_look_on, args=(page, over)))
        asking.callback(lambda: [asker.join() for asker in askers if asker.ident])
        asking.callback(over.set)
        for asker in askers:
            asker.start()
        return _drive(site, endpoint, watched, (minutes * 60, speed), _machines(machines, whole=whole))


def _machines(count: int, *, whole: bool) -> list[SoakMachine]:
    return [SoakMachine(f"machine-{i}", seed=i, zero=ZERO * (i % 3) * whole) for i in range(count)]


def _drive(
    site: SiteConfig,
    endpoint: str,
    watched: Mapping[str, Child],
    run: tuple[float, float],
    machines: Sequence[SoakMachine],
) -> Soak:
    """Send all machines' batches, and look at the processes every site minute."""
    end_s, speed = run
    session = open_session(SessionConfig(endpoint))
    looks: list[Look] = []
    begin_s, sent, late_s = time.monotonic(), 0, 0.0
    correction = (FOLDER / "corrections.bin").read_bytes()
    with connect(endpoint, site.name) as client:
        for at_s in np.arange(0.0, end_s, BATCH_S):
            early_s = begin_s + at_s / speed - time.monotonic()
            late_s = max(late_s, -early_s * speed)
            time.sleep(max(0.0, early_s))
            if "web" in watched:
                session.put(keys.corrections(site.name, "base-1"), correction)
            for machine in machines:
                _send(session, keys.ingest(site.name, machine.name), machine.drive(at_s, site.frame))
            sent += len(machines) * round(BATCH_S * RATE_HZ)
            if at_s + BATCH_S >= LOOK_S * (len(looks) + 1):
                looks.append(_look(client, watched, (at_s + BATCH_S) / 60))
    session.close()  # type: ignore[no-untyped-call]
    return Soak(tuple(looks), sent, late_s)


def _send(session: zenoh.Session, key: str, payload: bytes) -> None:
    """Send until acknowledged."""
    while True:
        for reply in session.get(key, payload=payload, timeout=60.0):
            if reply.ok is not None and isinstance(decode_reply(reply.ok.payload.to_bytes()), Ack):
                return


def _ask(endpoint: str, speed: float, over: threading.Event) -> None:
    """Query like a live map, occasionally for the past."""
    with connect(endpoint, "soak") as client:
        next_past_s = PAST_S
        begin_s = time.monotonic()
        while not over.wait(ASK_S / speed):
            with _survived():
                client.region((0, 0, 300, 300), ["resistance", "grade", "confidence"])
                client.point(150, 150)
                client.machines()
                if (at_s := (time.monotonic() - begin_s) * speed) >= next_past_s:
                    next_past_s = at_s + PAST_S
                    client.ask(HistoryQuery(150.0, 150.0, ("resistance",), span_s=300.0))
                    client.point(120, 0, as_of=START_NS + round(at_s * 0.5e9))


@contextmanager
def _survived() -> Iterator[None]:
    """A refused or unanswered visitor reports it and retries."""
    try:
        yield
    except SitegridError as error:
        print(error, file=sys.stderr)


def _look_on(page: str, over: threading.Event) -> None:
    """Keep a live page open that reads everything."""
    while not over.is_set():
        with suppress(OSError, ConnectionClosed), open_socket(page, max_size=None) as socket:
            while not over.is_set():
                with suppress(TimeoutError):
                    if isinstance(data := socket.recv(timeout=1.0), bytes):
                        head = json.loads(data[4 : 4 + int.from_bytes(data[:4], "big")])
                        socket.send(json.dumps({"row": head["row"], "fact": head["fact"]}))


def _look(client: Client, watched: Mapping[str, Child], minute: float) -> Look:
    page_mib = os.sysconf("SC_PAGE_SIZE") / 2**20
    pages = {name: int(Path(f"/proc/{child.pid}/statm").read_text().split()[1]) for name, child in watched.items()}
    return Look(minute, client.info().samples_merged, {name: n * page_mib for name, n in pages.items()})


if __name__ == "__main__":
    sys.exit(main())
