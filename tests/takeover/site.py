"""A site with router, PostgreSQL database, and two alternating map servers."""

from __future__ import annotations

import json
import signal
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psycopg

from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Admission
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.site.site_config import SiteConfig, site_toml
from protocol.wire.messages import SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.process.children import Child, Children
from tests.patience import PATIENCE_S, until
from tests.postgres_server import Cluster, Database
from tests.takeover.senders import BEGIN_NS, Acknowledged, Sender, rows_of
from tests.tcp_proxy import FAIR, Proxy, Weather

FENCED = 3
ROWS, FILL_BATCH = 100, 100  # per commit, and samples per row, of the initial content
SITE = SiteConfig("pit", 48.0, 11.0)
_HEAD = struct.Struct("<qqQqB")  # of a record (docs/operation.md), read without the product


@dataclass
class Server:
    """A map server of the site. proxy: to the database."""

    name: str
    proxy: Proxy
    child: Child
    serves: bool = False

    def is_serving(self) -> bool:
        self.serves |= any("ready" in line for line in self.child.lines())
        return self.serves


@dataclass
class Verdict:
    """Verdict from acknowledgements and database."""

    acknowledged: int
    rows: int
    lost: int
    double: int
    gaps: int
    old_epochs: int
    epochs: int
    faults: dict[str, int] = field(default_factory=dict)

    @property
    def is_clean(self) -> bool:
        return (self.lost, self.double, self.gaps, self.old_epochs) == (0, 0, 0, 0)


class TakeOverSite:
    """The site, after `start`; every process is one of `children`."""

    def __init__(
        self, folder: Path, children: Children, database: Database, machines: int = 3, hosts: Sequence[Cluster] = ()
    ) -> None:
        """hosts: of the database now or later, without proxy; none: proxied."""
        self._hosts = hosts
        self.folder, self.database, self._children = folder, database, children
        self.endpoint = free_endpoint()
        self.exit_codes: Counter[str] = Counter()
        self._made = 0
        (folder / "site.toml").write_text(site_toml(SITE))
        self.machines = [f"loader-{n}" for n in range(machines)]
        self.senders: list[Sender] = []
        self.standby: Server | None = None

    def fill(self, samples: int) -> None:
        """Fill the journal with an earlier machine's samples before any server starts."""
        journal = JournalLocation(self.folder / "fill", self.database.url).open(SITE.name, SITE.frame)
        with closing(journal):
            for first in range(1, samples, ROWS * FILL_BATCH):
                journal.begin()
                for seq in range(first, first + ROWS * FILL_BATCH, FILL_BATCH):
                    batch = SampleBatch("earlier", 1, seq, rows_of(seq, FILL_BATCH), SITE.frame)
                    journal.append(Admission(batch, trimmed=0, lost=0), BEGIN_NS)
                journal.commit()

    def start(self, pause_s: float = 0.02) -> None:
        self._children.start("router", "router", "--listen", self.endpoint).expect("ready", PATIENCE_S)
        self.session = self._children.enter_context(open_session(SessionConfig(self.endpoint)))
        self.active = self._server()
        self.active.child.expect("ready", PATIENCE_S)
        for machine in self.machines:
            sender = Sender(self.session, SITE, machine, self.folder / f"{machine}.audit", pause_s)
            self._children.callback(sender.end)
            self.senders.append(sender)
            sender.start()
        self.add_standby()

    def add_standby(self) -> Server:
        self.standby = self._server()
        self.standby.child.expect("standby", PATIENCE_S)
        return self.standby

    def acknowledged(self) -> list[Acknowledged]:
        return sorted((ack for sender in self.senders for ack in list(sender.acknowledged)), key=lambda ack: ack.at_s)

    def epoch(self) -> int:
        return max((ack.epoch for ack in self.acknowledged()), default=0)

    def wait_for_acknowledgements(self, count: int = 1, beyond: int = 0) -> float:
        """Wait for `count` acknowledgements with an epoch above `beyond`; returns the first one's time."""

        def seen() -> list[Acknowledged]:
            return [ack for ack in self.acknowledged() if ack.epoch > beyond]

        before = len(seen()) if not beyond else 0
        until(lambda: len(seen()) >= before + count, f"{count} acknowledgements beyond epoch {beyond}")
        return seen()[0].at_s if beyond else time.time()

    def settle(self) -> None:
        """Replace what ended after a fault, so that one server serves and one waits."""
        assert self.standby
        if not self.standby.is_serving() and self.active.child.code is None and self.standby.child.code is None:
            return  # the active one continued
        if self.standby.is_serving():
            self.active, self.standby = self.standby, self.active
        gone = self.standby
        self.exit_codes[str(gone.child.wait(PATIENCE_S))] += 1
        gone.child.stop()
        gone.proxy.__exit__()
        self.add_standby()

    def verdict(self) -> Verdict:
        """Compare audit files with the rows."""
        return verdict(
            self.folder, self.machines, self.database.sql("SELECT row, record FROM sitegrid.journal ORDER BY row")
        )

    def _server(self) -> Server:
        self._made += 1
        name = f"server-{self._made}"
        proxy = self._children.enter_context(Proxy(self.database.cluster.port))
        ports = [cluster.port for cluster in self._hosts] or [proxy.endpoint.rpartition(":")[2]]
        hosts = ",".join(f"127.0.0.1:{port}" for port in ports)
        url = f"postgresql://postgres@{hosts}/{self.database.name}?target_session_attrs=read-write"
        words = ("--endpoint", self.endpoint, "--site-file", self.folder / "site.toml")
        words += ("--store", self.folder / name, "--journal", url)
        return Server(name, proxy, self._children.start(name, "server", *words))


