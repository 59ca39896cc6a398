"""The history of one cell is what a fold of each span's samples alone makes of it."""

from contextlib import closing

import numpy as np
import pytest

from mapserver.evidence import cells as ev
from mapserver.evidence import grid as grids
from mapserver.journal.rows import Selection
from mapserver.past import cell_history as module
from mapserver.past.cell_history import cell_history
from tests.unit.mapserver.data import NOW_NS, folded, random_samples, samples
from tests.unit.mapserver.past.past_store import PastStore, S

pytest.importorskip("pyarrow.parquet")
CELL, PLACE, BLOCK = (-3, 7), 16 * 7 + 13, (-1, 0)
SPAN_NS = 300 * S


@pytest.fixture(params=[0, 12], ids=lambda rows: f"{rows} archived")
def store(request, tmp_path):
    with closing(PastStore(tmp_path)) as opened:
        parts = {name: np.split(random_samples(600, seed, half_m=15.0), 10) for seed, name in enumerate("ab")}
        for i in range(10):
            for name in "ab":
                opened.add(parts[name][i], name)
        opened.archive(request.param)
        yield opened


@pytest.mark.parametrize("piece", [7, grids.PIECE])
def test_the_history_of_a_cell_is_its_evidence_span_by_span(store, monkeypatch, piece):
    monkeypatch.setattr(module, "PIECE", piece)
    past = cell_history(store.past, store.reader, CELL, SPAN_NS)
    assert len(past.first_ns) > 2
    assert (np.diff(past.first_ns) > 0).all()
    assert (past.first_ns % SPAN_NS == 0).all()
    assert (past.last_ns == past.first_ns + SPAN_NS - 1).all()
    assert past.evidence.counts.shape == (len(past.first_ns), 1, ev.COUNTS)
    for i, (first_ns, last_ns) in enumerate(zip(past.first_ns.tolist(), past.last_ns.tolist(), strict=True)):
        expected = store.folded(last_ns, from_ns=first_ns).evidence([BLOCK])
        assert expected.weight[0, PLACE] > 0
        for name in ("counts", "bitmaps", "newest_ns", "changed_ns"):
            assert np.array_equal(getattr(past.evidence, name)[i, 0], getattr(expected, name)[0, PLACE])
    whole = store.folded(NOW_NS + 10**13).evidence([BLOCK]).counts[0, PLACE]
    assert np.array_equal(past.evidence.counts.sum(axis=(0, 1)), whole)


def test_spans_machines_and_times_of_a_history_can_be_chosen(store):
    day_ns = 86_400 * S
    one = cell_history(store.past, store.reader, CELL, day_ns)
    assert (one.first_ns.tolist(), one.last_ns.tolist()) == ([NOW_NS], [NOW_NS + day_ns - 1])
    only_a = cell_history(store.past, store.reader, CELL, day_ns, Selection(without=frozenset("b")))
    expected = store.folded(NOW_NS + day_ns, "b").evidence([BLOCK])
    assert np.array_equal(only_a.evidence.counts[0, 0], expected.counts[0, PLACE])
    selection = Selection(from_ns=NOW_NS + 900 * S, to_ns=NOW_NS + 1499 * S)
    half = cell_history(store.past, store.reader, CELL, SPAN_NS, selection)
    assert half.first_ns.tolist() == [NOW_NS + 900 * S, NOW_NS + 1200 * S]
    nowhere = cell_history(store.past, store.reader, (5000, 5000), SPAN_NS)
    assert nowhere.first_ns.shape == (0,)
    assert nowhere.evidence.counts.shape == (0, 1, ev.COUNTS)


@pytest.mark.parametrize("span_ns", [1, S, 10**18])
def test_spans_may_be_of_any_length(tmp_path, span_ns):
    with closing(PastStore(tmp_path)) as store:
        store.add(samples(3, stamp_ns=[NOW_NS, NOW_NS + 1, NOW_NS + S]))
        past = cell_history(store.past, store.reader, (8, 8), span_ns)
    assert past.first_ns.tolist() == sorted({stamp // span_ns * span_ns for stamp in (NOW_NS, NOW_NS + 1, NOW_NS + S)})


def test_cells_are_those_of_the_grid(tmp_path):
    with closing(PastStore(tmp_path, 0.5)) as store:
        store.add(samples(1, x_m=-0.25, y_m=20.75))
        past = cell_history(store.past, store.reader, (-1, 41), SPAN_NS)
    grid = folded(samples(1, x_m=-0.25, y_m=20.75), cell_m=0.5)
    assert past.evidence.weight[0, 0] == grid.evidence([(-1, 2)]).weight[0, 9 * 16 + 15] > 0


@pytest.mark.parametrize("std_m", [0.0, 1.0, 2.9])
def test_no_sample_is_passed_over_that_votes_for_the_cell(tmp_path, std_m):
    """Samples around the cell, a tenth of a metre apart, each a span of its own."""
    offsets = np.arange(-12.0, 12.0, 0.1)
    with closing(PastStore(tmp_path)) as store:
        stamps = NOW_NS + np.arange(len(offsets)) * S
        rows = samples(len(offsets), x_m=8.5 + offsets, stamp_ns=stamps, cov_xx_m2=std_m**2, cov_yy_m2=std_m**2)
        store.add(rows)
        past = cell_history(store.past, store.reader, (8, 8), S)
    votes = [stamp for row, stamp in zip(rows, stamps, strict=True) if _votes(row)]
    assert past.first_ns.tolist() == votes


def _votes(row) -> bool:
    evidence = folded(np.array([row])).evidence([(0, 0)])
    return bool(evidence.weight[0, 8 * 16 + 8])
