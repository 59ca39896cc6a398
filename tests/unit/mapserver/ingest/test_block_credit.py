"""What new ground a machine may open: an honest drive never has to wait, and a liar opens what its metres pay for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from mapserver.evidence.fold_config import FoldConfig
from mapserver.ingest.block_credit import MAX_STEP_M, BlockCredit
from protocol.arrays import Table
from protocol.errors import MessageError, Refusal
from protocol.machine.samples import joined
from protocol.wire.messages import Ack
from tests.unit.mapserver.data import NOW_NS, folded, incoming, open_store, random_samples, samples

CONFIG = FoldConfig()


def drive(draw: np.random.Generator, km: float, std_m: float, bend: float, step_m: float = 0.5) -> Table:
    """A drive over ground that nobody has seen: each position off by a new error, cut at three standard deviations."""
    n = round(1000 * km / step_m)
    heading = draw.uniform(0, 2 * np.pi) + np.cumsum(draw.normal(0, bend, n))
    driven = draw.uniform(0.5, 1.5, n) * step_m
    errors_m = std_m * np.clip(draw.normal(size=(2, n)), -2.1, 2.1)
    return samples(
        n,
        x_m=np.cumsum(driven * np.cos(heading)) + errors_m[0],
        y_m=np.cumsum(driven * np.sin(heading)) + errors_m[1],
        distance_m=driven,
        cov_xx_m2=std_m**2,
        cov_yy_m2=std_m**2,
    )


def batches(rows: Table, draw: np.random.Generator) -> Iterator[Table]:
    """The same samples as batches of any size."""
    while len(rows):
        n = int(2 ** draw.uniform(0, 12))
        yield rows[:n]
        rows = rows[n:]


def is_taken(credit: BlockCredit, rows: Table) -> bool:
    try:
        credit.spend("a", rows)
    except MessageError:
        return False
    finally:
        credit.keep()
    return True


def taken(credit: BlockCredit, rows: Table) -> int:
    """How many samples are taken of a sender that halves what is refused, and gives up what is refused alone."""
    if is_taken(credit, rows):
        return len(rows)
    half = len(rows) // 2
    return taken(credit, rows[:half]) + taken(credit, rows[half:]) if half else 0


@pytest.mark.parametrize(
    ("cell_m", "std_m", "km"),
    [(0.25, 2.9, 5), (0.5, 0.3, 10), (1.0, 0.0, 50), (1.0, 0.8, 50), (1.0, 2.9, 50), (2.0, 2.0, 50), (10.0, 2.9, 50)],
)
@pytest.mark.parametrize("bend", [0.0, 0.1])
def test_an_honest_drive_is_taken_whole_with_gaps_and_jumps(cell_m: float, std_m: float, km: float, bend: float):
    draw = np.random.default_rng(1)
    rows = drive(draw, km, std_m, bend)
    jumps = (draw.random(len(rows)) < 1 / 200)[:, None] * draw.uniform(-80, 80, (len(rows), 2))
    rows["x_m"], rows["y_m"] = rows["x_m"] + jumps[:, 0], rows["y_m"] + jumps[:, 1]
    rows = rows[draw.random(len(rows)) < 0.98]
    credit = BlockCredit(cell_m, CONFIG, ())
    assert all(is_taken(credit, batch) for batch in batches(rows, draw))


def test_50_km_over_new_ground_open_5000_blocks():
    """A line as straight as a die is the worst; on a site a machine comes back to where it was."""
    credit = BlockCredit(1.0, CONFIG, ())
    assert is_taken(credit, drive(np.random.default_rng(2), 50, 0.5, 0.0))
    assert 4000 < credit.opened < 6000


def scattered(draw: np.random.Generator, n: int) -> Table:
    return samples(n, x_m=draw.uniform(-2e4, 2e4, n), y_m=draw.uniform(-2e4, 2e4, n), cov_xx_m2=8.9, cov_yy_m2=8.9)


def _two_places(draw: np.random.Generator, n: int) -> Table:
    rows = scattered(draw, n)
    rows["x_m"][1::2] = rows["x_m"][::2] + 2.0
    rows["y_m"][1::2] = rows["y_m"][::2]
    return rows


def _shuttled(draw: np.random.Generator, n: int) -> Table:
    rows = scattered(draw, n)
    for name in ("x_m", "y_m"):
        rows[name] = np.where(np.arange(n) % 10 < 9, np.arange(n) % 2 * 2.0, rows[name])
    return rows


def _crept(draw: np.random.Generator, n: int) -> Table:
    rows = scattered(draw, n)
    rows["x_m"], rows["y_m"] = np.cumsum(draw.uniform(0, 1e-3, n)), 0.0
    rows["x_m"][::20] = draw.uniform(-2e4, 2e4, len(rows[::20]))
    return rows


@pytest.mark.parametrize("distance_m", [0.0, 0.5, 2.0, 100.0])
@pytest.mark.parametrize("move", [scattered, _two_places, _shuttled, _crept])
def test_whoever_scatters_opens_what_its_metres_pay_for(move, distance_m: float):
    draw = np.random.default_rng(1)
    credit, rows = BlockCredit(1.0, CONFIG, ()), move(draw, 3000)
    rows["distance_m"] = distance_m
    shift_m = np.hypot(np.diff(rows["x_m"]), np.diff(rows["y_m"]))
    metres = np.minimum(shift_m, min(distance_m, MAX_STEP_M)).sum()
    for batch in batches(rows, draw):
        taken(credit, batch)
    assert credit.opened <= credit.most + credit.per_m * metres
    assert credit.most == 200
    assert credit.per_m * MAX_STEP_M < 0.6, "blocks of a sample: a line of samples 2 m apart opens 0.3 of them"


@pytest.mark.parametrize("cell_m", [0.5, 1.0, 7.0])
def test_the_grid_opens_no_block_that_is_not_paid_for(cell_m: float):
    rows = joined([random_samples(400, seed=3, half_m=500.0, std_m=4.0), samples(1, x_m=9e3, distance_m=0.0)])
    opened = folded(rows, cell_m=cell_m).folded_since(-1)[0]
    without, beside = (BlockCredit(cell_m, CONFIG, blocks) for blocks in ((), opened))
    for credit in (without, beside):
        for number in range(len(rows)):
            credit.spend(f"machine-{number}", rows[number : number + 1])
    assert without.opened == beside.opened, "those of the grid are among them"
    assert len(opened) <= without.opened <= 1.5 * len(opened), "and few more: corners where no vote falls"


def test_a_batch_that_comes_again_is_answered_as_before():
    draw = np.random.default_rng(2)
    credit, liar = BlockCredit(1.0, CONFIG, ()), scattered(draw, 300)
    taken(credit, liar[:80])
    opened = credit.opened
    for batch in (liar, liar[200:201], liar[100:102], liar[200:201]):
        assert not any(is_taken(credit, batch) for _ in range(500)), "what is refused earns nothing, however often"
    assert credit.opened == opened


def test_a_machine_that_was_refused_is_taken_again_as_it_drives_on():
    draw = np.random.default_rng(3)
    credit = BlockCredit(1.0, CONFIG, ())
    taken(credit, scattered(draw, 300))
    rows = drive(draw, 1.0, 0.5, 0.0)
    rows["x_m"] += 5000.0  # where nobody was
    assert taken(credit, rows) > 0.9 * len(rows)


def test_what_is_not_committed_was_not_spent():
    draw = np.random.default_rng(4)
    credit = BlockCredit(1.0, CONFIG, ())
    for _ in range(20):
        credit.spend("a", scattered(draw, 40))
        credit.drop()
    assert credit.opened == 0


def test_what_is_refused_is_in_no_journal_and_the_rest_is(tmp_path):
    store = open_store(tmp_path)
    rows = scattered(np.random.default_rng(5), 400)
    rows["stamp_ns"] = NOW_NS
    (refused,) = store.commit([incoming(rows)])
    assert refused.reason == Refusal.SCATTERED
    assert refused.problem.startswith("x_m[")
    assert store.commit([incoming(rows)]) == [refused]
    (ack,) = store.commit([incoming(rows[:50])])
    assert isinstance(ack, Ack)
    (overlapping,) = store.commit([incoming(rows[:300])])
    assert overlapping.problem.startswith("x_m["), "rows count in the batch as it was sent"
    assert int(overlapping.problem[4:].split("]")[0]) >= 50
    assert (store.journal.samples, store.counters["refused_scattered"]) == (50, 3)
    assert len(store.grid.folded_since(-1)[0]) <= 200
    store.close()
