"""Choice of processes, and unusual answers; the session answers from a table."""

import time
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from protocol.errors import LinkError, QueryError, Refusal
from protocol.queries import answer_codec as codec
from protocol.queries.answers import ChangesAnswer, GroundChange, Piece, PointAnswer, Region, ServerAlive
from protocol.queries.origin import Origin, encode_origin
from protocol.queries.parameters import split_selector
from protocol.queries.requests import AliveQuery, InfoQuery, PointQuery, RegionQuery
from protocol.site.geometry import Bounds
from protocol.site.site_config import SiteConfig
from protocol.wire.fields import pack
from protocol.wire.messages import VERSION
from sitegrid import follower_choice
from sitegrid.client import Client
from sitegrid.follower_choice import Asker, preferred
from sitegrid.whole_answers import REGION_ATTEMPTS
from tests.unit.records import STORE, map_info, version

POINT = codec.encode_point(PointAnswer(0.5, 1.5, {"visits": 2.0}, version(17, 3), 5))
SITE = SiteConfig("pit", 48.0, 11.0)
SILENT, HANGS, UNREADABLE = "nobody", "hangs", "unreadable"


class Site:
    """A session with a site: followers by name, the server as "", with their answers.

    server: its successive answers, the last one repeated.
    """

    def __init__(self, *server: bytes | QueryError, **answers: bytes | QueryError | str) -> None:
        self.answers: dict[str, bytes | QueryError | str] = {"": POINT, **answers}
        self._next = list(server)
        self.asked: list[tuple[str, str]] = []
        self.timeouts: list[float] = []

    def liveliness(self):
        keys = [f"sitegrid/pit/follower/{name}/alive" for name in self.answers if name]
        return SimpleNamespace(get=lambda _, timeout: [SimpleNamespace(ok=SimpleNamespace(key_expr=k)) for k in keys])

    def get(self, selector, timeout):
        parts = str(selector.key_expr).split("/")
        name = parts[3] if parts[2] == "follower" else ""
        self.asked.append((name, f"{parts[-1]}?{selector.parameters}"))
        self.timeouts.append(timeout)
        if not name and self._next:
            self.answers[""] = self._next.pop(0)
        answer = self.answers.get(name, SILENT)
        if answer == SILENT:
            return []
        if answer == UNREADABLE:
            answer = POINT
        data = answer if isinstance(answer, bytes) else b"Timeout" if answer == HANGS else codec.encode_error(answer)
        origin = encode_origin(Origin(name, 3, 0.25)) if name else None
        if self.answers.get(name) == UNREADABLE:
            origin = pack({"v": VERSION + 1})
        attachment = SimpleNamespace(to_bytes=lambda: origin) if origin else None
        reply = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: data), attachment=attachment)
        is_answer = isinstance(answer, bytes)
        return [SimpleNamespace(ok=reply if is_answer else None, err=None if is_answer else reply)]

    @property
    def whom(self) -> list[str]:
        return [name for name, _ in self.asked]


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch):
    monkeypatch.setattr(follower_choice, "AGAIN_S", 0.001)


def asker(site: Site, timeout_s: float = 10.0) -> Asker:
    return Asker(site, "tcp/x", "pit", timeout_s)  # type: ignore[arg-type]


def test_a_map_is_asked_of_one_follower_and_of_nobody_else():
    site = Site(a=POINT, b=POINT)
    one = asker(site)
    origins = {one.ask(PointQuery(0, 0)).origin for _ in range(20)}
    assert origins == {Origin(site.whom[0], 3, 0.25)}  # one follower: reads never go back in time
    assert len(site.asked) == 20


def test_many_clients_spread_over_all_followers():
    site = Site(a=POINT, b=POINT, c=POINT)
    for _ in range(300):
        asker(site).ask(PointQuery(0, 0))
    assert all(60 < site.whom.count(name) < 140 for name in "abc")


