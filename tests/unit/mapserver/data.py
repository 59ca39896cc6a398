"""Samples, batches and stores for tests of the map server."""

import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
import zenoh

from mapserver.config import ServerConfig
from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import LIVE_ROWS, Grid
from mapserver.evidence.grid_state import GridState, PlacedPage
from mapserver.evidence.pages import Pages
from mapserver.ingest.store import Incoming, Store
from mapserver.ingest.writer import Writer
from mapserver.journal.journal import Journal
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Admission, JournalRow
from mapserver.past.past import StorePast
from protocol.arrays import Table
from protocol.errors import MessageError, QueryError
from protocol.machine.samples import empty
from protocol.site.geometry import CellWindow
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, Refused, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from tests.patience import PATIENCE_S, until
from tests.reference.grid import by_definition, of_grid, plain

SITE = SiteConfig("pit", 48.0, 11.0)
CONFIG = ServerConfig()
NOW_NS = 1_767_225_600_000_000_000


def wait_for(fact: Callable[[], Any]) -> None:
    """Wait on a condition without an event."""
    until(fact, "a test's condition")


def now_ns() -> int:
    return NOW_NS


def samples(n: int = 1, **columns: Any) -> Table:
    """1 m each on dry dirt at the centre of cell (8, 8), unless columns differ."""
    rows = empty(n)
    usual = {"x_m": 8.5, "y_m": 8.5, "distance_m": 1.0, "c_rr": 0.04, "grade_e": 0.1, "grade_n": -0.05}
    usual |= {"stamp_ns": NOW_NS + np.arange(n) * 10**9, "cov_xx_m2": 0.01, "cov_yy_m2": 0.01}
    for name, values in (usual | columns).items():
        rows[name] = values
    return rows


def random_samples(n: int, seed: int, half_m: float = 60.0, std_m: float = 1.5) -> Table:
    """Samples around the origin with full covariances, some without c_rr or grade."""
    draw = np.random.default_rng(seed)
    deviations, correlation = draw.uniform(0.0, std_m, (2, n)), draw.uniform(-0.95, 0.95, n)
    rows = samples(
        n,
        stamp_ns=NOW_NS + draw.integers(0, 1800, n) * 10**9,
        x_m=draw.uniform(-half_m, half_m, n),
        y_m=draw.uniform(-half_m, half_m, n),
        cov_xx_m2=deviations[0] ** 2,
        cov_yy_m2=deviations[1] ** 2,
        cov_xy_m2=correlation * deviations[0] * deviations[1],
        heading_rad=draw.uniform(-np.pi, np.pi, n),
        distance_m=draw.uniform(0.0, 2.0, n),
        c_rr=draw.uniform(0.0, 0.5, n),
        grade_e=draw.uniform(-0.6, 0.6, n),
        grade_n=draw.uniform(-0.6, 0.6, n),
        aid_share=draw.uniform(0.0, 1.0, n) * (draw.random(n) < 0.5),
    )
    for names, hit in ((("c_rr", "c_rr_var"), 7), (("grade_e", "grade_n", "grade_var"), 5)):
        for name in names:
            rows[name][::hit] = np.nan
    return rows


def batch(rows: Table, first_seq: int = 1, machine: str = "a", spool_id: int = 7, **more: Any) -> SampleBatch:
    return SampleBatch(machine, spool_id, first_seq, rows, more.pop("frame", SITE.frame), **more)


def incoming(rows: Table, first_seq: int = 1, machine: str = "a", spool_id: int = 7, **more: Any) -> Incoming:
    return Incoming(machine, encode_batch(batch(rows, first_seq, machine, spool_id, **more)))


def put(journal: Journal, sent: SampleBatch, received_ns: int = NOW_NS, lost: int = 0) -> None:
    journal.begin()
    journal.append(Admission(sent, trimmed=0, lost=lost), received_ns)
    journal.commit()


def fold_of(rows: Iterable[JournalRow], without: Container[str] = ()) -> Grid:
    grid = Grid(SITE.cell_m, CONFIG.fold)
    for row in rows:
        if row.machine not in without:
            grid.fold(row.rows, row.machine)
    return grid


def folded(rows: Table, machine: str = "a", cell_m: float = 1.0, waiting_rows: int = LIVE_ROWS, **options: Any) -> Grid:
    grid = Grid(cell_m, FoldConfig(**options), waiting_rows)
    grid.fold(rows, machine)
    return grid


def is_by_definition(grid: Grid, rows: Table, machine: str = "a") -> bool:
    """Whether a grid equals the reference, bit for bit."""
    return plain(of_grid(grid)) == plain(by_definition([(machine, rows)], grid.cell_m, grid.config))


