"""What the client does with answers that are no simple answer; real servers: test_server.py, tests/integration."""

import time

import numpy as np
import pytest

from protocol.errors import QueryError, Refusal
from protocol.queries import answer_codec as codec
from protocol.queries.answers import GroundChange, Piece, PointAnswer, Region
from sitegrid.client import REGION_ATTEMPTS, Client
from tests.unit.records import version

POINT = codec.encode_point(PointAnswer(0.5, 1.5, {"visits": 2.0}, version(17, 3), 5))
BUSY = QueryError(Refusal.OVERLOADED, "too much to do", 0.05)
EXPIRED = QueryError(Refusal.EXPIRED, "gone")


class _Reply:
    def __init__(self, answer: bytes | QueryError) -> None:
        data = codec.encode_error(answer) if isinstance(answer, QueryError) else answer
        self.ok, self.err = (None, self) if isinstance(answer, QueryError) else (self, None)
        self.payload, self.attachment = self, None
        self.to_bytes = lambda: data


class _Session:
    """Gives one prepared answer after the other, the last one for ever."""

    def __init__(self, *answers: bytes | QueryError) -> None:
        self.answers, self.asked = list(answers), []

    def liveliness(self):
        return self

    def get(self, selector, timeout):
        if str(selector).endswith("follower/*/alive"):
            return []
        self.asked.append(str(selector))
        return [_Reply(self.answers.pop(0) if len(self.answers) > 1 else self.answers[0])]


def client(*answers: bytes | QueryError, timeout_s: float = 10.0) -> tuple[Client, _Session]:
    session = _Session(*answers)
    return Client(session, "tcp/localhost:1", "pit", timeout_s), session  # type: ignore[arg-type]


def piece(number: int, merged: int = 7) -> bytes:
    """One of two pieces of 1 x 2 cells."""
    place = Piece(9, number, 2, 0, number, 1, 2)
    layers = {"visits": np.full((1, 1), number, np.float32)}
    return codec.encode_region(
        Region(np.array([0.5]), np.array([0.5 + number]), 1.0, layers, version(merged, 0), 5, place)
    )


def test_a_server_that_has_too_much_to_do_is_asked_again_when_it_says():
    asking, session = client(BUSY, BUSY, POINT)
    began_s = time.monotonic()
    assert asking.point(0, 0).values == {"visits": 2.0}
    assert len(session.asked) == 3
    assert time.monotonic() - began_s >= 2 * BUSY.retry_after_s


def test_a_server_that_stays_busy_is_an_error_within_the_time_out():
    asking, session = client(BUSY, timeout_s=0.3)
    with pytest.raises(QueryError, match="too much to do"):
        asking.point(0, 0)
    assert 1 < len(session.asked) < 10


def test_a_refusal_that_says_nothing_of_later_is_not_asked_again():
    asking, session = client(QueryError(Refusal.OUT_OF_RANGE, "no"))
    with pytest.raises(QueryError, match="no"):
        asking.point(0, 0)
    assert len(session.asked) == 1


def test_pieces_are_asked_for_one_after_the_other():
    asking, session = client(piece(0), piece(1))
    shown: list[tuple[int, int]] = []
    region = asking.region((0, 0, 1, 2), progress=lambda here, count: shown.append((here, count)))
    assert region["visits"].tolist() == [[0], [1]]
    assert session.asked[1].endswith("map/piece?cursor=9;number=1")
    assert shown == [(1, 2), (2, 2)]


def test_a_region_that_expired_is_asked_for_again_from_its_first_piece():
    asking, session = client(piece(0), EXPIRED, piece(0, 8), piece(1, 8))
    assert asking.region((0, 0, 1, 2)).merged == 8
    assert len(session.asked) == 4


def test_a_region_that_always_expires_is_an_error():
    asking, session = client(*[piece(0), EXPIRED] * REGION_ATTEMPTS)
    with pytest.raises(QueryError, match="gone"):
        asking.region((0, 0, 1, 2))
    assert len(session.asked) == 2 * REGION_ATTEMPTS


def test_more_changes_than_one_answer_holds_are_asked_for(monkeypatch):
    monkeypatch.setattr(codec, "MAX_CHANGES", 2)
    changes = [GroundChange(i, 1, 1, (0.0, 0.0, 1.0, 1.0), 4, None, 0.25, None, None) for i in (3, 4, 5)]
    answers = [codec.encode_changes(some, version(1, 0)) for some in (changes[:2], changes[2:])]
    asking, session = client(*answers)
    assert asking.changes(2) == changes
    assert session.asked[1].endswith("after=4")
