import math

from hypothesis import given
from hypothesis import strategies as st

from mapserver.ingest.snapshot_times import RESTART_SAMPLES, SHARE, SnapshotTimes


def test_a_snapshot_is_due_by_time_or_by_what_a_restart_would_fold():
    times = SnapshotTimes(60.0, 100.0)
    assert (times.due_s(0), times.due_s(RESTART_SAMPLES - 1), times.due_s(RESTART_SAMPLES)) == (160.0, 160.0, 100.0)


def test_none_is_due_while_one_is_written():
    times = SnapshotTimes(60.0, 100.0)
    times.began(160.0)
    assert times.due_s(10 * RESTART_SAMPLES) == math.inf
    times.ended(161.0)
    assert times.due_s(RESTART_SAMPLES) == 161.0 + 1.0 * (1 / SHARE - 1)
    assert times.due_s(0) == 220.0


def test_after_a_failure_nothing_is_tried_for_a_while():
    times = SnapshotTimes(60.0, 0.0)
    times.began(60.0)
    times.ended(60.1, failed=True)
    assert times.due_s(RESTART_SAMPLES) == 120.1


@given(st.lists(st.tuples(st.floats(0.001, 100), st.integers(0, 2 * RESTART_SAMPLES)), min_size=1), st.floats(0.1, 600))
def test_snapshots_never_take_more_than_their_share_of_the_time(snapshots, every_s):
    """Whatever they take, and whatever comes in: counted from when the first one begins."""
    times, now_s, spent_s, first_s = SnapshotTimes(every_s, 0.0), 0.0, 0.0, 0.0
    for took_s, samples in snapshots:
        now_s = max(now_s, times.due_s(samples))
        first_s = first_s if spent_s else now_s
        assert spent_s <= SHARE * (now_s - first_s) * (1 + 1e-9)
        times.began(now_s)
        now_s, spent_s = now_s + took_s, spent_s + took_s
        times.ended(now_s)
