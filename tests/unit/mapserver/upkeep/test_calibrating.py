"""Ledgers following the samples, solves in site time, people's requests."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mapserver.calibration import calibrate as solving
from mapserver.calibration.calibrate import Solution, calibrate
from mapserver.calibration.correction import corrected
from mapserver.config import CalibrationConfig, ServerConfig, StoreConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.writer import Writer
from mapserver.journal.archive import FOLDER, archive
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.upkeep import calibrating as calibrating_module
from mapserver.upkeep.calibrating import EVERY_NS, Calibrating
from mapserver.upkeep.upkeep import Upkeep
from protocol.arrays import Table
from protocol.errors import Refusal
from protocol.queries.commands import CalibrateCommand
from tests.patience import PATIENCE_S
from tests.unit.mapserver.calibration.drives import LOW, RAMP, RAMP_AGAIN, START_NS, Errors, drive
from tests.unit.mapserver.data import SITE, grid_copy, incoming, open_writer, past_of, refused, same, send

DRIVES = {
    "a": drive(LOW, Errors(zero=0.008), seed=1, seconds=300),
    "b": drive(RAMP, Errors(zero=-0.006, scale=0.05), seed=2, seconds=300),
    "c": drive(RAMP_AGAIN, Errors(scale=-0.04), seed=3, seconds=300),
}
S = 10**9


def deliver(writer: Writer, first: float = 0.0, last: float = 1.0, batch: int = 150) -> None:
    spans = {name: range(int(first * len(rows)), int(last * len(rows)), batch) for name, rows in DRIVES.items()}
    for i in range(max(map(len, spans.values()))):
        for name, starts in spans.items():
            if i < len(starts):
                end = min(starts[i] + batch, starts.stop)
                send(writer, [incoming(DRIVES[name][starts[i] : end], starts[i] + 1, name)])


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[Writer]:
    config = ServerConfig(store=StoreConfig(archive_after_h=0.0), calibration=CalibrationConfig(automatic=False))
    with closing(open_writer(tmp_path, config)) as opened:
        yield opened


def calibrating(writer: Writer, *doubtful: str) -> tuple[Calibrating, list[int]]:
    decided: list[int] = []

    def decide(_: Solution, now_ns: int) -> None:
        decided.append(now_ns)

    job = Calibrating(writer, past_of(writer), decide, lambda: frozenset(doubtful), list, threading.Event())
    return job, decided


def solved(writer: Writer, *doubtful: str) -> Solution:
    job, _ = calibrating(writer, *doubtful)
    with closing(job):
        return of_ledgers(job)


def of_ledgers(job: Calibrating) -> Solution:
    """The ledgers' result, without the first times of samples, which they do not own."""
    return replace(job.solve()[0], begins_ns={})


def test_followed_live_made_at_a_start_or_from_the_archive_ledgers_are_the_same(writer, tmp_path, monkeypatch):
    live, _ = calibrating(writer)
    with closing(live):
        for share in range(5):
            deliver(writer, share / 5, (share + 1) / 5)
            live.run()
        result = of_ledgers(live)
    assert solved(writer) == result
    with SqliteReader(tmp_path / JOURNAL_FILE) as reader:
        half = writer.run(lambda store: store.journalled) // 2

        def forget(until: int) -> int:
            return writer.run(lambda store: store.journal.forget(min(until, half)))

        pytest.importorskip("pyarrow.parquet")
        next(archive(tmp_path / FOLDER, reader, SITE, 2**62, lambda until: max(forget(until), until)))
        assert reader.archived_row == half
    assert solved(writer) == result
    monkeypatch.setattr("mapserver.upkeep.calibrating.TURN_SAMPLES", 10)
    assert solved(writer) == result


def test_a_machine_in_doubt_has_no_say(writer):
    deliver(writer)
    assert solved(writer, "a").machines["b"] != solved(writer).machines["b"]
    assert solved(writer, "a").machines["a"].zero == pytest.approx(0.008, abs=0.003)


