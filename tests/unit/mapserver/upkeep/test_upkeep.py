"""The upkeep on a real writer and store: exclusion, published changes, archiving."""

import shutil
import threading
from contextlib import closing, contextmanager
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapserver.calibration.correction import UNCORRECTED, Correction, SampleCorrections
from mapserver.calibration.decision import CalibrationDecision
from mapserver.calibration.select import MachineErrors
from mapserver.config import CalibrationConfig, ServerConfig, StoreConfig, TrustConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.writer import Writer
from mapserver.journal import archived_decisions
from mapserver.journal.archive import FOLDER
from mapserver.journal.location import JOURNAL_FILE
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.trust.judgement import Reason
from mapserver.upkeep import jobs, refolding, upkeep
from mapserver.upkeep.jobs import MOST_TURNS, REST_TURNS, Archiving, Audit, ChangeSearch
from mapserver.upkeep.upkeep import Upkeep
from protocol.errors import QueryError
from protocol.queries.answers import GroundChange
from protocol.site.ground_classes import ZONES
from tests.unit.mapserver.data import (
    NOW_NS,
    SITE,
    folded,
    grid_copy,
    incoming,
    open_store,
    open_writer,
    past_of,
    random_samples,
    same,
    samples,
    send,
    wait_for,
)

JUDGE_S = 0.05
HOUR_NS = 3600 * 10**9


class Site:
    def __init__(self, folder: Path, judge_s: float = 60.0, *, exclude: bool = True, calibrates: bool = True) -> None:
        self.published: list[GroundChange] = []
        self.config = ServerConfig(
            store=StoreConfig(archive_after_h=0.0),
            trust=TrustConfig(judge_s, exclude),
            calibration=CalibrationConfig(automatic=calibrates),
        )
        self.writer = open_writer(folder, self.config)
        self.upkeep = Upkeep(self.writer, self.published.append, past_of(self.writer), lambda: None)

    @property
    def grid(self) -> Grid:
        return self.writer.run(grid_copy)

    def machine(self, name: str) -> dict[str, Any]:
        return next(row for row in self.upkeep.machines() if row["name"] == name)

    def close(self) -> None:
        self.upkeep.close()
        self.writer.close()


@pytest.fixture
def opened(tmp_path, monkeypatch):
    monkeypatch.setattr(upkeep, "TURN_S", 0.01)
    monkeypatch.setattr(refolding, "RETRY_S", 0.01)

    @contextmanager
    def open_site(**options: Any):
        with closing(Site(tmp_path / "store", **options)) as site:
            yield site

    return open_site


@pytest.fixture
def store(tmp_path):
    folder = tmp_path / "store"
    with closing(open_writer(folder)) as writer, SqliteReader(folder / JOURNAL_FILE) as reader:
        yield writer, reader


