"""Followers as real processes: the server's map bit for bit; one process per query, even if one dies."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import zenoh

from protocol.errors import LinkError, QueryError
from protocol.queries.answer_codec import decode_info, decode_point
from protocol.queries.answers import MapVersion
from protocol.queries.map_tiles import decode_tiles
from protocol.queries.origin import decode_origin
from protocol.queries.requests import PointQuery
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid import Client
from sitegrid.process.children import Child
from tests.command_lines import said
from tests.integration.forks import Forks
from tests.integration.site_run import NOBODY_DRIVES, SiteRun, kill
from tests.patience import PATIENCE_S, until
from tests.unit.mapserver.data import random_samples

pytestmark = pytest.mark.processes

WHOLE = "bounds=-80,-80,80,80;layers=resistance,grade_east,visits,age_s,resistance_filled,grade_filled_std"
SIM = NOBODY_DRIVES
QUIET = "[store]\narchive_after_h = 0.0\n[trust]\nexclude = false\n[calibration]\nautomatic = false\n"


class Followed(SiteRun):
    """Router and server with followers, and a sending session."""

    def start_follower(self, name: str, *, ready: bool = True) -> Child:
        words = ("--endpoint", self.endpoint, "--site-file", self.site_file, "--name", name)
        config = ("--config", self.folder / "server.toml")
        child = self.children.start(name, "follow", *words, *config, "--store", self.folder / "store")
        if ready:
            assert child.expect("ready", PATIENCE_S)["name"] == name
        return child

    def serve(self) -> Child:
        (self.folder / "server.toml").write_text(QUIET)
        return self.start_server("--config", str(self.folder / "server.toml"))


class Sender:
    """Sends random batches, a spool each."""

    def __init__(self, run: Followed) -> None:
        self.session = open_session(SessionConfig(run.endpoint))
        self._site, self._spool = load_site(run.site_file), 0

    def send(self, machine: str = "a", n: int = 50) -> int:
        """Returns the batch's journal row."""
        self._spool += 1
        rows = random_samples(n, self._spool)
        batch = encode_batch(SampleBatch(machine, self._spool, 1, rows, self._site.frame))
        replies: list[zenoh.Reply] = []
        key = keys.ingest(self._site.name, machine)

        def is_answered() -> bool:  # a new router may know nobody yet
            replies[:] = self.session.get(key, payload=batch, timeout=60.0)
            return bool(replies)

        until(is_answered, "the server takes batches")
        ack = decode_reply(replies[0].ok.payload.to_bytes())
        assert isinstance(ack, Ack)
        return ack.row

    def ask(self, key: str, parameters: str) -> zenoh.Sample:
        (reply,) = self.session.get(f"{key}?{parameters}", timeout=60.0)
        assert reply.ok is not None, reply.err.payload.to_bytes()
        return reply.ok


@pytest.fixture
def run(tmp_path: Path, children: Forks) -> Followed:
    site = Followed(tmp_path, children, free_endpoint(), SIM)
    site.start_router()
    return site


@pytest.fixture
def sender(run: Followed) -> Iterator[Sender]:
    one = Sender(run)
    with closing(one.session):
        yield one


def region(sender: Sender, run: Followed, follower: str, row: int) -> bytes:
    ask = f"{WHOLE};after={row};wait=20"
    if not follower:
        return sender.ask(keys.map_query(run.site, "region"), ask).payload.to_bytes()
    return sender.ask(keys.follower_query(run.site, follower, "region"), ask).payload.to_bytes()


def roads(sender: Sender, run: Followed, follower: str, query: str, row: int) -> bytes:
    name, _, parameters = query.partition("?")
    parameters = f"{parameters};after={row}"  # others may lag by seconds
    key = keys.follower_query(run.site, follower, name) if follower else keys.map_query(run.site, name)
    return sender.ask(key, parameters).payload.to_bytes()


def tiles(sender: Sender, run: Followed, follower: str) -> dict[tuple[int, int], tuple[int, bytes]]:
    key = keys.follower_query(run.site, follower, "tiles") if follower else keys.map_query(run.site, "tiles")
    answer = decode_tiles(sender.ask(key, "").payload.to_bytes())
    return {(tile.x, tile.y): (tile.newest_ns, tile.planes) for tile in answer.tiles}


