"""A follower's edge: it is shown while its map is of now, and only then."""

import threading
from contextlib import closing

import pytest

from mapserver.follower import follower as edge
from mapserver.follower import following
from mapserver.follower.follower import Follower
from mapserver.journal.location import JournalLocation
from tests.unit.mapserver.data import (
    CONFIG,
    SITE,
    WAIT_S,
    incoming,
    now_ns,
    open_writer,
    random_samples,
    routed,
    send,
    wait_for,
)

pytestmark = pytest.mark.slow


def test_a_follower_that_cannot_keep_up_is_hidden_until_it_has_caught_up(tmp_path, monkeypatch, caplog):
    may_read, read = threading.Event(), following.read_history

    def slowly(*words):
        for rows in read(*words):
            assert may_read.wait(WAIT_S)
            yield rows

    monkeypatch.setattr(edge, "SHOWN_S", 1.5)  # for ten seconds
    monkeypatch.setattr(following, "read_history", slowly)
    may_read.set()
    with routed() as (_, session), closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(random_samples(20, 1), 1, "a")])
        with closing(Follower(session, "slow", JournalLocation(tmp_path), SITE, CONFIG, now_ns)) as one:

            def is_shown() -> bool:
                one.tend()
                return one.is_shown

            wait_for(is_shown)
            may_read.clear()
            send(writer, [incoming(random_samples(20, 2), 21, "a")])
            wait_for(lambda: not is_shown())
            assert "clients ask others" in caplog.text
            assert one.source.origin().behind_rows == 1
            assert writer.run(lambda store: store.merged) == 2, "nobody waits for it"
            may_read.set()
            wait_for(is_shown)
            assert one.source.origin().behind_rows == 0
