from hypothesis import given
from hypothesis import strategies as st

from mapserver.journal.rows import MachineTotals, Progress, Watermark

MARKS = st.builds(Watermark, st.integers(0, 50), st.integers(0, 50), st.integers(0, 9))


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(1, 3), MARKS)))
def test_totals_of_machines_are_the_sums_over_their_spools(puts):
    """However watermarks move; a newest stamp never goes back."""
    progress, newest = Progress({}), {}
    for machine, spool_id, watermark in puts:
        progress.put(machine, spool_id, watermark)
        newest[machine] = max(newest.get(machine, 0), watermark.newest_ns)
    marks = progress.watermarks()
    expected = {}
    for machine in newest:
        own = [mark for (name, _), mark in marks.items() if name == machine]
        lost = sum(mark.lost for mark in own)
        expected[machine] = MachineTotals(len(own), sum(mark.seq for mark in own) - lost, lost, newest[machine])
    assert progress.machines() == expected
    assert progress.samples == sum(totals.samples for totals in expected.values())
    assert marks == {(machine, spool_id): mark for machine, spool_id, mark in puts}


def test_totals_begin_with_what_is_on_disk():
    marks = {("a", 1): Watermark(10, 2, 5), ("a", 2): Watermark(7, 0, 3), ("b", 1): Watermark(1, 1, 0)}
    assert Progress(marks).machines() == {"a": MachineTotals(2, 15, 2, 5), "b": MachineTotals(1, 0, 1, 0)}
    assert (Progress(marks).watermark("a", 2), Progress(marks).watermark("c", 2)) == (Watermark(7, 0, 3), Watermark())
