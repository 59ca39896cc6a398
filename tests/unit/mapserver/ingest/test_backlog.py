from collections import Counter, defaultdict

from hypothesis import given
from hypothesis import strategies as st

from mapserver.ingest.backlog import GROUP_BATCHES, GROUP_BYTES, MOST_RETRY_S, Backlog, Pace


def filled(batches: str, size: int = 10, limit: int = 10**9) -> Backlog[str]:
    """A backlog with batches named as their machines, numbered."""
    backlog, sent = Backlog(limit), Counter()
    for machine in batches:
        sent[machine] += 1
        backlog.add(machine, size, f"{machine}{sent[machine]}")
    return backlog


def test_who_has_had_a_turn_comes_after_those_who_wait():
    backlog = filled("a" * 2 * GROUP_BATCHES + "b")
    first = backlog.take()
    assert (len(first), first[:3]) == (GROUP_BATCHES, ["a1", "b1", "a2"])
    backlog.add("c", 10, "c1")
    assert backlog.take()[:2] == [f"a{GROUP_BATCHES}", "c1"]


def test_a_group_is_bounded_in_bytes_and_never_empty():
    backlog = filled("abc", GROUP_BYTES // 2)
    assert backlog.take() == ["a1", "b1"]
    assert filled("ab", 2 * GROUP_BYTES).take() == ["a1"]


def test_the_newest_of_the_machine_with_most_bytes_gives_way():
    backlog = filled("aaab", limit=40)
    assert backlog.add("c", 10, "c1") == ["a3"]
    assert backlog.add("c", 10, "c2") == ["c2"]  # as much as anybody has
    assert backlog.add("d", 10, "d1") == ["a2"]
    assert backlog.add("e", 10, "e1") == ["e1"]  # all have one
    assert backlog.take() == ["a1", "b1", "c1", "d1"]


def test_a_batch_larger_than_all_room_is_not_taken_and_takes_nobodys_place():
    backlog = filled("ab", limit=40)
    assert backlog.add("c", 41, "c1") == ["c1"]
    assert backlog.take() == ["a1", "b1"]


@given(
    st.lists(st.tuples(st.sampled_from("abcdef"), st.integers(1, 400)) | st.none(), max_size=300),
    st.integers(400, 2000),
)
def test_nothing_is_lost_double_or_out_of_order_and_the_bytes_stay_below_the_limit(steps, limit):
    backlog, waiting, sizes = Backlog(limit), defaultdict(list), {}
    for number, step in enumerate(steps):
        if step is None:
            for each in backlog.take():
                assert waiting[each[0]].pop(0) == each  # the oldest of its machine
            continue
        machine, size = step
        batch = (machine, number)
        sizes[batch] = size
        own = sum(sizes[each] for each in waiting[machine])
        gone = backlog.add(machine, size, batch)
        if batch not in gone:
            waiting[machine].append(batch)
        for each in gone:
            if each != batch:
                assert each[0] != machine
                assert sum(sizes[one] for one in waiting[each[0]]) > own + size  # of one that had more
                assert waiting[each[0]].pop() == each  # the newest
        left = [each for lane in waiting.values() for each in lane]
        assert (len(backlog), backlog.size) == (len(left), sum(sizes[each] for each in left))
        assert backlog.size <= limit


@given(st.lists(st.sampled_from("abcd"), min_size=1, max_size=60))
def test_no_machine_waits_longer_than_one_turn_of_all_others(batches):
    """However much the others have: before a machine's next batch, none of the others has two."""
    backlog = filled("".join(batches))
    order = backlog.take()
    for i, batch in enumerate(order):
        later = [each[0] for each in order[i + 1 :]]
        if batch[0] in later:
            between = later[: later.index(batch[0])]
            assert max(Counter(between).values(), default=0) <= 1


def test_the_time_until_there_is_room_follows_the_pace():
    pace = Pace()
    for _ in range(100):
        pace.worked(2_000_000, 0.5)
    assert 0.9 < pace.retry_after_s(4_000_000) < 1.1
    pace.worked(1, 0.0)  # a clock that stood still
    assert pace.retry_after_s(10**12) == MOST_RETRY_S
