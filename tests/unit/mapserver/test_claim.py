import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress

import pytest
import zenoh

from mapserver.claim import BETWEEN_S, WriterClaim
from protocol.errors import LinkError
from protocol.wire import keys
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from tests.patience import PATIENCE_S
from tests.tcp_proxy import FAIR, Proxy, Weather
from tests.unit.mapserver.data import wait_for

FIRST, SECOND = "a" * 16, "b" * 16


class Network:
    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.router = open_session(SessionConfig(self.endpoint, mode="router"))
        self.opened = ExitStack()

    def session(self, endpoint: str = "") -> zenoh.Session:
        return self.opened.enter_context(closing(open_session(SessionConfig(endpoint or self.endpoint))))

    def claim(self, store: str, endpoint: str = "") -> WriterClaim:
        return WriterClaim(self.session(endpoint), "pit", store)

    @contextmanager
    def writer(self, store: str, endpoint: str = "") -> Iterator[WriterClaim]:
        with closing(self.claim(store, endpoint)) as claim:
            claim.acquire()
            yield claim


@pytest.fixture
def network() -> Iterator[Network]:
    made = Network()
    with made.opened:
        yield made
    made.router.close()


def test_a_second_server_is_refused_in_one_line_and_the_first_goes_on(network: Network):
    with network.writer(FIRST) as first, closing(network.claim(SECOND)) as second:
        with pytest.raises(LinkError) as caught:
            second.acquire()
        assert str(caught.value).startswith("site pit: a map server runs already, pid ")
        assert f"with store {FIRST}; stop it, or start this one with --take-over" in str(caught.value)
        assert (first.held, first.ended, second.held) == (True, "", False)


def test_a_server_that_takes_over_waits_until_the_other_one_has_ended(network: Network):
    with ExitStack() as opened, ThreadPoolExecutor() as threads:
        with network.writer(FIRST) as first:
            second = opened.enter_context(closing(network.claim(SECOND)))
            taking = threads.submit(second.acquire, take_over=True)
            wait_for(lambda: first.ended)
            assert first.ended.startswith("another map server takes over site pit, pid ")
            assert (first.held, second.held) == (False, False)
            with pytest.raises(TimeoutError):
                taking.result(4 * BETWEEN_S)
        taking.result(PATIENCE_S)
        assert (second.held, second.ended) == (True, "")


def test_of_two_servers_that_start_at_once_one_goes_on(network: Network):
    for _ in range(5):
        claims = [network.claim(store) for store in (FIRST, SECOND)]
        with ThreadPoolExecutor() as threads:
            runs = [threads.submit(claim.acquire) for claim in claims]
            errors = [run.exception(PATIENCE_S) for run in runs]
        assert sum(isinstance(error, LinkError) for error in errors) == 1
        assert sorted(claim.held for claim in claims) == [False, True]
        for claim in claims:
            claim.close()


def test_a_server_holds_nothing_until_it_has_asked_again_after_a_new_start_of_the_router(network: Network):
    with network.writer(FIRST) as claim:
        network.router.close()
        wait_for(lambda: not claim.held)
        network.router = open_session(SessionConfig(network.endpoint, mode="router"))
        wait_for(lambda: claim.held)
        assert claim.ended == ""


def test_a_server_that_was_cut_off_ends_if_another_one_writes_meanwhile(network: Network):
    with Proxy(int(network.endpoint.rpartition(":")[2])) as proxy, network.writer(FIRST, proxy.endpoint) as first:
        proxy.set(Weather(cut=True))
        wait_for(lambda: not first.held)
        with network.writer(SECOND) as second:
            proxy.set(FAIR)
            wait_for(lambda: first.ended)
            assert first.ended.startswith("another map server writes for site pit, pid ")
            assert SECOND in first.ended
            assert (first.held, second.held, second.ended) == (False, True, "")


