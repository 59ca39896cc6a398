"""The segment ledger: exact sums by hour and direction in any order; trends and losses of known ground."""

from dataclasses import fields, replace

import numpy as np
import pytest

from mapserver.evidence.fold_config import name_hash
from mapserver.roads.ledger import Ledgers, _places
from mapserver.roads.loss import Losses, losses
from mapserver.roads.tally import PER_C, PER_M, TALLY, Tally, place
from mapserver.roads.worklist import ranked, theil_sen
from protocol.units import GRAVITY_MPS2
from tests.unit.mapserver.roads.drives import along, passes, roads

LINE = along([(10, 10), (210, 10)])
BACK = LINE[::-1]


def add(kept, rows, name):
    kept.add(rows, np.full(len(rows), name_hash(name), np.uint64))


def tally_of(*machines, **options):
    out = Tally(**options)
    for i, rows in enumerate(machines):
        add(out, rows, f"truck-{i}")
    return out


def ledger_of(*machines, **times):
    kept = tally_of(*machines)
    ledgers = Ledgers(roads(*machines))
    return ledgers.ledger(kept.table(), kept.slot_ns, **times), ledgers.segments


def test_sums_are_those_of_the_samples():
    rows = passes(LINE, 3)
    rows["mass_kg"][::3] = np.nan
    rows["c_rr"][::5] = rows["c_rr_var"][::5] = np.nan
    table = tally_of(rows).table()
    metres = np.rint(rows["distance_m"].astype(float) * PER_M)
    known, weighed = np.isfinite(rows["c_rr"]), np.isfinite(rows["mass_kg"])
    assert table["metres"].sum() == metres.sum()
    assert table["measured"].sum() == metres[known].sum()
    assert table["weighed"].sum() == metres[weighed].sum()
    assert table["kg"].sum() == (metres * 40_000)[weighed].sum()
    assert table["c"].sum() == (metres * np.rint(rows["c_rr"].astype(float) * PER_C))[known].sum()


@pytest.mark.parametrize("places", [4000, 9000])  # many of them share a slot; beyond the first size of the table
def test_rows_of_a_place_find_each_other(places):
    rows = np.zeros(3 * places, TALLY)
    for seed in range(8):
        rows["key"] = np.tile(np.random.default_rng(seed).integers(0, 2**40, places), 3)
        which, numbers = _places(rows)
        assert len(set(numbers.tolist())) == len(numbers)
        np.testing.assert_array_equal(numbers[which], place(rows["key"]))


def test_the_oldest_hours_are_forgotten_whatever_the_order():
    parts = [passes(LINE, 1, seed=i, after_s=3600.0 * i) for i in range(6)]
    tables = []
    for order in (range(6), range(5, -1, -1), (3, 0, 5, 1, 4, 2)):
        kept = Tally(slots=3)
        for i in order:
            add(kept, parts[i], "a")
            kept.table()
        tables.append(kept.table().tobytes())
    assert len(set(tables)) == 1
    assert kept.table()["metres"].sum() == sum(tally_of(part).table()["metres"].sum() for part in parts[3:])


@pytest.mark.parametrize("sign", [1, -1])
def test_there_and_back_are_told_apart_ahead_and_in_reverse(sign):
    there, back = passes(LINE, 4), passes(BACK, 2, seed=1)
    for rows in (there, back):
        rows["speed_mps"] *= sign
    ledger, segments = ledger_of(there, back)
    passed = ledger.totals()["metres"][1:-1] / PER_M / segments.length_m[1:-1, None]
    assert passed[:, ::sign] == pytest.approx(np.tile([4.0, 2.0], (len(passed), 1)), rel=0.06)
    assert ledger.placed == 1.0


def test_the_mean_is_over_places_not_over_what_was_measured():
    rows = passes(LINE, 8)
    bad = (rows["x_m"] > 100) & (rows["x_m"] < 115)
    rows["c_rr"][bad] = 0.08
    rows["c_rr"][bad & (np.arange(len(rows)) % 8 > 0)] = np.nan
    rows["c_rr_var"][np.isnan(rows["c_rr"])] = np.nan
    ledger, segments = ledger_of(rows)
    at = segments.ids.index("4_0_e")
    assert losses(ledger, segments, 0.02).c_rr[at] == pytest.approx(0.056, rel=0.1)


def test_work_lost_is_mass_times_gravity_times_way_times_excess():
    ledger, segments = ledger_of(passes(LINE, 10, c_rr=0.05))
    lost = losses(ledger, segments, 0.02)
    metres = ledger.totals()["metres"].sum() / PER_M
    assert lost.work_j.sum() == pytest.approx(40_000 * GRAVITY_MPS2 * metres * 0.03, rel=0.01)
    assert (lost.low_j < lost.work_j).all()
    assert (lost.work_j < lost.high_j).all()
    assert not lost.guessed.any()
    assert losses(ledger_of(passes(LINE, 4, mass_kg=np.nan))[0], segments, 0.02).guessed.all()
    assert losses(ledger, segments, 0.08).work_j.sum() == 0.0


def test_a_descent_that_brakes_anyway_costs_nothing():
    rows, up = passes(LINE, 10, c_rr=0.05), passes(BACK, 10, c_rr=0.05, seed=1)
    for each in (rows, up):
        each["grade_e"], each["grade_n"], each["grade_var"] = -0.1, 0.0, 1e-4
    down, segments = ledger_of(rows)
    assert losses(down, segments, 0.02).work_j.sum() == 0.0
    both, segments = ledger_of(rows, up)
    ascent = both.totals()["metres"][:, 1].sum() / PER_M
    assert losses(both, segments, 0.02).work_j.sum() == pytest.approx(40_000 * GRAVITY_MPS2 * ascent * 0.03, rel=0.02)


def test_one_day_of_rain_is_no_trend():
    assert theil_sen(np.arange(7), np.array([0.02, 0.02, 0.02, 0.09, 0.02, 0.02, 0.02])) == 0.0


def test_traffic_where_no_road_is_belongs_to_none():
    ledgers = Ledgers(roads(passes(along([(0, 0), (2, 0)]))))
    assert not len(ledgers.segments.ids)
    kept = tally_of(passes(LINE))
    assert not len(ledgers.ledger(kept.table(), kept.slot_ns).rows)


def test_losses_that_nearly_equal_the_highest_of_their_rank_tie():
    work_j = np.array([94.9, 100.0, 90.0, 95.1, 80.0, 86.0]) * 1e6
    losses_of = Losses(**{field.name: work_j for field in fields(Losses)})
    assert ranked(replace(losses_of, low_j=np.where(work_j == 80e6, -1.0, 1.0))).rank.tolist() == [1, 1, 3, 3, 5]
