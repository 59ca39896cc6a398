"""Ledgers: order has no effect, the newest epochs stay, samples keep their content."""

import numpy as np
import pytest

from mapserver.calibration import stays as st
from mapserver.calibration.ledger import EPOCH_NS, EPOCH_SLOTS, EPOCHS, StayLedger, epochs_of
from mapserver.calibration.passages import links, passages
from protocol.arrays import Table
from tests.unit.mapserver.calibration.drives import LOW, drive
from tests.unit.mapserver.data import random_samples


def stays_of(parts: list[Table]) -> Table:
    ledger = StayLedger()
    for part in parts:
        ledger.add(part)
    return ledger.stays()


@pytest.mark.parametrize("seed", range(2))
def test_any_order_and_any_batching_give_the_same_bits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = random_samples(20_000, seed)
    rows["stamp_ns"] += rng.integers(0, 2 * EPOCHS, len(rows)) * EPOCH_NS
    mixed = np.array_split(rng.permutation(rows), np.sort(rng.integers(0, len(rows), 60)))
    assert stays_of([rows]).tobytes() == stays_of(mixed).tobytes()


def test_only_the_newest_epochs_are_remembered() -> None:
    rows = np.concatenate([drive(LOW, seconds=20.0, start_s=300.0 * i) for i in range(EPOCHS + 5)])
    stays = stays_of([rows])
    assert len(np.unique(st.slot(stays["key"]) // EPOCH_SLOTS)) == EPOCHS
    newest = rows["stamp_ns"] // EPOCH_NS > rows["stamp_ns"].max() // EPOCH_NS - EPOCHS
    assert stays.tobytes() == stays_of([rows[newest]]).tobytes()


def test_a_clock_that_is_ahead_displaces_nothing_whenever_its_samples_come() -> None:
    right = np.concatenate([drive(LOW, seconds=5.0, start_s=300.0 * i) for i in range(EPOCHS + 5)])
    ahead = np.concatenate([drive(LOW, seconds=5.0, start_s=72_000.0 + 300.0 * i) for i in range(EPOCHS + 5)])
    rng, until_ns = np.random.default_rng(0), int(right["stamp_ns"].max())
    rows = rng.permutation(np.concatenate([right, ahead]))
    ledger = StayLedger()
    ledger.until_ns = until_ns
    for part in np.array_split(rows, 40):
        ledger.add(part)
        ledger.stays()
    assert ledger.stays().tobytes() == stays_of([right]).tobytes()
    assert len(np.unique(epochs_of(ledger._stays))) == 2 * EPOCHS, "and memory is bounded"
    ledger.until_ns = int(ahead["stamp_ns"].max())
    assert ledger.stays().tobytes() == stays_of([ahead]).tobytes(), "where it was not ahead, it was right"


def test_what_is_older_than_asked_for_is_not_there() -> None:
    rows = np.concatenate([drive(LOW, seconds=5.0, start_s=300.0 * i) for i in range(4)])
    ledger = StayLedger()
    assert ledger.newest_ns == 0
    ledger.add(rows)
    begins_ns = [int(epoch) * EPOCH_NS for epoch in np.unique(epochs_of(ledger.stays()))]
    assert ledger.newest_ns == begins_ns[-1]
    assert epochs_of(ledger.stays(begins_ns[2])).min() * EPOCH_NS == begins_ns[2]
    assert epochs_of(ledger.stays(begins_ns[2] - 1)).min() * EPOCH_NS == begins_ns[2]
    assert len(ledger.stays(begins_ns[-1] + 1)) == 0


def test_samples_without_slope_or_distance_show_nothing() -> None:
    rows = drive(LOW, seconds=10.0)
    for name in ("grade_e", "grade_n", "grade_var"):
        rows[name][::2] = np.nan
    rows["distance_m"][1::2] = 0.0
    assert len(stays_of([rows])) == 0


def test_far_places_and_floods_of_samples_do_no_harm() -> None:
    rows = drive(LOW, seconds=100.0)
    far = rows.copy()
    far["x_m"] = 1e9
    flood = np.repeat(rows[:1], 5000)
    p, _, _ = passages({"a": stays_of([rows, far, flood])})
    assert np.isfinite(p.along).all()
    assert len(p) == len(passages({"a": stays_of([rows])})[0]) - 1  # the flood's stay


def test_nobody_drove_where_a_position_jumped() -> None:
    rows = drive(LOW, seconds=60.0)
    rows["x_m"][len(rows) // 2 :] += 30.0
    p, _, _ = passages({"a": stays_of([rows])})
    link = links(p)
    apart = np.hypot(*np.diff(p.place_m, axis=0).T)
    assert len(link.rise_m) == len(p) - 2
    assert apart.max() > 20