def test_of_two_that_write_since_neither_answered_in_time_the_earlier_one_goes_on(network: Network):
    """As if one was frozen while the other asked."""
    with network.writer(FIRST) as first, closing(network.claim(SECOND)) as second:
        second._writes = second.held = True
        second._watch.start()
        wait_for(lambda: second.ended)
        assert (first.held, first.ended, second.held) == (True, "", False)


def test_whatever_is_asked_is_answered(network: Network):
    with network.writer(FIRST) as claim:
        for payload in (b"", b"\xc1", b"\x80"):
            (reply,) = network.session().get(keys.writer("pit"), payload=payload, timeout=PATIENCE_S)
            assert reply.ok is not None
        with suppress(LinkError):
            network.claim(SECOND).acquire()
        assert (claim.held, claim.ended) == (True, "")


def shared(network: Network, epoch: int, known: int) -> WriterClaim:
    """Claim of a server with the journal FIRST. known: its database's newest epoch."""
    claim = WriterClaim(network.session(), "pit", FIRST, shared=True, known_epoch=lambda: known)
    claim.epoch = lambda: epoch
    return claim


def test_servers_of_one_journal_let_each_other_be(network: Network):
    with closing(shared(network, 4, 4)) as writer, closing(shared(network, 0, 4)) as standby:
        writer.acquire()
        standby.acquire()
        end_s = time.monotonic() + 2.5  # two of its queries
        wait_for(lambda: writer.superseded or writer.ended or standby.ended or time.monotonic() > end_s)
        assert (writer.held, standby.held) == (True, True)


def test_of_two_servers_that_write_one_journal_in_two_databases_the_lower_epoch_ends(network: Network):
    with closing(shared(network, 4, 4)) as old, closing(shared(network, 0, 4)) as promoted:
        old.acquire()
        promoted.acquire()
        promoted.epoch = lambda: 5  # took its turn in the other database
        wait_for(lambda: old.superseded)
        assert "writes with epoch 5, and this one with 4" in old.superseded
        assert not old.held
        assert (promoted.held, promoted.superseded, promoted.ended) == (True, "", "")


def test_a_server_whose_database_lacks_an_epoch_that_is_written_with_does_not_begin(network: Network):
    with closing(shared(network, 5, 5)) as writer, closing(shared(network, 0, 4)) as behind:
        writer.acquire()
        with pytest.raises(LinkError, match="writes with epoch 5, of which this server's database does not know; two"):
            behind.acquire()
        assert writer.held


def test_a_standby_whose_database_falls_behind_ends(network: Network):
    with closing(shared(network, 5, 5)) as writer, closing(shared(network, 0, 5)) as standby:
        writer.acquire()
        standby.acquire()
        writer.epoch = lambda: 6  # in another database than the standby's
        wait_for(lambda: standby.ended)
        with pytest.raises(LinkError, match="two databases have this journal"):
            standby.require()


def test_a_take_over_ends_who_writes_and_no_server_that_waits_for_the_same_journal(network: Network):
    with closing(shared(network, 4, 4)) as writer, closing(shared(network, 0, 4)) as standby:
        writer.acquire()
        standby.acquire()
        with closing(shared(network, 0, 4)) as third:
            third.acquire(take_over=True)
            wait_for(lambda: writer.ended)
            assert (standby.held, standby.ended, third.held) == (True, "", True)


def test_a_take_over_for_another_store_ends_also_who_waits(network: Network):
    """It would write as soon as the other ends."""
    with ExitStack() as opened, ThreadPoolExecutor() as threads:
        with closing(shared(network, 4, 4)) as writer, closing(shared(network, 0, 4)) as standby:
            writer.acquire()
            standby.acquire()
            other = opened.enter_context(closing(network.claim(SECOND)))
            taking = threads.submit(other.acquire, take_over=True)
            wait_for(lambda: writer.ended and standby.ended)
        taking.result(PATIENCE_S)
        assert other.held
