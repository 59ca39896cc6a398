import re
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import replace

import numpy as np
import pytest
import zenoh

from mapserver import server as server_module
from mapserver.journal.location import JournalLocation
from mapserver.query import queryable
from mapserver.query.answering import BYTES
from mapserver.server import Server
from protocol.errors import QueryError, Refusal
from protocol.queries import answer_codec as codec
from protocol.queries.answers import MapVersion
from protocol.queries.commands import TrustCommand
from protocol.queries.parameters import selector_of
from protocol.queries.request import Size
from protocol.queries.requests import AliveQuery, HistoryQuery, InfoQuery, PointQuery, RegionQuery
from protocol.site.geometry import Bounds
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack
from tests.paths import ROOT
from tests.patience import PATIENCE_S
from tests.unit.mapserver.data import CONFIG, NOW_NS, SITE, batch, held, now_ns, routed, samples, wait_for


@pytest.fixture(scope="module")
def sessions():
    with routed() as pair:
        yield pair


@pytest.fixture
def served(sessions, tmp_path):
    router, client = sessions
    server = Server(router, router, JournalLocation(tmp_path), SITE, CONFIG, now_ns)
    yield server, client
    server.close()


def test_threads_of_a_server_are_those_that_the_design_lists(sessions, tmp_path):
    table = (ROOT / "docs" / "design.md").read_text().partition("| thread |")[2].partition("\n\n")[0]
    listed = {name for line in table.splitlines()[2:] for name in re.findall("`([a-z ]+)`", line.split("|")[1])}
    before, router = {*threading.enumerate()}, sessions[0]
    with closing(Server(router, router, JournalLocation(tmp_path), SITE, CONFIG, now_ns)):
        names = {re.sub(r"-\d+$", "", thread.name) for thread in {*threading.enumerate()} - before}
    names = {name for name in names if "pyo3-closure" not in name}  # Zenoh's callbacks
    assert names <= listed
    assert listed - names <= {"fold", "read", "journal", "journal watch", "metrics"}


def get(client: zenoh.Session, key: str, parameters: dict[str, str] | None = None, payload: bytes | None = None):
    selector = f"{key}?{selector_of(parameters)}" if parameters else key
    (reply,) = client.get(selector, payload=payload, timeout=PATIENCE_S)
    return reply


def deliver(client: zenoh.Session, sent, machine: str = "a"):
    return decode_reply(get(client, keys.ingest("pit", machine), payload=encode_batch(sent)).ok.payload.to_bytes())


def ask(client: zenoh.Session, query) -> bytes:
    return get(client, keys.map_query("pit", query.name), query.parameters()).ok.payload.to_bytes()


def refusal(client: zenoh.Session, name: str, parameters: dict[str, str]):
    return codec.decode_error(get(client, keys.map_query("pit", name), parameters).err.payload.to_bytes())


def counters(client: zenoh.Session) -> dict[str, int]:
    """Without those of roads, made meanwhile."""
    counted = codec.decode_info(ask(client, InfoQuery())).counters
    return {name: count for name, count in counted.items() if not name.startswith("roads_")}


def test_a_batch_is_acknowledged_and_seen_by_a_query_that_waits_for_it(served):
    _, client = served
    ack = deliver(client, batch(samples(5, c_rr=0.25)))
    assert ack == Ack(5, 1, store=ack.store)
    query = RegionQuery(Bounds(0, 0, 16, 16), ("resistance", "grade_north"), after=ack.row)
    region = codec.decode_region(ask(client, query))
    assert region["resistance"][8, 8] == pytest.approx(0.25, rel=1e-3)
    assert np.isfinite(region["resistance"]).sum() == 1
    assert region.merged == 1
    point = codec.decode_point(ask(client, PointQuery(8.2, 8.9, ("resistance",))))
    assert point.values["resistance"] == region["resistance"][8, 8]


def test_a_probe_is_answered_while_the_writer_is_busy(served):
    server, client = served
    deliver(client, batch(samples(5)))
    with held(server._writer):
        alive = codec.decode_alive(ask(client, AliveQuery()))
        assert (alive.journalled, alive.merged, alive.store) == (1, 1, server._writer.store_id)
        assert 0 < alive.busy_s < PATIENCE_S
    error = refusal(client, "alive", {"after": "1"})
    assert error.reason == Refusal.UNKNOWN_PARAMETER


