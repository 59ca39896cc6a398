"""A copy of a server's journal over Zenoh: the same rows and events, whatever happens to the server."""

import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgpack
import pytest

from mapserver.follower.copying import Copying
from mapserver.follower.following import Following
from mapserver.journal.archive import archive
from mapserver.journal.location import JournalLocation
from mapserver.query import journal_queryable
from mapserver.server import Server
from mapserver.trust.decisions import PERSON, TrustDecision
from protocol.errors import MessageError, StoreError
from protocol.queries.journal_piece import decode_journal_piece, encode_journal_piece, parse_journal_query
from tests.unit.mapserver.data import (
    CONFIG,
    NOW_NS,
    SITE,
    WAIT_S,
    incoming,
    now_ns,
    random_samples,
    routed,
    same,
    send,
    wait_for,
)

pytestmark = pytest.mark.slow  # servers, and waits of theirs
MACHINES = "abc"


@pytest.fixture(scope="module")
def sessions():
    with routed() as pair:
        yield pair


@contextmanager
def served(sessions, folder: Path) -> Iterator[Server]:
    router, _ = sessions
    with closing(Server(router, router, JournalLocation(folder), SITE, CONFIG, now_ns)) as server:
        yield server


@contextmanager
def copied(sessions, folder: Path) -> Iterator[Copying]:
    copying = Copying(sessions[1], SITE, folder)
    copying.start()
    with closing(copying):
        yield copying


def deliver(server: Server, seed: int, n: int = 30) -> None:
    rows = random_samples(n, seed)
    send(server._writer, [incoming(rows, 1, MACHINES[seed % 3], spool_id=1 + seed)])


def contents(folder: Path) -> tuple:
    """All that a journal says, but its watermarks' ends without rows."""
    try:
        opened = JournalLocation(folder).reader()
    except StoreError:  # it is being made
        return ()
    with opened as reader:
        rows = [
            (row.row, row.machine, row.spool_id, row.first_seq, row.received_ns, row.rows.tobytes())
            for row in reader.read(after=reader.archived_row)
        ]
        checksums = [reader.row_checksum(row[0]) for row in rows]
        return reader.identity(), rows, checksums, reader.events(), reader.watermarks()


def follows(server: Server, copying: Copying) -> None:
    theirs = server._writer.location.folder
    wait_for(lambda: contents(copying.location.folder) == contents(theirs))


def test_a_copy_has_all_rows_and_events_of_the_server_and_goes_on_after_a_restart_of_either(sessions, tmp_path):
    with served(sessions, tmp_path / "store") as server:
        for seed in range(4):
            deliver(server, seed)
        with copied(sessions, tmp_path / "copy") as copying:
            follows(server, copying)
            server._upkeep.trust("b", False, "drifts", WAIT_S)
            deliver(server, 5)
            follows(server, copying)
        deliver(server, 6)
        with copied(sessions, tmp_path / "copy") as copying:
            follows(server, copying)
            wait_for(lambda copying=copying: copying.known[0] == 6)
    with copied(sessions, tmp_path / "copy") as copying, served(sessions, tmp_path / "store") as server:
        deliver(server, 7)
        follows(server, copying)


def test_a_follower_of_a_copy_has_the_map_and_says_how_far_it_is_behind_the_server(sessions, tmp_path):
    with served(sessions, tmp_path / "store") as server, copied(sessions, tmp_path / "copy") as copying:
        following = Following(copying.location, SITE, CONFIG, lambda: copying.known)
        following.start()
        with closing(following):
            for seed in range(3):
                deliver(server, seed)
            wait_for(lambda: following.behind()[0] == 0 and following.behind()[1] < WAIT_S)
            server._upkeep.trust("b", False, "drifts", WAIT_S)
            wait_for(lambda: following.run(lambda replica: replica.version) == server._writer.run(lambda s: s.version))
            assert following.run(lambda replica: server._writer.run(lambda store: same(replica.grid, store.grid)))


def test_rows_that_are_archived_come_from_the_archive(sessions, tmp_path):
    with served(sessions, tmp_path / "store") as server:
        for seed in range(5):
            deliver(server, seed)
        before = contents(tmp_path / "store")[1]
        location, writer = server._writer.location, server._writer
        with location.reader() as reader:
            forget = lambda until: writer.run(lambda store: store.journal.forget(until))  # noqa: E731
            assert list(archive(location.archive.folder, reader, SITE, NOW_NS + 10**15, forget, NOW_NS))
            assert reader.archived_row == 5
        deliver(server, 6)
        with copied(sessions, tmp_path / "copy") as copying:
            wait_for(lambda: len((contents(tmp_path / "copy") or ((), ()))[1]) == 6)
            assert contents(copying.location.folder)[1][:5] == before


def test_a_long_journal_comes_in_pieces(sessions, tmp_path, monkeypatch):
    monkeypatch.setattr(journal_queryable, "PIECE_BYTES", 5000)
    monkeypatch.setattr(journal_queryable, "EVENTS_AT_ONCE", 1)
    with served(sessions, tmp_path / "store") as server:
        for seed in range(9):
            deliver(server, seed)
        for trusted in (False, True):
            server._upkeep.trust("b", trusted, "drawn", WAIT_S)
        assert len(server._rows.piece(parse_journal_query({})).rows) < 9
        with copied(sessions, tmp_path / "copy") as copying:
            follows(server, copying)


