"""What new ground a machine may open: an honest drive never has to wait, and a liar opens what its metres pay for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from mapserver.evidence.fold_config import FoldConfig
from mapserver.ingest.block_credit import BlockCredit
from mapserver.journal.journal import UnwrittenError
from protocol.arrays import Table
from protocol.errors import MessageError, Refusal
from protocol.wire.messages import Ack
from tests.unit.mapserver.data import NOW_NS, folded, incoming, open_store, random_samples, samples

CONFIG = FoldConfig()


def drive(draw: np.random.Generator, km: float, std_m: float, bend: float) -> Table:
    """A drive over ground that nobody has seen, each position off by an error of its own of up to 3 std."""
    n = round(2000 * km)
    driven, heading = draw.uniform(0.25, 0.75, n), draw.uniform(0, 6) + np.cumsum(draw.normal(0, bend, n))
    x_m, y_m = np.cumsum(driven * [np.cos(heading), np.sin(heading)], axis=1) + std_m * draw.uniform(-2.1, 2.1, (2, n))
    return samples(n, x_m=x_m, y_m=y_m, distance_m=driven, cov_xx_m2=std_m**2, cov_yy_m2=std_m**2)


def scattered(draw: np.random.Generator, n: int) -> Table:
    return samples(n, x_m=draw.uniform(-2e4, 2e4, n), y_m=draw.uniform(-2e4, 2e4, n), cov_xx_m2=8.9, cov_yy_m2=8.9)


def batches(rows: Table, draw: np.random.Generator) -> Iterator[Table]:
    """The same samples as batches of any size."""
    while len(rows):
        n = int(2 ** draw.uniform(0, 12))
        yield rows[:n]
        rows = rows[n:]


def taken(credit: BlockCredit, rows: Table) -> int:
    """How many samples are taken of a sender that halves what is refused, and gives up what is refused alone."""
    try:
        credit.spend("a", rows)
    except MessageError:
        half = len(rows) // 2
        return taken(credit, rows[:half]) + taken(credit, rows[half:]) if half else 0
    return len(rows)


@pytest.mark.parametrize("bend", [0.0, 0.1])
@pytest.mark.parametrize(
    ("cell_m", "std_m", "km"), [(0.25, 2.9, 5), (1.0, 0.0, 50), (1.0, 0.8, 50), (1.0, 2.9, 50), (10.0, 2.9, 50)]
)
def test_an_honest_drive_is_taken_whole_with_gaps_and_jumps(cell_m: float, std_m: float, km: float, bend: float):
    draw = np.random.default_rng(1)
    rows, credit = drive(draw, km, std_m, bend), BlockCredit(cell_m, CONFIG, ())
    rows["x_m"] += (draw.random(len(rows)) < 1 / 400) * draw.uniform(-80, 80, len(rows))
    rows = rows[draw.random(len(rows)) < 0.98]
    assert all(taken(credit, batch) == len(batch) for batch in batches(rows, draw))
    if (cell_m, std_m, bend) == (1.0, 0.8, 0.0):
        assert 4500 < len(credit.opened) < 7000, "50 km straight on, the most that honest driving opens"


@pytest.mark.parametrize("distance_m", [0.5, 100.0])
@pytest.mark.parametrize("stay", [0, 1, 2, 10, 100])  # samples at a place, to and fro by 2 m; 0: on a line, 85 m apart
@pytest.mark.parametrize("std_m", [2.9, 50.0])  # of every other sample; a large one has no vote
def test_whoever_scatters_opens_what_its_metres_pay_for(stay: int, distance_m: float, std_m: float):
    draw, n = np.random.default_rng(2), 2000
    rows, credit = scattered(draw, n), BlockCredit(1.0, CONFIG, ())
    for name, offset_m in (("x_m", 2.0 * (np.arange(n) % 2)), ("y_m", 0.0)):
        rows[name] = rows[name][np.arange(n) // stay * stay] + offset_m if stay else 60.0 * np.arange(n)
    rows["distance_m"], rows["cov_xx_m2"][::2] = distance_m, std_m**2
    for batch in batches(rows, draw):
        taken(credit, batch)
    driven_m = min(distance_m, 2.0) * n
    assert len(credit.opened) <= 200 + (credit.jumps_per_m + credit.per_m) * driven_m
    assert len(credit.opened) <= 200 + 0.1 * driven_m or stay in (0, 100), "to and fro pays for no jumps"
    assert len(credit.opened) <= 200 or stay != 1, "and a jump earns nothing"


@pytest.mark.parametrize("cell_m", [0.5, 1.0, 7.0])
def test_the_grid_opens_no_block_that_is_not_paid_for(cell_m: float):
    rows = random_samples(400, seed=3, half_m=500.0, std_m=4.0)
    credit, opened = BlockCredit(cell_m, CONFIG, ()), folded(rows, cell_m=cell_m).folded_since(-1)[0]
    for number in range(len(rows)):
        credit.spend(f"machine-{number}", rows[number : number + 1])
    assert BlockCredit(cell_m, CONFIG, opened).opened <= credit.opened
    assert len(credit.opened) <= 1.5 * len(opened), "few more: corners where no vote falls"


def test_what_is_refused_earns_nothing_however_often_it_comes_but_driving_on_does():
    credit, liar = BlockCredit(1.0, CONFIG, ()), scattered(np.random.default_rng(4), 300)
    first = taken(credit, liar)
    assert {taken(credit, liar) for _ in range(20)} == {first}
    rows = samples(4000, x_m=5000 + 0.5 * np.arange(4000), y_m=0.0, distance_m=0.5)  # new ground, two blocks at a time
    assert 3500 < taken(credit, rows) < 4000


def test_what_is_refused_or_not_committed_is_neither_journalled_nor_paid_for(tmp_path, monkeypatch):
    store, rows = open_store(tmp_path), scattered(np.random.default_rng(6), 400)
    rows["stamp_ns"] = NOW_NS

    def fails() -> None:
        raise UnwrittenError("journal", "the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(store.journal, "commit", fails)
        lost = [store.commit([incoming(rows[first : first + 40])])[0] for first in range(50, 400, 40)]
    assert {answer.reason for answer in lost} == {Refusal.STORE}
    (refused,) = store.commit([incoming(rows)])
    assert refused.reason == Refusal.SCATTERED
    assert store.commit([incoming(rows)]) == [refused]
    assert isinstance(store.commit([incoming(rows[:50])])[0], Ack)
    (overlapping,) = store.commit([incoming(rows[:300])])
    assert 50 <= int(overlapping.problem.removeprefix("x_m[").split("]")[0]) < 300, "rows count as they were sent"
    assert (store.journal.samples, store.counters["refused_scattered"]) == (50, 3)
    store.close()
