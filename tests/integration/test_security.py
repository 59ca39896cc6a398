"""Access control with mutual TLS in real processes, and all who must not get through."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from protocol.errors import LinkError
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.queries.requests import PointQuery
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import MAX_BATCH_BYTES, decode_reply, encode_batch
from protocol.wire.credentials import SIGNING_FILE, Credentials, Identity, load_credentials
from protocol.wire.fields import MAX_SMALL_BYTES
from protocol.wire.messages import Ack, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sim.config import SimConfig, write_configs
from sitegrid import connect
from sitegrid.cli import main
from sitegrid.process.children import Child
from sitegrid.security.access import SPARE_BYTES
from sitegrid.security.join import reply_check
from sitegrid.security.signing import Signer
from tests.integration.forks import Forks
from tests.patience import PATIENCE_S, until

certificates = pytest.importorskip("sitegrid.security.key_folder", reason="cryptography is not installed")
pytestmark = pytest.mark.processes

SITE = "paper"
ROLES = {
    "loader-1": "machine",
    "loader-2": "machine",
    "guest": "visitor",
    "boss": "admin",
    "sim": "sim",
    "base-1": "corrections",
    "reader-1": "follower",
}
DAY = timedelta(days=1)


class Guarded:
    """Router and map server of a site with keys."""

    def __init__(self, folder: Path, children: Forks, *, signed: bool = False) -> None:
        self.keys, self.children = folder / "keys", children
        self.make_keys("init", "--site", SITE)
        for name, role in ROLES.items():
            self.make_keys("add", name, "--role", role)
        self.endpoint = free_endpoint().replace("tcp/", "tls/")
        self.configs = write_configs(SimConfig(machines=1, seed=1, world="fast"), folder)
        self.folder, self.site_file = folder, folder / "site.toml"
        self.router = children.start("router", "router", "--keys", self.keys, "--listen", self.endpoint)
        assert self.router.expect("ready", PATIENCE_S)["security"] == "mutual TLS"
        files = ("--site-file", self.site_file, "--store", folder / "store")
        asks = ("--signed", self.keys) if signed else ()
        self.server = children.start("server", "server", *self.network("server"), *files, *asks)
        self.server.expect("ready", PATIENCE_S)

    def make_keys(self, action: str, *words: str) -> None:
        assert main(["keys", action, *words, "--dir", str(self.keys)]) == 0

    def network(self, name: str) -> tuple[str | Path, ...]:
        return ("--endpoint", self.endpoint, "--keys", self.keys / name)

    def settings(self, name: str) -> SessionConfig:
        return SessionConfig(self.endpoint, credentials=load_credentials(self.keys / name))

    def session(self, name: str) -> closing[zenoh.Session]:
        return closing(open_session(self.settings(name)))

    def drive(self, spool: Path, seconds: float) -> tuple[Child, Child]:
        """A machine's agent and simulator."""
        files = ("--spool", spool, "--site-file", self.site_file, "--config", self.configs[0])
        agent = self.children.start("agent", "agent", *self.network("loader-1"), *files, "--json")
        agent.expect("ready", PATIENCE_S)
        words = ("--machines", 1, "--seed", 1, "--world", "fast", "--seconds", seconds, "--speed", 10, "--json")
        return agent, self.children.start("sim", "sim", *self.network("sim"), *words)

    def still_works(self) -> str:
        """Raises unless a visitor reads the map; returns a message for assertions."""
        with connect(self.endpoint, SITE, keys=self.keys / "guest") as client:
            client.info()
        return f"router pid {self.router.pid}, server pid {self.server.pid}"

    def batch(self, machine: str) -> bytes:
        """A machine's sample in its own spool, as an agent sends it."""
        rows = np.ones(1, SAMPLE_DTYPE)
        rows["cov_xy_m2"] = rows["applied_zero"] = rows["applied_scale"] = 0.0
        return encode_batch(SampleBatch(machine, time.time_ns(), 1, rows, load_site(self.site_file).frame))


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    folder = tmp_path_factory.mktemp("guarded")
    with Forks(folder) as children:
        yield Guarded(folder, children)


