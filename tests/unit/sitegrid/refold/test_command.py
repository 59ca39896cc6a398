"""Refolding of archives and stores with other parameters."""

from __future__ import annotations

import json
import shutil
import socket
import time
from contextlib import closing
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from mapserver.calibration.correction import LAST_NS, Correction
from mapserver.calibration.decide import CalibrationDecisions
from mapserver.calibration.decision import PERSON, SOLVER, CalibrationDecision
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.decisions import ground_decisions
from mapserver.ingest.store import Incoming, Store
from mapserver.journal import archived_decisions
from mapserver.journal.archive import FOLDER, archive
from mapserver.journal.history import history_rows
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.rows import JournalRow
from mapserver.journal.sqlite.reader import SqliteReader
from mapserver.roads.repair_facts import RoadRepair
from protocol.arrays import Table
from protocol.config import from_table
from protocol.disk.high_water_mark import HighWaterMark, mark_path
from protocol.files import load_toml
from protocol.machine.samples import empty
from protocol.site.site_config import SiteConfig, site_toml
from protocol.site.site_file import load_site
from protocol.units import HOUR_NS
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, SampleBatch
from sitegrid.cli import main
from sitegrid.refold import engine, new_store, work
from sitegrid.refold.sources import joined_decisions
from tests.journals import history_beside
from tests.unit.mapserver.data import same_evidence

pytest.importorskip("pyarrow.parquet")
fsspec = pytest.importorskip("fsspec")
pytest.importorskip("distributed")
SITE = SiteConfig("pit", 48.0, 11.0)
T0 = 1_767_225_600_000_000_000  # 2026-01-01T00:00Z
S = 10**9
BATCH = 20


def track(seed: int, n: int = 120) -> Table:
    """One sample every ten seconds on a walk."""
    draw = np.random.default_rng(seed)
    rows = empty(n)
    rows["stamp_ns"] = T0 + 10 * S * np.arange(n)
    for name in ("x_m", "y_m"):
        rows[name] = draw.uniform(-20, 20) + np.cumsum(draw.uniform(-1, 1, n))
    for name in ("cov_xx_m2", "cov_yy_m2"):
        rows[name] = draw.uniform(0.01, 4, n)
    rows["distance_m"] = draw.uniform(0, 2, n)
    rows["c_rr"] = draw.uniform(0.01, 0.3, n)
    rows["grade_e"] = draw.uniform(-0.2, 0.2, n)
    return rows


TRACKS = {"a": track(1), "b": track(2), "c": track(3)}


def make_store(
    folder: Path,
    names: str = "abc",
    *,
    batch: int = BATCH,
    spool_id: int = 7,
    site: SiteConfig = SITE,
    archived: float = 0,
    changed: int | None = None,
) -> Path:
    """A store with hourly batches; those of the first `archived` hours are archived."""
    clock = [T0]
    store = Store(JournalLocation(folder), site, ServerConfig(), lambda: clock[0])
    for first in range(0, 120, batch):
        for name in names:
            rows = TRACKS[name][first : first + batch].copy()
            if changed is not None and first <= changed < first + batch:
                rows["c_rr"][changed - first] += 0.01
            sent = encode_batch(SampleBatch(name, spool_id, first + 1, rows, site.frame))
            assert isinstance(store.commit([Incoming(name, sent)])[0], Ack)
        clock[0] += HOUR_NS
    with SqliteReader(folder / JOURNAL_FILE) as reader:
        list(archive(folder / FOLDER, reader, site, int(T0 + archived * HOUR_NS), store.journal.forget))
    store.close()
    (folder / "site.toml").write_text(site_toml(site))
    return folder


def run(*words: object) -> int:
    return main(["fold", *(str(word) for word in words)])


def opened(folder: Path) -> Store:
    """As opened by `sitegrid server`."""
    config = from_table(ServerConfig, load_toml(folder / "server.toml"), "server.toml")
    return Store(JournalLocation(folder), load_site(folder / "site.toml"), config, time.time_ns)


