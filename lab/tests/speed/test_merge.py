import json
import shutil
import sys
from itertools import islice

import numpy as np
import pytest

from lab.speed import merge, merge_memory, merge_restart, merge_work
from lab.speed.__main__ import main
from lab.speed.measure import START_NS, scattered, track
from lab.speed.merge_sums import AddAt, BoostHistogram, DuckDb, HardVotes, PlainC, Polars

SIDE = 1024
LIBRARIES = {HardVotes: "numba", AddAt: "numpy", BoostHistogram: "boost_histogram", Polars: "polars", DuckDb: "duckdb"}


@pytest.mark.parametrize("kind", [*LIBRARIES, PlainC])
@pytest.mark.parametrize("draw", [track, scattered])
def test_every_library_finds_the_same_sums(kind, draw):
    if kind is PlainC and not shutil.which("cc"):
        pytest.skip("no compiler")
    pytest.importorskip(LIBRARIES.get(kind, "numpy"))
    rows, sums = draw(3000), kind(SIDE)
    rows["x_m"][1::2], rows["y_m"][1::2] = rows["x_m"][::2], rows["y_m"][::2]  # cells that are hit again
    for part in (rows[:1000], rows[1000:]):
        sums.fold(part)
    cell = np.floor(rows["y_m"]).astype(int) * SIDE + np.floor(rows["x_m"]).astype(int)
    value = rows["c_rr"].astype(float)
    expected = [np.bincount(cell, weights, SIDE * SIDE) for weights in (None, value, value * value)]
    assert expected[0].max() >= 2
    np.testing.assert_allclose(sums.sums(), np.stack(expected, axis=1), rtol=1e-9, atol=1e-15)