def test_a_server_that_was_restored_has_the_copy_made_anew(sessions, tmp_path, caplog):
    with served(sessions, tmp_path / "store") as server:
        deliver(server, 1)
    shutil.copytree(tmp_path / "store", tmp_path / "backup")
    with copied(sessions, tmp_path / "copy") as copying:
        with served(sessions, tmp_path / "store") as server:
            deliver(server, 2)
            deliver(server, 4)
            follows(server, copying)
        shutil.rmtree(tmp_path / "store")
        (tmp_path / "backup").rename(tmp_path / "store")
        with served(sessions, tmp_path / "store") as server:
            for seed in (3, 5, 6):  # as many rows, and more
                deliver(server, seed)
            follows(server, copying)
        assert "the copy is made anew" in caplog.text


def test_a_copy_of_another_store_is_left_alone(sessions, tmp_path):
    for name in ("one", "other"):
        with served(sessions, tmp_path / name) as server:
            deliver(server, 1)
            if name == "one":
                with copied(sessions, tmp_path / "copy") as copying:
                    follows(server, copying)
                    before = contents(tmp_path / "copy")
            else:
                with copied(sessions, tmp_path / "copy") as copying:
                    wait_for(lambda copying=copying: copying.ended)
                    assert "choose another --copy" in copying.ended
                assert contents(tmp_path / "copy") == before


def test_two_processes_never_write_one_copy(sessions, tmp_path):
    with copied(sessions, tmp_path / "copy"), pytest.raises(StoreError, match="another"):
        Copying(sessions[1], SITE, tmp_path / "copy")


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"rows": [{"row": 1, "received_ns": 1, "batch": b""}, {"row": 3, "received_ns": 1, "batch": b""}]}, "rows"),
        ({"rows": [1]}, "rows"),
        ({"events": [{"id": 1, "kind": "trust", "stamp_ns": 1, "body": {"x": b"1"}}]}, "body"),
        ({"store": "x"}, "store"),
        ({"descends": ["x"]}, "descends"),
        ({"checksum": "x"}, "checksum"),
    ],
)
def test_a_piece_that_cannot_be_right_is_refused_and_its_field_named(sessions, tmp_path, change, field):
    with served(sessions, tmp_path / "store") as server:
        deliver(server, 1)
        piece = server._rows.piece(parse_journal_query({"row": "0"}))
    data = encode_journal_piece(piece)
    assert decode_journal_piece(data) == piece
    with pytest.raises(MessageError) as refused:
        decode_journal_piece(msgpack.packb(msgpack.unpackb(data) | change))
    assert refused.value.field == field


def test_a_decision_without_rows_reaches_a_copy(sessions, tmp_path):
    with served(sessions, tmp_path / "store") as server, copied(sessions, tmp_path / "copy") as copying:
        deliver(server, 0)
        follows(server, copying)
        server._writer.run(lambda store: store.decide(TrustDecision("a", False, PERSON, "gone", NOW_NS)))
        follows(server, copying)


def test_another_decision_under_the_same_number_has_the_copy_made_anew(sessions, tmp_path, caplog):
    with served(sessions, tmp_path / "store") as server:
        for seed in (0, 1):
            deliver(server, seed)
    shutil.copytree(tmp_path / "store", tmp_path / "backup")
    decide = lambda server, name: server._writer.run(  # noqa: E731
        lambda store: store.decide(TrustDecision(name, False, PERSON, "drifts", NOW_NS))
    )
    with copied(sessions, tmp_path / "copy") as copying:
        with served(sessions, tmp_path / "store") as server:
            decide(server, "a")
            follows(server, copying)
        shutil.rmtree(tmp_path / "store")
        (tmp_path / "backup").rename(tmp_path / "store")
        with served(sessions, tmp_path / "store") as server:
            decide(server, "b")
            follows(server, copying)
    assert "the copy is made anew" in caplog.text


def test_a_copy_that_has_lost_its_end_is_made_anew(sessions, tmp_path, caplog):
    older = tmp_path / "older.db"
    with served(sessions, tmp_path / "store") as server:
        deliver(server, 0)
        with copied(sessions, tmp_path / "copy") as copying:
            follows(server, copying)
        shutil.copy2(tmp_path / "copy" / "journal.db", older)
        deliver(server, 1)
        with copied(sessions, tmp_path / "copy") as copying:
            follows(server, copying)
        shutil.copy2(older, tmp_path / "copy" / "journal.db")  # the mark beside it knows of more
        server._writer.run(lambda store: store.decide(TrustDecision("a", False, PERSON, "gone", NOW_NS)))
        with copied(sessions, tmp_path / "copy") as copying:
            follows(server, copying)
    assert "the copy is made anew" in caplog.text


def test_events_are_cut_where_one_answer_cannot_have_all_of_them(sessions, tmp_path, monkeypatch):
    with served(sessions, tmp_path / "store") as server:
        body = {"values": [0.0] * 1000}  # twice as many bytes in MessagePack as in JSON
        server._writer.run(lambda store: store.journal.append_events([("other", NOW_NS, body)] * 450))
        first = server._rows.piece(parse_journal_query({}))
        assert len(encode_journal_piece(first)) < 2 * journal_queryable.PIECE_BYTES
        assert 100 < len(first.events) < 450
        rest = server._rows.piece(parse_journal_query({"event": str(first.events[-1].id)}))
        assert rest.events[0].id == first.events[-1].id + 1
        monkeypatch.setattr(journal_queryable, "PIECE_BYTES", 10)
        assert len(server._rows.piece(parse_journal_query({})).events) == 1