def answers(session: zenoh.Session, key: str, payload: bytes = b"", **options: Any) -> list[bytes]:
    replies = session.get(key, payload=payload, timeout=60.0, **options)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def acknowledged(session: zenoh.Session, key: str, batch: bytes) -> list[bool]:
    return [isinstance(decode_reply(data), Ack) for data in answers(session, key, batch)]


def is_taken(site: Guarded, session: zenoh.Session, machine: str) -> bool:
    """Whether a machine's batch is acknowledged exactly once."""
    return acknowledged(session, keys.ingest(SITE, machine), site.batch(machine)) == [True]


@contextlib.contextmanager
def listening(session: zenoh.Session, key: str) -> Iterator[list[bytes]]:
    """Arrivals on a key, known to the router once a later query is answered."""
    received: list[bytes] = []
    subscriber = session.declare_subscriber(key, lambda sample: received.append(sample.payload.to_bytes()))
    assert answers(session, keys.map_query(SITE, "info"))
    yield received
    subscriber.undeclare()


def put_until(received: list[bytes], payload: bytes, put: Callable[[], object]) -> None:
    """Put until arrival: routers learn of listeners late."""

    def arrived() -> bool:
        put()
        return payload in received

    until(arrived, f"{payload!r} received")


# --- who may, can ----------------------------------------------------------------------------------------------------


def test_a_machine_gets_its_acknowledgements_from_the_map_server(guarded: Guarded):
    with guarded.session("loader-1") as session, connect(guarded.endpoint, keys=guarded.keys / "loader-1") as client:
        before = client.info().journalled
        for _ in range(200):  # acknowledgements have no rate limit
            assert is_taken(guarded, session, "loader-1")
        assert client.info(after=before + 200).journalled == before + 200


@pytest.mark.nightly
def test_a_follower_with_keys_answers_under_its_own_name_alone(guarded: Guarded):
    with guarded.session("loader-1") as session:
        assert is_taken(guarded, session, "loader-1")
    words = ("--site-file", guarded.site_file, "--store", guarded.folder / "store")
    other = guarded.children.start("other", "follow", *guarded.network("reader-1"), *words, "--name", "reader-2")
    assert other.wait(PATIENCE_S) == 1, "the name is that of the keys"
    network = guarded.network("reader-1")
    follower = guarded.children.start("reader-1", "follow", *network, *words, "--name", "reader-1")
    follower.expect("ready", PATIENCE_S)
    with connect(guarded.endpoint, SITE, keys=guarded.keys / "guest") as client:
        row = client.info().journalled
        until(
            lambda: (
                client.ask(PointQuery(1.0, 1.0, after=row)).version.row == row and client.origin.follower == "reader-1"
            ),
            "an answer of the follower",
        )
        assert [one.name for one in client.followers()] == ["reader-1"]
    follower.stop()


def test_a_server_that_asks_for_signatures_takes_those_of_the_machine_alone(tmp_path: Path, children: Forks):
    site = Guarded(tmp_path, children, signed=True)
    key, batch = keys.ingest(SITE, "loader-1"), site.batch("loader-1")
    mine, others = (
        Signer((site.keys / name / SIGNING_FILE).read_bytes()).sign(key, batch) for name in ("loader-1", "loader-2")
    )
    with site.session("loader-1") as session:
        for signature in (None, others):
            (reply,) = answers(session, key, batch, attachment=signature)
            assert decode_reply(reply).reason == "wrong_machine", site.still_works()
        (reply,) = answers(session, key, batch, attachment=mine)
        assert isinstance(decode_reply(reply), Ack)
        (signed,) = session.get(key, payload=batch, attachment=mine, timeout=60.0)
        signature = signed.ok.attachment.to_bytes()
        assert reply_check(site.keys / "loader-1")(key, batch, signed.ok.payload.to_bytes(), signature)
    agent, _ = site.drive(tmp_path / "spool.db", 10)
    report = agent.expect("ended", PATIENCE_S)["ended"]
    assert report["delivered"], f"agent pid {agent.pid}, server pid {site.server.pid}"
    assert report["samples"] > 10


