"""Operation of real processes: SIGTERM at bad moments, metrics, doctor, logs, memory."""

from __future__ import annotations

import contextlib
import json
import signal
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zenoh
from prometheus_client.parser import text_string_to_metric_families

from agents.delivery.spool import Spool, SpoolConfig
from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.sqlite.reader import SqliteReader
from protocol.machine.samples import empty
from protocol.site.site_config import SiteConfig
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.process.children import Child, Children
from tests.command_lines import said
from tests.integration.site_run import SiteRun  # beside this file
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.processes

END_S = 25.0  # ten times its own limit; Zenoh's replies and links, not to be awaited, take 30
NOW_NS = 1_767_225_600_000_000_000


def end(child: Child) -> None:
    """SIGTERM ends it cleanly, whatever it waits for."""
    child.send(signal.SIGTERM)
    assert child.wait(END_S) == 0


def session_of(endpoint: str) -> closing[zenoh.Session]:
    return closing(open_session(SessionConfig(endpoint)))


def drive(n: int, seed: int, first_s: int = 0) -> np.ndarray:
    """Samples on 50 x 50 m, one per second."""
    draw = np.random.default_rng(seed)
    rows = empty(n)
    rows["stamp_ns"] = NOW_NS + (first_s + np.arange(n)) * 10**9
    rows["x_m"], rows["y_m"] = draw.uniform(0, 50, (2, n))
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1.0
    rows["distance_m"], rows["c_rr"], rows["c_rr_var"] = 1.0, 0.04, 1e-5
    return rows


class Sender:
    """Sends batches on a thread as fast as acknowledged; keeps the last acknowledged number."""

    def __init__(self, session: zenoh.Session, site: SiteConfig, machine: str, n: int = 200) -> None:
        self.machine, self.watermark = machine, 0
        self._session, self._site, self._rows = session, site, drive(n, seed=len(machine))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            batch = SampleBatch(self.machine, 7, self.watermark + 1, self._rows, self._site.frame)
            key = keys.ingest(self._site.name, self.machine)
            for reply in self._session.get(key, payload=encode_batch(batch), timeout=1.0):
                if reply.ok is not None and isinstance(ack := decode_reply(reply.ok.payload.to_bytes()), Ack):
                    self.watermark = ack.watermark


def committed(store: Path) -> dict[str, int]:
    with SqliteReader(store / JOURNAL_FILE) as journal:
        return {machine: mark.seq for (machine, _), mark in journal.watermarks().items()}


# --- SIGTERM ---------------------------------------------------------------------------------------------------------


def old_rows(store: Path, site: SiteConfig) -> None:
    """Fill a store with rows due for the archive."""
    with closing(Store(JournalLocation(store), site, ServerConfig(), lambda: NOW_NS)) as opened:
        for i in range(50):
            batch = SampleBatch("old", 7, 1 + 1000 * i, drive(1000, seed=i, first_s=100 * i), site.frame)
            assert isinstance(opened.commit([Incoming("old", encode_batch(batch))])[0], Ack)
        opened.save_snapshot()


def test_a_server_that_folds_answers_and_archives_ends_in_time_with_all_committed(site: SiteRun):
    options = site.folder / "server.toml"
    options.write_text("[store]\narchive_after_h = 0.01\nsnapshot_s = 0.5\n")
    config = load_site(site.site_file)
    old_rows(site.folder / "store", config)
    site.start_router()
    server = site.start_server("--config", str(options))
    until((site.folder / "store" / "archive").exists, "the archive is begun")
    with session_of(site.endpoint) as session, contextlib.ExitStack() as senders:
        sent = [senders.enter_context(closing(Sender(session, config, f"machine{'x' * i}"))) for i in range(3)]
        until(lambda: min(s.watermark for s in sent) > 1000, "samples taken")
        asked = f"sitegrid/{site.site}/map/region?bounds=0,0,200,200;as_of={NOW_NS + 10**11}"
        questions = [session.get(asked, timeout=3.0) for _ in range(8)]
        end(server)
        for question in questions:
            list(question)
    marks = committed(site.folder / "store")
    assert marks["old"] == 50 * 1000
    assert all(marks[s.machine] >= s.watermark for s in sent), "what was acknowledged is on disk"