def rows_of(folder: Path) -> list[JournalRow]:
    with SqliteReader(folder / JOURNAL_FILE) as reader:
        return list(history_rows(history_beside(reader)))


def identities(folder: Path) -> list[tuple[object, ...]]:
    return [(r.machine, r.spool_id, r.first_seq, r.received_ns, r.rows.tobytes()) for r in rows_of(folder)]


def folded(
    names: str = "abc", cell_m: float = 1.0, config: ServerConfig | None = None, keep: slice = slice(None)
) -> Grid:
    grid = Grid(cell_m, (config or ServerConfig()).fold)
    for name in names:
        grid.fold(TRACKS[name][keep], name)
    return grid


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three machines, two hours archived, four journalled. Read-only."""
    return make_store(tmp_path_factory.mktemp("made") / "store", archived=2)


def test_a_store_folded_again_is_the_same_store(store: Path, tmp_path: Path):
    assert run(store, "--out", tmp_path / "new") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    assert identities(tmp_path / "new") == identities(store)
    again = opened(tmp_path / "new")
    assert same_evidence(again.grid, folded())
    assert again.snapshot_row == again.journalled == again.merged == 18  # starts from a snapshot
    with SqliteReader(store / JOURNAL_FILE) as reader:
        assert again.journal.watermarks() == reader.watermarks()
        old = reader.identity()
    assert (again.site, again.newest_ns) == (SITE, T0 + 1190 * S)
    assert again.identity.id != old.id
    assert again.identity.descends == (old.id,)
    again.close()


FACTS = [
    CalibrationDecision("a", SOLVER, "", T0 + 600 * S, (Correction("a", T0 + 300 * S, LAST_NS, 0.02, 0.1, 0.01, ()),)),
    CalibrationDecision("b", PERSON, "levelled", T0 + 700 * S, (Correction("b", 0, LAST_NS, -0.03, 0.0, 0.0, ()),)),
    CalibrationDecision("a", SOLVER, "", T0 + 1200 * S, (Correction("a", T0 + 600 * S, LAST_NS, -0.01, 0.0, 0.0, ()),)),
]


def decide(store: Path) -> Grid:
    """Add corrections to a store like its server; returns its map."""
    with closing(Store(JournalLocation(store), SITE, ServerConfig(), time.time_ns)) as opened_store:
        for decision in FACTS:
            opened_store.decide(decision)
        archived_decisions.save(store / FOLDER, opened_store.identity.id, FACTS)
    with closing(Store(JournalLocation(store), SITE, ServerConfig(), time.time_ns)) as opened_store:
        return opened_store.grid


def test_corrections_go_with_the_samples_and_the_map_is_the_live_one(tmp_path: Path):
    source = make_store(tmp_path / "source", archived=2)
    before = folded()
    live = decide(source)
    assert not same_evidence(live, before)
    assert run(source, "--out", tmp_path / "new") == 0
    assert identities(tmp_path / "new") == identities(source), "samples are copied as they were sent"
    with closing(opened(tmp_path / "new")) as new:
        assert same_evidence(new.grid, live)
        assert (new.fact, new.snapshot_row) == (3, 18)
    assert run(tmp_path / "new", "--out", tmp_path / "again") == 0
    with closing(opened(tmp_path / "again")) as again:
        assert same_evidence(again.grid, live)


def test_a_copy_of_a_history_that_is_behind_brings_nothing_back():
    """Two stores, the second one's outdated archive, and a continued refold of both."""

    def decided(machine: str, zero: float) -> CalibrationDecision:
        correction = Correction(machine, 0, LAST_NS, zero, 0.0, 0.0, ())
        return CalibrationDecision(machine, PERSON, "", T0, (correction,))

    one, other = [decided("a", 0.001)], [decided("b", 0.002), decided("b", 0.005)]
    histories = {"one": one, "other": other, "stale": other[:1], "both": [*one, *other, decided("b", 0.009)]}
    for order in (*permutations(histories), ("one", "stale", "other")):
        counts = CalibrationDecisions(joined_decisions(histories[name] for name in order)).corrections.each
        newest = 0.009 if "both" in order else 0.005
        assert [(each.machine, each.zero) for each in counts] == [("a", 0.001), ("b", newest)], order