def test_a_visitor_reads_and_writes_nothing(guarded: Guarded):
    with connect(guarded.endpoint, SITE, keys=guarded.keys / "guest") as client:
        assert client.info().site.name == SITE
        with pytest.raises(LinkError, match="or these keys may not ask this"):
            client.distrust("loader-1", "because")
        guest = client.session
        assert answers(guest, keys.ingest(SITE, "loader-1"), guarded.batch("loader-1")) == []
        assert answers(guest, keys.ingest(SITE, "guest"), guarded.batch("guest")) == []
        with guarded.session("boss") as boss, listening(boss, keys.poses_all(SITE)) as received:
            guest.put(keys.pose(SITE, "loader-1"), b"forged")
            guest.put(keys.pose(SITE, "guest"), b"forged")
            assert answers(guest, keys.map_query(SITE, "info"))  # earlier puts were judged
            with guarded.session("loader-1") as loader:
                put_until(received, b"own", lambda: loader.put(keys.pose(SITE, "loader-1"), b"own"))
            assert set(received) == {b"own"}


# --- who has no name that counts -------------------------------------------------------------------------------------


def with_certificate(
    guarded: Guarded, folder: Path, authority: Any, days: float, name: str = "loader-1"
) -> Credentials:
    """Keys of an admitted machine with a certificate from elsewhere."""
    now = datetime.now(UTC)
    pair = certificates.issue(authority, name, now - 2 * DAY, now + days * DAY)
    shutil.copytree(guarded.keys / "loader-1", folder)
    (folder / "cert.pem").write_bytes(pair.certificate)
    (folder / "key.pem").write_bytes(pair.key)
    return Credentials(folder, Identity(SITE, name, "machine", now + DAY))


def own_authority(guarded: Guarded) -> Any:
    place = guarded.keys / "authority"
    return certificates.KeyPair((place / "cert.pem").read_bytes(), (place / "key.pem").read_bytes())


def refusal(config: SessionConfig) -> str:
    with pytest.raises(LinkError) as caught:
        open_session(dataclasses.replace(config, wait_s=0.4)).close()
    return str(caught.value)


def test_a_foreign_authority_is_refused(guarded: Guarded, tmp_path: Path):
    now = datetime.now(UTC)
    foreign = certificates.make_authority(SITE, now, now + DAY)
    credentials = with_certificate(guarded, tmp_path / "foreign", foreign, days=1)
    assert "do not know each other" in refusal(SessionConfig(guarded.endpoint, credentials=credentials))
    same = with_certificate(guarded, tmp_path / "same", own_authority(guarded), days=1)
    with closing(open_session(SessionConfig(guarded.endpoint, credentials=same))) as session:
        assert answers(session, keys.map_query(SITE, "info")), guarded.still_works()


def test_an_expired_certificate_is_refused(guarded: Guarded, tmp_path: Path):
    credentials = with_certificate(guarded, tmp_path / "old", own_authority(guarded), days=-1)
    assert "do not know each other" in refusal(SessionConfig(guarded.endpoint, credentials=credentials))
    assert guarded.still_works()


@pytest.mark.nightly
def test_a_link_ends_when_its_certificate_does(guarded: Guarded, tmp_path: Path):
    credentials = with_certificate(guarded, tmp_path / "short", own_authority(guarded), days=2 / 86400)
    with closing(open_session(SessionConfig(guarded.endpoint, credentials=credentials))) as session:
        assert answers(session, keys.map_query(SITE, "info"))
        until(lambda: not session.info.routers_zid(), "link closed")
        assert answers(session, keys.map_query(SITE, "info")) == [], guarded.still_works()


class NoCertificate(Credentials):
    """Knows the authority, shows no certificate."""

    def tls(self, *, listens: bool) -> Mapping[str, object]:
        return {"root_ca_certificate": str(self.folder / "ca.pem")}


def test_without_a_certificate_nobody_gets_in(guarded: Guarded):
    known = load_credentials(guarded.keys / "guest")
    without = NoCertificate(known.folder, known.identity)
    refusal(SessionConfig(guarded.endpoint, credentials=without))
    assert "pass --keys" in refusal(SessionConfig(guarded.endpoint.replace("tls/", "tcp/")))
    assert guarded.still_works()


