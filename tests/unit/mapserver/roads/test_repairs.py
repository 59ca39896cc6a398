"""Passes over segments, and what is taken for a repair: two passes that agree, and no calibration."""

import numpy as np
import pytest

from mapserver.evidence.fold_config import name_hash
from mapserver.fleet.correction import Correction, corrected
from mapserver.roads.ledger import Ledgers
from mapserver.roads.passes import PassTally
from mapserver.roads.repairs import AGREE, BEFORE, KNOWN_BY, Repair, ages, repairs
from tests.unit.mapserver.roads.drives import START_NS, along, passes, roads

LINE = along([(10, 10), (110, 10)])
MINUTE_NS = 60 * 10**9


def tally_of(machines):
    kept = PassTally()
    for name, rows in machines.items():
        kept.add(rows, np.full(len(rows), name_hash(name), np.uint64))
    return kept


def fleet(values, machines=("a", "b"), noise=0.0):
    """Passes of machines in turn, 150 s apart, each over ground of another resistance."""
    draw = np.random.default_rng(4)
    parts = {name: [] for name in machines}
    for i, c_rr in enumerate(values):
        own = machines[i % len(machines)]
        parts[own].append(passes(LINE, 1, c_rr + draw.normal(0, noise), seed=i, after_s=150.0 * i))
    return {name: np.concatenate(rows) for name, rows in parts.items() if rows}


def shown(machines):
    return repairs(tally_of(machines).passes(Ledgers(roads(*machines.values()))))