def merged(capsys, *words):
    assert main(["merge", "--json", "--runs", "1", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_merge_measures_every_variant_on_every_pattern(capsys):
    result = merged(capsys, "--samples", "1000")
    assert (result["benchmark"], result["samples"], result["runs"]) == ("merge", 1000, 1)
    rows, missing = result["rows"], result["missing"]
    assert [row["pattern"] for row in rows] == ["track"] * (len(rows) // 2) + ["random"] * (len(rows) // 2)
    for pattern in ("track", "random"):
        assert [r["variant"] for r in rows if r["pattern"] == pattern] == [
            v for v in merge.VARIANTS if v not in missing
        ]
    figures = {"msamples_per_s", "cpu_msamples_per_s", "ratio_to_add_at", "batch_us_median", "batch_us_amortised"}
    assert all(set(row) == {"variant", "buffer", "pattern", "samples"} | figures for row in rows)
    assert all(row[name] > 0 for row in rows for name in figures)
    assert [row["buffer"] for row in rows if row["buffer"]] == 2 * ["refold", "live", "live_read"]
    assert [row["ratio_to_add_at"] for row in rows if row["variant"] == "np.add.at"] == [1.0, 1.0]


def test_shares_and_ratios_are_those_of_the_figures(monkeypatch, capsys):
    names = ("soft_votes", "hard_votes", "np.add.at")
    monkeypatch.setattr(merge, "VARIANTS", {name: merge.VARIANTS[name] for name in names})
    rows = merged(capsys, "--samples", "20000")["rows"]
    for row in rows:
        share = merge.VARIANTS[row["variant"]].shares.get(row["pattern"], 1)
        assert row["samples"] == max(100, 20_000 // share)
    rows = [row for row in rows if row["variant"] != "soft_votes"]
    for hard, yardstick in (rows[:2], rows[2:]):
        expected = hard["cpu_msamples_per_s"] / yardstick["cpu_msamples_per_s"]
        assert hard["ratio_to_add_at"] == pytest.approx(expected, rel=0.02)


def test_a_second_of_site_time_is_read_at_once():
    rows = track(250)  # 10 ms apart, the first one at the beginning of a second
    parts = list(merge._spans(rows, merge.SECOND_NS))
    assert [len(part) for part in parts] == [100, 100, 50]
    assert np.concatenate(parts).tobytes() == rows.tobytes()
    assert [len(part) for part in merge._spans(rows, 0)] == [250]


def test_a_variant_without_a_compiler_is_absent(monkeypatch, capsys):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    result = merged(capsys, "--samples", "100")
    assert "hard_votes in C" not in {row["variant"] for row in result["rows"]}
    assert "compiler" in result["missing"]["hard_votes in C"]


@pytest.mark.parametrize(
    ("module", "variant"),
    [("polars", "polars group-by"), ("duckdb", "duckdb group-by"), ("boost_histogram", "boost_histogram")],
)
def test_a_variant_without_its_library_is_listed_with_what_to_install(module, variant, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, module, None)
    assert main(["merge", "--json", "--runs", "1", "--samples", "100"]) == 0
    output = capsys.readouterr()
    result = json.loads(output.out)
    assert ".[bench]" in result["missing"][variant]
    assert variant not in {row["variant"] for row in result["rows"]}
    assert "np.add.at" in {row["variant"] for row in result["rows"]}
    assert f"not measured: {variant}; pip install" in output.err


def test_work_drives_a_tenth_of_a_square_kilometre():
    rows = np.concatenate([rows for _, rows in islice(merge_work.batches(), merge_work.samples_of(2.0) // 100)])
    driven = {(x, y) for x, y in zip((rows["x_m"] // 10).tolist(), (rows["y_m"] // 10).tolist(), strict=True)}
    roads = sum(min(x % 25, 24 - x % 25) == 0 or min(y % 25, 24 - y % 25) == 0 for x, y in driven)
    assert 0.95 * len(driven) < roads <= len(driven)  # along roads every 250 m, errors of position aside
    assert np.ptp(rows["x_m"]) == pytest.approx(1000, abs=20)
    assert np.ptp(rows["y_m"]) == pytest.approx(1000, abs=20)
    assert rows["distance_m"].sum() == pytest.approx(10 * 3.0 * 2 * 3600, rel=0.01)
    assert np.hypot(rows["grade_e"], rows["grade_n"]).max() < 0.2


@pytest.mark.slow
def test_work_comes_in_batches_of_ten_machines_in_the_order_of_time_with_nights_off():
    a_day = merge_work.samples_of(10.0) // 100
    taken = list(islice(merge_work.batches(), a_day + 10))
    assert len({name for name, _ in taken[:10]}) == 10
    assert {len(rows) for _, rows in taken} == {100}
    starts = [int(rows["stamp_ns"][0]) for name, rows in taken if name == "loader-1"]
    assert starts == sorted(starts)
    assert starts[0] == START_NS
    assert (starts[-2] - START_NS) / 3.6e12 == pytest.approx(10.0, abs=0.1)
    assert starts[-1] == START_NS + 24 * 3600 * 10**9


def test_a_second_has_what_ten_machines_drive_in_it():
    seconds = merge_work.seconds_of(merge_work.batches())
    first = next(seconds)
    assert len({name for name, _ in first}) == len(first) == 10
    assert {len(rows) for _, rows in first} == {6}
    assert max(int(np.ptp(rows["stamp_ns"])) for _, rows in first) == 5 * merge_work.SAMPLE_NS < 10**9
    leg = [first, *(next(seconds) for _ in range(83))]
    assert sum(len(rows) for second in leg for _, rows in second) == 10 * 500


def test_work_is_a_function_of_its_seed():
    one, same, other = (next(merge_work.batches(seed))[1] for seed in (1, 1, 2))
    assert one.tobytes() == same.tobytes() != other.tobytes()


@pytest.mark.processes
def test_memory_prints_what_a_day_takes(capsys):
    assert main(["memory", "--json", "--hours", "0.05"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["hours"]) == ("memory", 0.05)
    (row,) = result["rows"]
    assert row["samples"] == 10_000
    assert 0 < row["pages"] < row["cells"]
    assert 25 < row["bytes_per_cell_and_bucket"] < 500
    assert 50 < row["resident_mb"] <= row["peak_mb"]
    assert row["evidence_mb"] > 0
    assert row["snapshot_mb"] > 0
    assert row["snapshot_save_s"] > 0
    assert row["snapshot_load_s"] > 0
    assert 50 < row["server_mb"] <= row["server_snapshot_mb"]
    assert row["snapshot_ratio"] == pytest.approx(row["server_snapshot_mb"] / row["server_mb"], abs=0.01)


def test_more_hours_are_more_samples():
    assert merge_work.samples_of(10.0) == 2_160_000
    assert merge_memory.measured(0.02)["samples"] < merge_memory.measured(0.05)["samples"]


@pytest.mark.slow
def test_restart_opens_a_store_with_snapshot_and_tail(monkeypatch, capsys):
    monkeypatch.setattr(merge_restart, "TAIL_SAMPLES", 700)
    assert main(["restart", "--json", "--samples", "1950"]) == 0
    result = json.loads(capsys.readouterr().out)
    names = ("samples_in_row", "journal_rows", "tail_rows")
    assert [tuple(row[name] for name in names) for row in result["rows"]] == [(100, 20, 7), (6, 325, 116)]
    for row in result["rows"]:
        assert row["samples"] >= result["samples"] == 1950
        assert 0 < row["open_s"] < row["process_s"]
        assert row["open_cpu_s"] > 0
        assert row["build_s"] >= 0  # in tenths of a second
        assert row["journal_mb"] > 0
        assert row["snapshot_mb"] > 0


def test_a_store_of_the_benchmark_holds_the_same_grid_as_folding_all_of_it(tmp_path):
    merge_restart.build(tmp_path, 20, tail_rows=7)
    store = merge_restart.Store(
        merge_restart.JournalLocation(tmp_path), merge_restart.SITE, merge_restart.CONFIG, lambda: START_NS
    )
    grid = merge_restart.Grid(1.0, merge_restart.CONFIG.fold)
    for name, rows in islice(merge_work.batches(), 20):
        grid.fold(rows, name)
    one, other = store.grid.state(), grid.state()
    store.close()
    assert (one.folded, one.newest_ns) == (other.folded, other.newest_ns) == (2000, other.newest_ns)
    assert [at.page.votes.tobytes() for at in one.pages] == [at.page.votes.tobytes() for at in other.pages]