@pytest.mark.nightly
def test_a_server_that_folds_a_long_journal_at_its_start_ends_in_time(site: SiteRun, children: Children):
    store, old = site.folder / "store", load_site(site.site_file)
    old_rows(store, old)
    for cache in store.glob("snapshot-*"):
        cache.unlink()
    text = site.site_file.read_text()
    site.site_file.write_text(text.replace(f"cell_m = {old.cell_m}", "cell_m = 0.05"))  # slow: many cells per sample
    assert load_site(site.site_file).cell_m == 0.05
    site.start_router()
    words = ("--endpoint", site.endpoint, "--site-file", site.site_file, "--store", store)
    server = children.start("server", "server", *words)
    until(lambda: (store / "journal.db-wal").exists(), "the store is opened")
    end(server)
    assert not server.lines(), "it was not ready yet"
    assert committed(store) == {"old": 50_000}


def wait_for_handlers(child: Child) -> None:
    """Wait until it handles SIGTERM, which kills it before."""

    def catches() -> bool:
        status = dict(line.split(":", 1) for line in Path(f"/proc/{child.pid}/status").read_text().splitlines())
        return bool(int(status["SigCgt"], 16) >> (signal.SIGTERM - 1) & 1)

    until(catches, f"{child.name} catches SIGTERM")


def start_agent(site: SiteRun, *options: object) -> tuple[Child, Path]:
    spool = site.folder / "spool.db"
    words = ("--endpoint", site.endpoint, "--site-file", site.site_file, "--config", site.configs[0], "--spool", spool)
    agent = site.children.start("agent", "agent", *words, "--json", *map(str, options))
    return agent, spool


def fill(spool: Path, n: int) -> None:
    with closing(Spool(spool, SpoolConfig())) as opened:
        opened.record(drive(n, seed=1))


def depth(spool: Path) -> int:
    with closing(Spool(spool, SpoolConfig())) as opened:
        return opened.counters()["depth"]


def test_an_agent_with_a_full_spool_and_no_router_ends_in_time(site: SiteRun):
    fill(site.folder / "spool.db", 100_000)
    agent, spool = start_agent(site)
    agent.expect("ready", PATIENCE_S)
    end(agent)
    assert depth(spool) == 100_000


@pytest.mark.nightly
def test_an_agent_in_the_middle_of_an_exchange_with_a_dead_server_ends_in_time(site: SiteRun):
    site.start_router()
    fill(site.folder / "spool.db", 1000)
    asked = threading.Event()
    kept: list[zenoh.Query] = []

    def never_answer(query: zenoh.Query) -> None:
        kept.append(query)
        asked.set()

    with session_of(site.endpoint) as session:
        queryable = session.declare_queryable(keys.ingest_all(site.site), never_answer)
        agent, spool = start_agent(site)
        agent.expect("ready", PATIENCE_S)
        assert asked.wait(PATIENCE_S)
        end(agent)
        for query in kept:
            query.drop()
        queryable.undeclare()
    assert depth(spool) == 1000


@contextlib.contextmanager
def paused(child: Child) -> Iterator[None]:
    """A hang: sockets stay open, unread."""
    child.send(signal.SIGSTOP)
    try:
        yield
    finally:
        child.send(signal.SIGCONT)


@pytest.mark.nightly
def test_a_simulator_whose_router_hangs_ends_in_time(site: SiteRun):
    router = site.start_router()
    agent, _ = start_agent(site)
    agent.expect("ready", PATIENCE_S)
    sim = site.start_sim()
    sim.expect("simulated_s", PATIENCE_S)
    with paused(router):
        end(sim)


def test_a_query_that_follows_ends_in_time_also_while_the_server_hangs(site: SiteRun, children: Children):
    site.start_router()
    server = site.start_server()
    query = children.start("query", "query", "--endpoint", site.endpoint, "--site", site.site, "changes", "--follow")
    wait_for_handlers(query)
    with paused(server):
        end(query)


# --- metrics, logs, doctor -------------------------------------------------------------------------------------------


def scrape(url: str) -> dict[str, float]:
    """Metrics by name; those of machines for the only one."""
    with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    return {sample.name: sample.value for family in families for sample in family.samples}