def test_a_pass_is_what_a_machine_drove_on_a_segment_within_a_minute():
    machines = fleet([0.02, 0.03, 0.04])
    segments = roads(*machines.values())
    known = tally_of(machines).passes(Ledgers(segments))
    at = segments.ids.index("2_0_e")
    own = known.segment == at
    assert known.c_rr[own] == pytest.approx([0.02, 0.03, 0.04], abs=0.001)
    begun = [(START_NS + round((150 * i + 11) * 1e9)) // MINUTE_NS for i in range(3)]
    assert np.abs(known.minute[own] - begun).max() <= 1
    assert len(set(known.machine[own].tolist())) == 2
    assert known.metres[own] == pytest.approx(25, abs=2)


def test_a_repair_is_seen_after_two_passes():
    repaired, _ = shown(fleet([0.04] * 6 + [0.02] * 4, noise=0.001))
    assert {each.segment for each in repaired} == {0, 1, 2, 3, 4}
    for each in repaired:
        assert (each.before, each.after) == (pytest.approx(0.04, rel=0.1), pytest.approx(0.02, rel=0.1))
        assert each.seen - each.minute <= 3  # the next pass is 150 s later
        assert each.minute == pytest.approx(START_NS // MINUTE_NS + 15, abs=2)


def test_where_zeros_count_three_passes_show_what_two_do_not():
    """On hard ground what is left of a machine's zero is a large share."""
    repaired, _ = shown(fleet([0.016] * 8 + [0.0102] * 4))
    assert {each.segment for each in repaired} == {0, 1, 2, 3, 4}
    assert all(4 <= each.seen - each.minute <= 6 for each in repaired), "the second pass after the first one shows it"
    assert not shown(fleet([0.016] * 8 + [0.0102] * 2 + [0.016] * 2))[0], "two do not"


def test_machines_that_differ_are_each_compared_with_themselves():
    """One machine finds a third more than the other, before and after: noise, where passes are taken together."""
    before, after = [0.036, 0.049], [0.024, 0.033]
    repaired, _ = shown(fleet([*(before * 3), *after, *after]))
    assert {each.segment for each in repaired} == {0, 1, 2, 3, 4}
    assert all(each.seen - each.minute <= 3 for each in repaired)
    assert not shown(fleet(before * 5))[0]


def test_one_odd_pass_is_nothing():
    assert shown(fleet([0.04] * 6 + [0.02] + [0.04] * 4, noise=0.001))[0] == []


def test_ground_that_becomes_worse_is_seen_too():
    repaired, _ = shown(fleet([0.02] * 6 + [0.05] * 3, noise=0.001))
    assert len(repaired) == 5
    assert all(each.after > each.before for each in repaired)


def test_a_second_change_is_compared_with_what_came_after_the_first():
    repaired, _ = shown(fleet([0.06] * 6 + [0.03] * 6 + [0.06] * 3, noise=0.001))
    one = [each for each in repaired if each.segment == 1]
    assert [round(each.after, 2) for each in one] == [0.03, 0.06]


def test_less_than_a_quarter_is_no_change():
    assert shown(fleet([0.040] * 6 + [0.034] * 6))[0] == []


def test_a_segment_has_to_be_known_first():
    repaired, looks = shown(fleet([0.04] * (BEFORE - 1) + [0.02] * AGREE[0]))
    assert repaired == []
    assert looks == 0


def test_one_machine_of_several_is_no_witness():
    """A machine whose zero steps: the others go on as before."""
    values = [0.04] * 6 + [0.02, 0.04, 0.02, 0.04, 0.02]
    assert shown(fleet(values, noise=0.001))[0] == []


def test_where_one_machine_drives_alone_it_has_to_do():
    assert len(shown(fleet([0.04] * 6 + [0.02] * 3, machines=("a",)))[0]) == 5


def test_a_calibration_in_between_is_no_repair():
    """Samples that were sent with a zero of 0.02 until a fact took it off: passes are of samples corrected alike."""
    machines = fleet([0.04] * 12, noise=0.001)
    sent = {name: rows.copy() for name, rows in machines.items()}
    for rows in sent.values():
        rows["c_rr"] += 0.02
    fact = {name: Correction(name, 0, 2**61, 0.02, 0.0, 0.0, ()) for name in sent}
    assert shown(sent)[0] == []
    assert shown({name: corrected(rows, [fact[name]]) for name, rows in sent.items()})[0] == []


def test_a_distrust_in_between_is_no_repair():
    machines = fleet([0.04, 0.07] * 6, noise=0.001)
    assert shown(machines)[0] == []
    assert shown({"a": machines["a"]})[0] == []


def test_order_and_batches_do_not_matter():
    machines = fleet([0.04] * 6 + [0.02] * 4, noise=0.001)
    ledgers, whole = Ledgers(roads(*machines.values())), tally_of(machines)
    pieces = PassTally()
    for name in reversed(list(machines)):
        rows = machines[name][::-1]
        for first in range(0, len(rows), 37):
            part = rows[first : first + 37]
            pieces.add(part, np.full(len(part), name_hash(name), np.uint64))
    for one, other in zip(whole.passes(ledgers), pieces.passes(ledgers), strict=True):
        assert one.tobytes() == other.tobytes()


def test_nothing_driven_is_nothing_repaired():
    assert repairs(PassTally().passes(Ledgers(roads()))) == ([], 0)


def test_ground_that_wears_is_compared_with_the_newest_passes():
    """Half a percent more from pass to pass is no change; over all passes it would hide the repair in the end."""
    worn = [0.02 * 1.005**i for i in range(2 * KNOWN_BY)]
    repaired, looks = shown(fleet([*worn, 0.014, 0.014], noise=0.0))
    assert {each.segment for each in repaired} == {0, 1, 2, 3, 4}
    assert all(each.minute > START_NS // MINUTE_NS + 150 * len(worn) // 60 - 3 for each in repaired)
    assert looks == 5 * (len(worn) + 2 - BEFORE - AGREE[0] + 1)


def cells_of(blocks):
    """Columns and rows of all cells with an age, and the ages."""
    places, begins = [], []
    for (x, y), own in blocks.items():
        at = np.flatnonzero(own)
        places.append(np.stack([16 * x + at % 16, 16 * y + at // 16], axis=1))
        begins.append(own[at])
    return np.concatenate(places), np.concatenate(begins)


@pytest.mark.parametrize("cell_m", [0.5, 1.0, 2.0])
def test_a_change_begins_an_age_of_the_cells_of_its_segment_alone(cell_m):
    beside = along([(10, 16), (110, 16)])
    segments = roads(passes(LINE), passes(beside, seed=1))
    at = segments.ids.index("2_0_e") if "2_0_e" in segments.ids else segments.ids.index("2_0_e.1")
    line = segments.line(at)
    places, begins = cells_of(ages(segments, [Repair(at, 10, 11, 0.04, 0.02)], cell_m))
    middles = (places + 0.5) * cell_m
    assert set(begins.tolist()) == {10 * MINUTE_NS}
    assert np.abs(middles[:, 1] - line[:, 1].mean()).max() <= 3.5
    assert middles[:, 0].min() == pytest.approx(line[:, 0].min(), abs=1.0)
    assert middles[:, 0].max() == pytest.approx(line[:, 0].max(), abs=1.0)
    assert len(places) * cell_m**2 == pytest.approx(25 * 6, rel=0.25)


def test_the_newest_change_of_a_segment_counts_and_none_is_no_age():
    segments = roads(passes(LINE))
    changes = [Repair(1, minute, minute + 1, 0.04, 0.02) for minute in (30, 10)]
    assert set(cells_of(ages(segments, changes, 1.0))[1].tolist()) == {30 * MINUTE_NS}
    assert ages(segments, [], 1.0) == {}