def test_a_refused_batch_gets_its_reason(served):
    _, client = served
    refused = deliver(client, batch(samples(1), 4))
    assert (refused.reason, refused.expected) == (Refusal.GAP, 1)
    assert deliver(client, batch(samples(1)), machine="b").reason == Refusal.WRONG_MACHINE
    reply = decode_reply(get(client, keys.ingest("pit", "a")).ok.payload.to_bytes())  # no payload
    assert reply.reason == Refusal.NOT_MSGPACK
    counted = {name: n for name, n in counters(client).items() if name.startswith("refused")}
    assert counted == {"refused_gap": 1, "refused_wrong_machine": 1, "refused_not_msgpack": 1}


@pytest.mark.parametrize(
    ("key", "parameters", "reason"),
    [
        (keys.map_query("pit", "region"), {"bounds": "0,0,1,1", "colour": "red"}, Refusal.UNKNOWN_PARAMETER),
        (keys.map_query("pit", "elevation"), {}, Refusal.UNKNOWN_QUERY),
        (keys.map_query("pit", "info"), {"after": "9", "wait": "0.01"}, Refusal.AFTER_TIMEOUT),
        (keys.admin("pit", "trust"), {"machine": "c", "trusted": "yes"}, Refusal.UNKNOWN_MACHINE),
        (keys.admin("pit", "trust"), {"machine": "c"}, Refusal.MISSING_FIELD),
        (keys.admin("pit", "shutdown"), {}, Refusal.UNKNOWN_QUERY),
    ],
)
def test_a_refused_query_or_command_gets_its_reason_and_is_counted(served, key, parameters, reason):
    _, client = served
    assert codec.decode_error(get(client, key, parameters).err.payload.to_bytes()).reason == reason
    assert counters(client) == {f"refused_query_{reason}": 1}