def verdict(folder: Path, machines: Sequence[str], rows: Sequence[tuple[Any, ...]]) -> Verdict:
    """Compare audit files with database rows, by number and record, read independently."""
    there: Counter[tuple[str, int]] = Counter()
    for number, record in rows:
        assert zlib.crc32(record[:-4]) == int.from_bytes(record[-4:], "little")
        row, _, _, first_seq, name_bytes = _HEAD.unpack_from(record)
        assert row == number
        machine = record[_HEAD.size : _HEAD.size + name_bytes].decode()
        if machine not in machines:
            continue
        samples = (len(record) - _HEAD.size - name_bytes - 4) // SAMPLE_DTYPE.itemsize
        there.update((machine, first_seq + k) for k in range(samples))
    lines = [line for path in folder.glob("*.audit") for line in path.read_text().splitlines()]
    acks = [Acknowledged(**json.loads(line)) for line in lines]
    acks.sort(key=lambda ack: ack.at_s)
    reached = {name: max((ack.watermark for ack in acks if ack.machine == name), default=0) for name in machines}
    lost = sum((machine, seq) not in there for machine, until in reached.items() for seq in range(1, until + 1))
    most = {machine: max((seq for name, seq in there if name == machine), default=0) for machine in machines}
    missing = sum((machine, seq) not in there for machine, until in most.items() for seq in range(1, until + 1))
    gaps = [number for number, _ in rows] != list(range(1, len(rows) + 1))
    double = sum(count - 1 for count in there.values())
    old, newest = 0, 0
    for ack in acks:
        old += ack.epoch < newest
        newest = max(newest, ack.epoch)
    return Verdict(len(acks), len(rows), lost, double, missing + gaps, old, newest)


# --- faults ----------------------------------------------------------------------------------------------------------


def kill(site: TakeOverSite) -> None:
    """The active server's host seems to lose power."""
    site.active.child.send(signal.SIGKILL)


def stop(site: TakeOverSite) -> None:
    """It hangs with its connection intact."""
    site.active.child.send(signal.SIGSTOP)


def stop_in_commit(site: TakeOverSite) -> None:
    """It hangs during a commit, with the answer under way."""
    site.active.proxy.set(Weather(hold_back=True))
    time.sleep(0.05)
    site.active.child.send(signal.SIGSTOP)
    site.active.proxy.set(FAIR)


def terminate(site: TakeOverSite) -> None:
    """The database ends the session."""
    site.database.end_writer()


def cut_answer(site: TakeOverSite) -> None:
    """The connection breaks between COMMIT and its answer."""
    site.active.proxy.set(Weather(hold_back=True))
    time.sleep(0.1)
    site.active.proxy.set(Weather(cut=True))
    site.active.proxy.set(FAIR)


def cut_network(site: TakeOverSite) -> None:
    """Both directions silently drop everything."""
    site.active.proxy.set(Weather(hold_there=True, hold_back=True))


def slow_commit(site: TakeOverSite) -> None:
    """A commit outlasts the idle session limit, and the server is killed in it."""
    blocked = "SELECT pid FROM pg_stat_activity WHERE wait_event_type = 'Lock' AND application_name = 'sitegrid writer'"
    with psycopg.connect(site.database.url) as db:
        db.execute("SELECT * FROM sitegrid.head FOR UPDATE")
        until(lambda: bool(site.database.sql(blocked)), "a commit waits")
        time.sleep(2.5)
        site.active.child.send(signal.SIGKILL)
        db.rollback()


FAULTS: Sequence[Callable[[TakeOverSite], None]] = (
    kill,
    stop,
    terminate,
    cut_answer,
    slow_commit,
    stop_in_commit,
    cut_network,
)


def round_of(site: TakeOverSite, fault: Callable[[TakeOverSite], None]) -> dict[str, Any]:
    """One fault, until a new epoch acknowledges batches and two servers stand again."""
    site.wait_for_acknowledgements(3)
    epoch, began_s = site.epoch(), time.time()
    fault(site)
    took_s = site.wait_for_acknowledgements(beyond=epoch) - began_s
    if fault in (stop, stop_in_commit):
        site.active.child.send(signal.SIGCONT)
    site.wait_for_acknowledgements(3)
    site.settle()
    return {"fault": fault.__name__, "seconds": round(took_s, 3), "epoch": site.epoch()}