def test_corrections_are_beside_the_files_of_an_archive_too(tmp_path: Path):
    source = make_store(tmp_path / "source", archived=9)
    live = decide(source)
    assert run(source / FOLDER, "--out", tmp_path / "new") == 0
    with closing(opened(tmp_path / "new")) as new:
        assert same_evidence(new.grid, live)
        assert new.fact == 3, "of six files, each once"
    (source / FOLDER / archived_decisions.FILE).unlink()
    assert run(source / FOLDER, "--out", tmp_path / "plain") == 0
    with closing(opened(tmp_path / "plain")) as plain_store:
        assert same_evidence(plain_store.grid, folded())


def test_repairs_of_roads_go_with_a_store_and_beside_the_files_of_an_archive(tmp_path: Path):
    source = make_store(tmp_path / "source", archived=9)
    repair = RoadRepair("3_0_e", T0, T0 + 1, T0 + 2, 0.06, 0.02, 1.0, ((1, -2, "0f" * 32),), T0 + 3)
    with closing(Store(JournalLocation(source), SITE, ServerConfig(), time.time_ns)) as opened_store:
        opened_store.decide(*FACTS, repair)
        archived_decisions.save(source / FOLDER, opened_store.identity.id, ground_decisions(opened_store.journal))
    for number, words in enumerate(((source,), (source / FOLDER,), (source, source / FOLDER))):
        assert run(*words, "--out", tmp_path / f"new-{number}") == 0
        with closing(opened(tmp_path / f"new-{number}")) as new:
            assert (new.facts.repairs.standing, new.fact) == ({repair.key: repair}, 4)
    assert run(source, "--out", tmp_path / "finer", "--cell", 0.5) == 0
    with closing(opened(tmp_path / "finer")) as finer:
        assert not finer.facts.repairs.standing, "they are of cells of 1 m"


def test_damaged_corrections_of_an_archive_are_not_folded_without(tmp_path: Path, capsys):
    source = make_store(tmp_path / "source", archived=9)
    decide(source)
    path = source / FOLDER / archived_decisions.FILE
    path.write_text(path.read_text().replace("0.02", "0.03"))
    assert run(source / FOLDER, "--out", tmp_path / "new") == 1
    assert "decisions.json: is damaged" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_store_that_lacks_what_was_acknowledged_is_not_folded_without_a_word(tmp_path: Path, capsys):
    source = make_store(tmp_path / "source")
    mark = HighWaterMark(mark_path(source / JOURNAL_FILE))
    mark.write({f"a {7:016x}": 150})
    mark.close()
    assert run(source, "--out", tmp_path / "new") == 1
    assert "30 acknowledged samples of a are gone; restore a backup, or start a map server" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    Store(JournalLocation(source), SITE, ServerConfig(), time.time_ns).close()
    assert run(source, "--out", tmp_path / "new") == 0


def test_a_store_lists_all_that_it_descends_from(store: Path, tmp_path: Path):
    gone = "0123456789abcdef"
    shutil.copytree(store, tmp_path / "copy")
    with closing(Store(JournalLocation(tmp_path / "copy"), SITE, ServerConfig(), time.time_ns)) as first:
        first.accept(gone, "its disk died")
        old = first.identity.id
    assert run(store / "archive", "--out", tmp_path / "files") == 0  # files alone name their store
    assert run(tmp_path / "files", tmp_path / "copy", "--out", tmp_path / "new") == 0
    with closing(opened(tmp_path / "files")) as files, closing(opened(tmp_path / "new")) as new:
        assert files.identity.descends == (old,)
        assert new.identity.descends == (files.identity.id, old, gone)


