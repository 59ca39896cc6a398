"""The checkpoint job on a real writer and store."""

import shutil
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from mapserver.config import ServerConfig, StoreConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.store import Store
from mapserver.ingest.writer import Writer
from mapserver.journal.facts import Facts
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.upkeep import checkpointing
from mapserver.upkeep.checkpointing import RESERVE_BYTES, Checkpointing
from protocol.arrays import Table
from protocol.units import HOUR_NS
from tests.unit.mapserver.data import NOW_NS, SITE, incoming, past_of, random_samples, same, send

TURNS = 500


class Site:
    def __init__(self, folder: Path, sent: list[tuple[str, Table]], checkpoints_gb: float = 5.0) -> None:
        self.config = ServerConfig(store=StoreConfig(archive_after_h=0.0, checkpoints_gb=checkpoints_gb))
        self.writer = Writer(Store(JournalLocation(folder), SITE, self.config, lambda: NOW_NS + 200 * HOUR_NS))
        self.reader = SqliteReader(folder / JOURNAL_FILE)
        self.past = past_of(self.writer)
        self.ending = threading.Event()
        self.job = Checkpointing(self.writer, self.reader, self.past, self.ending)
        self.sent = sent

    def drive(self, hours: list[float], n: int = 30, machine: str = "a") -> None:
        for hour in hours:
            rows = random_samples(n, len(self.sent), half_m=20.0)
            rows["stamp_ns"] += round(hour * HOUR_NS)
            first_seq = 1 + sum(len(table) for name, table in self.sent if name == machine)
            send(self.writer, [incoming(rows, first_seq, machine)])
            self.sent.append((machine, rows))

    def exclude(self, *machines: str) -> None:
        grid = self.folded(2**62, frozenset(machines))
        self.writer.run(lambda store: store.adopt(grid, store.merged, Facts(frozenset(machines))))

    def run(self) -> None:
        idle = 0
        for _ in range(TURNS):
            self.job.run()
            idle = 0 if self.job._making else idle + 1
            if idle > len(self.hours) + 2:  # each is looked at
                return
        raise AssertionError("never done")

    @property
    def hours(self) -> list[float]:
        """Closing times of the usable ones."""
        facts = self.past.depends_on(self.reader, self.writer.run(lambda store: store.facts))
        entries = self.past.checkpoints.entries(facts, self.reader.last_row)
        return [(entry.closed_ns - NOW_NS) / HOUR_NS for entry in entries if entry.usable]

    def folded(self, to_ns: int, without: frozenset[str] = frozenset()) -> Grid:
        grid = Grid(SITE.cell_m, self.config.fold)
        for machine, rows in self.sent:
            if machine not in without:
                grid.fold(rows[rows["stamp_ns"] <= to_ns], machine)
        return grid

    def is_true(self, hour: float, without: frozenset[str] = frozenset()) -> bool:
        to_ns = NOW_NS + round(hour * HOUR_NS)
        return same(self.past.grid_as_of(self.reader, to_ns, facts=Facts(without)), self.folded(to_ns, without))

    def close(self) -> None:
        self.job.close()
        self.reader.close()
        self.writer.close()


@pytest.fixture
def opened(tmp_path):
    sent: list[tuple[str, Table]] = []

    @contextmanager
    def open_site(**options: float) -> Iterator[Site]:
        with closing(Site(tmp_path / "store", sent, **options)) as site:
            yield site

    return open_site


def test_hours_of_the_last_day_are_made_and_days_stay(opened):
    with opened() as site:
        for hour in range(8, 12):
            site.drive([hour])
            site.run()
        assert site.hours == [9, 10, 11]  # the twelfth is not over
        assert all(site.is_true(hour) for hour in (8.2, 9, 10.4, 11.9))
        site.drive([30, 36.5])
        site.run()
        assert site.hours == [12, 31]  # only the last of the first day
        site.drive([60])
        site.run()
        assert site.hours == [12, 37]
        assert all(site.is_true(hour) for hour in (8.2, 11.9, 12, 30.3, 36.9, 61))