def test_a_follower_that_comes_or_goes_changes_nothing_between_the_others():
    clients = [bytes([i, i + 1]) for i in range(100)]
    first = {client: preferred(client, {"a", "b", "c"})[0] for client in clients}
    without = {client: preferred(client, {"a", "b"})[0] for client in clients}
    assert all(without[client] == name for client, name in first.items() if name != "c")
    assert Counter(without[client] for client, name in first.items() if name == "c").keys() == {"a", "b"}


@pytest.mark.parametrize("silence", [SILENT, HANGS])
def test_one_that_dies_or_hangs_is_replaced_and_not_asked_again_for_a_while(silence):
    site = Site(a=POINT, b=POINT)
    one = asker(site)
    first = one.ask(PointQuery(0, 0)).origin.follower
    site.answers[first] = silence
    other = one.ask(PointQuery(0, 0)).origin.follower
    assert {first, other} == {"a", "b"}
    one.ask(PointQuery(0, 0))
    assert site.whom == [first, first, other, other]
    assert 4.9 < max(site.timeouts) <= 5.0  # half of the time, then another one


def test_where_all_followers_are_silent_the_server_is_asked():
    site = Site(a=SILENT, b=SILENT, c=SILENT)
    assert asker(site).ask(PointQuery(0, 0)).origin == Origin()
    assert len(site.asked) == follower_choice.FOLLOWERS_TRIED + 1


@pytest.mark.parametrize(
    "reason", [Refusal.AFTER_TIMEOUT, Refusal.NOT_HERE, Refusal.OVERLOADED, Refusal.STORE, "internal"]
)
def test_what_a_follower_refuses_for_what_it_is_the_server_is_asked(reason):
    site = Site(a=QueryError(reason, "not I", 5.0))
    assert asker(site).ask(PointQuery(0, 0)).origin == Origin()
    assert site.whom == ["a", ""]


@pytest.mark.parametrize("answer", [UNREADABLE, b"Internal: no link"])
def test_one_that_answers_what_cannot_be_read_is_as_good_as_silent(answer, monkeypatch):
    site = Site(a=answer)
    if isinstance(answer, bytes):  # Zenoh's own errors are no messages
        monkeypatch.setattr(codec, "encode_error", lambda _: answer)
        site.answers["a"] = QueryError("internal", "no link")
    one = asker(site)
    assert [one.ask(PointQuery(0, 0)).origin for _ in range(2)] == [Origin(), Origin()]
    assert site.whom == ["a", "", ""]
    assert one.followers() == []
    with pytest.raises(QueryError, match="does not answer any more"):
        one.ask(RegionQuery(Bounds(0, 0, 1, 1)), at=Origin("a"))


def test_a_bad_question_is_refused_once():
    site = Site(a=QueryError(Refusal.UNKNOWN_LAYER, "no such layer"))
    with pytest.raises(QueryError, match="no such layer"):
        asker(site).ask(PointQuery(0, 0))
    assert site.whom == ["a"]


def test_a_follower_is_given_a_second_for_a_row_and_the_server_all_of_the_wait():
    site = Site(a=QueryError(Refusal.AFTER_TIMEOUT, "not yet"))
    asker(site).ask(PointQuery(0, 0, after=7, wait_s=30.0))
    waits = [split_selector(parameters)["wait"] for _, parameters in site.asked]
    assert [float(wait) for wait in waits] == [follower_choice.FOLLOWER_WAIT_S, 30.0]


def test_what_only_the_server_knows_is_asked_of_it_alone():
    site = Site(a=POINT)
    site.answers[""] = codec.encode_alive(ServerAlive(STORE, 1, 1, 0.0))
    asker(site).ask(AliveQuery())
    site.answers[""] = SILENT
    with pytest.raises(LinkError, match="no map server"):
        asker(site, 0.05).ask(AliveQuery())
    assert set(site.whom) == {""}


def test_the_state_of_the_map_is_asked_of_a_follower_where_no_server_is():
    site = Site(a=codec.encode_info(map_info(SITE)))
    site.answers[""] = SILENT
    assert asker(site).ask(InfoQuery()).origin.follower == "a"
    assert site.whom == ["", "a"]