def test_a_bug_in_a_query_is_answered(served, monkeypatch):
    server, client = served
    monkeypatch.setitem(server.answers._answers, PointQuery, lambda _: 1 // 0)
    error = refusal(client, "point", {"x": "0", "y": "0"})
    assert error.reason == "internal"
    assert str(error).startswith("the server failed")


@pytest.mark.parametrize(("query_threads", "together"), [(1, False), (2, True)])
def test_so_many_queries_are_answered_at_once(sessions, tmp_path, monkeypatch, query_threads, together):
    router, client = sessions
    config = replace(CONFIG, query_threads=query_threads)
    both, met = threading.Barrier(2), []

    def meet() -> dict[str, object]:
        with suppress(threading.BrokenBarrierError):
            both.wait(PATIENCE_S if together else 0.2)
            met.append(True)
        return {}

    with closing(Server(router, router, JournalLocation(tmp_path), SITE, config, now_ns)) as server:
        monkeypatch.setattr(server.answers, "info", meet)
        with ThreadPoolExecutor() as threads:
            list(threads.map(ask, [client] * 2, [InfoQuery()] * 2))
    assert len(met) == 2 * together


def test_a_server_that_closes_keeps_what_it_acknowledged(sessions, tmp_path):
    router, client = sessions
    server = Server(router, router, JournalLocation(tmp_path), SITE, CONFIG, now_ns)
    deliver(client, batch(samples(5)))
    server.close()
    assert not server.failed
    assert list(client.get(keys.ingest("pit", "a"), payload=b"", timeout=PATIENCE_S)) == []  # no listener
    server = Server(router, router, JournalLocation(tmp_path), SITE, CONFIG, now_ns)
    ack = deliver(client, batch(samples(0)))
    assert ack == Ack(5, 1, store=ack.store)
    assert server.answers.info()["samples_merged"] == 5
    server.close()


def begun(client: zenoh.Session, key: str, parameters: dict[str, str], n: int) -> list[zenoh.Handler]:
    return [client.get(f"{key}?{selector_of(parameters)}", timeout=PATIENCE_S) for _ in range(n)]


def test_waiting_queries_keep_no_other_from_an_answer_and_get_theirs(served):
    server, client = served
    waiting = begun(client, keys.map_query("pit", "info"), {"after": "1", "wait": "60"}, 50)
    wait_for(lambda: len(server._writer.waits._waiting) == 50)
    ask(client, InfoQuery())
    deliver(client, batch(samples(5)))
    for replies in waiting:
        assert codec.decode_info(next(iter(replies)).ok.payload.to_bytes()).merged == 1


@pytest.mark.parametrize(
    ("limit", "key", "parameters"),
    [
        ("ANSWER_BYTES", keys.map_query("pit", "info"), {}),
        ("MOST_PAST", keys.map_query("pit", "point"), {"x": "0", "y": "0", "as_of": "1"}),
        ("MOST_COMMANDS", keys.admin("pit", "trust"), {"machine": "a", "trusted": "yes"}),
    ],
)
def test_queries_beyond_a_budget_have_to_come_again(sessions, tmp_path, monkeypatch, limit, key, parameters):
    router, client = sessions
    module = server_module if limit == "MOST_COMMANDS" else queryable
    monkeypatch.setattr(module, limit, 2 if limit != "ANSWER_BYTES" else 2 * BYTES[Size.SMALL])
    with closing(Server(router, router, JournalLocation(tmp_path), SITE, CONFIG, now_ns)) as server:
        release = threading.Event()

        def hold(*_):
            assert release.wait(PATIENCE_S)
            raise QueryError(Refusal.STORE, "held")

        monkeypatch.setattr(server._commands, "_trust", hold)
        for query in (InfoQuery, PointQuery):
            monkeypatch.setitem(server.answers._answers, query, hold)
        first = begun(client, key, parameters, 2)
        refused = codec.decode_error(get(client, key, parameters).err.payload.to_bytes())
        assert refused.reason == Refusal.OVERLOADED
        assert refused.retry_after_s > 0
        assert deliver(client, batch(samples(1))) == Ack(1, 1, store=server._writer.store_id)
        release.set()
        reasons = {codec.decode_error(next(iter(replies)).err.payload.to_bytes()).reason for replies in first}
        assert reasons == {Refusal.STORE}


@pytest.mark.parametrize("asked", [{"payload": b"x"}, {"parameters": {"layers": "a" * 5000}}])
def test_a_query_that_would_fill_memory_while_it_waits_is_refused(served, asked):
    _, client = served
    reply = get(client, keys.map_query("pit", "info"), **asked)
    assert codec.decode_error(reply.err.payload.to_bytes()).reason == Refusal.TOO_LARGE


def test_no_batch_is_taken_while_another_server_may_be_the_writer(served):
    server, client = served
    server._claim.held = False
    refused = deliver(client, batch(samples(5)))
    assert refused.reason == Refusal.NOT_WRITER
    server._claim.held = True
    assert deliver(client, batch(samples(5))).watermark == 5


def test_a_command_reaches_the_upkeep_with_its_reason(served):
    _, client = served
    deliver(client, batch(samples(5)))
    command = TrustCommand("a", False, "50 % too high; gain = 1.5 & more?")
    row = codec.decode_machine(get(client, keys.admin("pit", "trust"), command.parameters()).ok.payload.to_bytes())
    assert (row.name, row.trusted, row.merged, row.fact) == ("a", False, 1, 1)
    assert row.reason == command.reason
    gone = {"x": "8.5", "y": "8.5", "layers": "weight"}
    for more in ({}, {"as_of": str(NOW_NS + 3600 * 10**9)}):
        point = codec.decode_point(get(client, keys.map_query("pit", "point"), gone | more).ok.payload.to_bytes())
        assert np.isnan(point.values["weight"])
        assert point.version == MapVersion(row.store, 1, 1)
    answer = codec.decode_machines(get(client, keys.map_query("pit", "machines"), {}).ok.payload.to_bytes())
    [machine] = answer.machines
    assert machine.name == "a"
    assert not machine.trusted
    assert answer.version == MapVersion(row.store, 1, 1)


@pytest.mark.parametrize("slow", ["past", "command"])
def test_the_map_as_it_is_does_not_wait_for_what_is_slow(served, monkeypatch, slow):
    server, client = served
    release, entered = threading.Event(), threading.Event()

    def hold(*_):
        entered.set()
        assert release.wait(PATIENCE_S)
        raise QueryError(Refusal.STORE, "held")

    monkeypatch.setitem(server.answers._answers, HistoryQuery, hold)
    monkeypatch.setattr(server._commands, "_trust", hold)
    key, asked = {
        "past": (keys.map_query("pit", "history"), HistoryQuery(0, 0).parameters()),
        "command": (keys.admin("pit", "trust"), TrustCommand("a", True).parameters()),
    }[slow]
    askers = [threading.Thread(target=get, args=(client, key, asked)) for _ in range(3)]
    for asker in askers:
        asker.start()
    assert entered.wait(PATIENCE_S)
    for _ in range(3):
        ask(client, InfoQuery())
    release.set()
    for asker in askers:
        asker.join()