def test_one_that_lacks_many_late_rows_is_made_again(opened, monkeypatch):
    monkeypatch.setattr(checkpointing, "LATE_ROWS", 3)
    with opened() as site:
        site.drive([8, 9, 10])
        site.run()
        rows = {entry.closed_ns: entry.header.row for entry in site.past.checkpoints.entries(lambda _: {}, 99)}
        assert list(rows.values()) == [3, 3]
        site.drive([8.1, 8.2], machine="late")
        site.run()
        assert [entry.header.row for entry in site.past.checkpoints.entries(lambda _: {}, 99)] == [3, 3]
        assert site.is_true(8.9)
        site.drive([9.1], machine="late")
        site.run()
        assert [entry.header.row for entry in site.past.checkpoints.entries(lambda _: {}, 99)] == [3, 6], (
            "only what lacks three"
        )
        assert all(site.is_true(hour) for hour in (8.9, 9, 9.9, 10))


def test_after_a_decision_about_a_machine_they_are_made_again_and_until_then_not_used(opened):
    with opened() as site:
        site.drive([8, 9, 10])
        site.drive([8.1, 9.1, 10.1], machine="bad")
        site.run()
        assert site.hours == [9, 10]
        site.exclude("bad")
        assert site.hours == []
        assert all(site.is_true(hour, frozenset(["bad"])) for hour in (8.9, 9.5, 10.4))
        site.run()
        assert site.hours == [9, 10]
        assert all(site.is_true(hour, frozenset(["bad"])) for hour in (8.9, 9.5, 10.4))
        site.exclude()
        assert all(site.is_true(hour) for hour in (8.9, 9.5, 10.4))
        site.run()
        assert site.hours == [9, 10]
        assert all(site.is_true(hour) for hour in (8.9, 9.5, 10.4))


def test_room_is_kept_to(opened, tmp_path):
    with opened() as site:
        site.drive(list(range(8, 16)))
        site.run()
        size = site.past.checkpoints.path(NOW_NS + 15 * HOUR_NS).stat().st_size
        assert site.past.checkpoints.state["bytes"] > 3.5 * size
    with opened(checkpoints_gb=3.5 * size / 1e9) as site:
        for hour in range(16, 24):
            site.drive([hour])
            site.run()
            assert sum(path.stat().st_size for path in site.past.checkpoints.folder.iterdir()) <= 3.5 * size
        assert site.hours[-1] == 23
        assert site.is_true(23.4)


@pytest.mark.parametrize(("gb", "warned"), [(0.0, False), (1e-6, True)])
def test_without_room_there_are_none_and_maps_of_the_past_are_the_same(opened, gb, warned, caplog, monkeypatch):
    with opened() as site:
        site.drive([8, 9])
        site.run()
        assert site.hours == [9]
    with opened(checkpoints_gb=gb) as site:
        site.drive([10, 11])
        site.job.run()
        assert site.hours == []
        assert site.is_true(9.5)
        assert ("no room for checkpoints" in caplog.text) == warned
        assert not list(site.past.checkpoints.folder.iterdir())


def test_a_disk_that_is_nearly_full_is_left_to_what_machines_send(opened, monkeypatch):
    with opened() as site:
        site.drive([8, 9, 10])
        site.run()
        usage = shutil.disk_usage(site.writer.location.folder)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=RESERVE_BYTES - 10**9))
        site.drive([11])
        site.job.run()
        assert site.hours == []
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=RESERVE_BYTES + 10**9))
        site.job._due_s = 0.0
        site.run()
        assert site.hours[-1] == 11


def test_what_a_killed_server_left_is_removed_at_the_start(opened, tmp_path):
    folder = tmp_path / "store" / "checkpoints"
    folder.mkdir(parents=True)
    (folder / ".2026-01-01T09.checkpoint.ab.part").write_bytes(b"half")
    with opened() as site:
        assert list(folder.iterdir()) == []
        site.drive([8, 9])
        site.run()
        assert [path.name for path in folder.iterdir()] == ["2026-01-01T09.checkpoint"]