def test_a_name_that_is_not_in_the_register_may_nothing(guarded: Guarded, tmp_path: Path):
    credentials = with_certificate(guarded, tmp_path / "unknown", own_authority(guarded), days=1, name="unknown")
    unknown = SessionConfig(guarded.endpoint, credentials=credentials)
    with closing(open_session(unknown)) as session:
        assert answers(session, keys.map_query(SITE, "info")) == [], guarded.still_works()


def test_a_machine_cannot_pose_as_the_router(guarded: Guarded):
    endpoint = free_endpoint().replace("tcp/", "tls/")
    thief = SessionConfig(endpoint, "router", credentials=load_credentials(guarded.keys / "loader-2"))
    with closing(open_session(thief)):
        refusal(dataclasses.replace(guarded.settings("loader-1"), endpoint=endpoint))


def test_a_router_is_believed_only_at_the_hosts_of_its_certificate(guarded: Guarded):
    port = free_endpoint().rpartition(":")[2]
    for host, is_listed in (("127.0.0.1", True), ("127.0.0.2", False)):
        endpoint = f"tls/{host}:{port}"
        router = SessionConfig(endpoint, "router", credentials=load_credentials(guarded.keys / "router"))
        with closing(open_session(router)):
            machine = dataclasses.replace(guarded.settings("loader-1"), endpoint=endpoint)
            if is_listed:
                open_session(machine).close()
            else:
                assert "do not know each other" in refusal(machine)


# --- who has a name, and wants more ----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["client", "router"])
def test_a_machine_writes_only_under_its_own_name(guarded: Guarded, mode: str):
    with as_machine(guarded, "loader-1", mode) as session:
        own, other = keys.ingest(SITE, "loader-1"), keys.ingest(SITE, "loader-2")
        assert acknowledged(session, own, guarded.batch("loader-1")) == [True]
        for forged in (guarded.batch("loader-2"), guarded.batch("loader-1")):
            assert answers(session, other, forged) == [], guarded.still_works()
            assert answers(session, keys.ingest_all(SITE), forged) == []
        assert answers(session, keys.admin(SITE, "trust")) == []


@contextlib.contextmanager
def as_machine(guarded: Guarded, name: str, mode: str) -> Iterator[zenoh.Session]:
    """A machine's session, possibly as a router to receive more."""
    settings = zenoh.Config()
    tls = load_credentials(guarded.keys / name).tls(listens=False)
    values = {"mode": mode, "connect/endpoints": [guarded.endpoint], "listen/endpoints": []}
    for key, value in {**values, "scouting/multicast/enabled": False, "transport/link/tls": tls}.items():
        settings.insert_json5(key, json.dumps(value))
    with closing(zenoh.open(settings)) as session:
        until(lambda: bool(answers(session, keys.map_query(SITE, "info"))), "connected")
        yield session


CORRECTIONS = keys.corrections(SITE, "base-1")
POSE, OTHERS_POSE = keys.pose(SITE, "loader-1"), keys.pose(SITE, "loader-2")
# Listener; forger and keys; legitimate sender and key.
FORGED = {
    "pose": (
        ("guest", keys.poses_all(SITE)),
        {"loader-1": (OTHERS_POSE, keys.poses_all(SITE), f"sitegrid/{SITE}/**")},
        ("loader-1", POSE),
    ),
    "corrections": (
        ("loader-2", keys.corrections_all(SITE)),
        {"loader-1": (CORRECTIONS,), "sim": (CORRECTIONS,), "base-1": (keys.corrections(SITE, "base-2"), POSE)},
        ("base-1", CORRECTIONS),
    ),
    "change": (("guest", keys.changed(SITE)), {"loader-1": (keys.changed(SITE),)}, ("server", keys.changed(SITE))),
}


@pytest.mark.parametrize("what", FORGED)
def test_what_is_forged_reaches_nobody(guarded: Guarded, what: str):
    (listener, key), forgers, (owner, own) = FORGED[what]
    with contextlib.ExitStack() as opened:
        sessions = {name: opened.enter_context(guarded.session(name)) for name in {listener, owner, *forgers}}
        received = opened.enter_context(listening(sessions[listener], key))
        for name, forged in forgers.items():
            for each in forged:
                sessions[name].put(each, b"forged")
            answers(sessions[name], keys.map_query(SITE, "info"))  # earlier puts were judged
        put_until(received, b"true", lambda: sessions[owner].put(own, b"true"))
        assert set(received) == {b"true"}, guarded.still_works()


