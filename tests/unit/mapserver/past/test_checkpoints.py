"""Which checkpoints of a store can be used."""

import shutil
from contextlib import closing

import pytest

from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.past.checkpoints import remove_beyond
from mapserver.past.plan import HOUR_NS
from tests.unit.mapserver.data import NOW_NS, random_samples
from tests.unit.mapserver.past.past_store import PastStore


@pytest.fixture
def store(tmp_path):
    """Three rows, and checkpoints after one, two and three hours, each made with one row more."""
    with closing(PastStore(tmp_path)) as opened:
        for hour in (1, 2, 3):
            opened.add(random_samples(20, hour))
            opened.make(NOW_NS + hour * HOUR_NS)
        yield opened


def nearest(store: PastStore, hour: float, without=(), last_row: int = 3) -> int | None:
    """Hour at which the nearest one is closed."""
    facts = store.past.depends_on(store.reader, Facts(frozenset(without)))
    checkpoint = store.past.checkpoints.nearest(NOW_NS + round(hour * HOUR_NS), facts, last_row)
    if checkpoint is None:
        return None
    checkpoint.close()
    return (checkpoint.header.closed_ns - NOW_NS) // HOUR_NS


def test_one_of_other_facts_is_not_used(store):
    assert nearest(store, 3, frozenset("b")) is None
    store.make(NOW_NS + 2 * HOUR_NS, "b")
    assert (nearest(store, 3, frozenset("b")), nearest(store, 2)) == (2, 1)


def test_one_of_another_fold_or_store_is_not_used(store, tmp_path):
    facts = store.past.depends_on(store.reader, NO_FACTS)
    for name, other in (("keep_hours", 5), ("cell_m", 2.0), ("schema", 0), ("store", "another"), ("correction", 1)):
        others = {**facts(0), name: other}
        assert store.past.checkpoints.nearest(NOW_NS + 3 * HOUR_NS, lambda _, others=others: others, 3) is None
    (tmp_path / "other").mkdir()
    with closing(PastStore(tmp_path / "other")) as other:
        other.add(random_samples(20, 1))
        shutil.copytree(store.past.checkpoints.folder, other.past.checkpoints.folder)
        assert nearest(other, 3) is None


def test_one_of_rows_that_the_journal_has_not_is_not_used_and_removed_at_the_start(store, tmp_path, caplog):
    assert [nearest(store, 3, last_row=row) for row in (3, 2, 1, 0)] == [3, 2, 1, None]
    remove_beyond(tmp_path, 2)
    assert nearest(store, 3, last_row=99) == 2
    assert "checkpoint removed" in caplog.text
    assert "2026-01-01T03" in caplog.text


def test_a_file_under_another_name_is_not_what_its_name_says(store):
    path = store.past.checkpoints.path(NOW_NS + HOUR_NS)
    shutil.copy(path, store.past.checkpoints.path(NOW_NS + 4 * HOUR_NS))
    for name in ("2026-13-45T99.checkpoint", "notes.txt", ".2026-01-01T05.checkpoint.12.part"):
        shutil.copy(path, path.with_name(name))
    assert nearest(store, 90) == 3
    assert len(store.past.checkpoints.entries(lambda _: {}, 3)) == 4
    assert store.past.checkpoints.passed_over == 1


def test_damage_seen_in_a_file_that_was_replaced_meanwhile_does_not_count(store):
    facts = store.past.depends_on(store.reader, NO_FACTS)
    with store.past.checkpoints.nearest(NOW_NS + HOUR_NS, facts, 3) as checkpoint:
        store.make(NOW_NS + HOUR_NS)
        store.past.checkpoints.entries(facts, 3)
        store.past.checkpoints.pass_over(checkpoint, ValueError("damaged"))
    assert nearest(store, 1) == 1
    assert store.past.checkpoints.passed_over == 0


def test_a_look_says_what_there_is(store):
    checkpoints = store.past.checkpoints
    assert checkpoints.state == {"count": 0, "bytes": 0, "newest_ns": 0, "passed_over": 0}
    size = sum(path.stat().st_size for path in checkpoints.folder.iterdir())
    checkpoints.look(store.past.depends_on(store.reader, NO_FACTS), 2)
    assert checkpoints.state == {"count": 2, "bytes": size, "newest_ns": NOW_NS + 2 * HOUR_NS, "passed_over": 0}
