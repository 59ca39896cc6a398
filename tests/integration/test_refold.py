"""Decisions in real processes: continued work, kills, ends, full disks at bad moments."""

from __future__ import annotations

import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import islice

import pytest

from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.store import Store
from mapserver.journal.location import JournalLocation
from protocol.errors import QueryError, Refusal
from protocol.site.site_file import load_site
from sitegrid import Client
from sitegrid.process.children import Child
from tests.integration.site_run import SiteRun, kill  # beside this file
from tests.integration.test_operation import Sender, end, session_of
from tests.patience import until
from tests.site_work import batches, write_store
from tests.unit.mapserver.data import same

pytestmark = pytest.mark.processes

ROWS, FEW_ROWS = 3000, 500  # of 100 samples: the larger fold takes a good part of a second


@pytest.fixture
def site(site: SiteRun, request: pytest.FixtureRequest) -> SiteRun:
    """Samples of ten machines, no snapshot."""
    (site.folder / "server.toml").write_text("[store]\narchive_after_h = 0.0\n[calibration]\nautomatic = false\n")
    rows = getattr(request, "param", ROWS)
    write_store(site.folder / "store", load_site(site.site_file), rows, tail_rows=rows)
    site.start_router()
    return site


def serve(site: SiteRun) -> Child:
    return site.start_server("--config", str(site.folder / "server.toml"))


def store_of(site: SiteRun) -> closing[Store]:
    return closing(
        Store(JournalLocation(site.folder / "store"), load_site(site.site_file), ServerConfig(), time.time_ns)
    )


def fold_without(site: SiteRun, machines: set[str]) -> Grid:
    grid = Grid(load_site(site.site_file).cell_m, ServerConfig().fold)
    for name, rows in islice(batches(), ROWS):
        if name not in machines:
            grid.fold(rows, name)
    return grid


@contextmanager
def repeated(ask: Callable[[], object]) -> Iterator[list[object]]:
    """Ask repeatedly on a thread; yields its answers."""
    answers, ended = list[object](), threading.Event()

    def repeat() -> None:
        while not ended.is_set():
            answers.append(ask())

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield answers
    finally:
        ended.set()
        thread.join()


@pytest.mark.nightly
def test_batches_and_queries_are_answered_during_a_refold_and_the_map_is_that_of_a_fold_from_the_start(site: SiteRun):
    server, config = serve(site), load_site(site.site_file)
    with session_of(site.endpoint) as session, site.connect() as client, site.connect() as other:
        with (
            closing(Sender(session, config, "loader-11", 50)) as sender,
            repeated(lambda: client.point(100, 0)) as asked,
        ):
            until(lambda: sender.watermark > 0 and len(asked) > 1, "traffic")
            for number in (1, 2):
                acknowledged, answered = sender.watermark, len(asked)
                row = other.distrust(f"loader-{number}", "a test")
                assert not row.trusted
                assert sender.watermark > acknowledged
                assert len(asked) > answered
        assert other.info().distrusted == ("loader-1", "loader-2")
    end(server)
    snapshots = list((site.folder / "store").glob("snapshot-*"))
    with store_of(site) as store:
        assert store.facts.excluded == {"loader-1", "loader-2"}
        adopted = store.grid
        folded = adopted.folded
        assert folded == fold_without(site, {"loader-1", "loader-2"}).folded + sender.watermark
    assert snapshots
    for path in snapshots:
        path.unlink()
    with store_of(site) as store:
        assert same(store.grid, adopted)


def given(client: Client, machine: str, wait_s: float = 0.0) -> None:
    """Give a command; answered whether or not the map follows in time."""
    try:
        client.distrust(machine, "a test", wait_s=wait_s)
    except QueryError as error:
        assert error.reason == Refusal.AFTER_TIMEOUT  # noqa: PT017 # where there is none it is as good


@pytest.mark.parametrize("site", [FEW_ROWS], indirect=True)
def test_a_server_killed_between_decision_and_map_comes_back_without_the_machine(site: SiteRun):
    server = serve(site)
    with site.connect() as client:
        given(client, "loader-3")
        kill(server)
        serve(site)
        assert list(client.info().distrusted) == ["loader-3"]
        assert not next(row for row in client.machines() if row.name == "loader-3").trusted


@pytest.mark.nightly
def test_a_server_that_folds_again_ends_in_time(site: SiteRun):
    server = serve(site)
    with site.connect() as client:
        given(client, "loader-3")
        end(server)


@contextmanager
def full_disk(server: Child) -> Iterator[None]:
    """No file of the process can grow or be created."""
    before = resource.prlimit(server.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(server.pid, resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.prlimit(server.pid, resource.RLIMIT_FSIZE, before)


@pytest.mark.nightly
def test_a_decision_that_a_full_disk_does_not_take_is_refused_and_one_that_was_answered_outlives_a_kill(site: SiteRun):
    server = serve(site)
    with site.connect() as client:
        with full_disk(server):
            with pytest.raises(QueryError, match="the decision cannot be written, so it does not count") as refused:
                client.distrust("loader-3", "a test")
            assert refused.value.reason == Refusal.STORE
            assert list(client.info().distrusted) == []
            assert next(row for row in client.machines() if row.name == "loader-3").trusted
            assert client.info().counters[f"refused_query_{Refusal.STORE}"] == 1
        kill(server)
        server = serve(site)
        assert list(client.info().distrusted) == [], "what was refused is not there"
        assert not client.distrust("loader-3", "a test").trusted
        kill(server)
        serve(site)
        assert list(client.info().distrusted) == ["loader-3"], "what was answered is"
