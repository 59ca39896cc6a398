from dataclasses import replace

import numpy as np
import pytest

from mapserver.ingest.admission import GapError, SeenTime, admit, judge
from protocol.errors import MessageError, Refusal
from tests.unit.mapserver.data import NOW_NS, SITE, batch, now_ns, refused, samples


def numbered(first: int, n: int, **more):
    """A batch whose samples carry their number as their stamp."""
    return batch(samples(n, stamp_ns=np.arange(first, first + n)), first, **more)


def numbers(admission) -> list[int]:
    return admission.batch.rows["stamp_ns"].tolist()


@pytest.mark.parametrize(
    ("first", "n", "watermark", "new", "trimmed"),
    [
        (1, 5, 0, [1, 2, 3, 4, 5], 0),  # the first of all
        (4, 2, 3, [4, 5], 0),  # follows
        (1, 5, 3, [4, 5], 3),  # overlaps
        (1, 5, 5, [], 5),  # a whole duplicate
        (1, 5, 9, [], 5),  # long since there
    ],
)
def test_what_is_there_already_is_trimmed(first, n, watermark, new, trimmed):
    admission = admit(numbered(first, n, lost_before=5 * (first > 1)), watermark)
    assert numbers(admission) == new
    assert (admission.trimmed, admission.lost) == (trimmed, 0)
    assert admission.watermark == max(watermark, first + n - 1)
    if new:
        assert admission.batch.first_seq == new[0]


def judged(sent, machine="a", site=SITE):
    judge(sent, machine, site, now_ns)


def test_a_stamp_ahead_of_the_wall_clock_is_refused_where_the_site_says_so():
    wall = replace(SITE, clock="wall", clock_tolerance_s=2.0)
    at_limit, beyond = (samples(3, stamp_ns=[NOW_NS - 10**12, NOW_NS + ahead, NOW_NS]) for ahead in (2e9, 2.1e9))
    judged(batch(at_limit), site=wall)
    judged(batch(samples(0)), site=wall)
    judged(batch(beyond))  # clock = "data"
    with pytest.raises(MessageError, match=r"2\.1 s ahead") as caught:
        judged(batch(beyond), site=wall)
    assert (caught.value.reason, caught.value.row) == (Refusal.WALL_CLOCK, 1)


DAY = 86_400 * 10**9


@pytest.mark.parametrize("clock", ["data", "wall"])
@pytest.mark.parametrize(
    ("ahead_ns", "seen", "reason"),
    [
        (DAY + 1, SeenTime(), Refusal.FAR_FUTURE),  # a new store
        (73 * 365 * DAY, SeenTime(NOW_NS, NOW_NS + DAY, NOW_NS), Refusal.FAR_FUTURE),  # the year 2099
        (3 * DAY, SeenTime(NOW_NS + DAY, NOW_NS + DAY), Refusal.FAR_FUTURE),  # ahead of all others, too
        (3 * DAY, SeenTime(0, NOW_NS + DAY, NOW_NS), Refusal.FAR_FUTURE),  # its own earlier stamps prove nothing
        (3 * DAY, SeenTime(0, 0, NOW_NS + 1), Refusal.SERVER_CLOCK),  # the server's clock went back
        (3 * DAY, SeenTime(0, NOW_NS + DAY + 1), Refusal.SERVER_CLOCK),
    ],
)
def test_a_stamp_a_day_ahead_of_all_that_is_known_is_refused_with_its_row(clock, ahead_ns, seen, reason):
    sent = batch(samples(3, stamp_ns=[NOW_NS, NOW_NS + ahead_ns, NOW_NS]))
    with pytest.raises(MessageError) as caught:
        judge(sent, "a", replace(SITE, clock=clock), now_ns, lambda machine: {"a": seen}[machine])
    assert (caught.value.reason, caught.value.field, caught.value.row) == (reason, "stamp_ns", 1)


@pytest.mark.parametrize(
    ("ahead_ns", "seen"),
    [
        (DAY, SeenTime()),
        (3 * DAY, SeenTime(NOW_NS + 2 * DAY, NOW_NS + 2 * DAY)),  # as the others say: the server's clock is behind
        (-(10**18), SeenTime()),  # a log of 1994
    ],
)
def test_a_stamp_that_others_bear_out_passes_a_site_that_goes_by_its_data(ahead_ns, seen):
    sent = batch(samples(1, stamp_ns=NOW_NS + ahead_ns))
    judge(sent, "a", SITE, now_ns, lambda _: seen)
    with refused(Refusal.SERVER_CLOCK, "set the server's clock"):
        judge(sent, "a", SITE, lambda: 1)


@pytest.mark.parametrize("lost_before", [0, 1, 2, 5])
def test_a_gap_is_taken_and_counted_where_all_of_it_is_declared_lost(lost_before):
    if lost_before < 2:
        with pytest.raises(GapError, match="sample 4 is expected"):
            admit(numbered(6, 2, lost_before=lost_before), 3)
    else:
        admission = admit(numbered(6, 2, lost_before=lost_before), 3)
        assert (numbers(admission), admission.lost, admission.watermark) == ([6, 7], 2, 7)


@pytest.mark.parametrize(
    ("first", "lost_before", "watermark", "expected"),
    [
        (8, 4, 3, (7, 4)),  # samples 4 to 7 will never come, and none after them
        (8, 9, 3, (7, 4)),  # some of them came before
        (8, 3, 3, (3, 0)),  # 4 is not declared: it may still come
        (4, 3, 3, (3, 0)),
        (2, 1, 3, (3, 0)),
    ],
)
def test_an_empty_batch_declares_samples_lost_that_none_follow(first, lost_before, watermark, expected):
    admission = admit(numbered(first, 0, lost_before=lost_before), watermark)
    assert (admission.watermark, admission.lost) == expected
    assert len(admission.batch.rows) == 0