def version_of(client: Client, sender: Sender, run: Followed, follower: str) -> MapVersion:
    return decode_tiles(sender.ask(keys.follower_query(run.site, follower, "tiles"), "").payload.to_bytes()).version


@pytest.mark.nightly
def test_two_followers_have_the_map_of_the_server_through_distrust_and_correction(run: Followed, sender: Sender):
    server = run.serve()
    for machine in "abcabc":
        sender.send(machine)
    near, far = run.start_follower("near"), run.start_follower("far")
    followers = [near, far]
    pids = f"server pid {server.pid}, followers pids {[one.pid for one in followers]}"
    with run.connect() as client:

        def all_equal(row: int) -> None:
            version = client.info(after=row)
            for name in ("near", "far"):
                until(
                    lambda name=name: (
                        version_of(client, sender, run, name) == MapVersion(version.store, version.merged, version.fact)
                    ),
                    f"{name} follows; {pids}",
                )
            maps = [region(sender, run, name, row) for name in ("", "near", "far")]
            assert maps[0] == maps[1] == maps[2], pids  # to the byte
            lines = ("route?line=-40,-40,0,10,40,40", "way?from=-40,-40;to=40,30;max_grade=1")
            for query in (
                "segments",
                "worklist",
                *lines,
            ):  # a former follower, and full readers
                answers = [roads(sender, run, name, query, row) for name in ("", "near", "far")]
                assert answers[0] == answers[1] == answers[2], (query, pids)
            drawn = [tiles(sender, run, name) for name in ("", "near", "far")]
            assert drawn[0] == drawn[1] == drawn[2], pids

        all_equal(sender.send("a"))
        client.distrust("b", "drifts")
        all_equal(sender.send("b"))
        client.correct("a", "measured on a ramp", zero=0.01)
        all_equal(sender.send("a"))
        client.trust("b", "repaired")
        all_equal(sender.send("c"))
        # ... and the past, and what only the journal has
        past = client.point(1.0, 1.0, as_of=client.info().stamp_ns)
        assert client.origin.follower in ("near", "far"), pids
        key = keys.map_query(run.site, "point")
        assert past.version.row == decode_point_row(sender, key, past.stamp_ns)


def decode_point_row(sender: Sender, key: str, stamp_ns: int) -> int:
    return decode_point(sender.ask(key, f"x=1;y=1;as_of={stamp_ns}").payload.to_bytes()).version.row


def answered(client: Client, sender: Sender, run: Followed, *followers: str) -> list[int]:
    """Numbers of queries answered by server and followers."""
    infos = [client.info()]
    for name in followers:
        data = sender.ask(keys.follower_query(run.site, name, "info"), "").payload.to_bytes()
        infos.append(decode_info(data))
    return [info.counters.get("queries_answered", 0) for info in infos]


@pytest.mark.nightly
def test_each_query_is_worked_by_one_process_and_by_another_while_one_dies(run: Followed, sender: Sender):
    server = run.serve()
    sender.send()
    near, far = run.start_follower("near"), run.start_follower("far")
    pids = f"server pid {server.pid}, near pid {near.pid}, far pid {far.pid}"
    clients = [run.connect() for _ in range(8)]
    try:
        before = answered(clients[0], sender, run, "near", "far")
        asked, origins = 0, dict[Client, str]()
        for client in clients:
            for _ in range(25):
                client.point(1.0, 1.0)
                asked += 1
            origins[client] = client.origin.follower
        after = answered(clients[0], sender, run, "near", "far")
        done = [now - then for now, then in zip(after, before, strict=True)]
        assert sum(done) - 3 == asked, pids  # plus the three counting queries
        assert done[0] == 1, pids  # the server only counted
        assert set(origins.values()) <= {"near", "far"}
        # Stop one during a query and kill it: the other answers.
        victim = next((client for client in clients if origins[client] == "near"), clients[0])
        name = origins[victim]
        child, other = (near, "far") if name == "near" else (far, "near")
        child.send(signal.SIGSTOP)
        got: list[object] = []

        def ask() -> None:
            got.append(victim.point(1.0, 1.0))

        thread = threading.Thread(target=ask)
        thread.start()
        thread.join(0.3)
        assert not got, pids  # held by a stopped process
        kill(child)
        thread.join(PATIENCE_S)
        assert got, pids
        assert victim.origin.follower == other, pids
        for client in clients:
            client.point(1.0, 1.0)
            assert client.origin.follower == other, pids
    finally:
        for client in clients:
            client.close()


