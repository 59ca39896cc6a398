from hypothesis import given
from hypothesis import strategies as st

from mapserver.ingest.snapshot_times import RESTART_SAMPLES, SHARE, SnapshotTimes


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
