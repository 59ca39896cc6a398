"""What was acknowledged and is gone is named when a journal is opened, by machine and number."""

from __future__ import annotations

import random
import shutil
from contextlib import closing
from pathlib import Path

import pytest

from mapserver.journal.rows import Watermark
from mapserver.journal.shortfall import KIND, Shortfall, SpoolShortfall, missing
from mapserver.journal.sqlite.journal import SqliteJournal
from protocol.disk.high_water_mark import mark_path
from protocol.errors import StoreError
from tests.unit.mapserver.data import NOW_NS, SITE, batch, put, random_samples

MACHINES = ("loader-1", "loader-2")
BATCHES, SAMPLES = 10, 100  # of each machine, of each batch


def open_journal(folder: Path) -> SqliteJournal:
    return SqliteJournal(folder / "journal.db", SITE.name, SITE.frame)


def write(journal: SqliteJournal, machine: str, first_seq: int, n: int = SAMPLES, lost: int = 0) -> None:
    put(journal, batch(random_samples(n, first_seq), first_seq, machine=machine), lost=lost)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a journal as kill -9 leaves it: 2000 acknowledged samples, and a decision in between."""
    work, left = tmp_path_factory.mktemp("work"), tmp_path_factory.mktemp("left")
    with closing(open_journal(work)) as journal:
        for i in range(BATCHES):
            for machine in MACHINES:
                write(journal, machine, 1 + i * SAMPLES)
            if i == BATCHES // 2:
                journal.append_event("trust", NOW_NS, {"machine": "loader-2"})
        shutil.copytree(work, left, dirs_exist_ok=True)
    return left


@pytest.fixture
def folder(killed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(killed, tmp_path / "store"))


def flip(path: Path, at: int, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1 << bit
    path.write_bytes(content)


def gone_of(journal: SqliteJournal) -> dict[str, int]:
    return dict(missing([Shortfall.from_event(event) for event in journal.events(KIND)], journal.watermarks()))


def test_each_flip_in_the_log_is_named_and_counted_by_machine(killed, tmp_path):
    rng, log, counted, refusals = random.Random(1), "journal.db-wal", 0, []
    size = (killed / log).stat().st_size
    for i in range(20):
        folder = Path(shutil.copytree(killed, tmp_path / str(i)))
        flip(folder / log, rng.randrange(size), rng.randrange(8))
        try:
            journal = open_journal(folder)
        except StoreError as error:  # pages of different times are in the file
            refusals.append(str(error))
            continue
        with closing(journal):
            present = {name: journal.watermark(name, 7).seq for name in MACHINES}
            assert journal.shortfall is not None
            assert gone_of(journal) == {n: BATCHES * SAMPLES - seq for n, seq in present.items() if seq < 1000}
            assert sum(gone_of(journal).values()) == 2000 - sum(len(row.rows) for row in journal.read())
            for name, n in gone_of(journal).items():
                assert f"{n} acknowledged samples of {name} are gone" in str(journal.shortfall)
            counted += 1
    assert counted > 10
    assert all("journal.db" in refusal for refusal in refusals)


def test_without_a_mark_damage_before_the_last_commit_is_named(folder):
    mark_path(folder / "journal.db").unlink()
    flip(folder / "journal.db-wal", 20_000, 3)
    with closing(open_journal(folder)) as journal:
        assert "journal.db-wal is damaged at byte" in str(journal.shortfall)


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.77, 1.0])
def test_a_mark_that_is_torn_or_behind_is_no_alarm(folder, kept):
    mark = mark_path(folder / "journal.db")
    whole = mark.read_bytes()
    mark.write_bytes(whole[: int(len(whole) * kept)] + b"\x55" * 7)
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is None


def cut_short(folder: Path, share: float = 0.5) -> None:
    """The log loses its end, as by a flip in its middle."""
    log = folder / "journal.db-wal"
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * share)])


def test_what_is_gone_is_remembered_until_it_is_sent_again_or_declared_lost(folder):
    cut_short(folder)
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is not None
        before = gone_of(journal)
        reached = {name: journal.watermark(name, 7).seq for name in MACHINES}
        assert min(before.values()) > 2 * SAMPLES
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is None, "it is named once"
        assert gone_of(journal) == before, "and counted for ever"
        write(journal, "loader-1", reached["loader-1"] + 1)  # it still has some
        assert gone_of(journal) == {**before, "loader-1": before["loader-1"] - SAMPLES}
        write(journal, "loader-1", 1001, lost=1000 - reached["loader-1"] - SAMPLES)  # and declares the others
        assert gone_of(journal) == {"loader-2": before["loader-2"]}
        assert journal.watermark("loader-1", 7).lost == before["loader-1"] - SAMPLES


def test_decisions_that_are_gone_are_named(folder):
    cut_short(folder, 0.3)
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is not None
        assert (journal.shortfall.event, journal.shortfall.expected_event) == (0, 1)
        assert "1 events are gone" in str(journal.shortfall)


def test_a_log_with_damage_is_kept_for_a_person(folder):
    flip(folder / "journal.db-wal", 20_000, 3)
    damaged = (folder / "journal.db-wal").read_bytes()
    with closing(open_journal(folder)) as journal:
        (kept,) = folder.glob("journal.db-wal.damaged-*")
        assert kept.name.endswith(f"-{journal.shortfall.row}")
        assert kept.read_bytes() == damaged
        assert kept.stat().st_mode & 0o777 == 0o600


def test_a_journal_from_a_backup_beside_a_newer_mark_is_named(folder, tmp_path):
    with closing(open_journal(folder)) as journal:
        write(journal, "loader-1", 1001)
    shutil.copy(folder / "journal.db", tmp_path / "backup.db")
    with closing(open_journal(folder)) as journal:
        write(journal, "loader-1", 1101, n=40)
    shutil.copy(tmp_path / "backup.db", folder / "journal.db")
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall == Shortfall(21, 22, 1, 1, (SpoolShortfall("loader-1", 7, 1100, 1140),))


def test_a_journal_that_is_not_there_any_more_is_named(folder):
    for name in ("journal.db", "journal.db-wal", "journal.db-shm"):
        (folder / name).unlink(missing_ok=True)
    with closing(open_journal(folder)) as journal:
        assert gone_of(journal) == dict.fromkeys(MACHINES, 1000)


def test_a_watermark_behind_its_rows_ends_the_start(folder):
    """As pages of different times would leave it: a batch that is sent again would be taken twice."""
    with closing(open_journal(folder)) as journal:
        journal.begin()
        journal.put_watermark("loader-1", 7, Watermark(900, 0, NOW_NS))
        journal.commit()
    mark = mark_path(folder / "journal.db")
    with closing(open_journal(folder)) as journal:
        assert journal.shortfall is None
        journal._mark.write({"loader-2 " + f"{7:016x}": 1001})
    assert mark.exists()
    with pytest.raises(StoreError, match="what its write-ahead log left is damaged; restore the file from a backup"):
        open_journal(folder)
