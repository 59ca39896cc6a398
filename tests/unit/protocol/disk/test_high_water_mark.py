"""The mark beside a database never exceeds what was written, whatever happens to its file."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.disk import high_water_mark
from protocol.disk.high_water_mark import HighWaterMark, mark_path, read_mark


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return mark_path(tmp_path / "journal.db")


@pytest.fixture
def mark(path: Path) -> Iterator[HighWaterMark]:
    mark = HighWaterMark(path)
    yield mark
    mark.close()


def test_the_newest_value_of_each_name_counts(path, mark):
    mark.write({"row": 1, "a 7": 5})
    mark.write({"row": 2})
    assert read_mark(path) == {"row": 2, "a 7": 5}
    mark.close()
    again = HighWaterMark(path)
    again.write({"row": 3, "a 7": 2**63})
    again.close()
    assert read_mark(path) == {"row": 3, "a 7": 2**63}


def test_a_mark_that_is_torn_or_damaged_is_behind_and_never_ahead(path, mark):
    rng, states = random.Random(1), [{}]
    for row in range(1, 12):
        mark.write({"row": row, f"a {row % 5}": row})
        states.append(dict(mark.values))
    whole = path.read_bytes()
    for n in range(len(whole)):
        path.write_bytes(whole[:n])
        assert read_mark(path) in states
    for _ in range(150):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        assert read_mark(path) in states


def test_records_go_on_behind_the_sound_ones(path, mark):
    for row in range(1, 10):
        mark.write({"row": row})
    mark.close()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] + b"\xff" + whole[len(whole) // 2 + 1 :])
    behind = read_mark(path)["row"]
    assert 0 < behind < 9
    again = HighWaterMark(path)
    again.write({"row": 20})
    again.close()
    assert read_mark(path) == {"row": 20}, "what lies behind the new record does not follow on it"


def test_a_long_mark_is_written_anew_with_the_newest_values(path, mark, monkeypatch):
    monkeypatch.setattr(high_water_mark, "LIMIT", 2000)
    for row in range(1, 2000):
        mark.write({"row": row, f"a {row % 3}": row})
    assert path.stat().st_size < 3000
    assert read_mark(path) == mark.values
    assert mark.values["row"] == 1999


def test_replaced_values_forget_all_others(path, mark):
    mark.write({"row": 5, "a 7": 5})
    mark.replace({"row": 3})
    assert read_mark(path) == {"row": 3}
    mark.write({"row": 4})
    assert read_mark(path) == {"row": 4}


def test_a_disk_that_takes_no_more_leaves_the_mark_behind_until_it_does(path, mark, monkeypatch):
    mark.write({"row": 1})

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "pwrite", full)
        mark.write({"row": 2, "a 7": 1})
    assert read_mark(path) == {"row": 1}
    mark.write({"row": 3})
    assert read_mark(path) == {"row": 3, "a 7": 1}


def test_a_closed_mark_writes_to_no_other_file(path, tmp_path):
    mark = HighWaterMark(path)
    mark.close()
    with (tmp_path / "other").open("w+b"):
        mark.write({"row": 1})
        assert (tmp_path / "other").read_bytes() == b""


def test_only_its_owner_reads_it(path):
    before = os.umask(0)
    try:
        mark = HighWaterMark(path)
        mark.write({"row": 1})
        mark.replace({"row": 2})
        mark.close()
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o600