def fleet(bad: dict[str, float], passes: int = 2, size: int = 48) -> dict[str, list[Any]]:
    """Four machines sweeping three zones; those in `bad` report c_rr times a gain."""
    zone = np.array([ZONES[i].c_rr for i in (0, 2, 3)])
    sent: dict[str, list[Any]] = {}
    for i, name in enumerate("abcd"):
        draw = np.random.default_rng(i)
        x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(size), np.arange(size)))
        sent[name] = []
        for number in range(passes):
            place = x + draw.normal(0, 0.3, len(x)), y + draw.normal(0, 0.3, len(x))
            c_rr = zone[(x * 3 // size).astype(int)] * bad.get(name, 1.0) * draw.normal(1, 0.03, len(x))
            stamps = NOW_NS + number * 3 * HOUR_NS + np.arange(len(x)) * 10**8
            values = {"x_m": place[0], "y_m": place[1], "c_rr": c_rr, "stamp_ns": stamps, "cov_xx_m2": 0.09}
            sent[name].append(samples(len(x), **values, cov_yy_m2=0.09))
    return sent


def deliver(site: Site, sent: dict[str, list[Any]]) -> None:
    seq = dict.fromkeys(sent, 1)
    parts = {name: np.array_split(np.concatenate(rows), 20) for name, rows in sent.items()}
    for i in range(20):
        for name, mine in parts.items():
            send(site.writer, [incoming(mine[i], seq[name], name)])
            seq[name] += len(mine[i])


def fold_of(sent: dict[str, list[Any]], config: ServerConfig, without: str = "") -> Grid:
    grid = Grid(SITE.cell_m, config.fold)
    for name, rows in sent.items():
        if name not in without:
            for part in rows:
                grid.fold(part, name)
    return grid


@pytest.mark.parametrize(("worked_s", "pause_s"), [(0.0, 1.0), (0.2, 1.0), (0.5, 2.0), (1.0, 4.0), (60.0, 5.0)])
def test_turns_of_a_large_fleet_leave_most_of_the_time_to_others(worked_s, pause_s):
    assert upkeep.pause_s(worked_s) == pytest.approx(pause_s)


def test_a_machine_that_contradicts_all_others_is_excluded(opened):
    sent = fleet({"c": 1.6})
    with opened(judge_s=JUDGE_S, calibrates=False) as site:  # its evidence is as sent
        deliver(site, sent)
        wait_for(lambda: site.writer.run(lambda store: store.facts).excluded == {"c"})
        row = site.machine("c")
        assert (row["trusted"], row["by"]) == (False, "audit")
        assert "gain" in row["reason"]
        assert row["evidence"]["gain"] == pytest.approx(1.6, rel=0.15)
        wait_for(lambda: same(site.grid, fold_of(sent, site.config, without="c")))
        assert all(site.machine(name)["trusted"] for name in "abd")


def test_a_bad_machine_is_only_named_where_the_server_may_not_exclude(opened):
    with opened(judge_s=JUDGE_S, calibrates=False, exclude=False) as site:
        deliver(site, fleet({"c": 1.6}))
        wait_for(lambda: site.machine("c")["contradicts"])
        never = threading.Event()
        for _ in range(4):  # turns in which it could be excluded
            never.wait(JUDGE_S)
        assert site.writer.run(lambda store: store.facts).excluded == frozenset()
        assert site.machine("c")["trusted"]
        assert site.machine("c")["reasons"]


def test_a_person_overrules_the_audit_and_hands_back(opened):
    with opened(judge_s=JUDGE_S, calibrates=False) as site:
        deliver(site, fleet({"c": 1.6}))
        wait_for(lambda: site.writer.run(lambda store: store.facts).excluded == {"c"})
        assert site.upkeep.trust("c", True, "I know better", 20.0)["by"] == "person"
        assert site.writer.run(lambda store: store.facts).excluded == frozenset()
        assert not site.upkeep.trust("c", None, "", 20.0)["trusted"]
        assert site.writer.run(lambda store: store.facts).excluded == {"c"}


def repaved(site: Site) -> None:
    size = 40
    x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(size), np.arange(size)))
    first = 1
    for hour, c_rr in ((0, 0.06), (1, 0.06), (2, 0.02)):
        stamps = NOW_NS + hour * HOUR_NS + np.arange(len(x)) * 10**8
        rows = samples(len(x), x_m=x, y_m=y, c_rr=c_rr, stamp_ns=stamps, cov_xx_m2=0.25)
        send(site.writer, [incoming(rows, first)])
        first += len(rows)


def test_a_change_is_published_listed_and_kept(opened):
    with opened() as site:
        repaved(site)
        wait_for(lambda: site.published)
        wait_for(lambda: site.upkeep.changes() and site.upkeep.changes()[0].cells > 1000)
        (change,) = site.upkeep.changes()
        assert site.published[-1] == change
        assert change.resistance_after == pytest.approx(0.02, rel=0.05)
    with opened() as site:
        assert site.upkeep.changes() == [change]
        wait_for(lambda: not site.writer.run(lambda store: store.grid.take_touched(1)))
        assert site.published == []
        assert site.upkeep.changes(after=change.id) == []


def test_a_block_is_looked_at_once_it_was_left_or_every_so_many_turns(store, monkeypatch):
    writer, reader = store
    search, look, looked = ChangeSearch(writer, reader, print, threading.Event()), ChangeSearch._look, list[Any]()
    monkeypatch.setattr(ChangeSearch, "_look", lambda self, some: looked.append((turn, some)) or look(self, some))
    for turn in range(1, MOST_TURNS + 10):
        if turn <= MOST_TURNS + 2:
            send(writer, [incoming(samples(1, x_m=1.0, y_m=1.0), turn)])
        search.run()
    assert {block for _, some in looked for block in some} >= {(0, 0)}
    assert [turn for turn, _ in looked] == [1 + MOST_TURNS, MOST_TURNS + 2 + REST_TURNS]


def archiving(writer: Writer, reader: SqliteReader, after_h: float, hours_later: float = 3.0) -> Archiving:
    writer = copy(writer)
    writer.now_ns = lambda: NOW_NS + round(hours_later * HOUR_NS)
    writer.config = ServerConfig(store=StoreConfig(archive_after_h=after_h))
    return Archiving(writer, reader, threading.Event())