def test_nobody_shows_presence_in_anothers_name(guarded: Guarded):
    with guarded.session("guest") as guest, guarded.session("loader-2") as loader:
        tokens = [loader.liveliness().declare_token(keys.alive(SITE, name)) for name in ("loader-1", "loader-2")]

        def present() -> set[str]:
            replies = guest.liveliness().get(keys.alive_all(SITE), timeout=60.0)
            return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

        until(lambda: bool(present()), "presence seen")
        assert present() == {keys.alive(SITE, "loader-2")}, guarded.still_works()
        for token in tokens:
            token.undeclare()


def test_nobody_listens_to_what_is_not_theirs(guarded: Guarded):
    own = keys.sensors(SITE, "loader-2")
    with (
        guarded.session("loader-2") as loader,
        guarded.session("guest") as guest,
        guarded.session("sim") as sim,
        listening(loader, "**") as all_heard,
        listening(guest, own) as guest_heard,
        listening(loader, own) as own_heard,
    ):
        sim.put(keys.sensors(SITE, "loader-1"), b"1")
        put_until(own_heard, b"2", lambda: sim.put(own, b"2"))
        assert b"1" not in all_heard
        assert guest_heard == [], guarded.still_works()


@pytest.mark.parametrize("mode", ["client", "router"])
def test_a_fake_map_server_is_never_asked(guarded: Guarded, mode: str):
    asked: list[str] = []

    def lie(query: zenoh.Query) -> None:
        with query:
            asked.append(str(query.key_expr))
            query.reply(query.key_expr, b"a lie")

    with as_machine(guarded, "loader-2", mode) as fake, guarded.session("loader-1") as loader:
        everything = (keys.map_queries_all(SITE), keys.ingest_all(SITE), keys.ingest(SITE, "loader-1"), "**")
        lies = [fake.declare_queryable(key, lie, complete=True) for key in everything]
        assert answers(fake, keys.map_query(SITE, "info"), allowed_destination=zenoh.Locality.REMOTE)  # after those
        for target in (zenoh.QueryTarget.ALL, zenoh.QueryTarget.BEST_MATCHING):
            replies = answers(loader, keys.map_query(SITE, "info"), target=target)
            assert len(replies) == 1
            assert b"a lie" not in replies
        assert is_taken(guarded, loader, "loader-1")
        assert asked == [], guarded.still_works()
        for queryable in lies:
            queryable.undeclare()


def test_oversize_payloads_stay_at_the_router(guarded: Guarded):
    own = keys.ingest(SITE, "loader-1")
    with guarded.session("loader-1") as loader, guarded.session("guest") as guest:
        assert answers(loader, own, bytes(MAX_BATCH_BYTES)), "the map server itself says what is wrong with it"
        assert answers(loader, own, bytes(MAX_BATCH_BYTES + SPARE_BYTES + 1)) == []
        assert answers(guest, keys.map_query(SITE, "info"), bytes(2**20 + 1)) == []
        with listening(guest, keys.poses_all(SITE)) as received:
            huge = bytes(MAX_SMALL_BYTES + 1)

            def put() -> None:
                loader.put(keys.pose(SITE, "loader-1"), huge)
                loader.put(keys.health(SITE, "loader-1"), huge)
                time.sleep(0.03)  # beyond the rate limit, which counts oversized messages
                loader.put(keys.pose(SITE, "loader-1"), b"small")

            put_until(received, b"small", put)
            assert huge not in received, guarded.still_works()


@pytest.mark.nightly
def test_a_flood_of_poses_is_thinned_out(guarded: Guarded):
    with guarded.session("guest") as guest, guarded.session("loader-1") as loader:
        with listening(guest, keys.poses_all(SITE)) as received:
            put_until(received, b"first", lambda: loader.put(keys.pose(SITE, "loader-1"), b"first"))
            began = time.monotonic()
            for _ in range(2000):
                loader.put(keys.pose(SITE, "loader-1"), b"flood")
            put_until(received, b"last", lambda: loader.put(keys.pose(SITE, "loader-1"), b"last"))
            most = 50 * (time.monotonic() - began) + 5
        assert received.count(b"flood") <= most, guarded.still_works()


