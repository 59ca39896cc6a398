"""Which checkpoints there should be."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapserver.past.plan import DAY_NS, GRACE_NS, HOUR_NS, due, surplus, thinned

DAY = 20_000 * DAY_NS


def next_stamp(*stamps: int):
    return lambda from_ns: min((stamp for stamp in stamps if stamp >= from_ns), default=None)


def at(days: float, hours: float = 0.0) -> int:
    return DAY + round(days * DAY_NS) + round(hours * HOUR_NS)


@pytest.mark.parametrize(
    ("now", "usable", "stamps", "expected"),
    [
        (at(0, 9.5), [], [at(0, 8.2)], at(0, 9)),  # the first full hour after the first sample
        (at(0, 9), [], [at(0, 8.2)], None),  # an hour is over when its latest samples have come in
        (at(0, 9) + GRACE_NS, [], [at(0, 8.2)], at(0, 9)),
        (at(0, 9) + GRACE_NS - 1, [], [at(0, 8.2)], None),
        (at(0, 12.5), [at(0, 9)], [at(0, 8.2), at(0, 11.1)], at(0, 12)),  # none for an hour without samples
        (at(0, 12.5), [at(0, 9)], [at(0, 9)], at(0, 10)),  # a stamp at a full hour belongs to the next one
        (at(0, 12.5), [at(0, 9)], [at(0, 9) - 1], None),
        (at(3, 12.5), [], [at(0, 8.2), at(1, 9)], at(1)),  # what is older than a day, by days
        (at(3, 12.5), [at(1)], [at(0, 8.2), at(1, 9)], at(2)),
        (at(3, 12.5), [at(0, 18)], [at(2, 13)], at(2, 14)),  # within the last day, by hours
        (at(3, 12.5), [at(0, 18)], [at(2, 12.4)], at(2, 13)),
        (at(3, 12.5), [at(0, 18)], [at(2, 11)], at(2, 12)),  # the hours after it are made as well
        (at(0, 9.5), [], [], None),
    ],
)
def test_hours_of_the_last_day_and_days_before(now, usable, stamps, expected):
    assert due(now, usable, [], next_stamp(*stamps)) == expected


def test_what_cannot_be_used_is_made_again_oldest_first():
    stamps = next_stamp(*range(at(0), at(1, 12), HOUR_NS))
    assert due(at(1, 12), [at(0, 20)], [at(1, 3), at(0, 10)], stamps) == at(0, 10)
    assert due(at(1, 12), [at(0, 10), at(0, 20)], [at(1, 3)], stamps) == at(1, 3)
    assert due(at(1, 12), [at(1, 11)], [at(1, 12)], stamps) is None, "not over yet"


def test_one_in_the_future_was_closed_by_a_wrong_clock():
    assert surplus(at(0, 12), [at(0, 11), at(5)]) == [at(5)]


@given(
    st.lists(st.tuples(st.integers(0, 2000), st.integers(1, 100)), unique_by=lambda pair: pair[0]), st.integers(0, 999)
)
def test_room_is_made_within_the_limit_and_the_newest_goes_last(pairs, most):
    sizes = {at(0, hour): size for hour, size in pairs}
    gone = thinned(at(0), at(0, 2001), sizes, most)
    kept = set(sizes) - set(gone)
    assert sum(sizes[each] for each in kept) <= most
    assert len(gone) == len(set(gone))
    if kept:
        assert max(sizes) in kept
    if gone:
        assert sum(sizes[each] for each in [*kept, gone[-1]]) > most, "one too many was removed"


def test_steps_grow_with_age():
    days = [at(day) for day in range(100)]
    gone = thinned(at(0, -8), at(100), dict.fromkeys(days, 1), 20)
    kept = sorted(set(days) - set(gone))
    steps = [(later - earlier) / DAY_NS for earlier, later in pairwise(kept)]
    assert steps[-1] == 1
    assert max(steps[:4]) > 3 * max(steps[-4:])
    relative = [step / (100 - (closed - DAY) / DAY_NS) for step, closed in zip(steps, kept, strict=False)]
    assert max(relative[:-3]) < 0.3
