"""Passes over segments, and detected repairs: two agreeing passes."""

import numpy as np
import pytest

from mapserver.evidence.fold_config import name_hash
from mapserver.roads.ledger import Ledgers
from mapserver.roads.passes import PassTally
from mapserver.roads.repair_facts import NO_REPAIRS
from mapserver.roads.repairs import TUNING, Repair, Strips, repairs, since
from tests.unit.mapserver.roads.drives import START_NS, along, passes, roads

LINE = along([(10, 10), (110, 10)])
MINUTE_NS = 60 * 10**9


def tally_of(machines):
    kept = PassTally()
    for name, rows in machines.items():
        kept.add(rows, np.full(len(rows), name_hash(name), np.uint64))
    return kept


def fleet(values, machines=("a", "b"), noise=0.0):
    """Machines' passes in turn, 150 s apart, each with its resistance."""
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


WORSE, SIX = [0.02] * 6 + [0.05] * 3, [0.04] * 6
HARD = [0.016] * 8 + [0.0102] * 4  # the residual zero of a machine is a large share here
BEFORE_BOTH, AFTER_BOTH = [0.036, 0.049], [0.024, 0.033]  # one machine measures a third more


@pytest.mark.parametrize(
    ("values", "machines", "minutes"),
    [
        ([*SIX, *[0.02] * 4], "ab", (2, 3)),  # next pass after 150 s
        (WORSE, "ab", (2, 3)),
        (HARD, "ab", (4, 6)),  # three passes show it
        ([*BEFORE_BOTH * 3, *AFTER_BOTH * 2], "ab", (2, 3)),
        ([*SIX, *[0.02] * 3], "a", (2, 3)),
    ],
    ids=["better", "worse", "hard ground", "machines that differ", "one machine"],
)
def test_a_change_is_seen_once_passes_agree(values, machines, minutes):
    repaired, _ = shown(fleet(values, machines, noise=0.0001))
    begins = next(i for i, c_rr in enumerate(values) if abs(c_rr / values[i % len(machines)] - 1) > 0.25)
    assert {each.segment for each in repaired} == {0, 1, 2, 3, 4}
    for each in repaired:
        assert each.before == pytest.approx(np.mean(values[:begins]), rel=0.1)
        assert each.after == pytest.approx(np.mean(values[begins:]), rel=0.1)
        assert minutes[0] <= (each.seen_ns - each.first_ns) / MINUTE_NS - 1 <= minutes[1]
        assert each.first_ns / MINUTE_NS == pytest.approx(START_NS // MINUTE_NS + 2.5 * begins, abs=2)
        assert each.known_ns / MINUTE_NS == pytest.approx(START_NS // MINUTE_NS, abs=1)


@pytest.mark.parametrize(
    ("values", "machines"),
    [
        ([*SIX, 0.02, *[0.04] * 4], "ab"),
        ([*SIX, 0.02, 0.04, 0.02, 0.04, 0.02], "ab"),
        (BEFORE_BOTH * 5, "ab"),
        ([*HARD[:10], *HARD[:2]], "ab"),
        ([*SIX, *[0.034] * 6], "ab"),
        ([*[0.04] * (TUNING.least_known - 1), *[0.02] * TUNING.least_agree], "ab"),
    ],
    ids=["one odd pass", "one machine", "machines that differ", "two passes", "less than a quarter", "hardly known"],
)
def test_what_is_no_change(values, machines):
    assert shown(fleet(values, machines, noise=0.0001))[0] == []


def test_a_second_change_is_compared_with_what_came_after_the_first():
    machines = fleet([0.06] * 6 + [0.03] * 6 + [0.06] * 3, noise=0.001)
    repaired, _ = shown(machines)
    one = [each for each in repaired if each.segment == 1]
    assert [round(each.after, 2) for each in one] == [0.03, 0.06]
    assert one[1].known_ns == one[0].first_ns
    passed = tally_of(machines).passes(Ledgers(roads(*machines.values())))
    later, _ = repairs(since(passed, one[:1]))
    assert [each for each in later if each.segment == 1] == one[1:], "as if the earlier passes were forgotten"
    assert [each for each in later if each.segment == 2] == [each for each in repaired if each.segment == 2]


def test_ground_that_wears_is_compared_with_the_newest_passes():
    """Wear of 0.5 % per pass is no change; averaged over all passes it would finally hide the repair."""
    worn = [0.02 * 1.005**i for i in range(2 * TUNING.most_known)]
    repaired, looks = shown(fleet([*worn, 0.014, 0.014], noise=0.0))
    assert {each.segment for each in repaired} == {0, 1, 2, 3, 4}
    assert all(each.first_ns // MINUTE_NS > START_NS // MINUTE_NS + 150 * len(worn) // 60 - 3 for each in repaired)
    assert looks == 5 * (len(worn) + 2 - TUNING.least_known - TUNING.least_agree + 1)


def cells_of(blocks):
    """Column and row of all cells with an age, and the ages."""
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
    strips, minutes = Strips(segments, cell_m), [at_minute * MINUTE_NS for at_minute in (10, 5)]
    located = strips.located([Repair(at, 1, first_ns, first_ns + 1, 0.04, 0.02) for first_ns in minutes], 2**60)
    assert [repair.segment for repair in strips.placed(located)] == [at, at]
    places, begins = cells_of(NO_REPAIRS.after(located).ages)
    middles = (places + 0.5) * cell_m
    assert set(begins.tolist()) == {10 * MINUTE_NS}, "of the newest change"
    assert np.abs(middles[:, 1] - line[:, 1].mean()).max() <= 3.5
    assert middles[:, 0].min() == pytest.approx(line[:, 0].min(), abs=1.0)
    assert middles[:, 0].max() == pytest.approx(line[:, 0].max(), abs=1.0)
    assert len(places) * cell_m**2 == pytest.approx(25 * 6, rel=0.25)