def test_the_server_tells_prometheus_of_itself_and_of_the_agents(site: SiteRun):
    site.start_router()
    words = ("--endpoint", site.endpoint, "--site-file", site.site_file, "--store", site.folder / "store")
    server = site.children.start("server", "server", *words, "--metrics", "0")
    url = server.expect("ready", PATIENCE_S)["metrics"]
    assert url.startswith("http://127.0.0.1:")
    fill(site.folder / "spool.db", 500)
    agent, _ = start_agent(site)
    agent.expect("ready", PATIENCE_S)
    until(lambda: scrape(url).get("sitegrid_machine_samples_total") == 500, "samples counted")
    until(lambda: scrape(url).get("sitegrid_agent_spool_samples") == 0, "health received")
    metrics = scrape(url)
    assert metrics["sitegrid_map_samples"] == 500
    assert metrics["sitegrid_journal_rows"] == metrics["sitegrid_merged_rows"] > 0
    assert metrics["process_resident_memory_bytes"] > 20 * 2**20
    end(agent)
    end(server)


def test_a_server_listens_nowhere_unasked_and_logs_one_json_object_per_line(site: SiteRun):
    site.start_router()
    words = ("--endpoint", site.endpoint, "--site-file", site.site_file, "--store", site.folder / "s", "--verbose")
    server = site.children.start("server", "server", *words)
    assert "metrics" not in server.expect("ready", PATIENCE_S)
    sockets = {link.readlink().name for link in Path(f"/proc/{server.pid}/fd").iterdir() if link.is_symlink()}
    listening = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    assert not [row for row in listening if row[3] == "0A" and f"socket:[{row[9]}]" in sockets]
    with session_of(site.endpoint) as session:
        batch = SampleBatch("loader-1", 7, 1, drive(1, seed=1), 'a "frame"\n')
        list(session.get(keys.ingest(site.site, "loader-1"), payload=encode_batch(batch), timeout=60.0))
    end(server)
    lines = (site.folder / "server.log").read_text().splitlines()
    events = [json.loads(line) for line in lines if line.startswith("{")]
    assert len(events) == len(lines)
    refused = next(event for event in events if event["event"] == "refused")
    assert (refused["machine"], refused["reason"], refused["level"]) == ("loader-1", "wrong_frame", "WARNING")
    assert '"frame"' in refused["problem"] or "frame" in refused["problem"]


def run_doctor(*words: object) -> tuple[int, dict[str, dict[str, str]]]:
    answer = said("doctor", "--json", *words)
    return answer.code, {one["check"]: one for one in json.loads(answer.out.splitlines()[-1])["findings"]}


@pytest.fixture
def guarded(tmp_path: Path, children: Children) -> Callable[..., tuple[int, dict[str, dict[str, str]]]]:
    """Runs the doctor on a site with keys, with one name's."""
    pytest.importorskip("cryptography")
    folder, endpoint = tmp_path / "keys", free_endpoint().replace("tcp/", "tls/")
    assert said("keys", "init", "--dir", folder).code == 0
    for name, role in {"loader-1": "machine", "guest": "visitor", "sim": "sim", "gone": "machine"}.items():
        assert said("keys", "add", name, "--role", role, "--dir", folder).code == 0
    assert said("keys", "revoke", "gone", "--dir", folder).code == 0
    router = children.start("router", "router", "--keys", folder, "--listen", endpoint)
    router.expect("ready", PATIENCE_S)
    site_file = Path("config/site.toml").absolute()
    files = ("--site-file", site_file, "--store", tmp_path / "store")
    server = children.start("server", "server", "--endpoint", endpoint, "--keys", folder / "server", *files)
    server.expect("ready", PATIENCE_S)
    return lambda name, *words: run_doctor("--endpoint", endpoint, "--keys", folder / name, *words)


def test_the_doctor_tells_denials_from_absence(guarded: Callable[..., tuple[int, dict[str, dict[str, str]]]]):
    code, machine = guarded("loader-1")
    assert code == 0, machine
    passed = ("certificate", "name", "authority", "router", "server", "permission")
    assert {check: machine[check]["level"] for check in passed} == dict.fromkeys(passed, "PASS")
    code, other = guarded("loader-1", "--machine", "loader-2")
    assert code == 1
    assert other["server"]["level"] == "PASS"
    assert "under the name of its keys alone" in other["permission"]["advice"]
    code, visitor = guarded("guest")
    assert (code, visitor["server"]["level"], visitor["permission"]["level"]) == (0, "PASS", "-")
    code, sim = guarded("sim")
    assert (code, sim["router"]["level"], sim["server"]["level"]) == (0, "PASS", "-")
    code, revoked = guarded("gone", "--site-file", "config/site.toml")
    assert code == 1
    assert "revoked" in revoked["server"]["advice"] + revoked["router"]["advice"]
