"""Unique machine names, and a machine that catches up: over Zenoh, in one process."""

from __future__ import annotations

import contextlib
import itertools
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from agents.agent import Agent, Places
from agents.config import AgentConfig
from agents.delivery.spool import Spool, SpoolConfig
from agents.delivery.uplink import Uplink, UplinkConfig, Wait
from agents.delivery.uplink_thread import UplinkThread
from agents.localisation.filters.belief import PoseBelief
from agents.presence import PATIENCE, Presence, find_namesake
from agents.sampling import Samples
from mapserver.config import ServerConfig
from mapserver.journal.location import JournalLocation
from mapserver.server import Server
from protocol.errors import LinkError
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.codec import decode_batch, decode_health, decode_pose, encode_reply
from protocol.wire.messages import Ack, Refused
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.commands.agent import _claim_name, _open
from tests.patience import PATIENCE_S, until
from tests.tcp_proxy import Proxy, Weather
from tests.unit.agents.drives import made_up_samples

SITE = SiteConfig("lot", 49.01, 8.4, 120.0)
MACHINE = MachineConfig("loader-1", sensors=(SensorConfig("imu", "imu"), SensorConfig("wheels", "encoder")))
TIMEOUT_S = UplinkConfig().timeout_s

Opened = Callable[..., zenoh.Session]


@pytest.fixture
def endpoint() -> Iterator[str]:
    endpoint = free_endpoint()
    router: Any = open_session(SessionConfig(endpoint, mode="router"))
    yield endpoint
    router.close()


@pytest.fixture
def slow_link(endpoint: str) -> Iterator[str]:
    """The router's endpoint over 300 kbit/s."""
    with Proxy(int(endpoint.rpartition(":")[2]), Weather(bytes_per_s=300e3 / 8), 4096) as link:
        yield link.endpoint


@pytest.fixture
def opened(endpoint: str) -> Iterator[Opened]:
    """Sessions like agents', closed with the test."""
    with contextlib.ExitStack() as stack:

        def session(where: str = endpoint) -> zenoh.Session:
            opened: Any = _open(SessionConfig(where))
            stack.callback(opened.close)
            return opened

        yield session


# --- one machine's name ----------------------------------------------------------------------------------------------


def test_second_live_agent_of_a_name_is_refused_and_named(endpoint: str, opened: Opened) -> None:
    first = Presence(opened(), SITE.name, "loader-1")
    host, pid = socket.gethostname(), first.owner.pid
    with pytest.raises(LinkError, match=rf"an agent of loader-1 runs already, pid {pid} on host {host}; stop it"):
        _claim_name(opened(), endpoint, SITE.name, "loader-1")
    assert _claim_name(opened(), endpoint, SITE.name, "loader-2") > first.owner
    first.close()
    _claim_name(opened(), endpoint, SITE.name, "loader-1")


def test_agent_without_a_router_starts(opened: Opened) -> None:
    nowhere = free_endpoint()
    session: Any = _open(SessionConfig(nowhere))
    assert _claim_name(session, nowhere, SITE.name, "loader-1").pid > 0
    session.close()


def test_killed_predecessor_keeps_nobody_from_starting(endpoint: str, opened: Opened) -> None:
    """Until its lease ends, a router shows its token and passes it queries, unanswered."""
    killed, held = opened(), []
    token = killed.liveliness().declare_token(keys.alive(SITE.name, "loader-1"))
    queryable = killed.declare_queryable(keys.alive(SITE.name, "loader-1"), held.append)
    _claim_name(opened(), endpoint, SITE.name, "loader-1")
    assert held, "it was asked"
    for query in held:
        query.drop()
    queryable.undeclare()
    token.undeclare()


def test_later_one_of_two_agents_yields_until_the_other_is_gone(opened: Opened) -> None:
    """They met after both had started, e.g. without a link."""
    first = Presence(opened(), SITE.name, "loader-1")
    second = Presence(opened(), SITE.name, "loader-1")
    until(lambda: second.look_around() == first.owner, "the later one sees the earlier one")
    assert first.look_around() is None
    first.close()
    looks = itertools.count(1)
    until(lambda: next(looks) and second.look_around() is None, "the name is free")
    assert next(looks) > PATIENCE
    second.close()


def test_namesake_of_another_site_is_none(opened: Opened) -> None:
    first = Presence(opened(), "other", "loader-1")
    assert find_namesake(opened(), SITE.name, "loader-1") is None
    first.close()