def test_the_size_of_cells_can_be_changed(store: Path, tmp_path: Path):
    assert run(store, "--out", tmp_path / "new", "--cell", 2.5) == 0
    again = opened(tmp_path / "new")
    assert again.site == replace(SITE, cell_m=2.5)
    assert same_evidence(again.grid, folded(cell_m=2.5))
    again.close()


def test_options_are_taken_and_written_beside_the_store(store: Path, tmp_path: Path):
    text = "# mine\n[fold]\nstd_cap_m = 1.2\n[store]\nsnapshot_s = 30.0\n"
    (tmp_path / "other.toml").write_text(text)
    assert run(store, "--out", tmp_path / "new", "--config", tmp_path / "other.toml") == 0
    assert (tmp_path / "new" / "server.toml").read_text() == text
    again = opened(tmp_path / "new")
    config = from_table(ServerConfig, load_toml(tmp_path / "other.toml"), "")
    assert same_evidence(again.grid, folded(config=config))
    assert again.grid.skipped > 0
    again.close()
    assert run(tmp_path / "new", "--out", tmp_path / "newer") == 0  # a store's own options stay
    assert (tmp_path / "newer" / "server.toml").read_text() == text


def test_machines_are_excluded_and_their_progress_is_kept(store: Path, tmp_path: Path, capsys):
    assert run(store, "--out", tmp_path / "new", "--without", "a", "--without", "c", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["excluded"] == {"machine": 240, "time": 0, "twice": 0}
    assert summary["machines"] == {"b": 120}
    again = opened(tmp_path / "new")
    assert same_evidence(again.grid, folded("b"))
    marks = {name: (mark.seq, mark.lost) for (name, _), mark in again.journal.watermarks().items()}
    assert marks == {"a": (120, 120), "b": (120, 0), "c": (120, 120)}
    assert again.info()["machines"]["a"]["samples"] == 0
    again.close()


def test_a_span_of_time_is_cut_out_of_batches(store: Path, tmp_path: Path, capsys):
    span = ("--from", "2026-01-01T00:01:40", "--until", "2026-01-01T01:05+01:00")  # samples 10 to 29
    assert run(store, "--out", tmp_path / "new", *span, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["samples"], summary["excluded"]["time"]) == (60, 300)
    rows = rows_of(tmp_path / "new")
    assert {(r.machine, r.first_seq, len(r.rows)) for r in rows} == {(n, f, 10) for n in "abc" for f in (11, 21)}
    again = opened(tmp_path / "new")
    assert same_evidence(again.grid, folded(keep=slice(10, 30)))
    assert {(mark.seq, mark.lost) for mark in again.journal.watermarks().values()} == {(120, 100)}
    again.close()


# --- several archives ------------------------------------------------------------------------------------------------


def test_what_is_in_two_archives_is_folded_once(store: Path, tmp_path: Path, capsys):
    """Even if batches were cut differently, or a file is named twice."""
    other = make_store(tmp_path / "other", "ab", batch=30, archived=1)
    file = min((store / FOLDER).glob("*.parquet"))
    assert run(store, other, file, file, "--out", tmp_path / "new", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["excluded"] == {"machine": 0, "time": 0, "twice": 240 + 120}
    assert (summary["samples"], summary["archives"]) == (360, 4)
    again = opened(tmp_path / "new")
    assert same_evidence(again.grid, folded())
    assert {(mark.seq, mark.lost) for mark in again.journal.watermarks().values()} == {(120, 0)}
    again.close()


def test_the_same_sample_with_another_content_is_named(store: Path, tmp_path: Path, capsys):
    other = make_store(tmp_path / "other", "b", batch=30, changed=76)
    assert run(store, other, "--out", tmp_path / "new") == 1
    error = capsys.readouterr().err
    assert "sample 77 of b, spool 0000000000000007, is another in a further archive" in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other"]  # nothing incomplete is left
    assert run(store, other, "--out", tmp_path / "new", "--without", "b") == 0


# --- refusals --------------------------------------------------------------------------------------------------------


def refused(capsys, *words: object) -> str:
    assert run(*words) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_other_sites_are_refused(store: Path, tmp_path: Path, capsys):
    moved = make_store(tmp_path / "moved", "a", site=replace(SITE, origin_lat_deg=48.1), archived=1)
    named = make_store(tmp_path / "named", "a", site=replace(SITE, name="quarry"))
    out = ("--out", tmp_path / "new")
    error = refused(capsys, store, moved, *out)
    assert f"{moved / FOLDER}" in error
    assert "is of site 'pit', frame" in error
    assert "fold them apart" in refused(capsys, store / FOLDER, moved / FOLDER, *out)
    assert f"{named / JOURNAL_FILE}, rows 1 to 6: is of site 'quarry'" in refused(capsys, store, named, *out)
    error = refused(capsys, store, "--site-file", moved / "site.toml", *out)
    assert f"{moved}/site.toml: is site 'pit', frame" in error
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("STORE", "--without", "d"), "'d' is no machine of these archives; they are: a, b, c"),
        (("STORE", "--from", "2026-01-02", "--until", "2026-01-02"), "--until: is not after --from"),
        (("STORE", "--from", "2027-01-01"), "no sample is left"),
        (("STORE", "--engine", "tcp://127.0.0.1:1"), "'tcp://127.0.0.1:1' is no dask://HOST:PORT"),
        (("STORE", "--engine", "dask://127.0.0.1:1"), "no Dask scheduler answers at dask://127.0.0.1:1"),
        (("s3://bucket/years",), "s3://bucket/years: is reached with a library that is not installed: Install s3fs"),
        (("nowhere://years",), "nowhere://years: no store is known as 'nowhere'"),
        (("memory://nothing",), "memory://nothing: no such file or folder"),
    ],
)
def test_what_makes_no_sense_is_refused_and_leaves_nothing(
    store: Path, tmp_path: Path, capsys, words: tuple[str, ...], problem: str
):
    given = [str(store) if word == "STORE" else word for word in words]
    assert problem in refused(capsys, *given, "--out", tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_archive_is_refused(store: Path, tmp_path: Path, capsys):
    out = ("--out", tmp_path / "new")
    (tmp_path / "nothing").mkdir()
    assert "neither Parquet files nor a journal.db" in refused(capsys, tmp_path / "nothing", *out)
    assert "site.toml: is damaged, or no file of" in refused(capsys, store / "site.toml", *out)
    data = bytearray(min((store / FOLDER).glob("*.parquet")).read_bytes())
    data[1000] ^= 1
    damaged = tmp_path / "nothing" / "damaged.parquet"
    damaged.write_bytes(data)
    assert f"{damaged}: is damaged" in refused(capsys, damaged, *out)
    assert not (tmp_path / "new").exists()


# --- what is shown ---------------------------------------------------------------------------------------------------


# --- who does the work, and where archives are -----------------------------------------------------------------------


@pytest.mark.processes
@pytest.mark.parametrize("jobs", [pytest.param(2), pytest.param(50, marks=pytest.mark.nightly)])
def test_processes_fold_a_store_as_one_does(store: Path, tmp_path: Path, jobs: int):
    """Even with more processes than files; the rest of the journal is a part."""
    assert run(store, "--out", tmp_path / "new", "--jobs", jobs, "--without", "b") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    again = opened(tmp_path / "new")
    assert same_evidence(again.grid, folded("ac"))
    assert again.snapshot_row == again.journalled == 12
    again.close()


def test_a_port_that_says_nothing_is_no_scheduler(store: Path, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr(engine, "CONNECT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"dask://127.0.0.1:{server.getsockname()[1]}"
        assert "no Dask scheduler answers" in refused(capsys, store, "--out", tmp_path / "new", "--engine", address)


def test_archives_elsewhere_are_folded(store: Path, tmp_path: Path):
    """In process memory, as an example of fsspec, with decisions."""
    source = make_store(tmp_path / "source", archived=9)
    live = decide(source)
    files = fsspec.filesystem("memory")
    for path in (source / FOLDER).iterdir():
        files.pipe_file(f"/years/{path.name}", path.read_bytes())
    try:
        assert run("memory://years", "--out", tmp_path / "new") == 0
        names = sorted(files.ls("/years", detail=False))
        assert run(f"memory:/{names[1]}", "--out", tmp_path / "one") == 0
    finally:
        files.rm("/years", recursive=True)
    with closing(opened(tmp_path / "new")) as new:
        assert same_evidence(new.grid, live)
        assert new.fact == 3
    assert identities(tmp_path / "new") == identities(source)
    assert len(rows_of(tmp_path / "one")) == 3


def test_a_disk_that_is_full_ends_a_fold_in_one_line(store: Path, tmp_path: Path, capsys, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    for name in ("whole_file", "seal"):
        with monkeypatch.context() as disk:
            disk.setattr(work, name, full)
            error = refused(capsys, store, "--out", tmp_path / "new")
            assert error.rstrip().endswith("cannot be written: No space left on device")
        assert list(tmp_path.iterdir()) == []


def test_what_is_done_is_kept_when_a_later_step_fails_and_used_when_the_fold_goes_on(
    store: Path, tmp_path: Path, capsys, monkeypatch
):
    with monkeypatch.context() as disk:
        disk.setattr(
            new_store, "save_snapshot", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device"))
        )
        error = refused(capsys, store, "--out", tmp_path / "new")
        assert f"what is done is kept in {tmp_path}/new.part, and the same command goes on" in error
    assert [path.name for path in tmp_path.iterdir()] == ["new.part"]
    assert "is left from a fold of something else that was killed; remove it" in refused(
        capsys, make_store(tmp_path / "other", "a"), "--out", tmp_path / "new"
    )
    assert run(store, "--out", tmp_path / "new") == 0
    with closing(opened(tmp_path / "new")) as new:
        assert same_evidence(new.grid, folded())
    assert not (tmp_path / "new.part").exists()


def test_decisions_count_in_the_order_of_their_stamps_however_archives_are_given():
    def decided(zero: float, stamp_s: int) -> CalibrationDecision:
        return CalibrationDecision(
            "a", PERSON, "", T0 + stamp_s * S, (Correction("a", 0, LAST_NS, zero, 0.0, 0.0, ()),)
        )

    first, second = [decided(0.001, 1), decided(0.003, 9)], [decided(0.002, 5)]
    histories = (first, second, joined_decisions([second, first]))
    for order in permutations(histories):
        assert [decision.corrections[0].zero for decision in joined_decisions(order)] == [0.001, 0.002, 0.003]
    went_back = [decided(0.004, 20), decided(0.005, 2)]  # of the site's clock
    assert joined_decisions([went_back, first])[-2:] == went_back


def test_a_fold_does_not_go_on_with_other_decisions_than_it_began_with(
    store: Path, tmp_path: Path, capsys, monkeypatch
):
    decide(store)
    with monkeypatch.context() as killed:
        killed.setattr(new_store.NewStore, "finish", lambda *_: (_ for _ in ()).throw(OSError(4, "killed")))
        assert "the same command goes on" in refused(capsys, store, "--out", tmp_path / "new")
    decide(store)
    assert "is left from a fold of something else" in refused(capsys, store, "--out", tmp_path / "new")
    shutil.rmtree(tmp_path / "new.part")
    assert run(store, "--out", tmp_path / "new") == 0