def test_it_solves_in_site_time(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        job, decided = calibrating(writer)
        with closing(job):
            rows, seq = DRIVES["a"], 1
            for until_s in (10, 20, 40, 65, 75, 80, 140, 150):
                part = rows[seq - 1 :][rows["stamp_ns"][seq - 1 :] <= START_NS + until_s * S]
                send(writer, [incoming(part, seq, "a")])
                seq += len(part)
                job._due_s = 0.0
                job.run()
                job.run()
            assert [round((now_ns - START_NS) / S) for now_ns in decided] == [75, 140], (
                "10 s were there before it began"
            )
            job._due_s = 1e12  # beyond its share of the processor
            send(writer, [incoming(rows[seq - 1 :], seq, "a")])
            job.run()
            assert len(decided) == 2
    assert EVERY_NS == 60 * S


def test_while_somebody_has_it_solved_other_jobs_do_not_wait(writer):
    job, decided = calibrating(writer)
    deliver(writer)
    with closing(job):
        with job._turn:
            job.run()
        assert (decided, job._followed) == ([], 0)
        job.run()
        assert job._followed == writer.run(lambda store: store.journalled)


def folded(upkeep: Upkeep, writer: Writer) -> Grid:
    each = writer.run(lambda store: store.facts.corrections).each
    grid = Grid(SITE.cell_m, writer.config.fold)
    for name, rows in DRIVES.items():
        grid.fold(corrected(rows, [one for one in each if one.machine == name]), name)
    return grid


def test_asked_for_the_map_has_what_is_known_at_once(writer):
    deliver(writer)
    before = writer.run(grid_copy)
    with closing(Upkeep(writer, lambda _: None, past_of(writer), lambda: None)) as site:
        assert site.calibration().machines[0].spans == ()
        site.calibrate(PATIENCE_S)
        answer = site.calibration()
        a, b, c = answer.machines
        assert (a.by, a.zero_by != (), answer.fact, answer.merged) == (
            "solver",
            True,
            3,
            writer.run(lambda s: s.merged),
        )
        assert a.spans[-1].zero == pytest.approx(a.zero, abs=1e-5)
        assert b.spans[-1].scale - c.spans[-1].scale == pytest.approx(0.09, abs=0.02)
        assert same(writer.run(grid_copy), folded(site, writer))
        assert not same(writer.run(grid_copy), before)
        site.calibrate(PATIENCE_S)
        assert site.calibration().fact == 3, "nothing new is known"


def test_a_person_corrects_a_machine_until_it_is_left_to_the_server(writer):
    deliver(writer)
    with closing(Upkeep(writer, lambda _: None, past_of(writer), lambda: None)) as site:
        site.correct(CalibrateCommand("a", zero=0.0081234, reason="levelled", wait_s=60.0))
        state = site.calibration().machines[0]
        assert (state.by, state.reason, state.spans[0].zero, state.spans[0].from_ns) == (
            "person",
            "levelled",
            0.00812,
            0,
        )
        site.calibrate(PATIENCE_S)
        assert site.calibration().machines[0].spans == state.spans, "a person is not overruled"
        assert site.calibration().machines[1].by == "solver"
        assert same(writer.run(grid_copy), folded(site, writer))
        site.correct(CalibrateCommand("a", auto=True, wait_s=60.0))
        assert site.calibration().machines[0].spans == ()
        site.calibrate(PATIENCE_S)
        assert site.calibration().machines[0].by == "solver"
        with refused(Refusal.UNKNOWN_MACHINE, "`z` has sent nothing; known: a, b, c"):
            site.correct(CalibrateCommand("z", auto=True))


@pytest.mark.slow
@pytest.mark.parametrize(("automatic", "machines"), [(True, 3), (False, 0)])
def test_by_itself_it_corrects_machines_unless_it_must_not(tmp_path, automatic, machines):
    config = ServerConfig(store=StoreConfig(archive_after_h=0.0), calibration=CalibrationConfig(automatic))
    with closing(open_writer(tmp_path, config)) as writer:
        site = Upkeep(writer, lambda _: None, past_of(writer), lambda: None)
        with closing(site):
            for share in range(4):
                deliver(writer, share / 4, (share + 1) / 4)
                site._calibrating._due_s = 0.0
                site._calibrating.run()
            site._refolding.wait(site._refolding._decided, PATIENCE_S)
            assert site.calibration().solved_ns > 0
            assert sum(bool(each.spans) for each in site.calibration().machines) == machines
            assert same(writer.run(grid_copy), folded(site, writer))


def test_rows_that_cannot_be_read_do_not_keep_the_others_from_counting(writer, tmp_path):
    deliver(writer)
    whole = solved(writer)
    damaged = writer.run(lambda store: store.journal.last_row) // 3
    with closing(sqlite3.connect(tmp_path / JOURNAL_FILE)) as db, db:
        (record,) = db.execute("SELECT record FROM journal WHERE row = ?", (damaged,)).fetchone()
        flipped = record[:-1] + bytes([record[-1] ^ 1])
        db.execute("UPDATE journal SET record = ? WHERE row = ?", (flipped, damaged))
    job, _ = calibrating(writer)
    with closing(job):
        without = job.solve()[0]
    assert {*without.machines} == set(DRIVES)
    assert without != whole
    for name, state in whole.machines.items():
        assert without.machines[name].zero == pytest.approx(state.zero, abs=2 * state.zero_std)


def test_a_large_fleet_is_solved_in_groups_that_take_turns(writer, monkeypatch):
    monkeypatch.setattr(solving, "MOST_MACHINES", 2)
    monkeypatch.setattr(solving, "MOST_EPOCHS", 4)
    together: list[set[str]] = []

    def note(stays: Mapping[str, Table], *more: Any) -> Solution:
        together.append({*stays})
        return calibrate(stays, *more)

    monkeypatch.setattr(calibrating_module, "calibrate", note)
    deliver(writer, last=0.1)
    job, _ = calibrating(writer)
    together.clear()
    with closing(job):
        for share in (0.1, 0.4, 0.7):
            job._due_s = 0.0
            job.run()
            deliver(writer, share, share + 0.3)
        job._due_s = 0.0
        job.run()
        assert together == [{"a", "c"}, {"b"}, {"a", "c"}]
        assert {*job.states()} == set(DRIVES)
        assert {*job.solve()[0].machines} == set(DRIVES)
        assert {ledger.epochs for ledger in job._ledgers.values()} == {2}


def test_it_says_from_when_on_there_may_be_samples_of_a_machine(writer):
    deliver(writer, last=0.5)
    job, _ = calibrating(writer)
    with closing(job):
        assert job.solve()[0].begins_ns == dict.fromkeys(DRIVES, 0), "what was days before it began is not read"
        rows = drive(LOW, seconds=20.0, start_s=1000.0)
        send(writer, [incoming(rows[10:], 1, "d")])
        first_ns = int(rows["stamp_ns"][10])
        assert job.solve()[0].begins_ns == dict.fromkeys(DRIVES, 0) | {"d": first_ns}
        send(writer, [incoming(rows[:10], 1, "d", spool_id=8)])
        assert job.solve()[0].begins_ns["d"] == int(rows["stamp_ns"][0]), "and late ones count"


def follows(job: Calibrating, writer: Writer, rows: Table, name: str = "a", first_seq: int = 1) -> None:
    for first in range(0, len(rows), 120):
        send(writer, [incoming(rows[first : first + 120], first_seq + first, name)])
        job._due_s = 0.0
        job.run()


@pytest.mark.parametrize("same_machine", [False, True])
def test_one_clock_that_was_ahead_does_not_stop_the_calibration_of_the_site(tmp_path, same_machine):
    with closing(open_writer(tmp_path)) as writer:
        job, decided = calibrating(writer)
        with closing(job):
            ahead = drive(LOW, seconds=5, start_s=20 * 3600)
            follows(job, writer, ahead, "a" if same_machine else "x")
            rows = drive(LOW, Errors(0.009), seconds=400)
            follows(job, writer, rows, first_seq=len(ahead) + 1 if same_machine else 1)
            assert len(decided) >= 5
            if same_machine:
                assert {round((now_ns - START_NS) / S) < 400 for now_ns in decided[1:]} == {True}


def test_what_a_clock_stamped_that_was_ahead_has_no_part_in_a_solve(tmp_path, monkeypatch):
    """A machine's clock is 20 h ahead, then right, some epochs each."""
    monkeypatch.setattr(solving, "MOST_EPOCHS", 1)
    monkeypatch.setattr("mapserver.calibration.ledger.PENDING_ROWS", 10)
    with closing(open_writer(tmp_path)) as writer:
        job, _ = calibrating(writer)
        with closing(job):
            right = drive(LOW, Errors(0.012), seconds=300, start_s=3600)
            send(writer, [incoming(right[:240], 1, "a")])
            job.run()
            ahead = drive(LOW, Errors(-0.005), seconds=150, start_s=20 * 3600)
            follows(job, writer, ahead, first_seq=241)
            follows(job, writer, right[240:], first_seq=241 + len(ahead))
            result = job.solve()[0]
            assert max(one.from_ns for one in result.corrections) <= int(right["stamp_ns"].max())
            assert result.machines["a"].zero == pytest.approx(0.012, abs=0.002)
            assert solved(writer).machines["a"].zero == pytest.approx(0.012, abs=0.002), "nor after a start"


def test_a_running_server_knows_no_more_of_machines_that_left_than_one_that_is_started(tmp_path, monkeypatch):
    monkeypatch.setattr(solving, "MOST_EPOCHS", 20)
    with closing(open_writer(tmp_path)) as writer:
        job, _ = calibrating(writer)
        with closing(job):
            for name in ("gone", "here"):
                send(writer, [incoming(drive(LOW, seconds=100), 1, name)])
            assert {*of_ledgers(job).machines} == {"gone", "here"}
            assert job._ledgers["here"].epochs == 10
            later = drive(LOW, Errors(0.006), seconds=200, start_s=30 * 86_400)
            send(writer, [incoming(later, 201, "here", lost_before=0)])
            running = of_ledgers(job)
            assert {*running.machines} == {"here"}
            assert {*job._ledgers} == {"here"}
            assert job._ledgers["here"].epochs == 20, "there is room again"
            assert running == solved(writer)