@pytest.mark.nightly
def test_connections_that_say_nothing_delay_no_link(guarded: Guarded, children: Forks):
    """At a separate router: each closed connection pauses its listener 0.1 s, so 150 block it 15 s."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    router = children.start("router", "router", "--keys", guarded.keys, "--listen", endpoint)
    router.expect("ready", PATIENCE_S)
    place = tuple(endpoint.removeprefix("tls/").rsplit(":", 1))
    with contextlib.ExitStack() as opened:
        silent = [opened.enter_context(socket.create_connection(place, PATIENCE_S)) for _ in range(150)]
        with closing(open_session(dataclasses.replace(guarded.settings("guest"), endpoint=endpoint))):
            for one in silent:
                one.setblocking(False)
                with pytest.raises(BlockingIOError):  # the router still holds all of them
                    one.recv(1)
        assert router.code is None


# --- revoked ---------------------------------------------------------------------------------------------------------


def test_a_revoked_machine_is_shut_out_at_once_and_for_good(tmp_path: Path, children: Forks):
    site = Guarded(tmp_path, children)
    stolen = tmp_path / "stolen"
    shutil.copytree(site.keys / "loader-1", stolen)
    with site.session("loader-1") as loader, site.session("loader-2") as other:
        assert is_taken(site, loader, "loader-1")
        site.make_keys("revoke", "loader-1")
        assert site.router.expect("reloaded", PATIENCE_S)["names"] == len(ROLES), f"router pid {site.router.pid}"
        until(lambda: is_taken(site, other, "loader-2"), "others go on")
        until(lambda: bool(loader.info.routers_zid()), "the link is there again")
        assert acknowledged(loader, keys.ingest(SITE, "loader-1"), site.batch("loader-1")) == []
    site.make_keys("add", "loader-1")
    site.router.expect("reloaded", PATIENCE_S)
    with site.session("loader-1") as repaired:
        until(lambda: is_taken(site, repaired, "loader-1"), "back under the same name")
    old = SessionConfig(site.endpoint, credentials=load_credentials(stolen))
    with closing(open_session(old)) as session:
        assert answers(session, keys.ingest(SITE, "loader-1"), site.batch("loader-1")) == []
        assert answers(session, keys.map_query(SITE, "info")) == []


@pytest.mark.nightly
def test_a_broken_register_changes_nothing(guarded: Guarded):
    register, log = guarded.keys / "register.toml", guarded.keys.parent / "router.log"
    whole = register.read_bytes()
    register.write_bytes(whole[: len(whole) // 2] + b"[[[")
    until(lambda: "the rules stay as they were" in log.read_text(), "said so")
    assert guarded.still_works()
    register.write_bytes(whole)
    assert guarded.router.expect("reloaded", PATIENCE_S)["names"] == len(ROLES) + 1, "and the map server"
    until(lambda: guarded.router.code is None and answers_again(guarded), "as before")


def answers_again(guarded: Guarded) -> bool:
    with guarded.session("guest") as session:
        return bool(answers(session, keys.map_query(SITE, "info")))


# --- without keys ----------------------------------------------------------------------------------------------------


def test_without_keys_the_router_stays_on_this_host(children: Forks):
    port = free_endpoint().rpartition(":")[2]
    words = ["router", "--listen", f"tcp/0.0.0.0:{port}"]
    command = [sys.executable, "-m", "sitegrid.cli", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert "--keys" in done.stderr
    assert "--insecure" in done.stderr
    open_router: Child = children.start("open", *words, "--insecure")
    assert open_router.expect("ready", PATIENCE_S)["security"] == "none: open to everyone who gets here"
    assert open_router.stop() == 0
    router = children.start("router", "router", "--listen", f"tcp/127.0.0.1:{port}")
    assert router.expect("ready", PATIENCE_S)["security"] == "none: this host only"
