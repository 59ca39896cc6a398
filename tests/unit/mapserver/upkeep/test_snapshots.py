"""The snapshot job on a real writer and store."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from mapserver.config import ServerConfig, StoreConfig
from mapserver.ingest import store as store_module
from mapserver.past.checkpoints import save_snapshot, snapshot_rows
from mapserver.upkeep import snapshots
from mapserver.upkeep.snapshots import SHARE, Snapshots
from tests.unit.mapserver.data import incoming, open_writer, samples, send


class Site:
    def __init__(self, folder: Path) -> None:
        self.folder, self.now_s = folder, 1000.0
        self.writer = open_writer(folder, ServerConfig(store=StoreConfig(snapshot_s=60.0)))
        self.job = Snapshots(self.writer, lambda: self.now_s)
        self._seq = 0

    def rows_after(self, samples_sent: int, passed_s: float = 0.0) -> list[int]:
        """Snapshot rows after more samples, a row each, and time."""
        for _ in range(samples_sent):
            self._seq += 1
            send(self.writer, [incoming(samples(1), self._seq)])
        self.now_s += passed_s
        self.job.run()
        return snapshot_rows(self.folder)

    def close(self) -> None:
        self.writer.close()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setattr(snapshots, "RESTART_SAMPLES", 3)
    with closing(Site(tmp_path)) as opened:
        yield opened


def test_a_snapshot_is_made_once_a_restart_would_take_long(site):
    assert [site.rows_after(1) for _ in range(7)] == [[], [], [3], [3], [3], [6, 3], [6, 3]]


def test_a_snapshot_is_made_when_its_time_has_come_even_if_nothing_comes(site):
    assert site.rows_after(1, 59.9) == []
    assert site.rows_after(0, 0.1) == [1]
    assert site.rows_after(0, 60.0) == [1], "nothing new"
    assert site.rows_after(1) == [1], "and it was looked at a moment ago"


def test_a_snapshot_that_takes_long_puts_the_next_off(site, monkeypatch):
    def slow(*words):
        site.now_s += 3.0
        return save_snapshot(*words)

    monkeypatch.setattr(store_module, "save_snapshot", slow)
    assert site.rows_after(3) == [3]
    assert site.rows_after(3, 3.0 * (1 / SHARE - 1) - 0.01) == [3], "it took 3 s: nothing for a minute"
    assert site.rows_after(0, 0.02) == [6, 3]


def test_a_snapshot_that_fails_is_tried_again_only_after_a_while(site, monkeypatch):
    tries = []

    def full(*words):
        tries.append(words[1])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store_module, "save_snapshot", full)
    with pytest.raises(OSError, match="No space"):
        site.rows_after(3)
    assert site.rows_after(2, 59.0) == []
    with pytest.raises(OSError, match="No space"):
        site.rows_after(1, 1.0)
    assert tries == [3, 6]
    site.writer.close()
    assert not site.writer.failed
    assert tries == [3, 6, 6], "and in the end"