@pytest.mark.nightly
def test_the_map_is_read_while_the_server_is_away_and_after_it_is_back(run: Followed, sender: Sender):
    server = run.serve()
    row = sender.send()
    follower = run.start_follower("near")
    with run.connect() as client:
        kill(server)
        point = client.ask(PointQuery(1.0, 1.0, after=row))
        assert point.version.row == row
        assert client.info().server.pid == follower.pid
        with pytest.raises(LinkError, match="no map server"):
            Client(client.session, run.endpoint, run.site, timeout_s=0.5).machines()
        again = run.serve()
        later = sender.send()
        assert later > row, f"server pid {again.pid}, follower pid {follower.pid}"
        # Rows it lacks are queried from the server: `after` keeps its meaning.
        assert client.ask(PointQuery(1.0, 1.0, after=later)).version.row >= later
        until(lambda: client.ask(PointQuery(1.0, 1.0, after=later)) and client.origin.follower == "near", "followed")


# --- one server and one follower, unchanged by tests


@dataclass(frozen=True)
class Quiet:
    """A site with one row, and a follower at it."""

    run: Followed
    sender: Sender
    row: int
    follower: Child


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Quiet]:
    folder = tmp_path_factory.mktemp("quiet")
    with Forks(folder) as children:
        run = Followed(folder, children, free_endpoint(), SIM)
        run.start_router()
        run.serve()
        sender = Sender(run)
        with closing(sender.session):
            yield Quiet(run, sender, sender.send(), run.start_follower("near"))


def test_a_follower_that_lacks_a_row_refuses_and_the_server_is_asked(quiet: Quiet):
    with quiet.run.connect() as client:
        until(lambda: client.point(1.0, 1.0) and client.origin.follower == "near", "a follower's answer")
        with pytest.raises(QueryError, match=r"row 99 is not merged after 1\.5 s") as refused:
            client.ask(PointQuery(1.0, 1.0, after=99, wait_s=1.5))  # the server refuses last
        assert refused.value.reason == "after_timeout"
        assert client.info().counters["refused_query_after_timeout"] == 1, f"follower pid {quiet.follower.pid}"


def test_followers_are_listed_with_how_far_behind_they_are(quiet: Quiet):
    with quiet.run.connect() as client:
        (one,) = client.followers()
        assert (one.name, one.merged, one.behind_rows) == ("near", quiet.row, 0)
        assert one.behind_s >= 0
    shown = said("query", "--endpoint", quiet.run.endpoint, "--site", quiet.run.site, "followers")
    assert shown.out.startswith(f"near: journal row {quiet.row}, 0 rows"), f"follower pid {quiet.follower.pid}"


def test_a_second_follower_of_a_name_ends_and_says_which_is_the_first(quiet: Quiet):
    second = quiet.run.start_follower("near", ready=False)
    assert second.wait(PATIENCE_S) == 1
    assert quiet.follower.code is None
    problem = f"another follower has this name, pid {quiet.follower.pid}"
    assert problem in (quiet.run.folder / "near.log").read_text()


def test_a_follower_of_another_site_ends_with_a_line(quiet: Quiet, tmp_path: Path):
    run, other = quiet.run, tmp_path / "other.toml"
    other.write_text(run.site_file.read_text().replace(f'"{run.site}"', '"elsewhere"'))
    where = ("--endpoint", run.endpoint, "--site-file", other, "--store", run.folder / "store")
    ended = said("follow", *where, "--name", "near")
    assert (ended.code, ended.err.strip().count("\n")) == (1, 0)
    assert "compare the site files" in ended.err


def test_answers_say_who_gave_them_and_how_far_behind(quiet: Quiet):
    site = quiet.run.site
    for key, who in ((keys.map_query(site, "point"), ""), (keys.follower_query(site, "near", "point"), "near")):
        origin = decode_origin(quiet.sender.ask(key, "x=1;y=1").attachment.to_bytes())
        assert (origin.follower, origin.behind_rows) == (who, 0)
        assert 0 <= origin.behind_s < np.inf