@pytest.mark.parametrize("after_h", [0.0, 1.0, 4.0])
def test_rows_that_are_old_enough_move_to_the_archive_and_the_map_stays(store, tmp_path, after_h):
    writer, reader = store
    rows = random_samples(400, 3)
    for first in range(0, 400, 100):
        send(writer, [incoming(rows[first : first + 100], first + 1)])
    archiving(writer, reader, after_h).run()
    assert reader.archived_row == (4 if after_h == 1.0 else 0)
    assert bool(list((tmp_path / "store" / FOLDER).glob("*.parquet"))) == (after_h == 1.0)
    shutil.copytree(tmp_path / "store", tmp_path / "copy")  # as after a kill: no snapshot
    with closing(open_store(tmp_path / "copy")) as again:  # folded from archive and journal
        assert same(again.grid, folded(rows))
    assert same(writer.run(grid_copy), folded(rows))


def test_decisions_are_written_beside_the_archive_with_a_new_file_or_once_in_an_hour(store, tmp_path):
    writer, reader = store
    folder = tmp_path / "store" / FOLDER
    job = archiving(writer, reader, 1.0)

    def decide(zero: float) -> list[float]:
        correction = Correction("a", 0, 2**62, zero, 0.0, 0.0, ())
        decision = CalibrationDecision("a", "person", "why", NOW_NS, (correction,))
        writer.run(lambda store: store.adopt(store.grid, store.merged, store.decide(decision)))
        job._due_s = 0.0
        job.run()
        return [each.corrections[0].zero for each in archived_decisions.load(folder)]

    assert decide(0.001) == [], "there is no archive"
    send(writer, [incoming(samples(5))])
    assert decide(0.002) == [0.001, 0.002]
    assert decide(0.003) == [0.001, 0.002]
    job._keep_s = 0.0  # an hour later
    assert decide(0.004) == [0.001, 0.002, 0.003, 0.004]


def test_a_damaged_archive_is_named_and_the_server_goes_on(opened, tmp_path, caplog):
    with opened() as site, SqliteReader(tmp_path / "store" / JOURNAL_FILE) as reader:
        send(site.writer, [incoming(samples(5))])
        archiving(site.writer, reader, 1.0).run()
        (path,) = (tmp_path / "store" / FOLDER).glob("*.parquet")
        path.write_bytes(path.read_bytes()[:-50])
        with pytest.raises(QueryError, match=f"the decision is kept, but the map is not folded again .*{path.name}"):
            site.upkeep.trust("a", False, "", 0.5)
        assert path.name in caplog.text
        wait_for(lambda: caplog.text.count("job=refolding") > 1)  # tried again
        assert len(reader.events("trust")) == 1
        send(site.writer, [incoming(samples(5), 6)])
        assert site.grid.state().folded == 10


def audit_of(
    writer: Writer,
    reader: SqliteReader,
    report: Any,
    judge_s: float = 1e-9,
    known: Any = lambda: (UNCORRECTED, {}),
) -> Audit:
    writer.config = ServerConfig(trust=TrustConfig(judge_s))
    return Audit(writer, reader, report, known, threading.Event())


def test_a_fleet_that_takes_long_to_judge_is_judged_a_piece_in_every_turn(store, monkeypatch):
    writer, reader = store
    monkeypatch.setattr(jobs, "PIECE_S", 0.0)
    for name, rows in fleet({"c": 1.5}, size=24).items():
        send(writer, [incoming(np.concatenate(rows), 1, name)])
    reports: list[Any] = []
    audit = audit_of(writer, reader, lambda verdicts, _: reports.append(verdicts))
    for pairs in range(6):
        audit.run()
        assert (reports, audit.verdicts) == ([], {}), pairs
    audit.run()
    assert [audit.verdicts] == reports == [audit._auditor.verdicts()]


def test_corrected_samples_are_judged_also_those_that_came_before_the_correction(store):
    writer, reader = store
    sent = fleet({})
    for rows in sent["c"]:  # high torque, mostly spent on a slope
        rows["c_rr"] += 0.6 * (rows["c_rr"] + rows["grade_e"])
    for name, (first, second) in sent.items():
        send(writer, [incoming(np.concatenate([first, second]), 1, name)])
    whole = SampleCorrections([Correction("c", 0, 2**62, 0.0, 0.375, 0.0, ())])
    state = MachineErrors(0.0, 0.001, 0.6, 0.01, 0.0, 0.001, (), (), (0.0, 13.0))
    known: list[Any] = [UNCORRECTED, {}]
    audit = audit_of(writer, reader, lambda *_: None, known=lambda: known)
    audit.run()
    assert audit.verdicts["c"].reasons
    known[:] = whole, {"c": state}
    audit.run()
    assert audit.verdicts["c"].reasons == (Reason.BEYOND_DATA_SHEET,)
    assert audit.verdicts["c"].evidence["gain"] == pytest.approx(1.0, abs=0.02)
    known[1] = {}
    audit.run()
    assert not audit.verdicts["c"].contradicts
    assert not any(audit.verdicts[name].contradicts for name in "abd")