class Silent:
    """A driver without readings that ends after a while."""

    def __init__(self, reads: int) -> None:
        self.left = reads

    def read(self, timeout_s: float) -> list[Any] | None:
        self.left -= 1
        time.sleep(0.01)
        return [] if self.left else None

    def counters(self) -> dict[str, int]:
        return {}

    def problems(self) -> list[str]:
        return []

    def close(self) -> None:
        return


def test_agent_holds_its_samples_while_another_has_its_name(opened: Opened, tmp_path: Path) -> None:
    first = Presence(opened(), SITE.name, "loader-1")
    agent = Agent(opened(), SITE, MACHINE, AgentConfig(), Places(tmp_path / "spool.db"))
    agent._spool.record(made_up_samples(3))
    until(lambda: agent._yield_name() or bool(agent._uplink.held), "it yields")
    problem = agent.report(Silent(1))["uplink"]["problem"]
    assert f"runs as {first.owner}: it sends, this one waits" in problem
    assert isinstance(agent._uplink.start_exchange(), Wait)
    agent.close()
    first.close()


def test_uplink_ends_at_once_while_a_server_does_not_answer(opened: Opened, tmp_path: Path) -> None:
    held: list[zenoh.Query] = []
    server = opened()
    queryable = server.declare_queryable(keys.ingest(SITE.name, "loader-1"), held.append)
    with uplink_of(opened(), tmp_path / "spool.db", 5, timeout_s=10 * PATIENCE_S):
        until(lambda: bool(held), "a batch is on its way")
    for query in held:
        query.drop()
    queryable.undeclare()


def test_forged_or_unsigned_reply_is_counted_and_not_believed(opened: Opened, tmp_path: Path) -> None:
    """An attacker on the router's host could send it: the samples would be deleted without a copy anywhere."""
    signatures = [None, b"forged"]
    store = "0123456789abcdef"

    def acknowledge(query: zenoh.Query) -> None:
        with query:
            batch = decode_batch(query.payload.to_bytes(), SITE.extent_m)
            signature = signatures.pop(0) if signatures else b"genuine"
            reply = Refused("out_of_range", "bad") if signature == b"forged" else Ack(batch.last_seq, 1, 0, store)
            query.reply(query.key_expr, encode_reply(reply), attachment=signature)

    def is_genuine(key: str, payload: bytes, reply: bytes, signature: bytes) -> bool:
        return signature == b"genuine"

    uplink, server = Uplink("loader-1", SITE.frame, 1.0), opened()
    with contextlib.closing(Spool(tmp_path / "spool.db", SpoolConfig())) as spool:
        spool.record(made_up_samples(5))
        queryable = server.declare_queryable(keys.ingest(SITE.name, "loader-1"), acknowledge)
        thread = UplinkThread(opened(), SITE.name, uplink, spool, lambda *_: b"mine", is_genuine)
        until(lambda: uplink.counters["refused_unsigned"] == 2, "two replies are not believed")
        assert spool.counters()["recorded"] == 5
        until(spool.is_settled, "the third one is")
        thread.close()
        assert (uplink.counters["refused_unsigned"], spool.counters()["put_aside"]) == (2, 0)
        queryable.undeclare()


def test_bug_does_not_end_delivery_silently(
    endpoint: str, opened: Opened, tmp_path: Path, monkeypatch: Any, caplog: pytest.LogCaptureFixture
) -> None:
    uplinks: list[Uplink] = []

    def fail(self: Uplink, *_: object) -> None:
        uplinks.append(self)
        raise RuntimeError("nobody thought of this")

    with monkeypatch.context() as patch, server_at(endpoint, tmp_path / "store"):
        patch.setattr(Uplink, "on_head", fail)
        with uplink_of(opened(), tmp_path / "spool.db", 5) as spool:
            until(lambda: len(uplinks) > 1, "it tries again")
            assert "nobody thought of this" in uplinks[0].problem
            assert uplinks[0].counters["bugs"] >= 1
            patch.undo()
            until(spool.is_settled, "everything delivered")
    assert "uplink failed" in caplog.text


# --- the disk --------------------------------------------------------------------------------------------------------


