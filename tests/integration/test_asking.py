"""Clients while router or server come and go (docs/protocol.md, Answers that do not come)."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from protocol.errors import LinkError
from protocol.queries.answers import MapInfo
from protocol.wire import keys
from protocol.wire.session import free_endpoint
from sitegrid import Client, connect
from tests.integration.forks import Forks
from tests.integration.site_run import NOBODY_DRIVES, SiteRun, kill  # beside this file
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SiteRun]:
    """Router and server, unchanged by tests."""
    folder, sim = tmp_path_factory.mktemp("asked"), NOBODY_DRIVES
    with Forks(folder) as children:
        run = SiteRun(folder, children, free_endpoint(), sim)
        run.start_router()
        run.start_server()
        yield run


@pytest.fixture
def asking() -> Iterator[Callable[[Client], Future[MapInfo]]]:
    """Asks on a thread; the query is out on return."""
    with ThreadPoolExecutor(1) as pool:

        def ask(client: Client) -> Future[MapInfo]:
            asker = client._asker
            out, get = threading.Event(), asker._session.get

            def noted(*words, **options):
                out.set()
                return get(*words, **options)

            asker._session = _Noted(asker._session, noted)  # type: ignore[assignment]
            answer = pool.submit(client.info)
            assert out.wait(PATIENCE_S)
            return answer

        yield ask


class _Noted:
    """A session that records its queries."""

    def __init__(self, session, get) -> None:
        self._session, self.get = session, get

    def __getattr__(self, name: str):
        return getattr(self._session, name)


def raw(client: Client, timeout_s: float) -> list[bytes]:
    """Zenoh's own replies: errors only."""
    replies = client.session.get(keys.map_query(client.site, "info"), timeout=timeout_s)
    return [reply.err.payload.to_bytes() for reply in replies]


def test_a_server_that_is_restarted_in_between_answers_later(site: SiteRun, asking):
    kill(site.server)
    with site.connect() as client:
        until(lambda: raw(client, 5.0) == [], "nobody answers, at once")
        answer = asking(client)
        site.start_server()
        assert answer.result(PATIENCE_S).site.name == site.site


def test_a_question_that_dies_with_its_server_is_asked_again(site: SiteRun, asking):
    with site.connect() as client:
        site.server.send(signal.SIGSTOP)
        answer = asking(client)
        kill(site.server)
        site.start_server()
        assert answer.result(PATIENCE_S).site.name == site.site


def test_a_router_that_is_restarted_in_between_costs_time_alone(site: SiteRun, asking):
    with site.connect() as client:
        kill(site.router)
        answer = asking(client)
        site.start_router()
        assert answer.result(PATIENCE_S).site.name == site.site


def test_a_server_that_hangs_is_no_answer_in_time(site: SiteRun):
    with connect(site.endpoint, site.site, timeout_s=1.0) as client, site.connect() as patient:
        assert patient.info().site.name == site.site, "it is there, also after its router was another one"
        site.server.send(signal.SIGSTOP)
        until(lambda: "T (stopped)" in Path(f"/proc/{site.server.pid}/status").read_text(), "does not stop")
        began_s = time.monotonic()
        with pytest.raises(LinkError, match="did not answer in time"):
            client.info()
        assert time.monotonic() - began_s >= 1.0
        assert set(raw(client, 0.5)) == {b"Timeout"}, "of Zenoh itself, no map"
        site.server.send(signal.SIGCONT)
        assert patient.info().site.name == site.site
