"""Samples lost by a machine's disk are named, counted and declared to the server."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from agents.delivery.spool import Spool, SpoolConfig
from protocol.errors import StoreError
from protocol.machine.samples import content_hash
from tests.unit.agents.drives import made_up_samples

ROWS = made_up_samples(400)


def opened(folder: Path) -> Spool:
    return Spool(folder / "spool.db", SpoolConfig())


def left_by_kill(work: Path, left: Path, use: Callable[[Spool], object]) -> Path:
    """Use a spool in `work` and copy its files to `left` before closing, as after kill -9."""
    with closing(opened(work)) as spool:
        use(spool)
        shutil.copytree(work, left)
    return left


def record(spool: Spool) -> None:
    for i in range(0, 400, 10):
        spool.record(ROWS[i : i + 10])


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """400 recorded samples, none sent."""
    folder = tmp_path_factory.mktemp("spools")
    return left_by_kill(folder / "work", folder / "left", record)


@pytest.fixture
def folder(killed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(killed, tmp_path / "spool"))


def cut_short(folder: Path, share: float) -> None:
    log = folder / "spool.db-wal"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * share)])


def deliver(spool: Spool) -> tuple[list[str], int, int]:
    """Send everything to a new server: accepted, number declared lost, last watermark."""
    taken: list[str] = []
    lost, marks = 0, dict[int, int]()
    while head := spool.head(1000):
        missing = head.first_seq - 1 - marks.get(head.spool_id, 0)
        assert missing <= head.lost_before
        lost += missing
        taken += [content_hash(row) for row in head.rows]
        marks[head.spool_id] = head.first_seq - 1 + len(head.rows)
        spool.acknowledge(head.spool_id, marks[head.spool_id])
    return taken, lost, max(marks.values(), default=0)


def test_a_kill_loses_nothing(folder):
    with closing(opened(folder)) as spool:
        assert (spool.damage, spool.counters()["gone"]) == ("", 0)
        assert deliver(spool) == ([content_hash(row) for row in ROWS], 0, 400)


def test_each_flip_in_the_log_is_named_counted_and_declared_to_the_server(killed, tmp_path):
    rng, size, counted = random.Random(1), (killed / "spool.db-wal").stat().st_size, 0
    for i in range(30):
        folder = Path(shutil.copytree(killed, tmp_path / str(i)))
        content = bytearray((folder / "spool.db-wal").read_bytes())
        content[rng.randrange(size)] ^= 1 << rng.randrange(8)
        (folder / "spool.db-wal").write_bytes(content)
        try:
            spool = opened(folder)
        except StoreError as error:
            assert "spool.db" in str(error)  # noqa: PT017 # most flips leave it usable
            continue
        with closing(spool):
            gone = spool.counters()["gone"]
            taken, lost, watermark = deliver(spool)
            assert gone == lost == 400 - len(taken) > 0
            assert watermark == 400
            assert f"{gone} recorded samples are gone" in spool.damage
            counted += 1
    assert counted > 25


def test_what_is_gone_is_counted_once_and_kept(folder):
    cut_short(folder, 0.45)  # amid a transaction: with orphaned pages
    with closing(opened(folder)) as spool:
        gone = spool.counters()["gone"]
        assert 100 < gone < 300
        assert spool.damage
    with closing(opened(folder)) as spool:
        assert (spool.counters()["gone"], spool.damage) == (gone, "")
        assert len(list(folder.glob("spool.db-wal.damaged-*"))) == 1


def test_runs_that_are_gone_with_the_log_are_declared_too(tmp_path):
    """Two kills without a checkpoint: two runs in the log."""

    def again(spool: Spool) -> None:
        spool.record(ROWS[300:])

    def first(spool: Spool) -> None:
        spool.record(ROWS[:300])

    one = left_by_kill(tmp_path / "work", tmp_path / "one", first)
    two = left_by_kill(one, tmp_path / "two", again)
    cut_short(two, 0.2)
    with closing(opened(two)) as spool:
        taken, lost, _ = deliver(spool)
        assert (len(taken) + lost, spool.counters()["gone"]) == (400, lost)
        assert lost >= 100


def test_what_was_acknowledged_is_not_gone(tmp_path):
    def use(spool: Spool) -> None:
        spool.record(ROWS[:50])
        spool.record(ROWS[50:60])
        spool.acknowledge(spool.spool_id, 57)

    left = left_by_kill(tmp_path / "work", tmp_path / "left", use)
    cut_short(left, 0.1)
    with closing(opened(left)) as spool:
        assert spool.counters()["gone"] == 3


def test_a_copy_in_place_of_the_file_is_named_and_declares_nothing(tmp_path):
    """The other file may still be sent, so its samples must not be declared lost."""
    with closing(opened(tmp_path)) as spool:
        spool.record(ROWS[:20])
    shutil.copy(tmp_path / "spool.db", tmp_path / "copy.db")
    with closing(opened(tmp_path)) as spool:
        spool.record(ROWS[20:90])
    shutil.copy(tmp_path / "copy.db", tmp_path / "spool.db")
    with closing(opened(tmp_path)) as spool:
        assert spool.damage == "70 recorded samples are gone"
        assert deliver(spool)[1:] == (0, 20)
    with closing(opened(tmp_path)) as spool:
        assert (spool.damage, spool.counters()["gone"]) == ("", 70)