def test_agent_goes_on_while_its_disk_takes_nothing(opened: Opened, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("agents.delivery.write_buffer.MOST_UNSAVED", 8)
    agent = Agent(opened(), SITE, MACHINE, AgentConfig(linger_s=0), Places(tmp_path / "spool.db"))
    agent._spool._db.execute("PRAGMA query_only = ON")
    for _ in range(5):
        agent._take(Samples(made_up_samples(2), made_up_samples(2)))
        agent._write()
    report = agent.report(Silent(1))
    assert (report["samples"], report["spool"]["unsaved"], report["spool"]["given_up"]) == (0, 8, 2)
    assert "look at the machine's disk" in report["spool_problem"]
    assert not agent._is_delivered()
    agent._spool._db.execute("PRAGMA query_only = OFF")
    report = agent.run(Silent(3), lambda: False)
    assert (report["samples"], report["spool"]["unsaved"], report["spool_problem"]) == (8, 0, "")
    assert report["host"] == socket.gethostname()
    agent.close()


def test_samples_that_the_disk_takes_only_after_the_end_are_delivered(
    endpoint: str, opened: Opened, tmp_path: Path
) -> None:
    with server_at(endpoint, tmp_path / "store"):
        agent = Agent(opened(), SITE, MACHINE, AgentConfig(linger_s=PATIENCE_S), Places(tmp_path / "spool.db"))
        agent._spool._db.execute("PRAGMA query_only = ON")
        agent._take(Samples(made_up_samples(5), made_up_samples(5)))

        def mend(seconds: float) -> None:
            agent._spool._db.execute("PRAGMA query_only = OFF")
            time.sleep(seconds)

        report = agent.run(Silent(3), lambda: False, wait=mend)
        agent.close()
    assert (report["samples"], report["spool"]["unsaved"], report["spool_problem"]) == (5, 0, "")
    assert report["delivered"]


# --- a machine that was off for a week -------------------------------------------------------------------------------


@contextlib.contextmanager
def uplink_of(session: zenoh.Session, path: Path, n: int, timeout_s: float = TIMEOUT_S) -> Iterator[Spool]:
    spool = Spool(path, SpoolConfig())
    for first in range(0, n, 50_000):
        spool.record(made_up_samples(n)[first : first + 50_000])
    link = UplinkThread(session, SITE.name, Uplink("loader-1", SITE.frame, timeout_s), spool)
    yield spool
    link.close()
    spool.close()


@contextlib.contextmanager
def server_at(endpoint: str, folder: Path) -> Iterator[None]:
    session: Any = open_session(SessionConfig(endpoint))
    server = Server(session, session, JournalLocation(folder), SITE, ServerConfig(), time.time_ns)
    yield
    server.close()
    session.close()


@pytest.mark.slow
def test_machine_with_a_long_spool_catches_up(endpoint: str, opened: Opened, tmp_path: Path) -> None:
    with server_at(endpoint, tmp_path / "store"), uplink_of(opened(), tmp_path / "spool.db", 20_000) as spool:
        until(spool.is_settled, "everything delivered")


def test_pose_and_health_stay_live_while_a_machine_catches_up(
    endpoint: str, slow_link: str, opened: Opened, tmp_path: Path
) -> None:
    """Over 300 kbit/s, with a longer backlog than the test."""
    received = Counter[str]()

    def take(sample: zenoh.Sample) -> None:
        kind = str(sample.key_expr).rpartition("/")[2]
        decoders[kind](sample.payload.to_bytes())
        received[kind] += 1

    decoders = {"pose": decode_pose, "health": decode_health}
    listener = opened()
    for kind in decoders:
        listener.declare_subscriber(f"sitegrid/{SITE.name}/machine/*/{kind}", take)
    session = opened(slow_link)
    presence = Presence(session, SITE.name, "loader-1")
    with server_at(endpoint, tmp_path / "store"), uplink_of(session, tmp_path / "spool.db", 20_000) as spool:
        until(lambda: spool.acknowledged > 400, "it catches up")
        before = spool.acknowledged
        for i in range(25):
            now_ns = time.time_ns()
            presence.show_pose(PoseBelief(now_ns, 1.0, 2.0, 0.0, 0.0, np.eye(2)))
            if i % 5 == 0:
                presence.show_health(now_ns, {"spool": spool.counters()})
            time.sleep(0.2)
        until(lambda: received["pose"] >= 20 and received["health"] >= 4, "poses and health arrive")
        assert spool.counters()["depth"] > 0, "it was busy all the time"
        assert spool.acknowledged > before, "and batches went on"
    presence.close()