def test_pieces_of_a_region_are_asked_of_whoever_has_the_first(monkeypatch):
    site = Site(a=b"", b=b"")
    client = Client(site, "tcp/x", "pit")  # type: ignore[arg-type]
    gone: list[str] = []

    def get(selector, timeout, asked=site.get):
        name = str(selector.key_expr).split("/")[3]
        query = str(selector.key_expr).rsplit("/", 1)[-1]
        if query == "piece" and not gone:  # dies between two pieces
            gone.append(name)
            site.answers.pop(name)
        if name in site.answers:
            site.answers[name] = piece(int(query == "piece"))
        return asked(selector, timeout)

    monkeypatch.setattr(site, "get", get)
    whole = client.region((0, 0, 1, 2))
    assert whole["visits"].tolist() == [[0], [1]]
    (other,) = {"a", "b"} - set(gone)
    assert site.whom == [gone[0], gone[0], other, other]
    assert client.origin.follower == other


def piece(number: int, merged: int = 7) -> bytes:
    """One of two pieces of 1 x 2 cells."""
    place = Piece(9, number, 2, 0, number, 1, 2)
    layers = {"visits": np.full((1, 1), number, np.float32)}
    return codec.encode_region(
        Region(np.array([0.5]), np.array([0.5 + number]), 1.0, layers, version(merged, 0), 5, place)
    )


# --- a server alone ---------------------------------------------------------------------------------------------------

BUSY = QueryError(Refusal.OVERLOADED, "too much to do", 0.05)
EXPIRED = QueryError(Refusal.EXPIRED, "gone")


def client(*answers: bytes | QueryError, timeout_s: float = 10.0) -> tuple[Client, Site]:
    site = Site(*answers)
    return Client(site, "tcp/localhost:1", "pit", timeout_s), site  # type: ignore[arg-type]


def test_a_server_that_has_too_much_to_do_is_asked_again_when_it_says():
    asking, site = client(BUSY, BUSY, POINT)
    began_s = time.monotonic()
    assert asking.point(0, 0).values == {"visits": 2.0}
    assert len(site.asked) == 3
    assert time.monotonic() - began_s >= 2 * BUSY.retry_after_s


@pytest.mark.parametrize(
    ("answers", "most"), [([BUSY], 10), ([QueryError(Refusal.OUT_OF_RANGE, "too far")], 1)], ids=["busy", "refused"]
)
def test_a_server_that_stays_busy_is_asked_until_the_time_is_over_and_one_that_refuses_once(answers, most):
    asking, site = client(*answers, timeout_s=0.3)
    with pytest.raises(QueryError, match="too"):
        asking.point(0, 0)
    assert min(2, most) <= len(site.asked) <= most


def test_pieces_are_asked_for_one_after_the_other():
    asking, site = client(piece(0), piece(1))
    shown: list[tuple[int, int]] = []
    region = asking.region((0, 0, 1, 2), progress=lambda here, count: shown.append((here, count)))
    assert region["visits"].tolist() == [[0], [1]]
    assert site.asked[1] == ("", "piece?cursor=9;number=1")
    assert shown == [(1, 2), (2, 2)]


def test_a_region_that_expired_is_asked_for_again_from_its_first_piece_so_many_times():
    asking, site = client(piece(0), EXPIRED, piece(0, 8), piece(1, 8))
    assert asking.region((0, 0, 1, 2)).merged == 8
    assert len(site.asked) == 4
    asking, site = client(*[piece(0), EXPIRED] * REGION_ATTEMPTS)
    with pytest.raises(QueryError, match="gone"):
        asking.region((0, 0, 1, 2))
    assert len(site.asked) == 2 * REGION_ATTEMPTS


def test_more_changes_than_one_answer_holds_are_asked_for(monkeypatch):
    monkeypatch.setattr(codec, "MAX_CHANGES", 2)
    changes = [GroundChange(i, 1, 1, (0.0, 0.0, 1.0, 1.0), 4, None, 0.25, None, None) for i in (3, 4, 5)]
    asking, site = client(
        *(codec.encode_changes(ChangesAnswer(tuple(some), version(1, 0))) for some in (changes[:2], changes[2:]))
    )
    assert asking.changes(2) == changes
    assert site.asked[1][1].endswith("after=4")