def total(grid: Grid) -> np.ndarray:
    """Counts summed over cells, (COUNTS,)."""
    counts = np.zeros(ev.COUNTS, np.int64)
    for at in grid.state().pages:
        np.add.at(counts, at.page.votes["place"] // ev.CELLS, at.page.votes["count"].astype(np.int64))
    return counts


def same(one: Grid, other: Grid) -> bool:
    return same_state(one.state(), other.state())


def same_state(a: GridState, b: GridState) -> bool:
    """Equal to the bit."""
    totals = [(state.folded, state.skipped, state.newest_ns, state.oldest_ns) for state in (a, b)]
    return totals[0] == totals[1] and [*map(_bits, a.pages)] == [*map(_bits, b.pages)]


def same_evidence(one: Grid, other: Grid) -> bool:
    """Equal evidence in all blocks, to the bit, however paged."""
    if one.bounds() != other.bounds() or (one.folded, one.skipped) != (other.folded, other.skipped):
        return False
    column, row, end_column, end_row = one.bounds() or (0, 0, 1, 1)
    window = CellWindow(column, row, end_column - column, end_row - row)
    a, b = (grid.evidence(grid.blocks_in(window)) for grid in (one, other))
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("counts", "bitmaps", "newest_ns"))


def _bits(at: PlacedPage) -> tuple[object, ...]:
    return at.x, at.y, at.tier, at.index, at.page.votes.dtype, at.page.votes.tobytes(), at.page.cells.tobytes()


def filled_to(state: GridState, count: int) -> GridState:
    """The state with all non-zero counts replaced."""
    blocks = []
    for x, y, record in state.blocks:
        pages = Pages.unpacked(record)
        votes = pages.votes & np.uint64(0xFFFF) | np.uint64(count) << np.uint64(16)
        blocks.append((x, y, pages._replace(votes=votes).record))
    return replace(state, blocks=tuple(blocks))


APART = {"keep_buckets": 1000}  # no test's bucket is ever summed


def merged(parts: Iterable[Grid]) -> Grid:
    first, *more = parts
    for part in more:
        first.merge(part)
    return first


def grid_copy(store: Store) -> Grid:
    """A map for another thread than the store's owner."""
    return Grid.from_state(store.grid.cell_m, store.grid.config, store.grid.state())


def open_store(folder: Path, config: ServerConfig = CONFIG, site: SiteConfig = SITE) -> Store:
    return Store(JournalLocation(folder), site, config, now_ns)


def store_at(location: JournalLocation) -> Store:
    return Store(location, SITE, CONFIG, now_ns)


def open_writer(
    folder: Path, config: ServerConfig = CONFIG, site: SiteConfig = SITE, clock: Callable[[], float] = time.monotonic
) -> Writer:
    return Writer(open_store(folder, config, site), clock)


def past_of(writer: Writer) -> StorePast:
    return StorePast.of_store(writer.location.folder, writer.site.cell_m, writer.config.fold)


@contextmanager
def refused(reason: str, match: str | None = None) -> Iterator[None]:
    with pytest.raises((QueryError, MessageError), match=match) as caught:
        yield
    assert caught.value.reason == reason


class Replies:
    """Answers to batches, in order."""

    def __init__(self) -> None:
        self.all: list[tuple[int, Ack | Refused]] = []
        self._more = Event()

    def __getitem__(self, key: int) -> Callable[[Ack | Refused], None]:
        def reply(answer: Ack | Refused) -> None:
            self.all.append((key, answer))
            self._more.set()

        return reply

    def wait(self, n: int) -> list[Ack | Refused]:
        while len(self.all) < n:
            assert self._more.wait(PATIENCE_S), f"{len(self.all)} of {n} answers after {PATIENCE_S} s"
            self._more.clear()
        return [answer for _, answer in self.all]


@contextmanager
def held(writer: Writer) -> Iterator[None]:
    """Block the owner's thread, so submissions wait."""
    entered, release = Event(), Event()

    def hold(_: Store) -> None:
        entered.set()
        release.wait(PATIENCE_S)

    reader = Thread(target=writer.run, args=(hold,))
    reader.start()
    assert entered.wait(PATIENCE_S)
    try:
        yield
    finally:
        release.set()
        reader.join()


def send(writer: Writer, batches: Sequence[Incoming]) -> list[Ack | Refused]:
    replies = Replies()
    for i, one in enumerate(batches):
        writer.submit(one, replies[i])
    return replies.wait(len(batches))


@contextmanager
def routed() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """A router's own session and a client's, in this process."""
    endpoint = free_endpoint()
    router = open_session(SessionConfig(endpoint, mode="router"))
    client = open_session(SessionConfig(endpoint))
    try:
        yield router, client
    finally:
        client.close()
        router.close()
